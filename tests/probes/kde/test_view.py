"""The density of the rays nearest to an observer, in the scene's frame: exact sums for few directions, a table for
many."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions, uniform_directions
from nerg_mi.probes.kde_view import WORTH, KdeView
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.observer import ObserverCache, view_along
from tests.reference.kde import kde as reference

COUNT, KAPPA = 40, 15.0


@pytest.fixture
def rays():
    rng = np.random.default_rng(0)
    return Rays(
        np.arange(300.0),
        np.zeros(300),
        ("a",),
        rng.normal(size=(300, 3)) * (1, 3, 0.2),
        uniform_directions(300, rng),
        np.ones(300),
    )


def expected(rays, p, d):
    near = np.argsort(np.linalg.norm(rays.origin - p, axis=1))[:COUNT]
    return reference(d, rays.direction[near], np.array([0, COUNT]), np.array([KAPPA]))[0]


def points(v):
    return ns.Array3f(np.ascontiguousarray(np.asarray(v).T, np.float32))


def test_the_rays_are_the_nearest(rays):
    view = KdeView(rays, COUNT, KAPPA)
    for p in np.random.default_rng(1).normal(size=(5, 3)):
        apart = np.linalg.norm(rays.origin - p, axis=1)
        want = rays.direction[np.argsort(apart)[:COUNT]]
        assert {tuple(x) for x in view.nearest(p)} == {tuple(x) for x in want}
    assert len(KdeView(rays, 10_000, KAPPA).nearest(np.zeros(3))) == 300
    with pytest.raises(ValueError, match="no rays"):
        KdeView(rays.select(np.zeros(300, bool)))


def test_it_says_of_how_many_rays_it_is(rays):
    assert KdeView(rays, COUNT).basis.words() == "300 rays of 1 person"


def test_each_lane_has_the_density_of_its_observer(rgb, rays):
    """Two observers, in a scene that is turned, twice the size and elsewhere."""
    turn = np.array([[0, -2.0, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    view = KdeView(rays, COUNT, KAPPA, Similarity(turn), ns)
    eyes, d = np.array([[0.1, 2.0, 0], [0.2, -1.5, 0.1]]), fibonacci_directions(50)
    there = eyes @ turn[:3, :3].T + turn[:3, 3]
    observers = [points(there[k : k + 1]) for k in (0, 1)]
    for k in (0, 1):
        p_o = points(np.repeat(there[k : k + 1], 50, axis=0))
        value = view_along(view, observers, p_o, points(d @ turn[:3, :3].T / 2), ObserverCache())
        assert np.allclose(value.numpy(), expected(rays, eyes[k], d), rtol=1e-4, atol=1e-6)


def test_many_directions_are_looked_up_and_equal(rays):
    view, p = KdeView(rays, COUNT, KAPPA, backend=ns), np.array([0.1, 0.2, 0.0])
    d = fibonacci_directions(max(WORTH, 20_000))
    observed = view.at(points(p[None]))
    found = observed.value(points(d)).numpy()
    want = expected(rays, p, d)
    assert np.abs(found - want).max() < 2e-3 * want.max()
    few = observed.value(points(d[:30])).numpy()
    assert np.allclose(few, want[:30], rtol=1e-4, atol=1e-6)
    assert not dr.grad_enabled(observed.value(points(d[:1])))
