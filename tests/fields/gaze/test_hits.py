"""Tests of `nerg_mi.fields.gaze_hits`."""

from __future__ import annotations

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.gaze_hits import FAR, MAX_NEIGHBOURS, HitKernel, ObservedHits, ReaimedHits, place_missing_points
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.sphere import fibonacci_directions


def sample(count=40, seed=0):
    """Origins and hit points of samples in a room of 4 m."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)), 2 * np.sign(rng.normal(size=(count, 3))) * rng.random((count, 3))


def reference(origins, points, bandwidth, kappa, p, d, widest=0.0):
    """The density in directions ``d`` (N, 3) in float64, without any nearest neighbours; ``widest`` is the bandwidth of
    another kernel."""
    square = ((origins - p) ** 2).sum(axis=1)
    weight = np.exp((square.min() - square) / (2 * bandwidth**2))
    aim = points - p
    near = np.linalg.norm(aim, axis=1) < 0.25 * bandwidth
    aim = np.where(near[:, None], points - origins, aim)
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    peak = kappa / (2 * np.pi * (1 - np.exp(-2 * kappa)))
    density = (peak * np.exp(kappa * (d @ aim.T - 1))) @ weight / weight.sum()
    extent = max(np.linalg.norm(np.ptp(origins, axis=0)) / 2, bandwidth, widest)
    nearness = np.exp(-square.min() / (2 * extent**2))
    return nearness * density + (1 - nearness) / (4 * np.pi)


def evaluate(hits, p, d):
    observed = hits.observe(np.asarray(p, float), ns)
    return np.array(observed.density(to_vector(ns.Array3f, d), ns.Array3f(*map(float, p))))


@pytest.mark.parametrize("p", [(0, 0, 0), (0.9, -0.4, 0.3), (30, 0, 0)])
@pytest.mark.parametrize("kappa", [1.0, 60.0, 2000.0])
def test_density_equals_float64(p, kappa):
    origins, points = sample()
    hits = ReaimedHits(origins, points, [HitKernel(0.5, 0.4, kappa)])
    for count in (500, 20_000):  # summed, and tabulated
        d = fibonacci_directions(count)
        expected = reference(hits.origins.astype(float), hits.points.astype(float), 0.4, kappa, np.array(p), d)
        peak = kappa / (2 * np.pi * (1 - np.exp(-2 * kappa)))
        np.testing.assert_allclose(evaluate(hits, p, d), expected, rtol=1e-3, atol=5e-4 * peak)
        if kappa < 100:
            assert 4 * np.pi * evaluate(hits, p, d).mean() == pytest.approx(1, abs=2e-3)


def test_samples_without_a_hit_keep_their_direction():
    origins, _ = sample(5)
    directions = fibonacci_directions(5)
    points = np.full((5, 3), np.nan)
    points[0] = (0.5, 0, 0)
    placed = place_missing_points(origins, directions, points, 0.4)
    assert np.array_equal(placed[0], points[0])
    np.testing.assert_allclose(np.linalg.norm(placed[1:] - origins[1:], axis=1), 0.4 * FAR)
    near = ReaimedHits(origins, placed, [HitKernel(0.5, 0.4, 50.0)]).find(np.array([(0.2, 0.1, 0.0)]))[0]
    order = [int(np.argmin(np.abs(origins - (0.2, 0.1, 0) - offset).sum(axis=1))) for offset in near.offsets[0]]
    rows = [order.index(k) for k in range(1, 5)]
    np.testing.assert_allclose(near.directions[0][rows], directions[1:], atol=1e-3)
    assert np.array_equal(place_missing_points(origins, directions, None, 0.4)[1:], placed[1:])
    # In millimetres, with a bandwidth of several metres
    far = place_missing_points(1e3 * origins, directions, None, 5e3)
    assert ReaimedHits(1e3 * origins, far, [HitKernel(0.5, 5e3, 50.0)]).find(origins)[0].directions.shape == (5, 5, 3)


def test_kernels_are_mixed():
    """The density is the mean of those of the kernels, and has their derivatives."""
    origins, points = sample(60, 3)
    kernels = HitKernel(0.3, 0.4, 60.0), HitKernel(0.1, 0.4, 10.0), HitKernel(0.2, 1.0, 60.0)
    hits, p = ReaimedHits(origins, points, kernels), np.array((0.2, 0.1, 0.0))
    assert hits.weight == pytest.approx(0.6)

    def derive(hits, d):
        r_o, p_o = to_vector(ns.Array3f, d), ns.Array3f(*p.tolist())
        dr.enable_grad(r_o, p_o)
        density = hits.observe(p, ns).density(r_o, p_o)
        dr.backward(dr.sum(density))
        return [np.array(v) for v in (density, dr.grad(r_o), dr.grad(p_o))]

    single = [ReaimedHits(origins, points, [kernel]) for kernel in kernels]
    for d in (fibonacci_directions(50), fibonacci_directions(20_000)):  # without tables, and with some
        for value, *parts in zip(derive(hits, d), *(derive(part, d) for part in single)):
            expected = sum(k.weight * part for k, part in zip(kernels, parts)) / 0.6
            np.testing.assert_allclose(value, expected, rtol=2e-3, atol=5e-4)
    d = fibonacci_directions(50)
    columns = hits.evaluate_kernels(np.tile(p, (50, 1)), d)
    np.testing.assert_allclose(hits.observe(p, ns).evaluate(d)[0], columns @ [1 / 2, 1 / 6, 1 / 3], rtol=1e-5)


def test_wide_kernels_sum_a_random_subset():
    """The nearest samples alone would be those of a small part of the neighbourhood."""
    rng = np.random.default_rng(0)
    origins, points = rng.uniform(-1, 1, (20_000, 3)), np.zeros((20_000, 3))
    # All look up, but those who stand near the middle look down.
    points[:, 2] = origins[:, 2] + np.where(np.linalg.norm(origins, axis=1) < 0.4, -1e4, 1e4)
    up = np.array([(0, 0, 1.0)])
    wide, narrow = (evaluate(ReaimedHits(origins, points, [HitKernel(1, b, 50.0)]), (0, 0, 0), up) for b in (2.0, 0.1))
    peak = 50 / (2 * np.pi)
    is_up = np.linalg.norm(origins, axis=1) >= 0.4
    weights = np.exp(-(origins**2).sum(axis=1) / 8)
    assert wide / peak == pytest.approx(np.average(is_up, weights=weights), abs=0.02)
    assert narrow / peak < 0.01


def test_extreme_positions_are_finite():
    origins, points = sample(3)
    points[0] = origins[0]  # A hit at the eye has no direction
    hits = ReaimedHits(origins, points, [HitKernel(0.5, 1e-3, 1e5)])
    d = fibonacci_directions(2000)
    for p in (origins[0], points[1], origins[0] + 1e-9, (1e6, 0, 0), (0, 0, 0)):
        value = evaluate(hits, p, d)
        assert np.isfinite(value).all() and (value >= 0).all()
    # Too narrow for a table, however many directions there are
    narrow = ReaimedHits(origins, points, [HitKernel(0.5, 0.4, 1e8)])
    assert np.isfinite(evaluate(narrow, (0, 0, 0), fibonacci_directions(20_000))).all()
    # Only the sample at the eye, of which nothing is known
    assert np.isfinite(evaluate(ReaimedHits(origins[:1], points[:1], [HitKernel(1.0, 0.4, 50.0)]), origins[0], d)).all()


def test_only_the_nearest_samples_count():
    origins, points = sample(MAX_NEIGHBOURS + 200)
    near = ReaimedHits(origins, points, [HitKernel(0.5, 0.4, 50.0)]).find(np.zeros((2, 3)))[0]
    assert near.directions.shape == (2, MAX_NEIGHBOURS, 3) and near.weights.max() == 1
    square = np.sort((origins.astype(np.float32).astype(float) ** 2).sum(axis=1))[:MAX_NEIGHBOURS]
    np.testing.assert_allclose((near.offsets[0] ** 2).sum(axis=1), square, rtol=1e-5)


@pytest.mark.parametrize("p", [(0.1, -0.2, 0.3), (1.6, -1.2, 0.9)])
def test_gradients_equal_finite_differences(p):
    origins, points = sample(60, 3)
    hits = ReaimedHits(origins, points, [HitKernel(0.5, 0.5, 20.0)])
    p, d = np.array(p), fibonacci_directions(50)
    observed = hits.observe(p, ns)
    r_o, p_o = to_vector(ns.Array3f, d), ns.Array3f(*p.tolist())
    dr.enable_grad(r_o, p_o)
    density = observed.density(r_o, p_o)
    dr.backward(dr.sum(density))
    of_directions, of_position = np.array(dr.grad(r_o)).T, np.array(dr.grad(p_o)).ravel()
    at = lambda p, d: reference(hits.origins.astype(float), hits.points.astype(float), 0.5, 20.0, p, d)
    step = 1e-4
    for axis in np.eye(3):
        by_position = (at(p + step * axis, d).sum() - at(p - step * axis, d).sum()) / (2 * step)
        assert of_position @ axis == pytest.approx(by_position, rel=2e-3, abs=1e-3)
        by_direction = (at(p, d + step * axis) - at(p, d - step * axis)) / (2 * step)
        # Derivatives along the sphere: the formulas differ for vectors that are not of unit length.
        tangential = lambda g: g - (g * d).sum(axis=1, keepdims=True) * d
        basis = tangential(np.tile(axis, (len(d), 1)))
        np.testing.assert_allclose(
            (of_directions * basis).sum(axis=1),
            by_direction - (d @ axis) * _radial(at, p, d, step),
            rtol=5e-3,
            atol=2e-3,
        )


def test_merged_observers_equal_single_ones():
    origins, points = sample(60, 5)
    hits = ReaimedHits(origins, points, [HitKernel(0.5, 0.5, 20.0)])
    positions, d = np.array([(0.1, -0.2, 0.3), (0.4, 0.1, -0.2)]), fibonacci_directions(40)
    single = [hits.observe(p, ns) for p in positions]
    index = np.arange(40) % 2

    def derive(observed, keep, *observer):
        r_o = to_vector(ns.Array3f, d[keep])
        p_o = to_vector(ns.Array3f, positions[index[keep]])
        dr.enable_grad(r_o, p_o)
        density = observed.density(r_o, p_o, *observer)
        dr.backward(dr.sum(density))
        return [np.array(a) for a in (density, dr.grad(r_o), dr.grad(p_o))]

    merged = derive(ObservedHits.merge(single), slice(None), ns.UInt32(index.astype(np.uint32)))
    for k in range(2):
        keep = index == k
        for expected, result in zip(derive(single[k], keep), merged):
            np.testing.assert_allclose(result[..., keep], expected, rtol=1e-5, atol=1e-6)


def _radial(at, p, d, step):
    return (at(p, d * (1 + step)) - at(p, d * (1 - step))) / (2 * step)


@pytest.mark.parametrize(
    "change",
    [
        {"origins": np.zeros((0, 3)), "points": np.zeros((0, 3))},
        {"points": np.zeros((2, 3))},
        {"points": np.full((40, 3), np.nan)},
        {"kernels": ()},
        {"kernels": [(0.6, 0.4, 50.0), (0.6, 0.4, 100.0)]},
        {"kernels": [(1.5, 0.4, 50.0)]},
        {"kernels": [(0.5, 0.0, 50.0)]},
        {"kernels": [(0.5, 0.4, -1.0)]},
    ],
)
def test_bad_values_are_refused(change):
    origins, points = sample()
    values = {"origins": origins, "points": points, "kernels": [(0.5, 0.4, 50.0)], **change}
    with pytest.raises(ValueError, match="re-aimed hits need"):
        ReaimedHits(**values)
