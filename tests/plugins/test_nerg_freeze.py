"""Functions frozen by ``dr.freeze``: recorded once, their replays equal what is traced anew, whatever has changed."""

import gc

import drjit as dr
import numpy as np
import pytest

from nerg_mi.registration import plugin_class
from tests.formats.splats.writers import random_splats

from . import fields
from .scenes import camera, observer_at, with_gaze


@pytest.fixture(scope="module")
def files(files):
    """Those of all tests, and `normalized.safetensors`."""
    fields.gaze(files / "normalized.safetensors", normalized=True)
    return files


def moved(mi, value, i):
    return mi.Transform4f().translate([0.2 * i, 0, 0]) @ mi.Transform4f(value)


def scaled(mi, value, i):
    return value * (1 + 0.2 * i)


def sheet(mi, value, i):
    """A sheet in an empty grid, elsewhere each time: what is known to be empty must not be what was recorded."""
    data = np.zeros(value.shape, np.float32)
    data[2 + i] = 20
    return mi.TensorXf(data)


def scene_of(mi, files, shapes=(), gaze="gaze", **more):
    integrator = with_gaze(
        files, **{"aovs": "depth,gaze,visibility", "falloff": 2.0, "observer": observer_at(mi, -2, 0.3, -2), **more}
    )
    integrator["gaze"] = {"type": "gazefield", "filename": str(files / f"{gaze}.safetensors")}
    sensor = {**camera(mi, size=6), "sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **dict(shapes)})


def check(mi, scene, key, change):
    params = mi.traverse(scene)
    start = type(params[key])(params[key])
    frozen, pictures = dr.freeze(lambda scene, seed: mi.render(scene, spp=1, seed=seed)), []
    for i in range(4):
        params[key] = change(mi, start, i)
        params.update()
        pictures.append(np.array(mi.render(scene, spp=1, seed=i)))
        assert np.allclose(np.array(frozen(scene, mi.UInt32(i))), pictures[-1], atol=2e-6), i
    # A parameter that was a number in the scene's description is recorded once more when it is an array.
    assert frozen.n_recordings <= 3
    assert not np.allclose(pictures[2], pictures[3], atol=1e-4)


@pytest.mark.parametrize(
    "key, change",
    [("falloff", scaled), ("observer.to_world", moved), ("gaze.grid.table", scaled), ("field.density_net.1", scaled)],
)
def test01_field(rgb, files, key, change):
    check(rgb, scene_of(rgb, files), f"integrator.{key}", change)


def test02_an_observer_who_starts_at_the_camera(rgb, files):
    """What may be left out for one observer may not be for the next."""
    check(rgb, scene_of(rgb, files, observer=observer_at(rgb, 0.5, 0.4, -3)), "integrator.observer.to_world", moved)


def test03_the_camera_is_the_observer(rgb, files):
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files), "sensor": camera(rgb, size=6)})
    check(rgb, scene, "sensor.to_world", moved)


@pytest.mark.parametrize("kind", ["map", "transmittance"])
def test04_other_kinds_of_visibility(rgb, files, kind):
    check(rgb, scene_of(rgb, files, visibility=kind, map_height=32), "integrator.observer.to_world", moved)


def test05_a_normalised_gaze_field(rgb, files):
    check(rgb, scene_of(rgb, files, gaze="normalized", aovs="gaze"), "integrator.observer.to_world", moved)


def test06_a_grid_whose_matter_moves(rgb):
    grid = {
        "type": "gridvolume",
        "grid": rgb.VolumeGrid(np.zeros((8, 8, 8), np.float32)),
        "to_world": rgb.ScalarTransform4f().translate(-1).scale(2),
    }
    integrator = {"type": "nerg", "density": grid, "aovs": "depth,opacity"}
    check(
        rgb,
        rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, size=6)}),
        "integrator.density.data",
        sheet,
    )


def test07_a_mesh_that_moves(rgb, files):
    cube = {"type": "cube", "to_world": rgb.ScalarTransform4f().translate([0, 0, -1.3]).scale(0.2)}
    check(
        rgb, scene_of(rgb, files, shapes={"cube": cube}), "cube.vertex_positions", lambda mi, value, i: value + 0.1 * i
    )


@pytest.mark.parametrize("key", ["gaze.emit_head.0", "falloff"])
def test08_training(rgb, files, key):
    """Derivatives of a frozen loss are those of the loss: an optimiser goes the same way."""
    scene, key = scene_of(rgb, files, aovs="gaze", radiance=False), f"integrator.{key}"
    reference = rgb.render(scene, spp=1) * 1.3
    ways = []
    start = type(rgb.traverse(scene)[key])(rgb.traverse(scene)[key])
    for frozen in (False, True):
        params = rgb.traverse(scene)
        params[key] = start
        params.update()
        params = rgb.traverse(scene)
        params.keep(key)
        opt = rgb.ad.Adam(lr=0.03)
        opt[key] = params[key]
        params.update(opt)

        def step(scene, params, reference, seed):
            loss = dr.mean(dr.square(rgb.render(scene, params, spp=1, seed=seed) - reference), axis=None)
            dr.backward(loss)
            return loss

        step = dr.freeze(step) if frozen else step
        way = []
        for i in range(4):
            way.append(step(scene, params, reference, rgb.UInt32(i)).numpy().item())
            opt.step()
            params.update(opt)
        ways.append(way)
    assert ways[0][1] != ways[0][0] and np.allclose(ways[0], ways[1], rtol=1e-5)
    assert step.n_recordings <= 3


def test09_garbage_waits_until_a_recording_is_over(rgb, files):
    """Dr.Jit ends the process where NumPy's memory is freed in the middle of a recording."""
    from nerg_mi.transport import jit

    seen = []

    def look(scene):
        with jit.no_collection():
            seen.append(gc.isenabled())
        return rgb.render(scene, spp=1)

    assert not jit.recording()
    dr.freeze(look)(scene_of(rgb, files))
    assert seen == [False] and gc.isenabled()
    with jit.no_collection():
        assert gc.isenabled()


def splat_scene(mi, **more):
    place = plugin_class("splats").of(random_splats(40, degree=1, size=0.2))
    integrator = {"type": "nerg", "id": "integrator", "field": place, "aovs": "depth,opacity", **more}
    return mi.load_dict({"type": "scene", "i": integrator, "s": camera(mi, size=6)})


def test10_gaussians_that_move(rgb):
    check(rgb, splat_scene(rgb), "integrator.field.centers", lambda mi, value, i: value + 0.1 * i)


def test11_gaussians_that_learn(rgb):
    """As weights do; and no kernel is compiled for where Gaussians have gone."""
    names = [f"integrator.field.{name}" for name in ("centers", "scales", "rotations", "opacities", "harmonics")]
    ways, reference = [], rgb.render(splat_scene(rgb), spp=1) * 0.9
    for frozen in (False, True):
        scene = splat_scene(rgb)
        params = rgb.traverse(scene)
        opt = rgb.ad.Adam(lr=1e-2, params={name: params[name] for name in names})
        params.update(opt)

        def step(scene, params, reference, seed):
            loss = dr.mean(dr.square(rgb.render(scene, params, spp=1, seed=seed) - reference), axis=None)
            dr.backward(loss)
            return loss

        step, way = dr.freeze(step) if frozen else step, []
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for i in range(5):
                if i == 3:
                    dr.kernel_history_clear()
                way.append(step(scene, params, reference, rgb.UInt32(i)).numpy().item())
                opt.step()
                params.update(opt)
            # Of all 36 pixels; others pack the Gaussians.
            found = [kernel["cache_hit"] for kernel in dr.kernel_history() if kernel["size"] == 36]
        assert all(found) and (frozen or found)
        ways.append(way)
    assert ways[0][1] != ways[0][0] and np.allclose(ways[0], ways[1], rtol=1e-4)
    assert step.n_recordings <= 3


def test12_gaussians_are_not_changed_inside(rgb):
    scene = splat_scene(rgb)
    params = rgb.traverse(scene)

    @dr.freeze
    def move(scene, params, by):
        params["integrator.field.centers"] = params["integrator.field.centers"] + by
        params.update()
        return rgb.render(scene, spp=1)

    with pytest.raises(RuntimeError) as found:
        move(scene, params, rgb.Float(0.1))
    assert "call params.update() before the function" in str(found.value.__cause__)
