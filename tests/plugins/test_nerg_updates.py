"""Updates of parameters: what they make anew, and what they leave as it is."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport import observer, volume_medium

from .scenes import camera, channels, observer_at, wall, with_field


def behind_a_wall(mi, **more):
    """An observer before a wall with a gap, and a camera that sees what lies behind it."""
    sensor = camera(mi, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    integrator = {
        "type": "nerg",
        "density": wall(mi),
        "aovs": "visibility",
        "step": 0.01,
        "falloff": 0.0,
        "radiance": False,
        "observer": observer_at(mi, 0, 0, -0.9),
        **more,
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def seen(mi, scene) -> np.ndarray:
    return np.array(mi.render(scene, spp=1))[..., -1]


@pytest.fixture
def reads(monkeypatch):
    """One entry for each time that the voxels of a grid are read."""
    count, describe = [], volume_medium.describe
    monkeypatch.setattr(volume_medium, "describe", lambda volume: (count.append(volume), describe(volume))[1])
    return count


def test01_voxels_are_read_when_they_change_and_not_otherwise(rgb, reads):
    scene = behind_a_wall(rgb)
    assert len(reads) == 1
    params = rgb.traverse(scene)
    for i in range(3):
        params["integrator.observer.to_world"] = rgb.ScalarTransform4f().translate([0.1 * i, 0, -0.9])
        params.update()
        params["integrator.falloff"] = rgb.Float(0.1 * i)
        params.update()
        seen(rgb, scene)
    assert len(reads) == 1
    params["integrator.density.data"] = params["integrator.density.data"] * 0
    params.update()
    assert len(reads) == 2 and not np.array(scene.integrator().medium.occupancy.bits).any()
    assert (seen(rgb, scene) == 0).all()


@pytest.mark.parametrize("of", ["scene", "integrator"])
def test01b_an_observer_who_moves_is_no_constant_of_the_kernel(rgb, of):
    """Each position would be compiled anew otherwise, which takes longer than any frame."""
    scene = behind_a_wall(rgb)
    params = rgb.traverse(scene if of == "scene" else scene.integrator())
    name = "integrator.observer.to_world" if of == "scene" else "observer.to_world"
    params[name] = rgb.Transform4f().translate([0.2, 0, -0.8])
    params.update()
    center = observer.center(scene.integrator().observer)
    assert np.allclose(np.ravel(np.array(center)), [0.2, 0, -0.8])
    assert scene.integrator().observer.world_transform().matrix[0, 3].state == dr.VarState.Evaluated


def test02_voxels_that_were_refused_are_read_again(rgb, reads):
    scene = behind_a_wall(rgb)
    params = rgb.traverse(scene)
    good = np.array(params["integrator.density.data"])
    bad = good.copy()
    bad[0, 0, 0] = np.nan
    for _ in range(2):
        params["integrator.density.data"] = rgb.TensorXf(bad)
        with pytest.raises(Exception, match="not finite"):
            params.update()
    params["integrator.density.data"] = rgb.TensorXf(good)
    params.update()
    assert len(reads) == 4


def test02b_voxels_that_are_written_to_in_place_are_read_when_that_is_said(rgb, reads):
    """NumPy shares their memory; a scatter would write to a copy, as they are kept to be told from others."""
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
def test03_a_map_follows_the_field(rgb, files, change):
    """The map is one of depths: of other voxels or weights it is another one, whatever else stays."""
    if change == "density":
        scene = behind_a_wall(rgb, visibility="map", map_height=64)
        key = "integrator.density.data"
    else:
        integrator = with_field(
            files,
            aovs="observer_depth",
            falloff=0.0,
            visibility="map",
            map_height=32,
            observer=observer_at(rgb, -2, 0.3, -2),
        )
        scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb)})
        key = "integrator.field.density_net.1"
    params = rgb.traverse(scene)
    before = seen(rgb, scene)
    value = np.array(params[key])
    if change == "density":
        value[:36] = 0  # the wall with the gap; what lies behind it stays
    else:
        value[0] = 0  # the logarithm of the density: the same everywhere, and thin
    params[key] = rgb.TensorXf(value)
    params.update()
    after = seen(rgb, scene)
    assert np.abs(after - before).max() > 0.1
    # What a map that was made for it says.
    scene.integrator().cache.forget()
    np.testing.assert_array_equal(seen(rgb, scene), after)


def test04_a_map_outlasts_what_it_does_not_depend_on(rgb):
    scene = behind_a_wall(rgb, visibility="map", map_height=64)
    seen(rgb, scene)
    kept = scene.integrator().cache.peek("map")[0]
    params = rgb.traverse(scene)
    params["integrator.falloff"] = rgb.Float(0.7)
    params.update()
    softer = seen(rgb, scene)
    assert scene.integrator().cache.peek("map")[0] is kept and ((softer > 0.05) & (softer < 0.95)).any()
    params["integrator.observer.to_world"] = rgb.ScalarTransform4f().translate([0.3, 0, -0.9])
    params.update()
    seen(rgb, scene)
    assert scene.integrator().cache.peek("map")[0] is not kept


def test05_all_is_looked_at_where_nobody_says_what_changed(rgb, reads):
    scene = behind_a_wall(rgb, visibility="map", map_height=64)
    seen(rgb, scene)
    integrator = scene.integrator()
    kept = integrator.cache.peek("map")[0]
    integrator.parameters_changed()
    assert len(reads) == 2
    seen(rgb, scene)
    assert integrator.cache.peek("map")[0] is not kept


def test05b_an_observer_is_told_of_its_pose_and_refuses_what_cameras_do(rgb):
    params = rgb.traverse(behind_a_wall(rgb))
    params["integrator.observer.to_world"] = rgb.ScalarTransform4f().scale(2)
    with pytest.raises(RuntimeError, match="Scale factors"):
        params.update()


def test06_gaze_and_its_spread_fade_with_visibility(rgb, files, tmp_path):
    """By transmittance the point stays the same, so that hidden and open differ by that share alone, whatever it is."""
    import drjit.llvm.ad as ns

    from nerg_mi.fields.gaze_base import GazeEnsemble, RaySupport
    from nerg_mi.formats.fields import load_gaze, save_gaze
    from nerg_mi.rays.rays import Rays

    from . import fields

    members = [fields.gaze(tmp_path / f"{k}.safetensors", seed=k) for k in (1, 2)]
    members[1].set_parameters({"emit_head.0": 20 * members[1].parameters()["emit_head.0"]})
    origins = np.random.default_rng(0).normal((-2, 0.3, -2), 0.3, (50, 3))
    save_gaze(GazeEnsemble(members, RaySupport.of(origins, 1.0)), tmp_path / "e.safetensors", {})
    assert len(load_gaze(tmp_path / "e.safetensors", ns)[0].members) == 2
    d = np.random.default_rng(1).normal(size=(50, 3)) + (2, -0.3, 2)
    Rays(np.arange(50), np.zeros(50), ("a",), origins, d / np.linalg.norm(d, axis=1, keepdims=True), np.ones(50)).save(
        tmp_path / "rays.npz"
    )
    more = {
        "gaze": {"type": "gazefield", "filename": str(tmp_path / "e.safetensors")},
        "observer": observer_at(rgb, -2, 0.3, -2),
        "kde": {"type": "gazekde", "filename": str(tmp_path / "rays.npz"), "kappa": 2.0},
        "visibility": "transmittance",
    }
    aovs = "gaze,gaze_std,kde,support,visibility,opacity"
    hidden, open_ = (channels(rgb, with_field(files, aovs=aovs, occlusion=o, **more)) for o in (True, False))
    share = hidden["visibility.Y"]
    part = (share > 0.1) & (share < 0.9)
    assert part.sum() > 10
    for name in ("gaze.Y", "gaze_std.Y", "kde.Y"):
        assert open_[name][part].max() > 1e-3
        np.testing.assert_allclose(hidden[name][part], (open_[name] * share)[part], rtol=2e-3, atol=1e-6, err_msg=name)
    # How much was recorded around the observer is no matter of what is hidden.
    np.testing.assert_array_equal(hidden["support.Y"], open_["support.Y"])
    assert hidden["support.Y"].max() > 1
