"""Tests of `nerg_mi.fields.kde`."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.kde import (
    SphericalKde,
    SphericalKdeTable,
    compute_loo_scores,
    compute_silverman_kappas,
    make_kappa_grid,
    select_loo_kappa,
    select_loo_kappas,
)
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions, sample_uniform_directions
from tests.reference.kde import kde as reference

# ---- Estimate ----


def ragged(seed=0, counts=(1, 7, 300, 64)):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return sample_uniform_directions(offsets[-1], rng), offsets, rng.uniform(0.5, 90, len(counts)), rng


def test_agrees_with_float64():
    rays, offsets, kappa, rng = ragged()
    x = fibonacci_directions(333)
    got = SphericalKde(rays, offsets, kappa, backend="llvm").evaluate(x)
    assert np.allclose(got, reference(x, rays, offsets, kappa), rtol=2e-4, atol=1e-6)

    weights = rng.random(len(rays))
    got = SphericalKde(rays, offsets, kappa, weights, "llvm").evaluate(x)
    assert np.allclose(got, reference(x, rays, offsets, kappa, weights), rtol=2e-4, atol=1e-6)


def test_extreme_concentration_is_finite_and_right():
    mu = np.array([[0.0, 0.6, 0.8]])
    kde = SphericalKde(mu, [0, 1], 1e8, backend="llvm")
    assert np.isclose(kde.evaluate(mu)[0, 0], np.exp(vmf.log_normaliser(1e8)), rtol=1e-5)
    assert kde.evaluate(-mu)[0, 0] == 0


def test_gradient_to_the_direction():
    import drjit.llvm.ad as ns

    rays, offsets, kappa, _ = ragged()
    kde = SphericalKde(rays, offsets, kappa, backend=ns)
    x0 = np.array([0.36, 0.48, 0.8])
    x = ns.Array3f(x0.tolist())
    dr.enable_grad(x)
    dr.set_grad(x, ns.Array3f(1, 0, 0))
    slope = dr.forward_to(kde.density(ns.UInt32(2), x))
    h = 1e-5
    # Off the sphere the kernel is exp(-κ|x - μ|²/2): differentiate that.
    a, b = offsets[2:4]
    f = lambda y: np.exp(vmf.log_density(y, rays[a:b], kappa[2])).mean()
    want = (f(x0 + [h, 0, 0]) - f(x0 - [h, 0, 0])) / (2 * h)
    assert np.isclose(slope[0], want, rtol=1e-3)


def test_refusals():
    rays, offsets, kappa, _ = ragged()
    with pytest.raises(ValueError, match="probe 1 has no ray"):
        SphericalKde(rays, [0, 5, 5, len(rays)], 1.0, backend="llvm")
    with pytest.raises(ValueError, match="do not match"):
        SphericalKde(rays, [0, 5], 1.0, backend="llvm")
    with pytest.raises(ValueError, match="are zero"):
        SphericalKde(rays, [0, len(rays)], 1.0, np.zeros(len(rays)), "llvm")
    with pytest.raises(ValueError, match="expected"):
        SphericalKde(rays, offsets, kappa, backend="llvm").evaluate(np.zeros((2, 5, 3)))


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan, -1.0, 1e300])
def test_invalid_weights_are_named(bad):
    rays, offsets, kappa, _ = ragged()
    weights = np.ones(len(rays))
    weights[7] = bad
    with pytest.raises(NergError, match=r"weights\[7\]"):
        SphericalKde(rays, offsets, kappa, weights, "llvm")
    with pytest.raises(NergError, match="372"):
        SphericalKde(rays, offsets, kappa, weights[1:], "llvm")
    for change in ({"kappa": bad}, {"rays": np.where(np.arange(len(rays))[:, None] == 3, bad, rays)}):
        if abs(bad) == np.inf or np.isnan(bad) or (bad < 0 and "kappa" in change):
            with pytest.raises(NergError, match="finite"):
                SphericalKde(**{"rays": rays, "offsets": offsets, "kappa": kappa, "backend": "llvm"} | change)


@pytest.mark.parametrize("count", [10**5, 10**6])
def test_many_equal_rays_have_the_density_of_one(count):
    """Added one by one in single precision, a million equal terms are wrong by 1 %."""
    import drjit.llvm.ad as ns

    axis, x = np.array([[0.0, 0.6, 0.8]]), fibonacci_directions(32)
    expected = reference(x, axis, [0, 1], [20.0])[0]
    many = SphericalKde(np.repeat(axis, count, axis=0), [0, count], 20.0, backend=ns)
    np.testing.assert_allclose(many.evaluate(x)[0], expected, rtol=2e-5, atol=0)
    single = many.density(ns.UInt32(np.zeros(len(x), np.uint32)), ns.Array3f(*x.T.astype(np.float32).copy()))
    np.testing.assert_allclose(np.array(single), expected, rtol=2e-5, atol=0)


def test_unequal_weights_of_many_rays():
    count = 300_000
    rng = np.random.default_rng(5)
    rays, weights, x = sample_uniform_directions(count, rng), rng.random(count) ** 4, fibonacci_directions(8)
    got = SphericalKde(rays, [0, count], 20.0, weights, "llvm").evaluate(x)
    np.testing.assert_allclose(got, reference(x, rays, [0, count], [20.0], weights), rtol=5e-6)


@pytest.mark.parametrize("weighted", [False, True])
def test_a_range_has_the_same_densities(weighted):
    rays, offsets, kappa, rng = ragged()
    # Some rays of each probe weigh much more than others, so that equal weights would give large errors.
    weights = rng.random(len(rays)) ** 4 if weighted else None
    kde, x = SphericalKde(rays, offsets, kappa, weights, "llvm"), fibonacci_directions(200)
    full = kde.evaluate(x)
    for first, last in [(0, 2), (1, 3), (2, 4), (3, 4), (0, 4)]:
        part = kde.select_range(first, last)
        assert part.count == last - first
        assert np.allclose(part.evaluate(x), full[first:last], rtol=1e-5, atol=1e-7)


# ---- Table ----


@pytest.mark.parametrize("kappa", [1e-3, 5.0, 50.0, 900.0])
@pytest.mark.parametrize("count", [1, 40])
def test_close_to_exact_everywhere(kappa, count):
    rng = np.random.default_rng(0)
    mu = sample_uniform_directions(count, rng)
    kde = SphericalKde(mu, [0, count], kappa, backend="llvm")
    # Everywhere, near the peaks, and at edges and corners of the cube.
    edges = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    edges = np.concatenate([edges, edges + 1e-6, edges - 1e-6])
    x = np.concatenate(
        [
            sample_uniform_directions(5000, rng),
            mu,
            vmf.sample(np.repeat(mu, 9, 0), kappa, rng),
            edges / np.linalg.norm(edges, axis=1, keepdims=True),
        ]
    )
    peak = np.exp(vmf.log_normaliser(kappa))
    table = SphericalKdeTable(kde)
    assert np.abs(table.evaluate(x) - kde.evaluate(x)[0]).max() < 1e-4 * peak
    if kappa < 300:
        assert np.abs(table.evaluate(x) - reference(x, mu, [0, count], [kappa])[0]).max() < 1e-4 * peak
    assert table.evaluate(fibonacci_directions(8192)).min() >= 0


def test_one_probe_of_several_and_its_slope():
    import drjit.llvm.ad as ns

    rng = np.random.default_rng(2)
    kde = SphericalKde(sample_uniform_directions(50, rng), [0, 20, 50], [5.0, 30.0], backend=ns)
    table = SphericalKdeTable(kde, probe=1)
    x0 = np.array([0.36, 0.48, 0.8])
    assert np.isclose(table.evaluate(x0[None])[0], kde.evaluate(x0[None])[1, 0], rtol=1e-3)
    x = ns.Array3f(x0.tolist())
    dr.enable_grad(x)
    side = np.array([0.8, -0.6, 0.0])  # along the sphere, where both functions are equal
    dr.set_grad(x, ns.Array3f(side.tolist()))
    slope = dr.forward_to(table.density(x))[0]
    ends = np.array([x0 + h * side for h in (1e-3, -1e-3)])
    a, b = reference(
        ends / np.linalg.norm(ends, axis=1, keepdims=True),
        np.array(kde.select_range(1, 2)._rays).reshape(-1, 4)[:, :3],
        [0, 30],
        [30.0],
    )[0]
    assert np.isclose(slope, (a - b) / 2e-3, rtol=2e-2)


def test_too_sharp_for_a_table():
    kde = SphericalKde(np.array([[0.0, 0, 1]]), [0, 1], 1e8, backend="llvm")
    with pytest.raises(ValueError, match="evaluate the density directly"):
        SphericalKdeTable(kde)
    assert not SphericalKdeTable.is_worthwhile(kde, 10**6)


# ---- The width of a kernel ----


def gazes(n, kappa=30.0, seed=0):
    rng = np.random.default_rng(seed)
    return vmf.sample(np.broadcast_to([0, 0.6, 0.8], (n, 3)), kappa, rng)


@pytest.mark.parametrize("max_kappa", [2.0, 30.0, 1000.0])
def test_kappa_grid_bounds_and_steps(max_kappa):
    grid = make_kappa_grid(max_kappa)
    assert grid[0] == 1 and grid[-1] == pytest.approx(max_kappa)
    # The number of equal steps nearest to 25 % each.
    assert abs(len(grid) - 1 - np.log(max_kappa) / np.log(1.25)) <= 0.5
    assert np.allclose(np.diff(np.log(grid)), np.log(grid[1] / grid[0]))
    assert len(make_kappa_grid(1.01)) == 2


@pytest.mark.parametrize("groups", [None, [0, 0, 1, 1, 1, 2, 0, 2, 2, 1, 0, 3]])
def test_loo_score_is_the_log_likelihood_under_other_groups(groups):
    x, grid = gazes(12), np.array([1.0, 20.0, 400.0])
    g = np.arange(12) if groups is None else np.array(groups)
    want = []
    for kappa in grid:
        density = np.exp(vmf.log_normaliser(kappa) + kappa * (x @ x.T - 1))
        want.append(np.mean([np.log(density[i][g != g[i]].mean()) for i in range(12)]))
    assert np.allclose(compute_loo_scores(x, None if groups is None else g, grid), want, rtol=1e-5)
    # With one participant, only the ray itself is left out.
    assert np.allclose(compute_loo_scores(x, np.zeros(12), grid), compute_loo_scores(x, None, grid))


def test_shared_kappa_maximises_the_sum_of_scores():
    x, offsets = np.concatenate([gazes(60, 5.0, 1), gazes(1, 5.0, 2), gazes(200, 60.0, 3)]), np.array([0, 60, 61, 261])
    person, grid = np.arange(261), make_kappa_grid(500.0)
    each = select_loo_kappas(x, person, offsets, 500.0, False, np.random.default_rng(0))
    runs = [(0, 60), (61, 261)]
    assert [each[0], each[2]] == [select_loo_kappa(x[a:b], person[a:b], kappa_max=500.0) for a, b in runs]
    assert each[1] == 1
    total = sum(compute_loo_scores(x[a:b], person[a:b], grid) for a, b in runs)
    assert (
        select_loo_kappas(x, person, offsets, 500.0, True, np.random.default_rng(0)).tolist()
        == [grid[np.argmax(total)]] * 3
    )
    assert select_loo_kappas(
        x[:2], person[:2], np.array([0, 1, 2]), 500.0, True, np.random.default_rng(0)
    ).tolist() == [1, 1]


def test_silverman_rule_uses_effective_counts():
    x, offsets = gazes(90), np.array([0, 40, 90])
    plain = compute_silverman_kappas(x, None, offsets, 1e9, False)
    doubled = compute_silverman_kappas(x, np.full(90, 2.0), offsets, 1e9, False)
    assert np.allclose(plain, doubled)
    # Rays of weight zero are ignored.
    weights = np.r_[np.ones(40), np.zeros(20), np.ones(30)]
    want = compute_silverman_kappas(np.delete(x, np.s_[40:60], axis=0), None, np.array([0, 40, 70]), 1e9, False)
    assert np.allclose(compute_silverman_kappas(x, weights, offsets, 1e9, False), want)
    shared = compute_silverman_kappas(x, None, offsets, 1e9, True)
    assert (
        np.allclose(1 / shared, np.mean(1 / plain))
        and (compute_silverman_kappas(x, None, offsets, 2.0, False) == 2).all()
    )
