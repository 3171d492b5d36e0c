"""Choice of a camera in scenes with closed-form depths."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment.overview import PinholeFrame, SeenSurfaces, ViewScorer, view_of_observer, view_of_scene
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.sphere import fibonacci_directions

UP = np.array([0.0, 0, 1])
FRAME = PinholeFrame(70, 1.5, UP)


def room(lower=(0, 0, 0), upper=(8, 6, 3), pillar=None):
    """Depths in a room with these corners, with a box in it."""

    def trace(o, d):
        near, far = intersect_box_numpy(o, d, np.array(lower, float), np.array(upper, float))
        outside = (near < far) & (near > 0)
        depth = np.where(outside, near, np.where((near < far) & (far > 0), far, 0.0))
        opacity = (depth > 0).astype(float)
        if pillar is not None:
            a, b = intersect_box_numpy(o, d, *np.array(pillar, float))
            hit = (a < b) & (b > 0)
            depth = np.where(hit & ((np.maximum(a, 0) < depth) | (opacity == 0)), np.maximum(a, 0), depth)
            opacity = np.maximum(opacity, hit)
        return depth, opacity

    return trace


def seen_from(eye, trace, attention):
    """Surfaces around ``eye``; ``attention`` is a function of directions."""
    d = fibonacci_directions(4000)
    depth, opacity = trace(np.broadcast_to(eye, d.shape), d)
    return SeenSurfaces(
        np.asarray(eye, float), d, depth, opacity > 0.5, attention(d), np.full(len(d), 4 * np.pi / len(d))
    )


def test_pixel_directions_round_trip():
    origin, ahead = np.array([1.0, -2, 3]), np.array([1.0, 2, -0.5]) / np.linalg.norm([1, 2, -0.5])
    d = FRAME.directions(ahead, 12, 8)
    assert d.shape == (96, 3) and np.allclose(np.linalg.norm(d, axis=1), 1)
    # The borders are half the angle of view away, the upper row is above.
    middle = FRAME.directions(ahead, 1, 1)[0]
    np.testing.assert_allclose(middle, ahead, atol=1e-12)
    assert d[:12, 2].min() > d[-12:, 2].max()
    wide = FRAME.directions(ahead, 1000, 1)
    assert np.degrees(np.arccos(wide[0] @ wide[-1])) == pytest.approx(70, abs=0.1)
    points = origin + d * np.linspace(1, 9, 96)[:, None]
    np.testing.assert_array_equal(FRAME.pixels(origin[None], ahead[None], points, 12, 8)[0], np.arange(96))
    behind = FRAME.pixels(origin[None], ahead[None], origin - d, 12, 8)
    assert (behind == -1).all()


def test_main_direction_and_mean_target():
    towards = np.array([0.6, 0.8, 0])
    seen = seen_from((4, 3, 1.5), room(), lambda d: np.exp(50 * (d @ towards - 1)) + 0.01)
    assert seen.main_direction @ towards > np.cos(np.radians(4))
    depth, _ = room()(np.array([[4, 3, 1.5]]), towards[None])
    assert np.linalg.norm(seen.mean_target() - (seen.observer + depth[0] * towards)) < 0.6
    empty = seen_from((4, 3, 1.5), lambda o, d: (np.zeros(len(d)), np.zeros(len(d))), lambda d: np.ones(len(d)))
    assert empty.median_depth == 0 and empty.mean_target() is None


def test_camera_shows_the_observers_attention():
    towards = np.array([1.0, 0, 0])
    # The pillar occludes the attended wall from behind.
    trace = room(pillar=((5, 3.6, 0), (5.5, 5.9, 3)))
    seen = seen_from((2.5, 2.5, 1.6), trace, lambda d: np.exp(60 * (d @ towards - 1)))
    shot = view_of_observer(trace, FRAME, seen)
    assert shot.surface_fraction == 1 and shot.attention_share > 0.9
    assert (
        (shot.origin > 0).all()
        and (shot.origin < (8, 6, 3)).all()
        and np.linalg.norm(shot.origin - seen.observer) > 0.3
    )
    # The attended point is in the image and visible.
    spot = np.array([8, 2.5, 1.6])
    direction = spot - shot.origin
    depth, _ = trace(shot.origin[None], direction[None] / np.linalg.norm(direction))
    assert depth[0] == pytest.approx(np.linalg.norm(direction), abs=1e-6)
    ahead = (shot.target - shot.origin) / np.linalg.norm(shot.target - shot.origin)
    assert FRAME.pixels(shot.origin[None], ahead[None], spot[None], 48, 32)[0, 0] >= 0


def test_attention_share_is_computed():
    trace = room()
    towards = np.array([1.0, 0, 0])
    seen = seen_from((4, 3, 1.5), trace, lambda d: (d @ towards > np.cos(np.radians(10))).astype(float))
    judge = ViewScorer(trace, FRAME, seen.median_depth, seen)
    origins = np.array([[4, 3, 1.5], [4, 3, 1.5], [0.5, 3, 1.5]])
    targets = origins + np.array([[1.0, 0, 0], [-1, 0, 0], [1, 0, 0]])
    ahead, away, behind = judge.score_views(origins, targets, (24, 16))
    assert (ahead.attention_share, away.attention_share, behind.attention_share) == pytest.approx((1, 0, 1))
    assert ahead.score > 4 * away.score and behind.score > 4 * away.score


def test_room_is_shown_from_inside():
    trace = room(pillar=((3, 2, 0), (4, 3, 2)))
    shot = view_of_scene(trace, FRAME, np.zeros(3), np.array([8.0, 6, 3]))
    assert shot.surface_fraction == 1 and (shot.origin > 0).all() and (shot.origin < (8, 6, 3)).all()
    # The camera is neither in the pillar nor close to the wall it faces.
    assert not ((shot.origin > (2.9, 1.9, 0)) & (shot.origin < (4.1, 3.1, 2.1))).all()
    d = (shot.target - shot.origin)[None] / np.linalg.norm(shot.target - shot.origin)
    assert trace(shot.origin[None], d)[0][0] > 1


def test_object_is_shown_from_outside():
    lower, upper = np.array([-1.0, -1, -1]), np.array([1.0, 1, 1])

    def solid(o, d):
        near, far = intersect_box_numpy(o, d, lower, upper)
        hit = (near < far) & (far > 0)
        return np.where(hit, np.maximum(near, 0), 0), hit.astype(float)

    shot = view_of_scene(solid, FRAME, lower, upper)
    assert np.abs(shot.origin).max() > 1 and shot.origin[2] > 0 and shot.surface_fraction > 0.1
    np.testing.assert_allclose(shot.target, 0, atol=1e-12)
    assert view_of_scene(solid, FRAME, lower, upper, allow_outside=False) is None


def test_empty_scene_has_no_view():
    void = lambda o, d: (np.zeros(len(o)), np.zeros(len(o)))
    assert view_of_scene(void, FRAME, np.zeros(3), np.ones(3)) is None
    assert view_of_observer(void, FRAME, seen_from((0, 0, 0), void, lambda d: np.ones(len(d)))) is None
