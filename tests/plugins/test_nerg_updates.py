"""Updates of parameters, and functions frozen by ``dr.freeze``."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.gaze_base import GazeEnsemble, RaySupport
from nerg_mi.formats.fields import save_gaze
from nerg_mi.registration import get_plugin_class
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport import observer, volume_medium
from nerg_mi.transport.mitsuba_mesh import positions_key
from tests.formats.splats.writers import random_splats

from . import fields
from .scenes import (
    camera,
    channels,
    make_observer,
    picture,
    plugin,
    put,
    scene_with,
    still,
    stored,
    wall,
    with_field,
    with_gaze,
)

# ---- Updates of parameters: what is recomputed, and what is kept ----


def behind_a_wall(mi, **overrides):
    """An observer in front of a wall with a gap, and a camera that sees what is behind it."""
    sensor = camera(mi, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    how = {"aovs": "visibility", "step": 0.01, "falloff": 0.0, "radiance": False, **overrides}
    return scene_with(mi, plugin("nerg", density=wall(mi), observer=make_observer(mi, 0, 0, -0.9), **how), sensor)


def seen(mi, scene) -> np.ndarray:
    return picture(mi, scene)[..., -1]


@pytest.fixture
def reads(monkeypatch):
    """One entry per reading of the voxels of a grid."""
    count, read_grid_volume = [], volume_medium.read_grid_volume
    monkeypatch.setattr(
        volume_medium, "read_grid_volume", lambda volume: (count.append(volume), read_grid_volume(volume))[1]
    )
    return count


def test01_voxels_are_read_only_when_changed(rgb, reads):
    scene = behind_a_wall(rgb)
    assert len(reads) == 1
    params = rgb.traverse(scene)
    for i in range(3):
        put(params, "integrator.observer.to_world", rgb.ScalarTransform4f().translate([0.1 * i, 0, -0.9]))
        put(params, "integrator.falloff", rgb.Float(0.1 * i))
        seen(rgb, scene)
    assert len(reads) == 1
    put(params, "integrator.density.data", params["integrator.density.data"] * 0)
    assert len(reads) == 2 and not np.array(scene.integrator().medium.occupancy.bits).any()
    assert (seen(rgb, scene) == 0).all()


@pytest.mark.parametrize("owner", ["scene", "integrator"])
def test01b_moving_observer_reuses_the_kernel(rgb, owner):
    """Otherwise each position would be compiled, which takes longer than any frame."""
    scene = behind_a_wall(rgb)
    params = rgb.traverse(scene if owner == "scene" else scene.integrator())
    name = "integrator.observer.to_world" if owner == "scene" else "observer.to_world"
    put(params, name, rgb.Transform4f().translate([0.2, 0, -0.8]))
    center = observer.sensor_center(scene.integrator().observer)
    assert np.allclose(np.ravel(np.array(center)), [0.2, 0, -0.8])
    assert scene.integrator().observer.world_transform().matrix[0, 3].state == dr.VarState.Evaluated


def test02_rejected_voxels_are_read_again(rgb, reads):
    scene = behind_a_wall(rgb)
    params = rgb.traverse(scene)
    good = np.array(params["integrator.density.data"])
    bad = good.copy()
    bad[0, 0, 0] = np.nan
    for _ in range(2):
        params["integrator.density.data"] = rgb.TensorXf(bad)
        with pytest.raises(Exception, match="not finite"):
            params.update()
    put(params, "integrator.density.data", rgb.TensorXf(good))
    assert len(reads) == 4


def test02b_voxels_changed_in_place_are_read_on_update(rgb, reads):
    """NumPy shares their memory; a scatter would write to a copy, since they are held for comparison."""
    scene = behind_a_wall(rgb)
    params = rgb.traverse(scene)
    data = params["integrator.density.data"].array
    before = data.index
    data.numpy()[:] = 0
    assert data.index == before
    params.set_dirty("integrator.density.data")
    params.update()
    assert len(reads) == 2 and not np.array(scene.integrator().medium.occupancy.bits).any()


@pytest.mark.parametrize("change", ["density", "field"])
def test03_map_is_updated_with_the_field(rgb, files, change):
    """The map consists of depths: other voxels or weights need another one, even if everything else is unchanged."""
    if change == "density":
        scene = behind_a_wall(rgb, visibility="map", map_height=64)
        key = "integrator.density.data"
    else:
        how = {"falloff": 0.0, "visibility": "map", "map_height": 32, "observer": make_observer(rgb, -2, 0.3, -2)}
        scene = scene_with(rgb, with_field(files, aovs="observer_depth", **how))
        key = "integrator.field.density_net.1"
    params = rgb.traverse(scene)
    before = seen(rgb, scene)
    value = np.array(params[key])
    if change == "density":
        value[:36] = 0  # the wall with the gap; what is behind it stays
    else:
        value[0] = 0  # the logarithm of the density: uniform, and thin
    put(params, key, rgb.TensorXf(value))
    after = seen(rgb, scene)
    assert np.abs(after - before).max() > 0.1
    # The values of a new map.
    scene.integrator().cache.clear()
    np.testing.assert_array_equal(seen(rgb, scene), after)


def test04_map_is_kept_across_unrelated_changes(rgb):
    scene = behind_a_wall(rgb, visibility="map", map_height=64)
    seen(rgb, scene)
    selected = scene.integrator().cache.peek("map")[0]
    params = rgb.traverse(scene)
    put(params, "integrator.falloff", rgb.Float(0.7))
    softer = seen(rgb, scene)
    assert scene.integrator().cache.peek("map")[0] is selected and ((softer > 0.05) & (softer < 0.95)).any()
    put(params, "integrator.observer.to_world", rgb.ScalarTransform4f().translate([0.3, 0, -0.9]))
    seen(rgb, scene)
    assert scene.integrator().cache.peek("map")[0] is not selected


def test05_update_without_keys_checks_everything(rgb, reads):
    scene = behind_a_wall(rgb, visibility="map", map_height=64)
    seen(rgb, scene)
    integrator = scene.integrator()
    selected = integrator.cache.peek("map")[0]
    integrator.parameters_changed()
    assert len(reads) == 2
    seen(rgb, scene)
    assert integrator.cache.peek("map")[0] is not selected


def test05b_observer_pose_update_is_validated(rgb):
    params = rgb.traverse(behind_a_wall(rgb))
    params["integrator.observer.to_world"] = rgb.ScalarTransform4f().scale(2)
    with pytest.raises(RuntimeError, match="Scale factors"):
        params.update()


def test06_gaze_and_std_fade_with_visibility(rgb, files, tmp_path):
    """With transmittance the point is the same, so that hidden and unoccluded values differ by that fraction alone."""
    members = [fields.gaze(tmp_path / f"{k}.safetensors", seed=k) for k in (1, 2)]
    members[1].set_parameters({"emit_head.0": 20 * members[1].parameters()["emit_head.0"]})
    origins = np.random.default_rng(0).normal((-2, 0.3, -2), 0.3, (50, 3))
    save_gaze(GazeEnsemble(members, RaySupport.from_origins(origins, 1.0)), tmp_path / "e.safetensors", {})
    d = np.random.default_rng(1).normal(size=(50, 3)) + (2, -0.3, 2)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    Rays(np.arange(50), np.zeros(50), ("a",), origins, d, np.ones(50)).save(tmp_path / "rays.npz")
    overrides = {"observer": make_observer(rgb, -2, 0.3, -2), "visibility": "transmittance"}
    overrides["gaze"] = stored("gazefield", tmp_path / "e.safetensors")
    overrides["kde"] = stored("gazekde", tmp_path / "rays.npz", kappa=2.0)
    aovs = "gaze,gaze_std,kde,support,visibility,opacity"
    hidden, open_ = (channels(rgb, with_field(files, aovs=aovs, occlusion=o, **overrides)) for o in (True, False))
    share = hidden["visibility.Y"]
    part = (share > 0.1) & (share < 0.9)
    assert part.sum() > 10
    for name in ("gaze.Y", "gaze_std.Y", "kde.Y"):
        assert open_[name][part].max() > 1e-3
        np.testing.assert_allclose(hidden[name][part], (open_[name] * share)[part], rtol=2e-3, atol=1e-6, err_msg=name)
    # Support does not depend on occlusion.
    np.testing.assert_array_equal(hidden["support.Y"], open_["support.Y"])
    assert hidden["support.Y"].max() > 1


# ---- Functions frozen by ``dr.freeze``: replays equal traced calls, for any changes ----


def moved(mi, value, i):
    return mi.Transform4f().translate([0.2 * i, 0, 0]) @ mi.Transform4f(value)


def scaled(mi, value, i):
    return value * (1 + 0.2 * i)


def shifted(mi, value, i):
    return value + 0.1 * i


def sheet(mi, value, i):
    """A sheet in an empty grid, at another position each time: empty cells must not be those of the recording."""
    data = np.zeros(value.shape, np.float32)
    data[2 + i] = 20
    return mi.TensorXf(data)


def small(mi):
    return still(camera(mi, size=6))


def scene_of(mi, files, shapes=(), **overrides):
    how = {"aovs": "depth,gaze,visibility", "falloff": 2.0, "observer": make_observer(mi, -2, 0.3, -2), **overrides}
    return scene_with(mi, with_gaze(files, **how), small(mi), **dict(shapes))


def splat_scene(mi):
    place = get_plugin_class("splats").from_network(random_splats(40, degree=1, size=0.2))
    return scene_with(mi, plugin("nerg", field=place, aovs="depth,opacity"), small(mi))


def normalized_scene(mi, files):
    fields.gaze(files / "normalized.safetensors", normalized=True)
    return scene_of(mi, files, gaze=stored("gazefield", files / "normalized.safetensors"), aovs="gaze")


def grid_scene(mi):
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = plugin("gridvolume", grid=mi.VolumeGrid(np.zeros((8, 8, 8), np.float32)), to_world=place)
    return scene_with(mi, plugin("nerg", density=grid, aovs="depth,opacity"), small(mi))


def cube_scene(mi, files):
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(0.2)}
    return scene_of(mi, files, {"cube": cube})


OBSERVER = "integrator.observer.to_world"
FROZEN = {
    "falloff": (scene_of, "integrator.falloff", scaled),
    "observer": (scene_of, OBSERVER, moved),
    "gaze weights": (scene_of, "integrator.gaze.grid.table", scaled),
    "field weights": (scene_of, "integrator.field.density_net.1", scaled),
    # What can be omitted for one observer may be needed for the next.
    "from camera": (lambda mi, files: scene_of(mi, files, observer=make_observer(mi, 0.5, 0.4, -3)), OBSERVER, moved),
    "camera": (lambda mi, files: scene_with(mi, with_gaze(files), camera(mi, size=6)), "sensor.to_world", moved),
    "map": (lambda mi, files: scene_of(mi, files, visibility="map", map_height=32), OBSERVER, moved),
    "transmittance": (lambda mi, files: scene_of(mi, files, visibility="transmittance"), OBSERVER, moved),
    "normalized": (normalized_scene, OBSERVER, moved),
    "grid": (lambda mi, files: grid_scene(mi), "integrator.density.data", sheet),
    "mesh": (cube_scene, "cube.{positions}", shifted),
    "splats": (lambda mi, files: splat_scene(mi), "integrator.field.centers", shifted),
}


@pytest.mark.parametrize("what", list(FROZEN))
def test10_replays_match_traced_calls(rgb, files, what):
    make, key, change = FROZEN[what]
    key = key.format(positions=positions_key())
    scene = make(rgb, files)
    params = rgb.traverse(scene)
    start = type(params[key])(params[key])
    frozen, pictures = dr.freeze(lambda scene, seed: rgb.render(scene, spp=1, seed=seed)), []
    for i in range(4):
        put(params, key, change(rgb, start, i))
        pictures.append(np.array(rgb.render(scene, spp=1, seed=i)))
        assert np.allclose(np.array(frozen(scene, rgb.UInt32(i))), pictures[-1], atol=2e-6), i
    # A parameter that was a literal in the scene's description is recorded again once it is an array.
    assert frozen.n_recordings <= 3
    assert not np.allclose(pictures[2], pictures[3], atol=1e-4)


SPLATS = ["field." + name for name in ("centers", "scales", "rotations", "opacities", "harmonics")]


@pytest.mark.parametrize("names", [["gaze.emit_head.0"], ["falloff"], SPLATS], ids=["gaze", "falloff", "splats"])
def test11_frozen_training_matches(rgb, files, names):
    """Derivatives of a frozen loss are those of the loss; moved Gaussians compile no kernel."""
    make = lambda: splat_scene(rgb) if names is SPLATS else scene_of(rgb, files, aovs="gaze", radiance=False)
    reference = rgb.render(make(), spp=1) * 1.3
    keys, variants = [f"integrator.{name}" for name in names], []

    def step(scene, params, reference, seed):
        loss = dr.mean(dr.square(rgb.render(scene, params, spp=1, seed=seed) - reference), axis=None)
        dr.backward(loss)
        return loss

    frozen = dr.freeze(step)
    for descend in (step, frozen):
        scene, direction = make(), []
        params = rgb.traverse(scene)
        params.keep(keys)
        opt = rgb.ad.Adam(lr=1e-2, params={key: params[key] for key in keys})
        params.update(opt)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for i in range(5):
                if i == 3:
                    dr.kernel_history_clear()
                direction.append(descend(scene, params, reference, rgb.UInt32(i)).numpy().item())
                opt.step()
                params.update(opt)
            # Of all 36 pixels; others pack the Gaussians.
            result = [k["cache_hit"] for k in dr.kernel_history() if k["size"] == 36 and "cache_hit" in k]
        assert all(result) and (descend is frozen or result)
        variants.append(direction)
    assert variants[0][1] != variants[0][0] and np.allclose(*variants, rtol=1e-4)
    assert frozen.n_recordings <= 3


def test11b_frozen_images_follow_changed_gaussians(rgb):
    """Without another image that reads them before."""
    scene, center = splat_scene(rgb), "integrator.field.centers"
    params = rgb.traverse(scene)
    start = rgb.Float(params[center])
    frozen = dr.freeze(lambda scene: rgb.render(scene, spp=1))
    images = []
    for i in range(4):
        put(params, center, shifted(rgb, start, i))
        images.append(np.array(frozen(scene)))
    assert frozen.n_recordings < 4
    for i, image in enumerate(images):
        put(params, center, shifted(rgb, start, i))
        np.testing.assert_allclose(image, rgb.render(scene, spp=1), atol=2e-6)
    assert not np.allclose(images[2], images[3], atol=1e-4)


def test12_changing_gaussians_in_a_frozen_function_is_refused(rgb):
    scene = splat_scene(rgb)
    params = rgb.traverse(scene)

    @dr.freeze
    def move(scene, params, by):
        put(params, "integrator.field.centers", params["integrator.field.centers"] + by)
        return rgb.render(scene, spp=1)

    with pytest.raises(RuntimeError) as result:
        move(scene, params, rgb.Float(0.1))
    assert "call params.update() before the function" in str(result.value.__cause__)
