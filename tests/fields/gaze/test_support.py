"""How much data there is around a position: cells against the sum over all rays."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.gaze_base import REACH, RaySupport


def exact(origins, radius, p, reach=REACH):
    return np.maximum(1 - ((origins - p) ** 2).sum(axis=1) / (reach * radius) ** 2, 0).sum()


def at(support, p):
    return float(support.at(ns.Array3f(*map(float, p)))[0])


def paths(n=20_000, seed=0):
    """People who walk through a hall and stop here and there."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0, 0.03, (n, 2)) * (rng.random((n, 1)) < 0.5), axis=0) % 4
    return np.concatenate([walk, rng.normal(1.6, 0.08, (n, 1))], axis=1)


def test_where_it_is_greatest():
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.normal(c, 0.05, (n, 3)) for c, n in (((0, 0, 1), 400), ((3, 1, 2), 900))])
    support = RaySupport.of(origins, 0.3)
    densest = support.densest()
    assert np.linalg.norm(densest - (3, 1, 2)) < 0.1
    everywhere = [exact(origins, 0.3, p, 1) for p in origins[::7]]
    assert exact(origins, 0.3, densest, 1) > 0.9 * max(everywhere)


@pytest.mark.parametrize("radius", [0.1, 0.6])
def test_cells_stand_for_their_rays(radius):
    origins = paths()
    support = RaySupport.of(origins, radius)
    assert support.cells[:, 3].sum() == len(origins) and len(support.cells) < len(origins)
    rng = np.random.default_rng(1)
    places = np.concatenate([origins[rng.integers(0, len(origins), 200)], rng.uniform(-6, 10, (100, 3))])
    found, expected = (
        np.array([f(p) for p in places]) for f in (lambda p: at(support, p), lambda p: exact(origins, radius, p))
    )
    many = expected >= 5
    assert many.sum() > 100 and (expected == 0).sum() > 20
    off = np.abs(found / np.where(many, expected, 1) - 1)[many]
    assert np.percentile(off, 95) < 0.04 and np.median(off) < 0.01
    assert np.abs(found - expected)[~many].max() < 4


def test_inside_of_the_radius_cells_are_exact():
    origins = np.random.default_rng(0).normal(0, 0.05, (1000, 3))
    support = RaySupport.of(origins, 1.0)
    assert at(support, (1.2, 2.1, 0)) == pytest.approx(exact(origins, 1.0, [1.2, 2.1, 0]), rel=1e-5)


def test_one_ray_counts_one_where_it_started_and_nothing_five_radii_away():
    support = RaySupport.of([[1.0, 2, 3]], 0.5)
    assert at(support, (1, 2, 3)) == 1 and at(support, (1, 2, 4.25)) == 0.75 and at(support, (3.5, 2, 3)) < 1e-6
    assert support.reach == 2.5


def test_what_is_no_support_is_refused():
    for cells, radius in (([[0, 0, 0, 1, np.nan]], 1.0), ([[0, 0, 0, 1, 0]], 0.0)):
        with pytest.raises(ValueError, match="finite cells and a positive radius"):
            RaySupport(np.array(cells), radius)


def test_a_cube_of_the_radius_has_eight_cells():
    """However its lowest rays lie on their borders."""
    axis = np.arange(4) / 4
    origins = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    assert RaySupport.of(origins, 1.0).cells[:, 3].tolist() == [8] * 8
