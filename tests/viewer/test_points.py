"""Tests of `nerg_mi.viewer.points`."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import nerg_mi as nerg
from nerg_mi.fields.splats import Splats
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.viewer.points import (
    BAND_SIZES,
    BATCH_SIZE,
    NUM_LEVELS,
    ROUGH_DIRECTIONS,
    BandPace,
    PinholeView,
    compute_point_gaze,
    downsample_points,
    find_free_position,
    gather_points,
    make_heading,
    order_points,
    refine,
    rough_integrals,
)

# ---- Point proxy: on surfaces, with the gaze of the integrator ----


def last(steps):
    return [one for one in steps if one is not None][-1]


def test01_points_are_on_surfaces(room_scene):
    proxies = [p for p in gather_points(room_scene, [np.array([0, 0, 0.5])], max_positions=3) if p is not None]
    assert len(proxies) == 2 and len(proxies[0].points) < len(proxies[1].points)
    x, y, z = proxies[-1].points.T.astype(float)
    off = np.maximum(np.maximum(np.abs(x - 1.5), np.abs(y)), np.abs(z - 0.5)) - 0.5
    assert (np.minimum(np.abs(z), np.abs(off)) < 1e-3).all()
    assert (np.abs(off) < 1e-3).sum() > 100
    lower, upper = proxies[-1].bounds
    assert (lower > -3.01).all() and (upper < 3.01).all() and upper[2] > 0.9


def test01c_points_are_as_bright_as_surfaces(room_scene):
    """The light on shapes is the mean of several samples."""
    eye = np.array([0, 0, 0.5])
    proxy = last(gather_points(room_scene, [eye], max_positions=1))
    directions = (proxy.points - eye) / np.linalg.norm(proxy.points - eye, axis=1, keepdims=True)
    true = np.mean([nerg.trace(room_scene, eye, directions, ["color"], seed=seed).color for seed in range(4)], axis=0)
    np.testing.assert_allclose(proxy.color.mean(axis=0), true.mean(axis=0), rtol=0.1)


def test01b_points_are_on_splats(rgb):
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21)))
    n = len(x)
    centers, turns = np.stack([x, y, 0 * x], axis=1), np.tile([1.0, 0, 0, 0], (n, 1))
    floor = Splats(centers, np.tile([0.15, 0.15, 0.01], (n, 1)), turns, np.full(n, 0.95), np.ones((n, 1, 3)))
    points = last(gather_points(nerg.make_scene(floor), [np.array([0, 0, 1.5])], max_positions=2)).points
    inside = np.abs(points[:, :2]).max(axis=1) < 2
    assert inside.sum() > 1000 and np.abs(points[inside, 2]).max() < 0.03


def test02_one_point_per_cell():
    points = np.random.default_rng(1).random((200_000, 3))
    proxy = downsample_points(
        [(points[:100_000], points[:100_000]), (points[100_000:], points[100_000:])], max_points=5000
    )
    cells = np.floor((proxy.points - np.percentile(points, 0.5, axis=0)) / proxy.size)
    assert 1000 < len(proxy.points) <= 5000 and len(np.unique(cells, axis=0)) >= 0.999 * len(cells)
    assert np.array_equal(proxy.points, proxy.color)
    empty = downsample_points([(np.zeros((0, 3)), np.zeros((0, 3)))])
    assert len(empty.points) == 0 and [count for count, _ in empty.levels] == [0] * NUM_LEVELS


def test03_gaze_on_points_equals_integrator(store):
    scene = nerg.Scene.load(store, width=96, height=64)
    eye = np.array([4.4, 2.8, 1.6])
    seen = nerg.render(scene, observers=eye, quantities=["position", "gaze", "opacity"], spp=1)
    points = seen.position[0].reshape(-1, 3)
    proxy = order_points(points, np.arange(3 * len(points)).reshape(-1, 3), 0.1)
    baked = last(compute_point_gaze(scene, proxy, eye))
    order = proxy.color[:, 0].astype(int) // 3
    true, hit = seen.gaze[0].ravel()[order], seen.opacity[0].ravel()[order] > 0.9
    assert set(baked) == {"gaze", "visibility"} and baked["gaze"].shape == true.shape
    near = np.abs(baked["gaze"] - true) < 0.02 * true.max()
    # Near silhouettes, a point within half a pixel can be on either side.
    assert near[hit].mean() > 0.98
    assert np.corrcoef(baked["gaze"][hit], true[hit])[0, 1] > 0.97


def test04_occluded_points_are_invisible(room_scene):
    # Behind the box, in front of it, and next to it.
    points = np.array([[2.5, 0, 0.01], [0.5, 0, 0.01], [1.5, 1.5, 0.01]], np.float32)
    proxy = order_points(points, points, 0.1)
    baked = last(compute_point_gaze(room_scene, proxy, np.array([0, 0, 0.5])))
    hidden = (proxy.points[:, 0] > 2) & (proxy.points[:, 1] == 0)
    assert np.allclose(baked["visibility"], ~hidden, atol=1e-3) and "gaze" not in baked


def test05_levels_cover_the_scene_evenly():
    points = np.random.default_rng(1).random((200_000, 3)) * [8, 6, 0.01]
    proxy = downsample_points([(points, points)], max_points=40_000)
    counts = [count for count, _ in proxy.levels]
    assert counts[0] == len(proxy.points) and all(1.4 < a / b < 2.9 for a, b in zip(counts, counts[1:]))
    for count, size in proxy.levels:
        # On a plane with square cells: no two points in one cell, and no large gaps.
        cells = np.floor(proxy.points[:count] / size)
        assert size == proxy.size or len(np.unique(cells, axis=0)) > 0.97 * count
        away = KDTree(proxy.points[:count]).query(proxy.points)[0]
        assert away.max() < 3 * size
    nearest = KDTree(proxy.points[:BATCH_SIZE]).query(proxy.points)[1]
    assert np.array_equal(proxy.nearest, nearest)


def test06_gaze_improves_with_each_step(store):
    scene = nerg.Scene.load(store, width=96, height=64)
    eye, home = np.array([4.4, 2.8, 1.6]), np.array([6.3, 3.0, 1.6])
    proxy = last(gather_points(scene, [eye, home], max_positions=4))
    assert len(proxy.points) > BATCH_SIZE
    steps = list(compute_point_gaze(scene, proxy, eye))
    assert len(steps) == -(-len(proxy.points) // BATCH_SIZE)
    final = steps[-1]["gaze"]
    off = [np.abs(step["gaze"] - final).mean() / final.mean() for step in steps]
    assert off[0] < 0.35 and sorted(off, reverse=True) == off and off[-1] == 0


def test07_position_in_a_solid_is_moved_out(room_scene):
    """The box extends from 1 to 2 along x."""
    positions = [np.array([0, 0, 0.5]), np.array([-2, 0, 1.0])]
    proxy = last(gather_points(room_scene, positions, max_positions=4))
    assert len(proxy.free_positions) > 50 and (proxy.free_positions[:, 2] > 0).all()
    inside = lambda p: np.abs(np.asarray(p) - (1.5, 0, 0.5)).max() < 0.5
    assert not any(map(inside, proxy.free_positions))
    for at, free in (
        ((1.5, 0, 0.5), positions[0]),
        ((1.02, 0.3, 0.2), positions[1]),
        ((1.9, -0.4, 0.9), np.array([2.6, -1, 0.5])),
    ):
        out = find_free_position(room_scene, proxy, np.array(at), free)
        assert not inside(out) and np.abs(out - (1.5, 0, 0.5)).max() < 0.6
        # On the line from the free position.
        assert np.cross(out - free, np.array(at) - free) == pytest.approx(0, abs=1e-6)
    for at in ((0.5, 0, 0.5), (2.5, 0, 0.3), (1.5, 0, 1.4), (1.5, 1.2, 0.1), (9, 9, 9)):
        assert find_free_position(room_scene, proxy, np.array(at, float), positions[0]) is None, at


# ---- Progressive refinement ----

QUANTITIES = ["color", "depth", "opacity", "visibility"]


def test08_final_picture_equals_integrator(room_scene):
    view = PinholeView.from_sensor(room_scene.resolve_sensor(0))
    steps = list(refine(room_scene, view, np.array([0, 0, 0.5]), QUANTITIES, 48, 64, BandPace()))
    pictures = [p for p in steps if p is not None]
    assert [p.downsampling for p in pictures[:2]] == [4, 2] and [p.samples for p in pictures[2:]] == [
        1,
        2,
        4,
        8,
        16,
        32,
        64,
    ]
    assert pictures[0].values["depth"].shape == (8, 12) and pictures[-1].values["color"].shape == (32, 48, 3)
    assert [p.is_final for p in pictures] == [False] * (len(pictures) - 1) + [True]
    true = nerg.render(room_scene, quantities=QUANTITIES, camera=view.to_camera(48), spp=256)
    for name, tolerance in (("color", 0.02), ("depth", 0.02), ("visibility", 0.02)):
        assert np.abs(pictures[-1].values[name] - true[name][0]).mean() < tolerance, name
    # Each picture is closer to the reference than the first one of its size.
    errors = [np.abs(p.values["color"] - true.color[0]).mean() for p in pictures[2:]]
    assert errors[-1] < 0.5 * errors[0]
    # Pictures of a part of the samples are as bright as the last one.
    np.testing.assert_allclose([p.values["color"].mean() for p in pictures[2:]], true.color.mean(), rtol=0.05)


def test09_equal_seeds_give_equal_pictures(room_scene):
    view = PinholeView.from_sensor(room_scene.resolve_sensor(0))
    names = ["depth", "opacity"]
    one, other = BandPace(), BandPace()
    other._index = 2
    first, second = (list(refine(room_scene, view, None, names, 150, 2, pace))[-1] for pace in (one, other))
    assert first is not None and second is not None
    assert np.allclose(first.values["depth"], second.values["depth"], atol=1e-5)


def test10_closed_refinement_traces_no_more(room_scene, monkeypatch):
    import nerg_mi.viewer.points as module

    traced = []
    original = module.trace
    monkeypatch.setattr(module, "trace", lambda *a, **k: traced.append(len(a[2])) or original(*a, **k))
    view = PinholeView.from_sensor(room_scene.resolve_sensor(0))
    steps = refine(room_scene, view, None, ["depth", "opacity"], 400, 4, BandPace())
    next(steps)
    steps.close()
    assert traced == [BAND_SIZES[0]]


def test11_band_size_adapts_to_time(monkeypatch):
    pace = BandPace()
    for _ in range(10):
        pace.record(0.01)
    assert pace.num_rays == BAND_SIZES[-1]
    pace.record(20.0)  # a kernel was compiled
    assert pace.num_rays == BAND_SIZES[-1]
    for _ in range(20):
        pace.record(20.0)
    assert pace.num_rays == BAND_SIZES[0]


def test12_ceiling_is_hidden_from_above(room_scene):
    up = np.array([0.0, 0, 1])
    view = PinholeView.look_at((1.5, 0, 5), (1.5, 0.01, 0), up, 0.3, 1.0)
    is_visible = list(refine(room_scene, view, None, ["depth", "opacity"], 32, 1, BandPace()))[-1]
    cut = list(refine(room_scene, view, None, ["depth", "opacity"], 32, 1, BandPace(), ceiling=Ceiling(0.5, up)))[-1]
    assert is_visible is not None and cut is not None
    # The top of the box is at z = 1, 4 below the camera; below the ceiling is the floor.
    assert is_visible.values["depth"][16, 16] == pytest.approx(4, abs=0.02)
    assert cut.values["depth"][16, 16] == pytest.approx(5, abs=0.02)
    assert room_scene.integrator.ceiling is None


def test13_integrals_are_rough_until_the_final_picture(store):
    scene = nerg.Scene.load(store)
    settings = scene.integrator.observer_settings
    with rough_integrals(scene):
        assert scene.integrator.observer_settings == replace(settings, directions=ROUGH_DIRECTIONS)
    with rough_integrals(scene, False):
        assert scene.integrator.observer_settings is settings
    with pytest.raises(ZeroDivisionError), rough_integrals(scene):
        raise ZeroDivisionError
    assert scene.integrator.observer_settings is settings


# ---- Views ----


def test14_view_from_page():
    # Forward along +y, down along -z: a horizontal camera.
    turn = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]))
    x, y, z, w = turn.as_quat()
    camera = SimpleNamespace(
        wxyz=(w, x, y, z), position=(1.0, 2.0, 3.0), fov=0.8, image_width=600, image_height=400, aspect=1.5
    )
    view = PinholeView.from_page(camera)
    assert np.allclose(view.forward, [0, 1, 0]) and np.allclose(view.up, [0, 0, 1])
    assert view.aspect == 1.5 and view.fov == 0.8 and np.allclose(view.origin, [1, 2, 3])  # noqa: RUF069 (stored)


def test15_rays_equal_mitsuba_sensor(rgb):
    view = PinholeView.look_at((1, 2, 3), (4, 3, 1), (0, 0, 1), 0.9, 1.5)
    sensor = rgb.load_dict(view.to_camera(30).to_dict())
    height = view.picture_height(30)
    assert height == 20
    columns, rows = np.meshgrid((np.arange(30) + 0.5) / 30, (np.arange(20) + 0.5) / 20)
    at = rgb.Point2f(columns.ravel().astype(np.float32), rows.ravel().astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, at, rgb.Point2f(0.5))
    directions = view.ray_directions(30, height, np.full((600, 2), 0.5))
    assert np.allclose(directions, np.array(ray.d).T, atol=1e-5)


def test16_view_from_sensor(rgb):
    view = PinholeView.look_at((1, 2, 3), (4, 3, 1), (0, 0, 1), 0.9, 1.5)
    copy = PinholeView.from_sensor(rgb.load_dict(view.to_camera(300).to_dict()))
    for name in ("origin", "forward", "up", "fov", "aspect"):
        assert np.allclose(getattr(copy, name), getattr(view, name), atol=1e-5), name
    assert math.isclose(view.fov_x_degrees, math.degrees(2 * math.atan(math.tan(0.45) * 1.5)))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1)])
def test17_vertical_view_has_an_up_direction(up):
    view = PinholeView.look_at((0, 0, 5), (0, 0, 0), up, 0.9, 1.0)
    assert math.isclose(np.linalg.norm(view.up), 1) and abs(view.up @ view.forward) < 1e-9


def test18_heading_is_horizontal():
    for ahead in ((1, 2, -0.7), (0, 0, -1), (0, 0, 1)):
        turn = make_heading(np.array(ahead, float) / np.linalg.norm(ahead), np.array([0.0, 0, 1]))
        assert np.allclose(turn.T @ turn, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
        assert np.allclose(turn[:, 2], [0, 0, 1])
