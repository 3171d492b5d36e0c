"""Tests of `nerg_mi.tracking.kde_view`."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions, sample_uniform_directions
from nerg_mi.tracking.kde_view import MIN_TABLE_DIRECTIONS, KdeView
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.observer import ObserverCache, observe_view, select_nearest
from tests.reference.kde import kde as reference


def rays_of(origin, seed, people=1):
    n, who = len(origin), np.arange(len(origin)) % people
    d = sample_uniform_directions(n, np.random.default_rng(seed))
    return Rays(np.arange(n) * 0.1, who, tuple("abcd"[:people]), origin, d, np.ones(n))


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
        entries = observe_view(view, observers, ObserverCache())
        value = select_nearest(entries, p_o, lambda value: value.evaluate(points(d @ turn[:3, :3].T / 2)))
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
