"""The volume `nerf`: what it returns, where it lies, and what it says about wrong files."""

import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from nerg_mi.fields.occupancy import OccupancyGrid

from . import fields
from .scenes import camera, channels


@pytest.fixture
def field(tmp_path):
    return fields.radiance(tmp_path / "f.safetensors")


def load(mi, path, **kwargs):
    return mi.load_dict({"type": "nerf", "filename": str(path), **kwargs})


def evaluate(mi, volume, p):
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.asarray(p, np.float32).T)
    return volume.eval_1(it).numpy()


def test01_density_in_the_scene(rgb, tmp_path, field):
    p = np.random.default_rng(0).uniform(-1.2, 1.2, (50, 3)).astype(np.float32)
    expected = field.density(rgb.Point3f(p.T)).numpy()
    assert (expected == 0).any() and (expected > 0).any()
    assert np.allclose(evaluate(rgb, load(rgb, tmp_path / "f.safetensors"), p), expected, rtol=1e-6)
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 1, 0], 30).scale(4)
    volume = load(rgb, tmp_path / "f.safetensors", to_world=to_world)
    q = np.array(to_world.matrix)[:3] @ np.concatenate([p.T, np.ones((1, 50))])
    inside = np.abs(np.abs(p) - 1).min(-1) > 1e-4
    assert np.allclose(evaluate(rgb, volume, q.T)[inside], expected[inside] / 4, rtol=1e-3)


def test02_bounds(rgb, tmp_path, field):
    box = load(rgb, tmp_path / "f.safetensors", to_world=rgb.ScalarTransform4f().translate([1, 2, 3]).scale(2)).bbox()
    assert np.allclose(np.array(box.min).ravel(), [-1, 0, 1]) and np.allclose(np.array(box.max).ravel(), [3, 4, 5])


def test03_parameters(rgb, tmp_path, field):
    volume = load(rgb, tmp_path / "f.safetensors")
    params = rgb.traverse(volume)
    assert set(field.parameters()) == set(params.keys())
    before = evaluate(rgb, volume, [[0.1, 0.2, 0.3]])
    params["density_net.1"] = params["density_net.1"] * 2
    params.update()
    assert not np.isclose(evaluate(rgb, volume, [[0.1, 0.2, 0.3]]), before, rtol=1e-3)


@pytest.mark.parametrize("change", ["mirror", "shear", "uneven"])
def test04_placements_that_are_no_similarity(rgb, tmp_path, field, change):
    m = np.eye(4)
    m[{"mirror": (0, 0), "shear": (0, 1), "uneven": (2, 2)}[change]] = {"mirror": -1, "shear": 0.5, "uneven": 3}[change]
    with pytest.raises(RuntimeError, match='"to_world"'):
        load(rgb, tmp_path / "f.safetensors", to_world=rgb.ScalarTransform4f(m.tolist()))


def test05_wrong_files(rgb, tmp_path):
    fields.gaze(tmp_path / "g.safetensors")
    with pytest.raises(RuntimeError, match="holds a gaze field"):
        load(rgb, tmp_path / "g.safetensors")
    (tmp_path / "x.safetensors").write_bytes(b"no")
    with pytest.raises(RuntimeError, match="x.safetensors.*not a readable safetensors file"):
        load(rgb, tmp_path / "x.safetensors")
    with pytest.raises(RuntimeError, match='"filename"'):
        rgb.load_dict({"type": "nerf", "filename": 3.0})
    with pytest.raises(RuntimeError, match="bogus"):
        fields.radiance(tmp_path / "f.safetensors")
        load(rgb, tmp_path / "f.safetensors", bogus=1.0)


def test06_says_what_it_is(rgb, tmp_path, field):
    volume = load(rgb, tmp_path / "f.safetensors")
    assert volume.channel_count() == 1
    assert "NerfVolume[" in str(volume) and "f.safetensors" in str(volume)


def test07_empty_cells_are_vacuum_also_for_others(rgb, tmp_path):
    # Training leaves them unsampled: the networks' density there means nothing, and marching passes over it.
    bits = np.zeros((4, 4, 4), bool)
    bits[:, :, 2:] = True
    field = fields.radiance(tmp_path / "half.safetensors", occupancy=OccupancyGrid(bits, ns, 0.01))
    p = np.random.default_rng(1).uniform(-0.99, 0.99, (50, 3)).astype(np.float32)
    raw, got = field.density(rgb.Point3f(p.T)).numpy(), evaluate(rgb, load(rgb, tmp_path / "half.safetensors"), p)
    assert (raw > 0).all() and not got[p[:, 0] < 0].any()
    assert np.allclose(got[p[:, 0] > 0], raw[p[:, 0] > 0], rtol=1e-6) and (p[:, 0] > 0).any()


def medium_scene(mi, files, spp, **kwargs):
    """The field as a medium that only absorbs, in a cube before white light."""
    volume = {"type": "nerf", "filename": str(files / "field.safetensors"), **kwargs}
    interior = {"type": "heterogeneous", "sigma_t": volume, "albedo": {"type": "constvolume", "value": 0.0}}
    scale = kwargs["to_world"] if "to_world" in kwargs else mi.ScalarTransform4f()
    cube = {"type": "cube", "to_world": scale, "bsdf": {"type": "null"}, "interior": interior}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 200, "rr_depth": 1000},
            "sensor": camera(mi, size=8),
            "cube": cube,
            "sky": {"type": "constant", "radiance": 1.0},
        }
    )


@pytest.mark.parametrize("placed", [False, True])
def test_as_a_medium_it_absorbs_what_the_marcher_does(rgb, files, placed):
    """Analog tracking lets a path through or not: counts of n paths around n T, by a z-test for each pixel."""
    spp = 1024
    where = {"to_world": rgb.ScalarTransform4f().translate([0.1, 0, 0]).scale(0.6)} if placed else {}
    through = np.array(rgb.render(medium_scene(rgb, files, spp, max_density=40.0, **where), spp=spp))[..., 0]
    field = {"type": "nerf", "filename": str(files / "field.safetensors"), **where}
    opacity = channels(
        rgb,
        {"type": "nerg", "field": field, "aovs": "opacity", "step": 0.01, "radiance": False},
        camera(rgb, size=8),
        spp=256,
    )
    T = 1 - opacity["opacity.Y"].astype(float)
    # Within a pixel T varies, over silhouettes too much for a mean of 256.
    inside = binary_erosion(T < 0.6)
    z = (through - T)[inside] / np.sqrt((T * (1 - T))[inside] / spp)
    assert inside.sum() > 8 and np.abs(z).max() < 4.5 and np.mean(z**2) < 1.6


def test_a_medium_needs_a_bound(rgb, files):
    with pytest.raises(RuntimeError, match='"max_density"'):
        medium_scene(rgb, files, 1)


def test_its_bound_caps_densities(rgb, files):
    import drjit as dr

    volume = {"type": "nerf", "filename": str(files / "field.safetensors")}
    it = dr.zeros(rgb.Interaction3f)
    it.p = rgb.Point3f(np.random.default_rng(0).uniform(-0.9, 0.9, (3, 100)).astype(np.float32))
    free, capped = (np.array(rgb.load_dict({**volume, **more}).eval_1(it)) for more in ({}, {"max_density": 2.2}))
    assert free.max() > 2.2 and np.allclose(capped, np.minimum(free, 2.2))


def test_constant_weights_change_no_density(rgb, files):
    import drjit as dr

    volume = {"type": "nerf", "filename": str(files / "field.safetensors")}
    it = dr.zeros(rgb.Interaction3f)
    it.p = rgb.Point3f(np.random.default_rng(0).uniform(-0.9, 0.9, (3, 100)).astype(np.float32))
    plain, constant = rgb.load_dict(volume), rgb.load_dict({**volume, "constant_weights": True})
    assert constant.field.color_net.constant and not plain.field.color_net.constant
    assert np.ptp(plain.eval_1(it)) > 0 and np.array_equal(constant.eval_1(it), plain.eval_1(it))
    with pytest.raises(RuntimeError, match="constant_weights"):
        rgb.load_dict({**volume, "constant_weights": "yes"})
