"""Rays that end as soon as it is known whether a point is hidden: the same answers, with fewer evaluations."""

import math
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.march_primal import MarchSettings, Occlusion
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.occlusion import trace_sight
from nerg_mi.transport.volume_medium import VolumeMedium

COUNT = 2000


@pytest.fixture
def clouds(rgb):
    """A place between air, fog and walls, and points in it that cameras and observers all around look at."""
    rng = np.random.default_rng(0)
    data = np.where(rng.random((12, 12, 12)) < 0.25, np.exp(rng.uniform(-2, 6, (12, 12, 12))), 0)
    grid = rgb.VolumeGrid(data.astype(np.float32)[..., None])
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": grid, "filter_type": "nearest"}))
    turned = rng.normal(size=(2, COUNT, 3))
    eyes = 0.5 + 2 * turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    return Place(medium), *eyes, rng.uniform(0.1, 0.9, (COUNT, 3))


def sights(mi, clouds, settings, falloff):
    """Of all points, with rays to their ends and without."""
    place, camera, observer, at = clouds
    o, d = camera, (at - camera) / np.linalg.norm(at - camera, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))
    about = place, ray, mi.Point3f(at.T), mi.Point3f(observer.T), 0, mi.Bool(True), mi.Float(falloff), settings
    return [trace_sight(*about, count=True, whole=whole) for whole in (True, False)]


@pytest.mark.parametrize(
    "depth, surface_opacity, falloff",
    [("median", 0.5, 0.2), ("median", 0.9, 0.0), ("median", 0.0, 0.1), ("refined", 0.3, 0.05), ("expected", 0.5, 0.1)],
)
def test_the_answer_is_that_of_whole_rays(rgb, clouds, depth, surface_opacity, falloff):
    settings = ObserverSettings(march=MarchSettings(0.02), depth=depth, surface_opacity=surface_opacity, tolerance=0.05)
    whole, short = sights(rgb, clouds, settings, falloff)
    seen, evaluations = whole.visibility.numpy(), [s.density_evals.numpy().mean() for s in (whole, short)]
    assert np.array_equal(short.visibility.numpy(), seen)
    assert 0.1 < seen.mean() < 0.9
    # Where gaze is not 0, it is that of the same place.
    assert np.array_equal(np.array(short.p_od)[:, seen > 0], np.array(whole.p_od)[:, seen > 0])
    if depth == "expected":
        # What lies behind the point moves a mean: there is no early end.
        assert evaluations[0] == evaluations[1]
    else:
        assert evaluations[1] < 0.9 * evaluations[0]


def test_what_is_known_of_a_hidden_point_lies_before_it(rgb, clouds):
    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    whole, short = sights(rgb, clouds, settings, 0.0)
    hidden = whole.visibility.numpy() == 0
    before = np.linalg.norm(clouds[3] - clouds[2], axis=1)[hidden]
    assert np.all(short.depth.numpy()[hidden] < before)
    # Of opaque rays it is the surface itself; of others it lies behind that.
    found, surface = short.depth.numpy()[hidden], whole.depth.numpy()[hidden]
    assert np.mean(np.isclose(found, surface, rtol=1e-5)) > 0.5 and np.all(found > surface - 1e-4)


def test_by_shapes_in_the_medium_too(rgb, clouds):
    ball = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.3}
    scene = rgb.load_dict({"type": "scene", "ball": ball})
    place = Place(clouds[0].medium, scene)
    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    whole, short = sights(rgb, (place, *clouds[1:]), settings, 0.1)
    assert np.array_equal(short.visibility.numpy(), whole.visibility.numpy())
    assert short.density_evals.numpy().mean() < whole.density_evals.numpy().mean()


def test_derivatives_take_whole_rays(rgb, clouds):
    import drjit as dr

    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    place, camera, observer, at = clouds
    p_o = rgb.Point3f(observer.T)
    dr.enable_grad(p_o)
    d = (at - camera) / np.linalg.norm(at - camera, axis=1, keepdims=True)
    ray = rgb.Ray3f(rgb.Point3f(camera.T), rgb.Vector3f(d.T))
    sight = trace_sight(place, ray, rgb.Point3f(at.T), p_o, 0, rgb.Bool(True), rgb.Float(0.3), settings, whole=False)
    dr.backward(dr.sum(sight.visibility))
    assert np.all(np.isfinite(np.array(p_o.grad))) and np.abs(np.array(p_o.grad)).max() > 0


def test_limits_of_what_is_known(rgb):
    asked = Occlusion(rgb.Float(2), rgb.Float(1.5), 0.5)
    quarter, half = -math.log(0.75), math.log(2)
    t = rgb.Float([1.9, 2.0, 2.0])
    assert asked.clear(t, rgb.Float([0, 0.99 * quarter, 1.01 * quarter])).numpy().tolist() == [False, True, False]
    t = rgb.Float([1.4, 1.4, 1.6])
    assert asked.hidden(t, rgb.Float([0.99 * half, 1.01 * half, 9])).numpy().tolist() == [False, True, False]
    # All light must be lost: no ray is sure to do so before its end.
    assert not np.any(replace(asked, surface_opacity=1.0).hidden(t, rgb.Float(100.0)).numpy())
