"""Fields in and out of files: exact in fp32, rounded in fp16, and a sentence for what does not fit."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.occupancy import OccupancyGrid, contracted_cascades
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import load_gaze, load_radiance, save_gaze, save_radiance
from nerg_mi.maths.geometry import Box, ContractedBox

GRID = HashGridConfig(levels=2, log2_rows=8, base=4, finest=16)
BOX = Box((-1, 0, 2), (3, 2, 4))


def radiance(resolution=5):
    bits = np.random.default_rng(0).random((resolution,) * 3) < 0.2
    return RadianceField.random(
        RadianceConfig(GRID, width=16, color_hidden=1, geometry=3, sh_degree=2, density_scale=7.0),
        BOX,
        ns,
        1,
        occupancy=OccupancyGrid(bits, ns, 0.25),
        color_space="linear",
        march_step=0.01,
    )


def gaze():
    return GazeField.random(GazeConfig(GRID, "capture", "exp", width=16, geometry=3, sh_degree=3), BOX, ns, 2)


def arrays(field):
    return {k: v.numpy() for k, v in field.parameters().items()}


def rewrite(path, change):
    """Write the file again after ``change(tensors, metadata)``."""
    with safe_open(path, framework="numpy") as f:
        tensors, meta = {k: f.get_tensor(k) for k in f.keys()}, json.loads(f.metadata()["nerg"])
    change(tensors, meta)
    save_file(tensors, path, metadata={"nerg": json.dumps(meta)})


@pytest.mark.parametrize("half", [False, True])
def test01_radiance_round_trip(tmp_path, half):
    field, path = radiance(), tmp_path / "f.safetensors"
    save_radiance(field, path, {"dataset": "fox", "seconds": 12.5}, half=half)
    again, meta = load_radiance(path, ns)
    assert again.config == field.config and again.box == field.box
    assert (again.color_space, again.march_step) == ("linear", 0.01)
    assert np.array_equal(again.occupancy.bits, field.occupancy.bits) and again.occupancy.threshold == 0.25
    assert meta["provenance"] == {"dataset": "fox", "seconds": 12.5} and meta["units"]["density"] == "1 / scene unit"
    for k, v in arrays(field).items():
        assert np.array_equal(arrays(again)[k], v.astype(np.float16).astype(np.float32) if half else v), k
        assert arrays(again)[k].dtype == np.float32
    if not half:
        p = ns.Array3f(1, 1, 3)
        assert field.density(p).numpy()[0] == again.density(p).numpy()[0] > 0


@pytest.mark.parametrize("half", [False, True])
def test02_gaze_round_trip(tmp_path, half):
    field, path = gaze(), tmp_path / "g.safetensors"
    save_gaze(field, path, {}, half=half)
    again, meta = load_gaze(path, ns)
    assert again.config == field.config and again.box == field.box and meta["units"]["gaze"] == "1 / steradian"
    for k, v in arrays(field).items():
        assert np.array_equal(arrays(again)[k], v.astype(np.float16).astype(np.float32) if half else v), k


def test02b_what_a_gaze_field_rests_on(tmp_path):
    """Read of what its training says of itself, and of nothing where that says nothing."""
    for about, words in (({"rays": 300, "people": 7}, "300 rays of 7 people"), ({"rays": -3}, None), ({}, None)):
        save_gaze(gaze(), tmp_path / "g.safetensors", about)
        basis = load_gaze(tmp_path / "g.safetensors", ns)[0].basis
        assert (None if basis is None else basis.words()) == words


def test02c_a_deferred_field(tmp_path):
    made = RadianceField.random(RadianceConfig(GRID, width=16, deferred=True), Box((-1, -1, -1), (1, 1, 1)), ns)
    save_radiance(made, tmp_path / "f.safetensors", {})
    assert load_radiance(tmp_path / "f.safetensors", ns)[0].config.deferred
    save_radiance(radiance(), tmp_path / "g.safetensors", {})
    assert "deferred" not in load_radiance(tmp_path / "g.safetensors", ns)[1]["architecture"]


def test03_without_occupancy_and_step(tmp_path):
    field = RadianceField.random(RadianceConfig(GRID, width=16), BOX, ns)
    save_radiance(field, tmp_path / "f", {})
    again, _ = load_radiance(tmp_path / "f", ns)
    assert again.occupancy is None and again.march_step is None and again.color_space == "srgb"


def test04_the_other_kind(tmp_path):
    save_gaze(gaze(), tmp_path / "g", {})
    with pytest.raises(ValueError, match="holds a gaze field"):
        load_radiance(tmp_path / "g", ns)
    save_radiance(radiance(), tmp_path / "f", {})
    with pytest.raises(ValueError, match="holds a radiance field"):
        load_gaze(tmp_path / "f", ns)


NAMES = ["grid.table", "density_net.0", "color_net.1", "occupancy.bits"]
GAZE_NAMES = ["grid.table", "position_net.1", "direction_net.0", "emit_head.0", "capture_head.0"]


@pytest.mark.parametrize(
    "kind, name", [*(("radiance", name) for name in NAMES), *(("gaze", name) for name in GAZE_NAMES)]
)
def test05_missing_tensors_are_named(tmp_path, kind, name):
    path = tmp_path / "f.safetensors"
    (save_radiance if kind == "radiance" else save_gaze)(radiance() if kind == "radiance" else gaze(), path, {})
    rewrite(path, lambda tensors, meta: tensors.pop(name))
    with pytest.raises(ValueError, match=name) as e:
        (load_radiance if kind == "radiance" else load_gaze)(path, ns)
    assert "f.safetensors" in str(e.value)


@pytest.mark.parametrize("name", NAMES)
def test07_tensors_of_the_wrong_shape(tmp_path, name):
    path = tmp_path / "f.safetensors"
    save_radiance(radiance(), path, {})
    rewrite(path, lambda tensors, meta: tensors.update({name: tensors[name][:1].copy()}))
    with pytest.raises(ValueError) as e:
        load_radiance(path, ns)
    assert "f.safetensors" in str(e.value)


@pytest.mark.parametrize("key", ["architecture", "box", "color_space"])
def test08_missing_metadata(tmp_path, key):
    path = tmp_path / "f.safetensors"
    save_radiance(radiance(), path, {})
    rewrite(path, lambda tensors, meta: meta.pop(key))
    with pytest.raises(ValueError, match=key) as e:
        load_radiance(path, ns)
    assert "f.safetensors" in str(e.value)


def test09_an_architecture_of_a_later_version(tmp_path):
    path = tmp_path / "f.safetensors"
    save_radiance(radiance(), path, {})
    rewrite(path, lambda tensors, meta: meta["architecture"].update(novelty=3))
    with pytest.raises(ValueError, match="novelty"):
        load_radiance(path, ns)


def test10_weights_that_are_not_finite_are_refused(tmp_path):
    # fp16 ends at 65504: half=True would store infinity in silence.
    field = radiance()
    field.set_parameters({"color_net.1": field.color_net.weights[1] * 1e6})
    with pytest.raises(ValueError, match="color_net.1"):
        save_radiance(field, tmp_path / "f", {}, half=True)


@pytest.mark.parametrize(
    "path, value",
    [
        (("architecture", "grid", "levels"), 10**9),
        (("architecture", "width"), 10**9),
        (("architecture", "color_hidden"), 10**9),
        (("architecture", "grid", "log2_rows"), 60),
        (("architecture", "grid", "finest"), 1e300),
        (("architecture", "sh_degree"), 2.5),
        (("architecture", "grid", "base"), True),
        (("architecture", "geometry"), "15"),
        (("architecture", "grid"), [1]),
        (("architecture",), 3),
        (("box", "lower"), "here"),
        (("box",), None),
        (("occupancy", "resolution"), 10**6),
        (("occupancy", "resolution"), -1),
        (("occupancy", "bound"), 1e300),
        (("march_step",), 0),
        (("march_step",), "x"),
        (("march_step",), float("nan")),
        (("provenance",), [1]),
        (("color_space",), {}),
    ],
)
def test_sizes_are_checked_before_anything_is_built(tmp_path, path, value):
    save_radiance(radiance(), tmp_path / "f", {})

    def change(tensors, meta):
        *way, last = path
        for key in way:
            meta = meta[key]
        meta[last] = value

    rewrite(tmp_path / "f", change)
    with pytest.raises(NergError, match='"[^"]*/f"'):
        load_radiance(tmp_path / "f", ns)


@pytest.mark.parametrize(
    "name, shape", [("grid.table", (4,)), ("density_net.0", (3, 5)), ("color_net.0", (7,)), ("color_net.1", ())]
)
def test_arrays_must_have_the_shapes_of_the_architecture(tmp_path, name, shape):
    save_radiance(radiance(), tmp_path / "f", {})
    rewrite(tmp_path / "f", lambda tensors, meta: tensors.update({name: np.zeros(shape, np.float32)}))
    with pytest.raises(NergError, match=f'"{name}" has the shape'):
        load_radiance(tmp_path / "f", ns)


def test_cascades_that_float32_cannot_address_are_refused():
    from nerg_mi.fields.occupancy import CascadeGrid

    with pytest.raises(ValueError, match="cells along an edge"):
        CascadeGrid(np.zeros((25, 2, 2, 2), bool), 2.0**24, ns, 0.0)


def test_a_place_without_an_end(tmp_path):
    box, r = ContractedBox(Box((-1, 0, 2), (3, 2, 4)), 8), 8
    field = RadianceField.random(
        RadianceConfig(GRID, width=16, color_hidden=1, geometry=3, sh_degree=2),
        box,
        ns,
        1,
        occupancy=contracted_cascades(np.random.default_rng(0).random((r, r, r)) < 0.2, 8.0, ns, 0.25),
        march_step=0.01,
        march_growth=1 / 128,
    )
    path = tmp_path / "f.safetensors"
    save_radiance(field, path, {})
    again, meta = load_radiance(path, ns)
    assert again.box == box and again.march_growth == 1 / 128 and meta["box"]["reach"] == 8
    assert np.array_equal(again.occupancy.bits, field.occupancy.bits) and again.occupancy.bound == 8
    p = ns.Array3f(np.random.default_rng(1).uniform(-14, 14, (3, 100)).astype(np.float32))
    assert np.array_equal(again.density(p).numpy(), field.density(p).numpy())
    attention = GazeField.random(GazeConfig(GRID, width=16, geometry=3, sh_degree=3), box, ns, 2)
    save_gaze(attention, path, {})
    assert load_gaze(path, ns)[0].box == box


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m["box"].update(reach=3),
        lambda m: m["box"].update(reach="far"),
        lambda m: m.update(march_growth=2),
        lambda m: m.update(march_growth=None),
    ],
)
def test_a_place_without_an_end_that_makes_no_sense(tmp_path, change):
    path = tmp_path / "f.safetensors"
    save_radiance(radiance(), path, {})
    rewrite(path, lambda _, m: change(m))
    with pytest.raises(NergError, match=path.name):
        load_radiance(path, ns)


@pytest.mark.parametrize("value", [1e30, 81.0, 1e5])
def test_a_blind_density_that_single_precision_cannot_hold_is_refused(tmp_path, value):
    save_gaze(LogGazeField.random(LogGazeConfig(GRID, prior=4), BOX, ns), tmp_path / "g.safetensors", {})
    load_gaze(tmp_path / "g.safetensors", ns)
    rewrite(tmp_path / "g.safetensors", lambda tensors, meta: tensors["prior"].fill(value))
    with pytest.raises(NergError, match='g.safetensors.*"prior".*80'):
        load_gaze(tmp_path / "g.safetensors", ns)


@pytest.mark.parametrize("far", [1.1e7, 1e30, 1e308])
def test_a_box_beyond_all_places_is_refused(tmp_path, far):
    save_gaze(gaze(), tmp_path / "g.safetensors", {})
    rewrite(tmp_path / "g.safetensors", lambda tensors, meta: meta["box"].update(upper=[far, far, far]))
    with pytest.raises(NergError, match="two finite corners of 3 numbers within"):
        load_gaze(tmp_path / "g.safetensors", ns)
