"""torch-ngp checkpoints of the real sizes against a restatement of its kernels in NumPy float32, and back again."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.formats.torch_ngp import Given, read_torch_ngp, write_torch_ngp
from nerg_mi.maths.geometry import Box
from tests.reference import torch_ngp_numpy as reference

pytestmark = pytest.mark.usefixtures("torch")

PARITY = 1e-6


def save(path, state, **more):
    write_torch(path, {"epoch": 7, "global_step": 99, "stats": {}, "model": state, **more})
    return path


def points(bound, n=4000, seed=3):
    """Inside, on the faces and edges, and a little outside."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-1.02 * bound, 1.02 * bound, (n, 3)).astype(np.float32)
    p[: n // 10] = np.clip(p[: n // 10] * 3, -bound, bound)
    d = rng.normal(size=(n, 3))
    return p, (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def columns(values):
    values = list(values)
    dr.eval(values)  # one kernel, not one a column
    return np.stack([v.numpy() for v in values], -1)


def worst(got, expected):
    """Largest difference, as a share of the largest value."""
    return np.abs(np.asarray(got, np.float64) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("bound, behind", [(1, False), (2, True), (5, True)])
def test01_equals_the_restatement(tmp_path, bound, behind):
    state = reference.nerf_state(bound, np.random.default_rng(bound), behind)
    given = Given(background_radius=3.0 * bound if behind else None)
    field, origin = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns, given=given)
    p, d = points(bound)
    at, along = ns.Array3f(p.T), ns.Array3f(d.T)

    # One kernel has the grid in it once; the sizes of bound 5 are those that show the last bit of a coordinate.
    ours = field.grid(field.box.to_unit(at)) if bound == 5 else []
    density, geometry = field.density_features(at)
    painted = field.color(geometry, along)
    dr.eval(ours, density, painted)
    if bound == 5:
        features = reference.encode(p, state["encoder.embeddings"], state["encoder.offsets"], 2048 * bound, bound)
        assert worst(columns(ours), features) <= PARITY
    sigma, color, _ = reference.nerf(state, bound, p, d)
    inside = np.all(np.abs(p) <= bound, axis=1)
    assert 0 < (~inside).sum() < len(p)
    got = density.numpy()
    # An exponential turns an absolute error of its argument, which is of size 8 here, into a relative one.
    assert np.abs(got[inside] / sigma[inside] - 1).max() <= 2 * np.abs(np.log(sigma)).max() * PARITY
    assert not got[~inside].any()
    assert np.abs(columns(painted) - color).max() <= PARITY
    if behind:
        o = np.clip(p, -bound, bound)
        shown = columns(field.background(ns.Array3f(o.T), along))
        # The last bit of an angle is 4e-4 cells of the finest level, so that this much differs by the machine's atan2
        # too.
        assert np.abs(shown - reference.background(state, 3.0 * bound, o, d)).max() <= 1e-3
        angles = columns(field.background.coordinates(ns.Array3f(o.T), along))
        features = reference.encode(angles, state["encoder_bg.embeddings"], state["encoder_bg.offsets"], 2048, 1)
        square = ns.Array2f(*[0.5 * ns.Float(a) + 0.5 for a in angles.T])
        assert worst(columns(field.background.grid(square)), features) <= PARITY
    assert origin["epoch"] == 7 and origin["weights"] == "raw"
    assert field.march_step == pytest.approx(2 * 3**0.5 / 1024)


def test05_there_and_back_is_exact(tmp_path, torch):
    for bound, behind in ((1, False), (2.7, True)):
        state = reference.nerf_state(bound, np.random.default_rng(6), behind)
        first = save(tmp_path / "ngp.pth", state)
        field, origin = read_torch_ngp(first, ns, given=Given(background_radius=10.0))
        save_radiance(field, tmp_path / "f.safetensors", origin)
        again, meta = load_radiance(tmp_path / "f.safetensors", ns)
        assert meta["provenance"]["imported_from"] == "ngp.pth" and again.box == field.box
        write_torch_ngp(again, tmp_path / "back.pth")
        back = torch.load(tmp_path / "back.pth", weights_only=True)
        assert set(back["model"]) == set(state)
        for name, value in state.items():
            assert np.array_equal(back["model"][name].numpy(), value), name
            assert back["model"][name].numpy().dtype == value.dtype


def test08_a_bare_state_dictionary_and_a_smaller_box(tmp_path):
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
        (lambda s: s.pop("sigma_net.1.weight"), "numbers, so it is not spherical harmonics"),
        (lambda s: s.pop("aabb_train"), 'lacks "aabb_train"'),
        (lambda s: s.update({"aabb_train": s["aabb_train"] / 2}), "not those of a bound"),
        (lambda s: s.update({"encoder.offsets": s["encoder.offsets"] + 8}), "begin at rows .*--finest"),
        (lambda s: s.update({"color_net.0.bias": np.zeros(64, np.float32)}), "layers without biases"),
        (lambda s: s.update({"color_net.0.weight": np.zeros((64, 30), np.float32)}), "not spherical harmonics"),
        (lambda s: s.update({"color_net.2.weight": np.full((3, 64), np.nan, np.float32)}), "not finite.*diverged"),
        (lambda s: s.update({"density_bitfield": np.zeros(5, np.uint8)}), "40 density bits"),
        (lambda s: s.update({"encoder.params": np.zeros(5, np.float32)}), "--tcnn"),
        (lambda s: s.update({"bg_net.0.weight": np.zeros((64, 24), np.float32)}), "--bg-radius"),
    ],
)
def test09_what_does_not_fit_is_said(tmp_path, change, words):
    state = small_state()
    change(state)
    with pytest.raises(ValueError, match=words) as e:
        read_torch_ngp(save(tmp_path / "wrong.pth", state), ns)
    assert "\n" not in str(e.value)


def small_state():
    """A state dictionary of the right names, with a grid of two levels only."""
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


def test10_a_grid_of_another_resolution(tmp_path):
    state = small_state()
    where = reference.offsets(2, 4096)
    state["encoder.offsets"] = where
    # 2 levels: 17^3 and a hashed one, whatever the finest resolution is.
    field, _ = read_torch_ngp(save(tmp_path / "a.pth", state), ns, given=Given(finest=4096))
    assert field.config.grid == HashGridConfig(levels=2, finest=4096)


def test11_fields_without_a_torch_ngp_form(tmp_path):
    config = RadianceConfig(HashGridConfig(levels=2, log2_rows=8, base=4, finest=16), width=16)
    field = RadianceField.random(config, Box((0, 0, 0), (1, 2, 3)), ns)
    with pytest.raises(ValueError, match="torch-ngp form: its unit"):
        write_torch_ngp(field, tmp_path / "x.pth")
    assert not list(tmp_path.iterdir())


def test12_a_deferred_field_has_none(tmp_path):
    field = RadianceField.random(RadianceConfig(HashGridConfig(), deferred=True), Box((-1, -1, -1), (1, 1, 1)), ns)
    with pytest.raises(ValueError, match="torch-ngp form: torch-ngp asks"):
        write_torch_ngp(field, tmp_path / "x.pth")
    assert not list(tmp_path.iterdir())
