"""Points that stand for a place: they lie on its surfaces, and have the gaze that the integrator gives them."""

from __future__ import annotations

import numpy as np

import nerg_mi as nerg
from nerg_mi.viewer.proxy import Proxy, bake, gather, thin


def last(steps):
    return [one for one in steps if one is not None][-1]


def test01_points_lie_on_the_surfaces(room_scene):
    proxies = [p for p in gather(room_scene, [np.array([0, 0, 0.5])], places=3) if p is not None]
    assert len(proxies) == 2 and len(proxies[0].points) < len(proxies[1].points)
    x, y, z = proxies[-1].points.T.astype(float)
    off = np.maximum(np.maximum(np.abs(x - 1.5), np.abs(y)), np.abs(z - 0.5)) - 0.5
    assert (np.minimum(np.abs(z), np.abs(off)) < 1e-3).all()
    assert (np.abs(off) < 1e-3).sum() > 100
    lower, upper = proxies[-1].bounds
    assert (lower > -3.01).all() and (upper < 3.01).all() and upper[2] > 0.9


def test02_one_point_in_a_cell():
    points = np.random.default_rng(1).random((200_000, 3))
    proxy = thin([(points[:100_000], points[:100_000]), (points[100_000:], points[100_000:])], most=5000)
    cells = np.floor((proxy.points - np.percentile(points, 0.5, axis=0)) / proxy.size)
    assert 1000 < len(proxy.points) <= 5000 and len(np.unique(cells, axis=0)) >= 0.999 * len(cells)
    assert np.array_equal(proxy.points, proxy.color)
    assert len(thin([(np.zeros((0, 3)), np.zeros((0, 3)))]).points) == 0


def test03_gaze_on_points_is_that_of_the_integrator(store):
    scene = nerg.Scene.load(store, width=96, height=64)
    eye = np.array([4.4, 2.8, 1.6])
    seen = nerg.render(scene, observers=eye, quantities=["position", "gaze", "opacity"], spp=1)
    points = seen.position[0].reshape(-1, 3)
    proxy = Proxy(points, np.zeros_like(points), 0.1)
    baked = last(bake(scene, proxy.points, eye))
    true, met = seen.gaze[0].ravel(), seen.opacity[0].ravel() > 0.9
    assert set(baked) == {"gaze", "visibility"} and baked["gaze"].shape == true.shape
    near = np.abs(baked["gaze"] - true) < 0.02 * true.max()
    # Along edges of what the observer sees a point in half a pixel's width of them is either here or there.
    assert near[met].mean() > 0.98
    assert np.corrcoef(baked["gaze"][met], true[met])[0, 1] > 0.97


def test04_what_is_hidden_is_known(room_scene):
    # Behind the box, in front of it, and beside it.
    points = np.array([[2.5, 0, 0.01], [0.5, 0, 0.01], [1.5, 1.5, 0.01]], np.float32)
    baked = last(bake(room_scene, points, np.array([0, 0, 0.5])))
    assert np.allclose(baked["visibility"], [0, 1, 1], atol=1e-3) and "gaze" not in baked
