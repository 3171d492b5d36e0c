"""A place as points: on its surfaces, with normals that face who saw them."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.api.scene import make_scene
from nerg_mi.report.data import place_proxy, smooth_normals, spread_out, surface_normals, thin

LOW, HIGH = np.array([-2.0, -3.0, 0.0]), np.array([2.0, 3.0, 3.0])


@pytest.fixture
def room(rgb):
    to_world = rgb.ScalarTransform4f().translate((0.5 * (LOW + HIGH)).tolist()).scale((0.5 * (HIGH - LOW)).tolist())
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    box = {"type": "cube", "to_world": to_world, "flip_normals": True, "bsdf": red}
    light = {"type": "point", "position": [0, 0, 1.5], "intensity": {"type": "rgb", "value": [9.0, 9, 9]}}
    inner = {"type": "path", "max_depth": 2}
    scene = make_scene(shapes={"box": box, "light": light}, inner=inner, aovs="opacity,position")
    return scene.mitsuba


def test_points_lie_on_the_walls_and_face_inwards(room):
    eyes = np.array([[0.0, 0, 1.5], [1, 2, 1.0]])
    told = []
    gaze = lambda observer, points, spacing: np.linalg.norm(points - observer, axis=1)
    up = np.array([0.0, 0, 1])
    found = place_proxy(room, eyes, up, eyes[:1], gaze, 3000, (96, 48), lambda *done: told.append(done))
    p = found.vertices
    to_wall = np.minimum(np.abs(p - LOW), np.abs(p - HIGH)).min(axis=1)
    assert 500 < len(p) <= 3000 and to_wall.max() < 0.5 * found.spacing + 1e-3 and told == [(1, 2), (2, 2)]
    # Close to an edge a point is of two walls.
    flat = np.sort(np.minimum(np.abs(p - LOW), np.abs(p - HIGH)), axis=1)[:, 1] > 2 * found.spacing
    centre = (LOW + HIGH) / 2
    inward = ((centre - p) * found.normals).sum(axis=1)
    assert (inward[flat] > 0).all() and (np.abs(found.normals[flat]).max(axis=1) > 0.98).mean() > 0.95
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-4)
    lit = found.colors[found.colors.max(axis=1) > 60]
    assert len(lit) > 100 and (lit[:, 0] > lit[:, 1]).all()  # a red room
    assert np.allclose(found.gaze[0], np.linalg.norm(p - eyes[0], axis=1), atol=1e-4)
    for side in range(3):
        for end in (LOW, HIGH):
            assert (np.abs(p[:, side] - end[side]) < found.spacing).any()


def test_thinning_keeps_the_two_sides_of_a_wall_apart():
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(0, 4, (4000, 2)), np.zeros((4000, 1))], axis=1)
    points = np.concatenate([flat, flat + [0, 0, 1e-4]])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], 4000, axis=0)
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1]], 4000, axis=0)
    p, c, edge = thin(points, normals, colors, 500)
    assert len(p) <= 500 and set(map(tuple, np.round(c, 6))) == {(1, 0, 0), (0, 0, 1)}
    # Every point has a representative in its cube.
    apart = np.linalg.norm(points[:, None, :] - p[None], axis=2).min(axis=1)
    assert apart.max() <= edge * np.sqrt(2) + 1e-9


def test_thinning_leaves_few_points_alone():
    p = np.array([[0.0, 0, 0], [1, 1, 1]])
    found = thin(p, np.array([[0.0, 0, 1]] * 2), np.ones((2, 3)), 10)
    assert np.allclose(found[0], p)
    alone = thin(p[:1], np.array([[0.0, 0, 1]]), np.ones((1, 3)), 10)
    assert np.allclose(alone[0], p[:1]) and alone[2] > 0


def test_normals_of_a_plane_and_an_edge():
    u, v = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 10))
    plane = np.stack([u, v, 0.5 * u + 2], axis=-1)
    expected = np.array([0.5, 0, -1]) / np.sqrt(1.25)
    normals = surface_normals(plane, -plane)
    assert np.allclose(normals[:, 1:-1], expected, atol=1e-6)
    step = np.where(u[..., None] < 0, plane, plane + [0, 0, 5])
    assert np.allclose(surface_normals(step, -step)[:, 1:-1], expected, atol=1e-6)
    hole = plane.copy()
    hole[4, 7] = np.nan
    assert np.isfinite(surface_normals(hole, -np.nan_to_num(hole, nan=1.0))).all()


def test_smooth_normals_of_a_noisy_ball():
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = outward * (2 + rng.normal(0, 0.003, (4000, 1)))
    found = smooth_normals(points, [0.3, 0.1, 0.5] + 5 * outward)
    assert np.percentile((found * outward).sum(axis=1), 5) > 0.97 and np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.allclose(smooth_normals(points[:2], 3 * outward[:2]), outward[:2])


def test_places_far_apart():
    line = np.linspace(0, 10, 11)[:, None] * [1.0, 0, 0]
    assert sorted(spread_out(line, 3, first=np.zeros(3)).tolist()) == [3, 5, 10] or spread_out(
        line, 2, first=np.zeros(3)
    ).tolist() == [10, 5]
    assert spread_out(line, 2).tolist() == [0, 10]
    assert len(spread_out(np.zeros((5, 3)), 3)) == 1 and len(spread_out(np.zeros((0, 3)), 3)) == 0
