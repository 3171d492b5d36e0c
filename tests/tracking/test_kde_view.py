"""Tests of `nerg_mi.tracking.kde_view`."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions, sample_uniform_directions
from nerg_mi.tracking.kde_view import (
    MIN_TABLE_DIRECTIONS,
    KdeView,
    compute_directions,
    evaluate_kde_frame,
    make_probe_at,
)
from nerg_mi.tracking.rays import RayIndex, Rays
from nerg_mi.transport.observer import ObserverCache, evaluate_view
from tests.reference.kde import kde as reference

# ---- Frame ----

OBSERVER = np.array([1.0, 1.0, 1.6])


def rays_of(origin, seed, people=1):
    n, who = len(origin), np.arange(len(origin)) % people
    d = sample_uniform_directions(n, np.random.default_rng(seed))
    return Rays(np.arange(n) * 0.1, who, tuple("abcd"[:people]), origin, d, np.ones(n))


@pytest.fixture(scope="module")
def rays_frame():
    return rays_of(np.random.default_rng(3).uniform([0, 0, 1.5], [2, 2, 1.7], (4000, 3)), 4, people=4)


def wall(h=60, w=90):
    """Points of a wall in front of the observer, with open sky in one corner."""
    x, z = np.meshgrid(np.linspace(-2, 4, w), np.linspace(3, 0, h))
    points = np.stack([x, np.full_like(x, 4.0), z], axis=-1)
    points[:10, :10] = np.nan
    return points


@pytest.mark.parametrize("method", ["exact", "table", "auto"])
def test_every_pixel_has_the_density_of_its_direction(rays_frame, method):
    probe = make_probe_at(rays_frame, OBSERVER, 0.3, kappa_rule="fixed", kappa=25.0, index=RayIndex(rays_frame))
    points = wall()
    picture = evaluate_kde_frame(probe, observer=OBSERVER, points=points, method=method, backend="llvm")
    assert picture.shape == (60, 90) and (picture[:10, :10] == 0).all()
    d = points - OBSERVER
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    want = reference(d[20:].reshape(-1, 3), probe.directions, probe.offsets, probe.kappa)[0].reshape(40, 90)
    assert np.allclose(picture[20:], want, rtol=2e-3)
    is_valid = np.isfinite(points).all(axis=-1)
    again = evaluate_kde_frame(
        probe, np.where(is_valid[..., None], d, (0, 0, 1)), mask=is_valid, method=method, backend="llvm"
    )
    assert np.allclose(again, picture, rtol=1e-4, atol=1e-6)


def test_directions_to_points():
    d, is_valid = compute_directions(OBSERVER, np.array([[[1, 1, 3.6], OBSERVER, [np.nan, 0, 0]]]))
    assert is_valid.tolist() == [[True, False, False]] and np.allclose(d, [0, 0, 1])


def test_refusals(rays_frame):
    probe = make_probe_at(rays_frame, OBSERVER)
    with pytest.raises(ValueError, match="either directions"):
        evaluate_kde_frame(probe)
    with pytest.raises(ValueError, match="either directions"):
        evaluate_kde_frame(probe, points=wall())
    with pytest.raises(ValueError, match="method"):
        evaluate_kde_frame(probe, observer=OBSERVER, points=wall(), method="guess")
    with pytest.raises(ValueError, match="increase the radius"):
        make_probe_at(rays_frame, [50, 0, 0])


# ---- View ----
#
# Density of the rays nearest to an observer, in the frame of the scene: exact sums for few directions, a table for
# many.

COUNT, KAPPA = 40, 15.0


@pytest.fixture
def rays_view():
    return rays_of(np.random.default_rng(0).normal(size=(300, 3)) * (1, 3, 0.2), 1)


def expected(rays, p, d):
    near = np.argsort(np.linalg.norm(rays.origin - p, axis=1))[:COUNT]
    return reference(d, rays.direction[near], np.array([0, COUNT]), np.array([KAPPA]))[0]


def points(v):
    return ns.Array3f(np.ascontiguousarray(np.asarray(v).T, np.float32))


def test_the_rays_are_the_nearest(rays_view):
    view = KdeView(rays_view, COUNT, KAPPA)
    for p in np.random.default_rng(1).normal(size=(5, 3)):
        distances = np.linalg.norm(rays_view.origin - p, axis=1)
        want = rays_view.direction[np.argsort(distances)[:COUNT]]
        assert {tuple(x) for x in view.find_nearest(p)} == {tuple(x) for x in want}
    assert len(KdeView(rays_view, 10_000, KAPPA).find_nearest(np.zeros(3))) == 300
    with pytest.raises(ValueError, match="no rays"):
        KdeView(rays_view.select(np.zeros(300, bool)))


def test_each_lane_has_the_density_of_its_observer(rgb, rays_view):
    """Two observers, in a scene that is rotated, scaled by two and shifted."""
    turn = np.array([[0, -2.0, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    view = KdeView(rays_view, COUNT, KAPPA, Similarity(turn), ns)
    origins, d = np.array([[0.1, 2.0, 0], [0.2, -1.5, 0.1]]), fibonacci_directions(50)
    is_valid = origins @ turn[:3, :3].T + turn[:3, 3]
    observers = [points(is_valid[k : k + 1]) for k in (0, 1)]
    for k in (0, 1):
        p_o = points(np.repeat(is_valid[k : k + 1], 50, axis=0))
        value = evaluate_view(view, observers, p_o, points(d @ turn[:3, :3].T / 2), ObserverCache())
        assert np.allclose(value.numpy(), expected(rays_view, origins[k], d), rtol=1e-4, atol=1e-6)


def test_table_lookups_equal_direct_evaluation(rays_view):
    view, p = KdeView(rays_view, COUNT, KAPPA, backend=ns), np.array([0.1, 0.2, 0.0])
    d = fibonacci_directions(max(MIN_TABLE_DIRECTIONS, 20_000))
    observed = view.for_position(points(p[None]))
    result = observed.evaluate(points(d)).numpy()
    want = expected(rays_view, p, d)
    assert np.abs(result - want).max() < 2e-3 * want.max()
    few = observed.evaluate(points(d[:30])).numpy()
    assert np.allclose(few, want[:30], rtol=1e-4, atol=1e-6)
    assert not dr.grad_enabled(observed.evaluate(points(d[:1])))
