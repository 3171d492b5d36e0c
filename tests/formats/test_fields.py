"""Tests of `nerg_mi.formats.fields`."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import max_sizes_of
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, cascades_from_contracted
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.formats.fields import (
    MAX_GRID_RESOLUTION,
    MAX_OCCUPANCY_CELLS,
    MAX_WEIGHT,
    StoredArrays,
    check_occupancy,
    check_sizes,
    load_gaze,
    load_radiance,
    read_number,
    save_gaze,
    save_radiance,
    to_stored_arrays,
    translate_build_errors,
)
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.tracking.rays import Rays
from tests.conftest import ROOT
from tests.evaluation import gaze_fields

# ---- Sizes in checkpoints: within limits, or an error that names the file ----

GRID = {"levels": 2, "features": 2, "log2_rows": 8, "base": 4, "finest": 16, "dimensions": 3}


def test_valid_sizes_pass_unchanged():
    config = {"grid": GRID, "width": 4096, "density_hidden": 1, "geometry": 15, "other": "kept"}
    assert check_sizes(config) is config
    assert check_sizes({"grid": {"kind": "hashgrid", **GRID}})


def test_each_kind_of_gaze_field_has_its_own_bounds():
    """The entry "geometry" of a log density is not a size."""
    product, log = {"geometry": "surface"}, {"kind": "log_density", "geometry": "surface", "layers": 2}
    assert check_sizes(log, limits=max_sizes_of(log)) is log
    for config, name in ((product, "geometry"), ({**log, "layers": 65}, "layers"), ({**log, "prior": 0}, "prior")):
        with pytest.raises(ValueError, match=f'"{name}" of its architecture must be a whole number'):
            check_sizes(config, limits=max_sizes_of(config))
    assert (
        not max_sizes_of({"kind": "wavelet"})
        and not max_sizes_of({"kind": ["product"]})
        and not max_sizes_of("product")
    )


@pytest.mark.parametrize(
    "config, words",
    [
        ([1], '"architecture"'),
        ({"width": 0}, '"width".*1.*4096.*0'),
        ({"width": True}, "not True"),
        ({"width": 2.0}, "not 2.0"),
        ({"width": 10**99}, r"\.\.\."),
        ({"grid": {**GRID, "levels": 65}}, '"levels".*1.*64'),
        ({"grid": {**GRID, "finest": MAX_GRID_RESOLUTION + 1}}, '"finest"'),
        ({"grid": {**GRID, "finest": float("nan")}}, "must be a finite number"),
        ({"grid": "fine"}, '"grid"'),
        ({"grid": {**GRID, "kind": "octree"}}, "'octree'"),
    ],
)
def test_sizes_out_of_bounds_are_named(config, words):
    with pytest.raises(ValueError, match=words):
        check_sizes(config)


def test_numbers_must_be_finite_and_not_boolean():
    assert read_number({"a": 2}, "a", "thing") == 2
    for wrong in ({"a": True}, {"a": "2"}, {"a": float("inf")}, {"a": None}, [2]):
        with pytest.raises(ValueError, match='"a"'):
            read_number(wrong, "a", "thing")


def test_occupancy_size_is_limited():
    config = {"resolution": 400, "threshold": 0.5}
    assert check_occupancy(config) is config
    check_occupancy({**config, "resolution": 128, "bound": 16.0})
    for wrong in ({"resolution": 407}, {"resolution": 2.0}, {"resolution": 128, "bound": 2.0**40}):
        with pytest.raises(ValueError, match=f"{MAX_OCCUPANCY_CELLS:,} cells in total"):
            check_occupancy({**config, **wrong})


@pytest.mark.parametrize("error", [KeyError("box"), ValueError("x"), TypeError("x"), OverflowError("x")])
def test_build_errors_name_file(error):
    with pytest.raises(
        NergError, match='the checkpoint "a.safetensors" (contains no usable field: (it lacks .box.|x))'
    ) as e:
        with translate_build_errors("a.safetensors"):
            raise error
    assert e.value.__cause__ is error


def test_nerg_errors_and_bugs_pass():
    error = NergError("as it is")
    with pytest.raises(NergError) as e, translate_build_errors("a"):
        raise error
    assert e.value is error
    with pytest.raises(ZeroDivisionError), translate_build_errors("a"):
        _ = 1 / 0


# ---- Conversion between arrays of checkpoints and parts of fields ----

ARRAYS_GRID = HashGridConfig(levels=1, log2_rows=3, base=1, finest=1)


def test_arrays_are_float32_with_required_shape():
    arrays = StoredArrays({"a": np.ones((2, 3), np.float16), "n": np.array([1, np.nan]), "big": np.array([1e300])}, ns)
    array = arrays.get_array("a", 2, None)
    assert array.dtype == np.float32 and array.ctypes.data % 64 == 0
    assert arrays.get_raw("a").dtype == np.float16
    for shape in ((3, 2), (2,), (2, 3, 1)):
        with pytest.raises(ValueError, match='"a".*2.*3'):
            arrays.get_array("a", *shape)
    for name, size in (("n", 2), ("big", 1)):
        with pytest.raises(ValueError, match=f'"{name}" is not finite'):
            arrays.get_array(name, size)
    with pytest.raises(KeyError, match="b"):
        arrays.get_array("b", 1)


@pytest.mark.parametrize("value, largest", [(1e30, MAX_WEIGHT), (-1.1e6, MAX_WEIGHT), (81.0, 80.0)])
def test_values_whose_products_single_precision_cannot_hold_are_refused(value, largest):
    arrays = StoredArrays({"a": np.array([0.0, value])}, ns)
    with pytest.raises(ValueError, match=f'"a" contains values beyond {largest:g}'.replace("+", ".")):
        arrays.get_array("a", 2, max_value=largest)
    assert arrays.get_array("a", 2, max_value=2 * abs(value)).shape == (2,)


def test_networks_and_encodings():
    net = MLP.random([3, 4, 2], ns, np.random.default_rng(0), normalized=True)
    (size,) = ARRAYS_GRID.parameter_shapes()["table"]
    tensors = {f"net.{k}": v.numpy() for k, v in net.named().items()} | {"grid.table": np.arange(size, dtype="f4")}
    arrays = StoredArrays(tensors, ns)
    again = arrays.build_network("net", [3, 4, 2], normalized=True)
    assert all(np.array_equal(again.named()[k].numpy(), v.numpy()) for k, v in net.named().items())
    assert arrays.build_network("net", [3, 4, 2]).norms is None
    assert arrays.build_grid(ARRAYS_GRID).table.numpy().tolist() == list(range(size))
    with pytest.raises(ValueError, match='"grid.table" has shape'):
        arrays.build_grid(HashGridConfig(levels=2, log2_rows=3, base=1, finest=2))


def test_members_have_own_names():
    arrays = StoredArrays({"0.a": np.zeros(1), "1.a": np.ones(1), "10.a": np.full(1, 10)}, ns)
    architecture, member = arrays.get_member(1, {"width": 4})
    assert architecture == {"width": 4} and member.get_array("a", 1).tolist() == [1]
    with pytest.raises(ValueError, match="width"):
        arrays.get_member(0, {"width": 0})


def test_stored_weights_are_finite():
    values = {"a": ns.Float([1.0, 70000.0])}
    assert to_stored_arrays(values, False)["a"].dtype == np.float32
    with pytest.raises(NergError, match='"a".*fp16.*half'):
        to_stored_arrays(values, True)
    with pytest.raises(NergError, match='"a" is not finite.*diverged'):
        to_stored_arrays({"a": ns.Float([np.inf])}, False)
    with pytest.raises(NergError, match='"a".*06'):
        to_stored_arrays({"a": ns.Float([-2e6])}, True)
    assert to_stored_arrays({"a": ns.TensorXf(np.ones((2, 2), np.float32))}, True)["a"].dtype == np.float16


# ---- Fields in files: exact in fp32, rounded in fp16, and errors for invalid files ----

FIELDS_GRID = HashGridConfig(levels=2, log2_rows=8, base=4, finest=16)
BOX = Box((-1, 0, 2), (3, 2, 4))


def make_radiance(resolution=5):
    bits = np.random.default_rng(0).random((resolution,) * 3) < 0.2
    return RadianceNetwork.random(
        RadianceConfig(FIELDS_GRID, width=16, color_hidden=1, geometry=3, sh_degree=2, density_scale=7.0),
        BOX,
        ns,
        1,
        occupancy=OccupancyGrid(bits, ns, 0.25),
        color_space="linear",
        march_step=0.01,
    )


def make_gaze():
    return ProductHead.random(GazeConfig(FIELDS_GRID, "capture", "exp", width=16, geometry=3, sh_degree=3), BOX, ns, 2)


def arrays(field):
    return {k: v.numpy() for k, v in field.parameters().items()}


def rewrite(path, change):
    """Write the file again after ``change(tensors, metadata)``."""
    with safe_open(path, framework="numpy") as f:
        tensors, meta = {k: f.get_tensor(k) for k in f.keys()}, json.loads(f.metadata()["nerg"])
    change(tensors, meta)
    save_file(tensors, path, metadata={"nerg": json.dumps(meta)})


@pytest.mark.parametrize("half", [False, True])
def test01_fields_round_trip(tmp_path, half):
    path, provenance = tmp_path / "f.safetensors", {"dataset": "fox", "seconds": 12.5}
    rounded = lambda v: v.astype(np.float16).astype(np.float32) if half else v
    for made, save, load in ((make_radiance(), save_radiance, load_radiance), (make_gaze(), save_gaze, load_gaze)):
        save(made, path, provenance, half=half)
        again, meta = load(path, ns)
        assert again.config == made.config and again.box == made.box and meta["provenance"] == provenance
        for k, v in arrays(made).items():
            assert np.array_equal(arrays(again)[k], rounded(v)) and arrays(again)[k].dtype == np.float32, k
        unit = {"density": "1 / scene unit"} if save is save_radiance else {"gaze": "1 / steradian"}
        assert unit.items() <= meta["units"].items()


def test02_optional_parts_of_radiance_fields(tmp_path):
    field = make_radiance()
    save_radiance(field, tmp_path / "f", {})
    again, meta = load_radiance(tmp_path / "f", ns)
    assert (again.color_space, again.march_step) == ("linear", 0.01) and "deferred" not in meta["architecture"]
    assert np.array_equal(again.occupancy.bits, field.occupancy.bits) and again.occupancy.threshold == 0.25  # noqa: RUF069 (stored)
    p = ns.Array3f(1, 1, 3)
    assert field.density(p).numpy()[0] == again.density(p).numpy()[0] > 0
    save_radiance(
        RadianceNetwork.random(RadianceConfig(FIELDS_GRID, width=16, deferred=True), BOX, ns), tmp_path / "f", {}
    )
    again, _ = load_radiance(tmp_path / "f", ns)
    assert again.occupancy is None and again.march_step is None and again.color_space == "srgb"
    assert again.config.deferred


def test02a_fields_of_poor_quality_are_named_once(tmp_path, monkeypatch):
    import mitsuba as mi

    lines = []
    monkeypatch.setattr(mi, "Log", lambda level, line: lines.append(line))
    for quality, count in (("usable", 0), ("poor", 1), ("poor", 1)):
        save_radiance(make_radiance(), tmp_path / f"{quality}.safetensors", {"quality": quality})
        load_radiance(tmp_path / f"{quality}.safetensors", ns)
        assert len(lines) == count
    assert "poor.safetensors" in lines[0]


def test02b_support_and_provenance_of_gaze_fields(tmp_path):
    """Read from the provenance of the training; None without it."""
    for metadata, words in (
        ({"rays": 300, "people": 7}, "300 rays of 7 participants"),
        ({"rays": -3}, None),
        ({}, None),
    ):
        save_gaze(make_gaze(), tmp_path / "g.safetensors", metadata)
        basis = load_gaze(tmp_path / "g.safetensors", ns)[0].basis
        assert (None if basis is None else basis.words()) == words


def test02c_reaimed_hits_of_gaze_fields(tmp_path):
    """Stored exactly, also with fp16 weights; damaged ones are refused in a sentence."""
    path, rng = tmp_path / "g.safetensors", np.random.default_rng(0)
    field = gaze_fields.made("default recipe", BOX)
    field.hits = ReaimedHits(*rng.normal(size=(2, 9, 3)), [HitKernel(0.25, 0.4, 60.0), HitKernel(0.1, 2.0, 9.0)])
    save_gaze(field, path, {}, half=True)
    hits = load_gaze(path, ns)[0].hits
    assert hits.kernels == field.hits.kernels
    assert np.array_equal(hits.origins, field.hits.origins) and np.array_equal(hits.points, field.hits.points)
    for change, message in (
        (without("hits.points"), "lacks"),
        (array("hits.points", (8, 3)), "one point for each"),
        (array("hits.origins", (9, 2)), "has shape"),
        (metadata(2.0, "hits", "kernels", 0, 0), "weight"),
        (metadata("near", "hits", "kernels", 0, 1), "bandwidth"),
        (metadata(0, "hits", "kernels", 0, 2), "concentration"),
        (metadata([0.5, 1.0], "hits", "kernels", 0), "no usable field"),
        (metadata([], "hits", "kernels"), "1 to 64 kernels"),
        (metadata(3, "hits", "kernels"), "must be a list"),
        (metadata([], "hits"), "no usable field"),
    ):
        tensors, meta = read_checkpoint(path, "gaze")
        change(tensors, meta)
        write_checkpoint(tmp_path / "h.safetensors", "gaze", tensors, meta)
        with pytest.raises(NergError, match=message):
            load_gaze(tmp_path / "h.safetensors", ns)


def test02d_reaimed_hits_of_earlier_versions_have_one_kernel(tmp_path):
    path = gaze_fields.saved(tmp_path / "g.safetensors", "re-aimed hits", BOX) and tmp_path / "g.safetensors"
    tensors, meta = read_checkpoint(path, "gaze")
    meta["hits"] = {"weight": 0.25, "bandwidth": 0.4, "kappa": 60.0}
    write_checkpoint(path, "gaze", tensors, meta)
    assert load_gaze(path, ns)[0].hits.kernels == (HitKernel(0.25, 0.4, 60.0),)


RADIANCE_NAMES = ("grid.table", "density_net.0", "color_net.1", "occupancy.bits")
GAZE_NAMES = ("grid.table", "position_net.1", "direction_net.0", "emit_head.0", "capture_head.0")


def without(name):
    return lambda tensors, meta: tensors.pop(name)


def array(name, shape):
    return lambda tensors, meta: tensors.update({name: np.zeros(shape, np.float32)})


def metadata(value, *path):
    def change(tensors, meta):
        *keys, last = path
        for key in keys:
            meta = meta[key]
        meta[last] = value

    return change


DAMAGE = [
    *((without(name), name) for name in RADIANCE_NAMES),
    *((lambda _, meta, key=key: meta.pop(key), key) for key in ("architecture", "box", "color_space")),
    (lambda tensors, _: tensors.update({"occupancy.bits": tensors["occupancy.bits"][:1].copy()}), ""),
    (array("grid.table", (4,)), '"grid.table" has shape'),
    (array("density_net.0", (3, 5)), '"density_net.0" has shape'),
    (array("color_net.0", (7,)), '"color_net.0" has shape'),
    (array("color_net.1", ()), '"color_net.1" has shape'),
    (metadata(3, "architecture", "novelty"), "novelty"),
    (metadata(10**9, "architecture", "grid", "levels"), "levels"),
    (metadata(10**9, "architecture", "width"), "width"),
    (metadata(10**9, "architecture", "color_hidden"), "color_hidden"),
    (metadata(60, "architecture", "grid", "log2_rows"), "log2_rows"),
    (metadata(1e300, "architecture", "grid", "finest"), "finest"),
    (metadata(2.5, "architecture", "sh_degree"), "sh_degree"),
    (metadata(True, "architecture", "grid", "base"), "base"),
    (metadata("15", "architecture", "geometry"), "geometry"),
    (metadata([1], "architecture", "grid"), "grid"),
    (metadata(3, "architecture"), "architecture"),
    (metadata("here", "box", "lower"), ""),
    (metadata(None, "box"), ""),
    (metadata(3, "box", "reach"), ""),
    (metadata("far", "box", "reach"), ""),
    *((metadata([far] * 3, "box", "upper"), "two finite corners of 3 numbers") for far in (1.1e7, 1e30, 1e308)),
    (metadata(10**6, "occupancy", "resolution"), "resolution"),
    (metadata(-1, "occupancy", "resolution"), "resolution"),
    (metadata(1e300, "occupancy", "bound"), ""),
    (metadata(0, "march_step"), "march_step"),
    (metadata("x", "march_step"), "march_step"),
    (metadata(float("nan"), "march_step"), "march_step"),
    (metadata(2, "march_growth"), "march_growth"),
    (metadata(None, "march_growth"), "march_growth"),
    (metadata([1], "provenance"), "provenance"),
    (metadata({}, "color_space"), ""),
]


@pytest.mark.parametrize("change, said", DAMAGE)
def test_damaged_radiance_fields_are_refused_before_anything_is_built(tmp_path, change, said):
    save_radiance(make_radiance(), tmp_path / "f.safetensors", {})
    rewrite(tmp_path / "f.safetensors", change)
    with pytest.raises(NergError, match=f"f.safetensors.*{said}"):
        load_radiance(tmp_path / "f.safetensors", ns)


@pytest.mark.parametrize(
    "change, said",
    [
        *((without(name), name) for name in GAZE_NAMES),
        (metadata([1e30] * 3, "box", "upper"), "two finite corners of 3 numbers"),
    ],
)
def test_damaged_gaze_fields_are_refused(tmp_path, change, said):
    save_gaze(make_gaze(), tmp_path / "g.safetensors", {})
    rewrite(tmp_path / "g.safetensors", change)
    with pytest.raises(NergError, match=f"g.safetensors.*{said}"):
        load_gaze(tmp_path / "g.safetensors", ns)


def test_cascades_that_float32_cannot_address_are_refused():
    with pytest.raises(ValueError, match="cells along an edge"):
        CascadeGrid(np.zeros((25, 2, 2, 2), bool), 2.0**24, ns, 0.0)


def test_contracted_box_round_trips(tmp_path):
    box, r = ContractedBox(Box((-1, 0, 2), (3, 2, 4)), 8), 8
    field = RadianceNetwork.random(
        RadianceConfig(FIELDS_GRID, width=16, color_hidden=1, geometry=3, sh_degree=2),
        box,
        ns,
        1,
        occupancy=cascades_from_contracted(np.random.default_rng(0).random((r, r, r)) < 0.2, 8.0, ns, 0.25),
        march_step=0.01,
        march_growth=1 / 128,
    )
    path = tmp_path / "f.safetensors"
    save_radiance(field, path, {})
    again, meta = load_radiance(path, ns)
    assert again.box == box and again.march_growth == 1 / 128 and meta["box"]["reach"] == 8  # noqa: RUF069 (stored)
    assert np.array_equal(again.occupancy.bits, field.occupancy.bits) and again.occupancy.bound == 8
    p = ns.Array3f(np.random.default_rng(1).uniform(-14, 14, (3, 100)).astype(np.float32))
    assert np.array_equal(again.density(p).numpy(), field.density(p).numpy())
    attention = ProductHead.random(GazeConfig(FIELDS_GRID, width=16, geometry=3, sh_degree=3), box, ns, 2)
    save_gaze(attention, path, {})
    assert load_gaze(path, ns)[0].box == box


@pytest.mark.parametrize("value", [1e30, 81.0, 1e5])
def test_a_prior_that_single_precision_cannot_hold_is_refused(tmp_path, value):
    save_gaze(LogGazeField.random(LogGazeConfig(FIELDS_GRID, prior=4), BOX, ns), tmp_path / "g.safetensors", {})
    load_gaze(tmp_path / "g.safetensors", ns)
    rewrite(tmp_path / "g.safetensors", lambda tensors, meta: tensors["prior"].fill(value))
    with pytest.raises(NergError, match='g.safetensors.*"prior".*80'):
        load_gaze(tmp_path / "g.safetensors", ns)


# ---- Files of earlier versions ----
#
# ``files/`` contains one file of each kind in the first format, written by version 0.1, and ``expected.json``, the
# values of these fields in that version. Files of later formats are added and do not replace these.


FILES = ROOT / "tests" / "formats" / "files"
EXPECTED = json.loads((FILES / "expected.json").read_text(encoding="utf-8"))
POINTS, DIRECTIONS, OBSERVERS = (
    ns.Array3f(np.array(EXPECTED[k], np.float32).T) for k in ("points", "directions", "observers")
)
GAZE = ("product", "layernorm", "log_density", "ensemble")


def metadata_of(path):
    with safe_open(path, framework="numpy") as f:
        return json.loads(f.metadata()["nerg"])


@pytest.mark.parametrize("name, occupancy", [("radiance", OccupancyGrid), ("cascades", CascadeGrid)])
def test_radiance_fields(name, occupancy):
    field, _ = load_radiance(FILES / f"{name}.safetensors", ns)
    expected = EXPECTED[name]
    sigma, features = field.density_features(POINTS)
    assert np.allclose(sigma.numpy(), expected["density"], rtol=1e-4) and np.max(expected["density"]) > 0.1
    color = np.stack([c.numpy() for c in field.color(features, DIRECTIONS)], 1)
    assert np.allclose(color, expected["color"], atol=1e-4)
    assert isinstance(field.occupancy, occupancy) and field.occupancy.occupied_fraction == pytest.approx(
        expected["occupied"]
    )
    if name == "radiance":
        behind = np.stack([c.numpy() for c in field.background(OBSERVERS, DIRECTIONS)], 1)
        assert np.allclose(behind, expected["background"], atol=1e-4)


@pytest.mark.parametrize("name", GAZE)
def test_gaze_fields(name):
    field, _ = load_gaze(FILES / f"{name}.safetensors", ns)
    members = field.members if name == "ensemble" else [field]
    assert len(members) == len(EXPECTED[name]["unnormalized"])
    for member, expected in zip(members, EXPECTED[name]["unnormalized"]):
        emit, capture = member.unnormalized(POINTS, OBSERVERS, DIRECTIONS)
        assert np.allclose((emit * capture).numpy(), expected, rtol=1e-4, atol=1e-6)
    if "support" in EXPECTED[name]:
        # In that version, kernels ended at the radius.
        field.support.cutoff = field.support.radius
        loaded = [field.support.evaluate(ns.Array3f(*p))[0] for p in EXPECTED["observers"]]
        assert np.allclose(loaded, EXPECTED[name]["support"], rtol=1e-4) and max(loaded) >= 1
    else:
        assert field.support is None


@pytest.mark.parametrize("suffix", ["npz", "parquet"])
def test_rays(suffix):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    rays, expected = Rays.load(FILES / f"rays.{suffix}"), EXPECTED["rays"]
    assert rays.t.tolist() == expected["t"] and rays.person.tolist() == expected["person"]
    assert list(rays.persons) == expected["persons"] and rays.cohorts == ("one", "two")
    assert np.allclose(rays.origin, EXPECTED["observers"]) and np.allclose(rays.hit, EXPECTED["points"])
    assert np.allclose(rays.direction, EXPECTED["directions"], atol=1e-6)


def test_fields_of_store():
    field, metadata = load_radiance(ROOT / "scenes" / "store" / "store.safetensors", ns)
    assert metadata["format"] == 1 and field.occupancy is not None and np.isfinite(field.density(POINTS).numpy()).all()
    gaze, metadata = load_gaze(ROOT / "scenes" / "store" / "shoppers.safetensors", ns)
    assert metadata["format"] == 1 and np.isfinite(gaze.unnormalized(POINTS, OBSERVERS, DIRECTIONS)[0].numpy()).all()


@pytest.mark.parametrize("name", ["radiance", "cascades", *GAZE])
def test_field_is_stored_unchanged(tmp_path, name):
    """Metadata and arrays survive loading and saving, so that earlier versions can read the new file."""
    old, new = FILES / f"{name}.safetensors", tmp_path / "new.safetensors"
    load, save = (load_gaze, save_gaze) if name in GAZE else (load_radiance, save_radiance)
    field, metadata = load(old, ns)
    save(field, new, metadata["provenance"], half=name in ("cascades", "layernorm", "ensemble"))
    assert metadata_of(new) == metadata_of(old)
    with safe_open(old, framework="numpy") as a, safe_open(new, framework="numpy") as b:
        assert list(a.keys()) == list(b.keys())
        assert all(np.array_equal(a.get_tensor(k), b.get_tensor(k)) for k in a.keys())
