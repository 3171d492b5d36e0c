"""torch-ngp checkpoints of realistic size, compared with a reference implementation of its kernels in NumPy float32."""

import sys
import types
from enum import Enum
from pathlib import Path

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import load_gaze, load_radiance, save_gaze, save_radiance
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.formats.torch_ngp import (
    ImportOptions,
    StateDict,
    build_network,
    describe_origin,
    infer_grid_config,
    infer_sh_degree,
    make_torch_ngp,
    morton_order,
    open_checkpoint,
    pack_bitfield,
    read_nerg,
    read_torch_ngp,
    shorten_floats,
)
from nerg_mi.maths.geometry import Box
from tests.reference import torch_ngp_numpy as reference

pytestmark = pytest.mark.usefixtures("torch")

PARITY = 1e-6


def save(path, state, **entries):
    write_torch(path, {"epoch": 7, "global_step": 99, "stats": {}, "model": state, **entries})
    return path


def points(bound, n=4000, seed=3):
    """Points inside, on the faces and edges, and slightly outside."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-1.02 * bound, 1.02 * bound, (n, 3)).astype(np.float32)
    p[: n // 10] = np.clip(p[: n // 10] * 3, -bound, bound)
    d = rng.normal(size=(n, 3))
    return p, (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def columns(values):
    values = list(values)
    dr.eval(values)  # one kernel for all columns
    return np.stack([v.numpy() for v in values], -1)


def max_error(got, expected):
    """Largest difference relative to the largest value."""
    return np.abs(np.asarray(got, np.float64) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("bound, behind", [(1, False), (2, True), (5, True)])
def test01_equals_reference_implementation(tmp_path, bound, behind):
    state = reference.nerf_state(bound, np.random.default_rng(bound), behind)
    options = ImportOptions(background_radius=3.0 * bound if behind else None)
    field, origin = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns, options=options)
    p, d = points(bound)
    at, along = ns.Array3f(p.T), ns.Array3f(d.T)

    # A kernel contains the grid only once; with a bound of 5, the last bit of a coordinate affects the result.
    ours = field.grid(field.box.to_unit(at)) if bound == 5 else []
    density, geometry = field.density_features(at)
    painted = field.color(geometry, along)
    dr.eval(ours, density, painted)
    if bound == 5:
        features = reference.encode(p, state["encoder.embeddings"], state["encoder.offsets"], 2048 * bound, bound)
        assert max_error(columns(ours), features) <= PARITY
    sigma, color, _ = reference.nerf(state, bound, p, d)
    inside = np.all(np.abs(p) <= bound, axis=1)
    assert 0 < (~inside).sum() < len(p)
    got = density.numpy()
    # The exponential converts an absolute error of its argument, here about 8, to a relative error.
    assert np.abs(got[inside] / sigma[inside] - 1).max() <= 2 * np.abs(np.log(sigma)).max() * PARITY
    assert not got[~inside].any()
    assert np.abs(columns(painted) - color).max() <= PARITY
    if behind:
        o = np.clip(p, -bound, bound)
        shown = columns(field.background(ns.Array3f(o.T), along))
        # The last bit of an angle is 4e-4 cells of the finest level, which also depends on the machine's atan2.
        assert np.abs(shown - reference.background(state, 3.0 * bound, o, d)).max() <= 1e-3
        angles = columns(field.background.coordinates(ns.Array3f(o.T), along))
        features = reference.encode(angles, state["encoder_bg.embeddings"], state["encoder_bg.offsets"], 2048, 1)
        square = ns.Array2f(*[0.5 * ns.Float(a) + 0.5 for a in angles.T])
        assert max_error(columns(field.background.grid(square)), features) <= PARITY
    assert origin["epoch"] == 7 and origin["weights"] == "raw"
    assert field.march_step == pytest.approx(2 * 3**0.5 / 1024)


def test05_export_and_import_is_exact(tmp_path, torch):
    for bound, behind in ((1, False), (2.7, True)):
        state = reference.nerf_state(bound, np.random.default_rng(6), behind)
        first = save(tmp_path / "ngp.pth", state)
        field, origin = read_torch_ngp(first, ns, options=ImportOptions(background_radius=10.0))
        save_radiance(field, tmp_path / "f.safetensors", origin)
        again, meta = load_radiance(tmp_path / "f.safetensors", ns)
        assert meta["provenance"]["imported_from"] == "ngp.pth" and again.box == field.box
        make_torch_ngp(again).save(tmp_path / "back.pth")
        back = torch.load(tmp_path / "back.pth", weights_only=True)
        assert set(back["model"]) == set(state)
        for name, value in state.items():
            assert np.array_equal(back["model"][name].numpy(), value), name
            assert back["model"][name].numpy().dtype == value.dtype


def test08_bare_state_dict_and_smaller_box(tmp_path):
    state = reference.nerf_state(2, np.random.default_rng(9))
    state["aabb_infer"] = np.array([-1, -2, -0.5, 2, 1.5, 2], np.float32)
    write_torch(tmp_path / "bare.pth", state)
    field, _ = read_torch_ngp(tmp_path / "bare.pth", ns)
    assert field.box == Box((-1, -2, -0.5), (2, 1.5, 2), 2.0)
    p = np.array([[-0.9, 0.3, 0.4], [-1.1, 0.3, 0.4]], np.float32)
    sigma, _, _ = reference.nerf(state, 2, p, np.array([[0, 0, 1.0]] * 2))
    assert np.allclose(field.density(ns.Array3f(p.T)).numpy(), [sigma[0], 0], rtol=1e-5)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda s: s.pop("sigma_net.1.weight"), "numbers, which does not match spherical harmonics"),
        (lambda s: s.pop("aabb_train"), 'lacks "aabb_train"'),
        (lambda s: s.update({"aabb_train": s["aabb_train"] / 2}), "do not match a bound"),
        (lambda s: s.update({"aabb_infer": np.array([0, 1e-44, 2e-44, 1.5e-36, 0])}), "do not match a bound"),
        (lambda s: s.update({"aabb_train": np.linspace(0, 1e-30, 10_000)}), "do not match a bound"),
        (lambda s: s.update({"encoder.offsets": s["encoder.offsets"] + 8}), "start at rows .*finest"),
        (lambda s: s.update({"color_net.0.bias": np.zeros(64, np.float32)}), "layers without biases"),
        (lambda s: s.update({"color_net.0.weight": np.zeros((64, 30), np.float32)}), "not match spherical harmonics"),
        (lambda s: s.update({"color_net.2.weight": np.full((3, 64), np.nan, np.float32)}), "not finite.*diverged"),
        (lambda s: s.update({"density_bitfield": np.zeros(5, np.uint8)}), "40 density bits"),
        (lambda s: s.update({"encoder.params": np.zeros(5, np.float32)}), "tcnn"),
        (lambda s: s.update({"bg_net.0.weight": np.zeros((64, 24), np.float32)}), "bg_radius"),
    ],
)
def test09_invalid_checkpoints_are_refused(tmp_path, change, words):
    state = small_state()
    change(state)
    with pytest.raises(ValueError, match=words) as e:
        read_torch_ngp(save(tmp_path / "wrong.pth", state), ns)
    assert "\n" not in str(e.value) and len(str(e.value)) < 600


def small_state():
    """A state dictionary with the required names and a grid of only two levels."""
    rng = np.random.default_rng(0)
    where = reference.offsets(2, 2048)
    return {
        "aabb_train": np.array([-1, -1, -1, 1, 1, 1], np.float32),
        "encoder.embeddings": reference.table(where[-1], rng),
        "encoder.offsets": where,
        "sigma_net.0.weight": reference.matrix(rng, 64, 4),
        "sigma_net.1.weight": reference.matrix(rng, 16, 64),
        "color_net.0.weight": reference.matrix(rng, 64, 31),
        "color_net.1.weight": reference.matrix(rng, 64, 64),
        "color_net.2.weight": reference.matrix(rng, 3, 64),
    }


def test10_grid_of_other_resolution(tmp_path):
    state = small_state()
    where = reference.offsets(2, 4096)
    state["encoder.offsets"] = where
    # Two levels: 17^3 and a hashed one, regardless of the finest resolution.
    field, _ = read_torch_ngp(save(tmp_path / "a.pth", state), ns, options=ImportOptions(finest=4096))
    assert field.config.grid == HashGridConfig(levels=2, finest=4096)


@pytest.mark.parametrize(
    "config, box, said",
    [
        (
            RadianceConfig(HashGridConfig(levels=2, log2_rows=8, base=4, finest=16), width=16),
            Box((0, 0, 0), (1, 2, 3)),
            "its unit",
        ),
        (RadianceConfig(HashGridConfig(), deferred=True), Box((-1,) * 3, (1,) * 3), "torch-ngp evaluates"),
    ],
)
def test11_unrepresentable_fields_are_refused(tmp_path, config, box, said):
    field = RadianceNetwork.random(config, box, ns)
    with pytest.raises(ValueError, match=f"cannot represent this field: {said}"):
        make_torch_ngp(field).save(tmp_path / "x.pth")
    assert not list(tmp_path.iterdir())


# ---- NeRG checkpoints ----


def save_nerg(path, state, variant="EmitCapture", nerf=None, **entries):
    state = {**state, **{f"model_nerf.{k}": v for k, v in (nerf or {}).items()}}
    write_torch(path, {"epoch": 2, "global_step": 5, "stats": {}, "variant": variant, "model": state, **entries})
    return path


def queries(bound, n=2000):
    rng = np.random.default_rng(1)
    p_od, p_o = (rng.uniform(-1.01 * bound, 1.01 * bound, (n, 3)).astype(np.float32) for _ in range(2))
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o, axis=1, keepdims=True)
    return p_od, p_o, r_o.astype(np.float32)


def small_gaze(layernorm=True, variant="EmitCapture"):
    """A gaze field with the networks of the authors on a grid of two levels."""
    rng = np.random.default_rng(3)
    state = reference.gaze_state(1, rng, variant, layernorm)
    where = reference.offsets(2, 256)
    state |= {"encoder.embeddings": reference.table(where[-1], rng), "encoder.offsets": where}
    first = "net1.lin0.weight" if layernorm else "net1.0.weight"
    state[first] = reference.matrix(rng, 64, 4)
    if layernorm:
        state |= {"net1.layernorm0.weight": np.ones(4, np.float32), "net1.layernorm0.bias": np.zeros(4, np.float32)}
    return state


def compare(gaze, state, bound, variant="EmitCapture"):
    q = queries(bound)
    got = gaze.evaluate(*[ns.Array3f(x.T) for x in q])
    dr.eval(got)
    for a, b in zip(got, reference.gaze(state, bound, *q, variant)):
        assert np.abs(a.numpy() - b).max() <= 2e-6 * max(np.abs(b).max(), 1)


@pytest.mark.parametrize("bound", [2, 5])
def test01_nerg_equals_reference_implementation(tmp_path, bound):
    state = reference.gaze_state(bound, np.random.default_rng(bound))
    field, gaze, origin = read_nerg(save_nerg(tmp_path / "nerg_ep0002.pth", state), ns)
    assert field is None and origin["format"] == "NeRG" and origin["epoch"] == 2
    assert (gaze.config.trunk, gaze.config.activation, gaze.config.variant) == ("layernorm", "linear", "emit_capture")
    save_gaze(gaze, tmp_path / "g.safetensors", origin)
    again, _ = load_gaze(tmp_path / "g.safetensors", ns)
    assert again.config == gaze.config and again.box == gaze.box
    compare(again, state, bound)


@pytest.mark.parametrize("layernorm", [True, False])
@pytest.mark.parametrize("variant", ["Emit", "Capture", "EmitCapture"])
def test02_variants_and_network_types(tmp_path, layernorm, variant):
    state = small_gaze(layernorm, variant)
    _, gaze, _ = read_nerg(save_nerg(tmp_path / "n.pth", state, variant), ns)
    assert gaze.config.trunk == ("layernorm" if layernorm else "linear")
    compare(gaze, state, 1, variant)
    _, unnamed, _ = read_nerg(save_nerg(tmp_path / "n.pth", state, None), ns)
    assert unnamed.config == gaze.config


def test03_older_head_names(tmp_path):
    state = small_gaze()
    for head in ("emit", "capture"):
        state[f"lin_{head}.weight"] = state.pop(f"{head}_head.weight")
    _, gaze, _ = read_nerg(save_nerg(tmp_path / "n.pth", state), ns)
    assert np.array_equal(gaze.emit_head.weights[0].numpy(), state["lin_emit.weight"])
    assert np.array_equal(gaze.capture_head.weights[0].numpy(), state["lin_capture.weight"])


def test04_checkpoint_with_custom_enum(tmp_path, torch, monkeypatch):
    class NeRGVariant(Enum):
        EmitCapture = "EmitCapture"

        def __new__(cls, name):
            obj = object.__new__(cls)
            obj._value_, obj.emit = name, True
            return obj

    module = types.ModuleType("nerg.gaze_prediction")
    NeRGVariant.__module__, NeRGVariant.__qualname__, module.NeRGVariant = module.__name__, "NeRGVariant", NeRGVariant
    monkeypatch.setitem(sys.modules, "nerg", types.ModuleType("nerg"))
    monkeypatch.setitem(sys.modules, "nerg.gaze_prediction", module)
    state = {**small_gaze(), **{f"model_nerf.{k}": v for k, v in small_state().items()}}
    torch.save(
        {
            "epoch": 1,
            "global_step": 4,
            "stats": {},
            "variant": NeRGVariant.EmitCapture,
            "model": {k: torch.tensor(v) for k, v in state.items()},
        },
        tmp_path / "nerg_ep0001.pth",
    )
    monkeypatch.delitem(sys.modules, "nerg.gaze_prediction")
    monkeypatch.delitem(sys.modules, "nerg")
    field, gaze, _ = read_nerg(tmp_path / "nerg_ep0001.pth", ns)
    assert gaze.config.variant == "emit_capture" and field.config.width == 64
    assert np.array_equal(field.color_net.weights[2].numpy(), state["model_nerf.color_net.2.weight"])
    assert "nerg.gaze_prediction" not in sys.modules


@pytest.mark.parametrize("variant", ["EmitCaptureSemantic", "EmitSemanticFinetune", "EmitCaptureAttend"])
def test05_unsupported_variants_are_refused(tmp_path, variant):
    with pytest.raises(ValueError, match=f"the variant {variant}; Emit, Capture, EmitCapture are supported"):
        read_nerg(save_nerg(tmp_path / "n.pth", small_gaze(), variant), ns)


def test06_mixture_head_and_missing_heads_are_refused(tmp_path):
    state = small_gaze()
    state["capture_head.mu.weight"] = state.pop("capture_head.weight")
    with pytest.raises(ValueError, match="von Mises-Fisher"):
        read_nerg(save_nerg(tmp_path / "n.pth", state), ns)
    del state["capture_head.mu.weight"]
    with pytest.raises(ValueError, match="EmitCapture but lacks"):
        read_nerg(save_nerg(tmp_path / "n.pth", state), ns)


def test07_averages_replace_weights(tmp_path):
    path = save_nerg(tmp_path / "n.pth", small_gaze(), ema={"shadow_params": [np.zeros(3, np.float32)]})
    assert read_nerg(path, ns)[2]["weights"] == "moving averages"
    with pytest.raises(ValueError, match="without ema=False"):
        read_nerg(path, ns, ema=False)
    with pytest.raises(ValueError, match="with ema=False"):
        read_nerg(save_nerg(tmp_path / "n.pth", small_gaze()), ns, ema=True)


# ---- Occupancy ----


@pytest.mark.parametrize("bound", [1, 2, 5, 2.7])
def test_marching_uses_bits_of_reference_kernel(tmp_path, bound):
    rng = np.random.default_rng(4)
    state = reference.nerf_state(bound, rng, filled=0.02)
    field, _ = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns)
    p = rng.uniform(-bound, bound, (20000, 3)).astype(np.float32)
    k = field.occupancy.distance_to_occupied(field.box.to_unit(ns.Array3f(p.T))).numpy()
    # Rounding may place points near a cell face on either side; 128 is the resolution, 0.5 b the largest cell.
    cells = (p[:, :, None] / np.minimum(2.0 ** np.arange(4), bound) + 1) * 64
    clear = np.abs(cells - np.round(cells)).min((1, 2)) > 1e-4
    assert clear.mean() > 0.95
    assert np.array_equal((k == 0)[clear], reference.occupied(state["density_bitfield"], bound, p)[clear])
    assert np.isclose(field.occupancy.occupied_fraction, 0.02, rtol=0.05)


@pytest.mark.parametrize("bound", [2, 5])
def test_skipped_cells_are_empty(tmp_path, bound):
    # Cells of the marching grid within a distance of k are empty.
    rng = np.random.default_rng(5)
    state = reference.nerf_state(bound, rng, filled=2e-6)
    grid = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns)[0].occupancy
    p = rng.uniform(-bound, bound, (3000, 3)).astype(np.float32)
    u = ((p + bound) / (2 * bound)).astype(np.float32)
    k, n = grid.distance_to_occupied(ns.Array3f(u.T)).numpy().astype(int), grid.cells[0]
    assert (k > 20).mean() > 0.3 and n == 128 * bound
    low = np.floor(u.astype(np.float64) * n) - (k[:, None] - 1)
    for _ in range(40):
        inside = (low + rng.random((len(p), 3)) * (2 * k[:, None] - 1)) / n
        inside = np.clip(inside, 1e-6, 1 - 1e-6)
        q = ((inside * 2 - 1) * bound).astype(np.float32)
        assert not reference.occupied(state["density_bitfield"], bound, q)[k > 0].any()


def test_morton_order():
    z, y, x = np.indices((128, 128, 128)).reshape(3, -1)
    assert np.array_equal(morton_order(), reference.morton(x, y, z))


def test_density_grid_without_bitfield(tmp_path):
    rng = np.random.default_rng(8)
    state = reference.nerf_state(1, rng)
    bits = np.unpackbits(state["density_bitfield"], bitorder="little").astype(bool)
    state["density_grid"] = np.where(bits, 5 + rng.random(bits.size), rng.random(bits.size) - 0.5).astype(np.float32)[
        None
    ]
    expected = read_torch_ngp(save(tmp_path / "a.pth", state), ns)[0].occupancy
    assert 0.49 < expected.threshold <= 0.5
    del state["density_bitfield"]
    got = read_torch_ngp(save(tmp_path / "b.pth", state), ns)[0].occupancy
    # min(mean, 10): the mean of the grid, which is between the two values of the cells here.
    assert np.array_equal(got.bits, expected.bits)
    del state["density_grid"]
    assert read_torch_ngp(save(tmp_path / "c.pth", state), ns)[0].occupancy is None


def test_single_grid_becomes_cascades(tmp_path):
    # Exactly the cells of a cascade that overlap an occupied cell are set.
    bits = np.zeros((6, 6, 6), bool)
    bits[1, 2, 3] = bits[5, 5, 0] = True
    packed = pack_bitfield(OccupancyGrid(bits, ns, 0.1), 2.0)
    p = np.random.default_rng(1).uniform(-2, 2, (20000, 3)).astype(np.float32)
    cell = np.clip((p / 4 + 0.5) * 6, 0, 5).astype(int)
    true = bits[cell[:, 2], cell[:, 1], cell[:, 0]]
    got = reference.occupied(packed, 2, p)
    assert np.all(got[true]) and true.any() and (got & ~true).mean() < 0.02


def test_cascades_are_packed_unchanged():
    bits = np.random.default_rng(2).random((2, 128, 128, 128)) < 0.01
    packed = pack_bitfield(CascadeGrid(bits, 2.0, ns, 0.1), 2.0)
    assert packed.dtype == np.uint8 and packed.size * 8 == bits.size
    ordered = np.unpackbits(packed, bitorder="little").reshape(2, -1)[:, morton_order()]
    assert np.array_equal(ordered.reshape(bits.shape), bits)
    assert pack_bitfield(None, 2.0).min() == 255
    with pytest.raises(NergError, match="torch-ngp cannot represent.*16"):
        pack_bitfield(CascadeGrid(bits[:, :16, :16, :16], 2.0, ns, 0.1), 2.0)


# ---- State dictionaries ----


@pytest.fixture
def state(tmp_path):
    """A checkpoint of a network with a prefix and a diverged one, as a state dictionary."""
    path = tmp_path / "s.pth"
    tensors = {
        "model.net.0.weight": np.ones((3, 2), np.float32),
        "model.net.1.weight": np.full((1, 3), 2, np.float16),
        "model.far.0.weight": np.full((1, 2), np.inf, np.float32),
        "other": np.zeros(1, np.float32),
    }
    write_torch(path, {"model": tensors, "epoch": 3, "global_step": "many"})
    complete, model = open_checkpoint(path)
    return path, complete, StateDict(Path(path), model)


def test_state_dict(state):
    path, checkpoint, tensors = state
    below = tensors.select("model.net.")
    assert below.names() == ["0.weight", "1.weight"] and "0.weight" in below and "other" not in below
    assert below.shape("0.weight") == (3, 2) and below["0.weight"].tolist() == [[1, 1]] * 3
    with pytest.raises(NergError, match='s.pth" lacks "model.net.2.weight"'):
        below.shape("2.weight")
    assert tensors.get_weights("model.net.1.weight").dtype == np.float32
    with pytest.raises(NergError, match='"model.far.0.weight".*diverged'):
        tensors.get_weights("model.far.0.weight")
    net = build_network(tensors.select("model."), "net", ns)
    assert [w.shape for w in net.weights] == [(3, 2), (1, 3)]
    entries = {"imported_from": "s.pth", "format": "torch-ngp", "weights": "moving averages", "epoch": 3}
    assert describe_origin(path, checkpoint, "torch-ngp", True) == entries


def test_other_files_are_refused(tmp_path):
    write_torch(tmp_path / "x.pth", {"model": {"a": 1}})
    with pytest.raises(NergError, match="contains no weights"):
        open_checkpoint(tmp_path / "x.pth")
    write_torch(tmp_path / "l.pth", [1])
    with pytest.raises(NergError, match="contains a list, not a checkpoint"):
        open_checkpoint(tmp_path / "l.pth")


def test_shortest_decimals(state):
    assert shorten_floats(np.float32([2.7, -0.1])).tolist() == [2.7, -0.1]
    _, _, tensors = state
    assert infer_sh_degree(tensors, 16) == 4
    for wrong in (15, 0, -1):
        with pytest.raises(NergError, match="not match spherical harmonics"):
            infer_sh_degree(tensors, wrong)


def test_grid_config_is_inferred_from_levels(tmp_path):
    where = reference.offsets(4, 512)
    tensors = {"e.embeddings": np.zeros((where[-1], 2), np.float32), "e.offsets": where}
    write_torch(tmp_path / "g.pth", {"model": tensors})
    grid = StateDict(tmp_path / "g.pth", open_checkpoint(tmp_path / "g.pth")[1])
    config = infer_grid_config(grid, "e", 512.0)
    assert config.offsets() == where.tolist() and config.finest == 512 and isinstance(config.finest, int)
    with pytest.raises(NergError, match="16.*32.*finest"):
        infer_grid_config(grid, "e", 32)


def test_moving_averages(tmp_path, torch):
    # As torch writes it: with an optimiser, parameters, half precision and NumPy numbers in the statistics.
    state = reference.nerf_state(1, np.random.default_rng(7))
    weights = [k for k in state if k.endswith(("embeddings", "weight"))]
    shadow = [torch.tensor(state[k]) * 2 for k in weights]
    adam = torch.optim.Adam([torch.nn.Parameter(torch.ones(3))])
    adam.param_groups[0]["params"][0].sum().backward()
    adam.step()
    torch.save(
        {
            "epoch": 3,
            "global_step": 30,
            "stats": {"loss": [np.float64(0.5)], "best_result": None},
            "mean_count": 0,
            "model": {k: torch.tensor(v) for k, v in state.items()},
            "optimizer": adam.state_dict(),
            "ema": {"decay": 0.95, "num_updates": 3, "shadow_params": shadow, "collected_params": None},
        },
        tmp_path / "ngp_ep0003.pth",
    )
    for ema, factor, said in ((None, 2, "moving averages"), (True, 2, "moving averages"), (False, 1, "raw")):
        field, origin = read_torch_ngp(tmp_path / "ngp_ep0003.pth", ns, ema)
        assert np.array_equal(field.color_net.weights[2].numpy(), factor * state["color_net.2.weight"])
        assert np.array_equal(field.grid.table.numpy()[:100], factor * state["encoder.embeddings"].ravel()[:100])
        assert origin["weights"] == said and origin["global_step"] == 30
    with pytest.raises(ValueError, match="ema=False"):
        read_torch_ngp(save(tmp_path / "raw.pth", state), ns, ema=True)
    bad = {"shadow_params": [np.zeros((2, 2), np.float32)]}
    with pytest.raises(ValueError, match="1 moving averages .* do not match its 6 weights"):
        read_torch_ngp(save(tmp_path / "bad.pth", state, ema=bad), ns)
