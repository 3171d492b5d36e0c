"""Hits of rays as arrays: all of them, in their order, beside a look at every Gaussian in double precision."""

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.splats import Splats
from nerg_mi.surfaces.splats import groups_of_hits
from nerg_mi.transport.splat_medium import SplatArrays
from tests.reference.splats import peaks
from tests.transport.media.splats.scenes import rays, stack


def some(n=80, seed=3):
    rng = np.random.default_rng(seed)
    centers, scales = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.05, 0.4, (n, 3))
    return Splats(centers, scales, rng.normal(size=(n, 4)), rng.uniform(0.05, 0.6, n), np.zeros((n, 1, 3)))


def shares(splats, o, d, **more):
    """Light that each Gaussian takes (R, N), what is left (R,), and how many groups there were."""
    taken, left, count = np.zeros((len(o), len(splats))), np.ones(len(o)), 0
    for group in groups_of_hits(SplatArrays(splats, ns), o, d, **more):
        ray, hit = np.nonzero(group.index >= 0)
        taken[group.rows[ray], group.index[ray, hit]] += (group.arriving * group.absorbed)[ray, hit]
        left[group.rows] = group.left
        count += 1
    return taken, left, count


def test01_all_gaussians_in_double_precision(rgb):
    splats, (o, d) = some(), rays(300)
    taken, left, count = shares(splats, o, d, stop=1e-6)
    t, absorbed = peaks(splats, o, d)
    absorbed = np.where(t >= 0, absorbed, 0)
    order = np.argsort(t, axis=1)
    sorted_ = np.take_along_axis(absorbed, order, 1)
    through = np.cumprod(1 - sorted_, axis=1)
    expected = np.zeros_like(taken)
    np.put_along_axis(expected, order, np.concatenate([np.ones((300, 1)), through[:, :-1]], 1) * sorted_, 1)
    assert count >= 3 and np.abs(taken - expected).max() < 2e-5
    # All that a ray brings is found, or goes on.
    assert np.abs(taken.sum(axis=1) + left - 1).max() < 1e-12


def test02_up_to_a_distance_and_no_farther_than_is_asked_for(rgb):
    splats = stack(np.arange(30.0), np.full(30, 0.1))
    o, d = np.array([[0, 0, -1.0], [0, 0, -1.0]]), np.array([[0, 0, 1.0], [0, 0, 1.0]])
    taken, left, _ = shares(splats, o, d, before=np.array([5.5, np.inf]))
    assert np.allclose(taken.sum(axis=1), 1 - 0.9 ** np.array([5, 30]), atol=1e-6) and np.allclose(
        1 - left, taken.sum(1)
    )
    groups = groups_of_hits(SplatArrays(splats, ns), o, d)
    first = next(groups)
    assert list(first.rows) == [0, 1] and not first.through.any()
    assert list(groups.send(np.array([1])).rows) == [1]
