"""Points that stand for a place: they lie on its surfaces, and have the gaze that the integrator gives them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

import nerg_mi as nerg
from nerg_mi.fields.splats import Splats
from nerg_mi.viewer.points import BATCH, LEVELS, bake, gather, ordered, thin, way_out


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


def test01_and_on_a_floor_of_splats(rgb):
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21)))
    n = len(x)
    centers, turns = np.stack([x, y, 0 * x], axis=1), np.tile([1.0, 0, 0, 0], (n, 1))
    floor = Splats(centers, np.tile([0.15, 0.15, 0.01], (n, 1)), turns, np.full(n, 0.95), np.ones((n, 1, 3)))
    points = last(gather(nerg.make_scene(floor), [np.array([0, 0, 1.5])], places=2)).points
    inside = np.abs(points[:, :2]).max(axis=1) < 2
    assert inside.sum() > 1000 and np.abs(points[inside, 2]).max() < 0.03


def test02_one_point_in_a_cell():
    points = np.random.default_rng(1).random((200_000, 3))
    proxy = thin([(points[:100_000], points[:100_000]), (points[100_000:], points[100_000:])], most=5000)
    cells = np.floor((proxy.points - np.percentile(points, 0.5, axis=0)) / proxy.size)
    assert 1000 < len(proxy.points) <= 5000 and len(np.unique(cells, axis=0)) >= 0.999 * len(cells)
    assert np.array_equal(proxy.points, proxy.color)
    nothing = thin([(np.zeros((0, 3)), np.zeros((0, 3)))])
    assert len(nothing.points) == 0 and [count for count, _ in nothing.levels] == [0] * LEVELS


def test03_gaze_on_points_is_that_of_the_integrator(store):
    scene = nerg.Scene.load(store, width=96, height=64)
    eye = np.array([4.4, 2.8, 1.6])
    seen = nerg.render(scene, observers=eye, quantities=["position", "gaze", "opacity"], spp=1)
    points = seen.position[0].reshape(-1, 3)
    proxy = ordered(points, np.arange(3 * len(points)).reshape(-1, 3), 0.1)
    baked = last(bake(scene, proxy, eye))
    order = proxy.color[:, 0].astype(int) // 3
    true, met = seen.gaze[0].ravel()[order], seen.opacity[0].ravel()[order] > 0.9
    assert set(baked) == {"gaze", "visibility"} and baked["gaze"].shape == true.shape
    near = np.abs(baked["gaze"] - true) < 0.02 * true.max()
    # Along edges of what the observer sees a point in half a pixel's width of them is either here or there.
    assert near[met].mean() > 0.98
    assert np.corrcoef(baked["gaze"][met], true[met])[0, 1] > 0.97


def test04_what_is_hidden_is_known(room_scene):
    # Behind the box, in front of it, and beside it.
    points = np.array([[2.5, 0, 0.01], [0.5, 0, 0.01], [1.5, 1.5, 0.01]], np.float32)
    proxy = ordered(points, points, 0.1)
    baked = last(bake(room_scene, proxy, np.array([0, 0, 0.5])))
    hidden = (proxy.points[:, 0] > 2) & (proxy.points[:, 1] == 0)
    assert np.allclose(baked["visibility"], ~hidden, atol=1e-3) and "gaze" not in baked


def test05_the_first_points_are_spread_as_all():
    points = np.random.default_rng(1).random((200_000, 3)) * [8, 6, 0.01]
    proxy = thin([(points, points)], most=40_000)
    counts = [count for count, _ in proxy.levels]
    assert counts[0] == len(proxy.points) and all(1.4 < a / b < 2.9 for a, b in zip(counts, counts[1:]))
    for count, size in proxy.levels:
        # Of a plane, whose cells are squares: no two in one, and none far from the next.
        cells = np.floor(proxy.points[:count] / size)
        assert size == proxy.size or len(np.unique(cells, axis=0)) > 0.97 * count
        away = KDTree(proxy.points[:count]).query(proxy.points)[0]
        assert away.max() < 3 * size
    nearest = KDTree(proxy.points[:BATCH]).query(proxy.points)[1]
    assert np.array_equal(proxy.near, nearest)


def test06_each_step_of_the_gaze_is_better(store):
    scene = nerg.Scene.load(store, width=96, height=64)
    eye, home = np.array([4.4, 2.8, 1.6]), np.array([6.3, 3.0, 1.6])
    proxy = last(gather(scene, [eye, home], places=4))
    assert len(proxy.points) > BATCH
    steps = list(bake(scene, proxy, eye))
    assert len(steps) == -(-len(proxy.points) // BATCH)
    final = steps[-1]["gaze"]
    off = [np.abs(step["gaze"] - final).mean() / final.mean() for step in steps]
    assert off[0] < 0.35 and sorted(off, reverse=True) == off and off[-1] == 0


def test07_who_is_put_into_something_is_put_out_before_it(room_scene):
    """The box reaches from 1 to 2 along x."""
    eyes = [np.array([0, 0, 0.5]), np.array([-2, 0, 1.0])]
    proxy = last(gather(room_scene, eyes, places=4))
    assert len(proxy.free) > 50 and (proxy.free[:, 2] > 0).all()
    inside = lambda p: np.abs(np.asarray(p) - (1.5, 0, 0.5)).max() < 0.5
    assert not any(map(inside, proxy.free))
    for at, free in (
        ((1.5, 0, 0.5), eyes[0]),
        ((1.02, 0.3, 0.2), eyes[1]),
        ((1.9, -0.4, 0.9), np.array([2.6, -1, 0.5])),
    ):
        out = way_out(room_scene, proxy, np.array(at), free)
        assert not inside(out) and np.abs(out - (1.5, 0, 0.5)).max() < 0.6
        # On the way that was taken.
        assert np.cross(out - free, np.array(at) - free) == pytest.approx(0, abs=1e-6)
    for at in ((0.5, 0, 0.5), (2.5, 0, 0.3), (1.5, 0, 1.4), (1.5, 1.2, 0.1), (9, 9, 9)):
        assert way_out(room_scene, proxy, np.array(at, float), eyes[0]) is None, at
