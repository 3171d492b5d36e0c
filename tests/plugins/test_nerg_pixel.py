"""Lazy evaluation along one camera ray; contexts with other AOVs, and several observers of the same rays."""

from functools import cached_property

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport import observer_gaze
from nerg_mi.transport.geometry import SceneGeometry

from . import fields
from .scenes import camera, look_at, make_observer, named, picture, plugin, scene_with, stored, with_gaze

# ---- Lazy evaluation along one camera ray ----


@pytest.fixture
def traced(monkeypatch):
    """One entry per traced ray: the origin of its first lane."""
    result, trace = [], SceneGeometry.trace
    monkeypatch.setattr(
        SceneGeometry, "trace", lambda *a, **k: (result.append(np.array(a[1].o)[:, 0]), trace(*a, **k))[1]
    )
    return result


def pixel(mi, integrator, eye=(0.5, 0.4, -3), **overrides):
    """Rays from a camera at ``eye`` to the field and past it."""
    scene = scene_with(mi, {**integrator, **overrides}, camera(mi, eye))
    o = mi.Point3f(*map(float, eye))
    target = mi.Point3f([0, 0.1, 9], [0, 0.1, 9], 0)
    ray = mi.Ray3f(o + dr.zeros(mi.Point3f, 3), dr.normalize(target - o))
    context = scene.integrator().context()
    return context.trace(scene, scene.sensors(), None, ray, mi.Bool(True)).make_pixel()


def test01_values_are_computed_on_first_access(rgb, files, traced):
    result = pixel(rgb, with_gaze(files, "gaze,visibility", observer=make_observer(rgb, -2, 0.3, -2)))
    assert len(traced) == 1
    result.camera.depth, result.camera.has_surface, result.camera.p_d, result.r_o  # noqa: B018
    assert len(traced) == 1
    result.observer_hit, result.surface_gaze, result.observer_hit  # noqa: B018
    assert len(traced) == 2 and np.allclose(traced[1], (-2, 0.3, -2))


@pytest.mark.parametrize("observer", [None, (0.5, 0.4, -3)])
def test02_observer_at_the_camera_sees_the_same(rgb, files, traced, observer):
    overrides = {} if observer is None else {"observer": make_observer(rgb, *observer)}
    result = pixel(rgb, with_gaze(files, "gaze,visibility", **overrides))
    assert result.is_aligned and np.allclose(np.array(result.observer.p_o).T, (0.5, 0.4, -3))
    assert (result.observer_hit.visibility.numpy() == 1).all() and len(traced) == 1
    assert np.allclose(result.observer_hit.depth.numpy()[:2], result.camera.depth.numpy()[:2], rtol=1e-5)


def test03_gaze_is_zero_without_a_surface(rgb, files):
    result = pixel(rgb, with_gaze(files, "gaze,emit"))
    surface = result.camera.has_surface.numpy()
    assert surface.tolist() == [True, True, False]
    for value in (result.surface_gaze.gaze, result.surface_gaze.emit, result.surface_gaze.capture):
        assert ((value.numpy() > 0) == surface).all()
    assert result.surface_gaze.evaluations.numpy().tolist() == [2, 2, 0] and result.surface_gaze.std is None


def test03b_networks_are_evaluated_on_visible_surfaces_only(rgb, files):
    """Results equal those of full evaluation, as with gradients; with factors, on all surfaces."""

    def attention(aovs, attached):
        integrator = with_gaze(files, aovs, observer=make_observer(rgb, -0.2, 3, 0.1), falloff=0.0)
        scene = scene_with(rgb, integrator, camera(rgb, (0.5, 0.4, -3)))
        if attached:
            params = rgb.traverse(scene)
            dr.enable_grad(params["integrator.gaze.emit_head.0"])
            params.update()
        result = named(rgb, picture(rgb, scene), integrator)
        return {name.split(".")[0]: values for name, values in result.items()}

    aovs = "gaze,gaze_evals,visibility,opacity"
    seen, everywhere = (attention(aovs, attached) for attached in (False, True))
    np.testing.assert_array_equal(seen["gaze"], everywhere["gaze"])
    surface, visible = seen["opacity"] >= 0.5, seen["visibility"] > 0
    assert (surface & visible).any() and (surface & ~visible).any() and (seen["gaze"][surface & visible] > 0).all()
    np.testing.assert_array_equal(seen["gaze_evals"], np.where(surface & visible, 2, 0))
    full = attention(aovs + ",emit", False)
    np.testing.assert_array_equal(full["gaze_evals"], np.where(surface, 2, 0))
    np.testing.assert_allclose(full["gaze"], seen["gaze"], rtol=1e-5)


def test04_evaluation_counts_cover_all_marches(rgb, files):
    integrator = with_gaze(files, "visibility,density_evals", observer=make_observer(rgb, -2, 0.3, -2))
    result = pixel(rgb, integrator)
    alone = result.count_density_evaluations().numpy()
    result.observer_hit  # noqa: B018
    assert (result.count_density_evaluations().numpy()[:2] > alone[:2]).all() and (alone[:2] > 5).all()


@pytest.mark.parametrize(
    "aovs, looked_up", [("gaze", True), ("gaze,gaze_evals,depth", True), ("gaze,emit", False), ("visibility", False)]
)
def test05_map_replaces_gaze_only(rgb, files, aovs, looked_up):
    """A map stores neither factors nor unrequested values."""
    observer = make_observer(rgb, -2, 0.3, -2)
    result = pixel(rgb, with_gaze(files, aovs, observer=observer, visibility="map", map_height=32))
    assert (result.observer_hit.gaze is not None) == looked_up
    assert bool(result.context.nerg.cache.peek("gaze of map")) == looked_up
    assert len(result.context.nerg.cache.peek("map")) == 1


def test07_each_observer_has_its_own_pixel(rgb, files):
    """All values of a pixel follow its observer; the camera's part is one object without an observer."""
    first = pixel(rgb, with_gaze(files, "gaze,visibility,density_evals", observer=make_observer(rgb, -2, 0.3, -2)))
    for name, value in vars(type(first)).items():
        assert not isinstance(value, cached_property) or getattr(first, name) is not None
    other = first.camera.make_pixel(first.context.make_observer((2, 0.3, -2)))
    assert other.camera is first.camera and not set(vars(other)) & {"observer", "sight", "gaze", "attention"}
    assert not np.allclose(np.array(other.r_o), np.array(first.r_o))
    assert not np.allclose(other.surface_gaze.gaze.numpy(), first.surface_gaze.gaze.numpy())


# ---- The integrator's context for other AOVs, arbitrary rays, and several observers of the same rays ----

POSITIONS = [(0.3, -3, 0.4), (2.5, -1, 0.5), (-1.5, -2.0, 1.0)]


@pytest.fixture
def scene(rgb, files):
    field, gaze = stored("nerf", files / "field.safetensors"), stored("gazefield", files / "gaze.safetensors")
    return rgb.load_dict({"type": "scene", "integrator": plugin("nerg", field=field, gaze=gaze)})


@pytest.fixture
def ray(rgb):
    o, d = np.float32([(0, -3, 0), (0.2, -3, 0.3)]), np.float32([(0, 1, 0), (0, 1, -0.1)])
    return rgb.RayDifferential3f(rgb.Point3f(o.T.copy()), dr.normalize(rgb.Vector3f(d.T.copy())))


def sampler(mi):
    made = mi.load_dict({"type": "independent"})
    made.seed(0, 2)
    return made


def traced_for(mi, scene, aovs, ray, sensors=()):
    """``(context for these AOVs, result of tracing the camera's ray)``."""
    context = scene.integrator().make_context(aovs, False)
    return context, context.trace(scene, sensors, sampler(mi), ray, mi.Bool(True))


def test01_observer_dependent_aovs(scene):
    context = scene.integrator().make_context(["depth", "gaze", "position", "visibility"], True)
    assert context.shared_aovs == ["depth", "position"] and context.observer_aovs == ["gaze", "visibility"]
    assert context.channel_names(context.shared_aovs) == ["depth.T", "position.X", "position.Y", "position.Z"]
    # All other settings are the integrator's, which is unchanged.
    assert scene.integrator().aov_names() == ["depth.T", "opacity.Y"]


def test03_values_match_a_rendering(rgb, scene, ray):
    names = ["gaze", "visibility", "gaze_evals"]
    context, camera = traced_for(rgb, scene, ["depth", *names], ray)
    camera.eval_shared()
    for eye in POSITIONS:
        result = camera.make_pixel(context.make_observer(eye)).compute_channels(names)
        observer = {"type": "perspective", "to_world": rgb.ScalarTransform4f().translate(list(eye))}
        alone = plugin("nerg", aovs=",".join(names), observer=observer, **scene.integrator().children)
        expected = rgb.load_dict(alone).sample(scene, sampler(rgb), ray)[2]
        for mine, theirs in zip(result, expected):
            assert np.array_equal(np.array(mine), np.array(theirs))


def test05_camera_rays_are_traced_once_for_several_observers(rgb, scene, ray, traced):
    context, camera = traced_for(rgb, scene, ["depth", "gaze", "visibility"], ray)
    camera.eval_shared()
    kernels = []
    for eye in POSITIONS:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(camera.make_pixel(context.make_observer(eye)).compute_channels(["gaze", "visibility"]))
            kernels.append({k["hash"] for k in dr.kernel_history() if "hash" in k})
    assert kernels[0] and kernels[0] == kernels[1] == kernels[2] and len(traced) == 1 + len(POSITIONS)


def test06_observer_at_the_camera_position(rgb, scene):
    to_world = look_at(rgb, (0, -3, 0), up=(0, 0, 1))
    sensor = rgb.load_dict({"type": "perspective", "to_world": to_world})
    ray, _ = sensor.sample_ray_differential(0, 0, rgb.Point2f([0.4, 0.5], [0.5, 0.6]), rgb.Point2f(0.5))
    context, camera = traced_for(rgb, scene, ["gaze", "visibility", "density_evals"], ray, [sensor])
    moved, elsewhere = (camera.make_pixel(context.make_observer(eye)) for eye in ((0, -3, 0), POSITIONS[1]))
    assert moved.is_aligned and not elsewhere.is_aligned
    # For other observers a second march decides what they see.
    evaluations = lambda pixel: np.array(pixel.compute_channels(["visibility", "density_evals"])[1])
    assert np.all(evaluations(moved) < evaluations(elsewhere))
    separate = camera.make_pixel_per_origin()
    assert separate.is_aligned and np.allclose(
        *(np.array(p.compute_channels(["gaze"])[0]) for p in (separate, moved)), rtol=1e-3
    )


def test08_integrals_of_several_observers_are_cached(rgb, files, tmp_path, ray, monkeypatch):
    """Two alternating observers: each has its own integral, computed once."""
    fields.gaze(tmp_path / "gaze.safetensors", normalized=True)
    field, gaze = stored("nerf", files / "field.safetensors"), stored("gazefield", tmp_path / "gaze.safetensors")
    scene = rgb.load_dict({"type": "scene", "integrator": plugin("nerg", field=field, gaze=gaze)})
    result, integrate_sphere = [], observer_gaze.integrate_sphere
    monkeypatch.setattr(observer_gaze, "integrate_sphere", lambda *a: result.append(1) or integrate_sphere(*a))

    def values():
        context, camera = traced_for(rgb, scene, ["gaze"], ray)
        pixels = (camera.make_pixel(context.make_observer(eye)) for eye in POSITIONS[:2])
        return [np.array(pixel.compute_channels(["gaze"])[0]) for pixel in pixels]

    np.testing.assert_array_equal(values(), values())
    assert len(result) == 2
