"""The width of a kernel: what is chosen from, the leave-one-out score by its definition, and whose chance it is."""

import numpy as np
import pytest

from nerg_mi.maths import vmf
from nerg_mi.probes.kde import kappa_grid, leave_one_out_kappa, leave_one_out_scores, loo_kappas, silverman_kappas


def gazes(n, kappa=30.0, seed=0):
    rng = np.random.default_rng(seed)
    return vmf.sample(np.broadcast_to([0, 0.6, 0.8], (n, 3)), kappa, rng)


@pytest.mark.parametrize("most", [2.0, 30.0, 1000.0])
def test_what_is_chosen_from_ends_at_the_bounds_in_steps_of_a_quarter(most):
    grid = kappa_grid(most)
    assert grid[0] == 1 and grid[-1] == pytest.approx(most)
    # As many equal steps as come nearest to a quarter each.
    assert abs(len(grid) - 1 - np.log(most) / np.log(1.25)) <= 0.5
    assert np.allclose(np.diff(np.log(grid)), np.log(grid[1] / grid[0]))
    assert len(kappa_grid(1.01)) == 2


@pytest.mark.parametrize("groups", [None, [0, 0, 1, 1, 1, 2, 0, 2, 2, 1, 0, 3]])
def test_the_score_is_the_log_likelihood_under_the_others(groups):
    x, grid = gazes(12), np.array([1.0, 20.0, 400.0])
    g = np.arange(12) if groups is None else np.array(groups)
    want = []
    for kappa in grid:
        density = np.exp(vmf.log_normaliser(kappa) + kappa * (x @ x.T - 1))
        want.append(np.mean([np.log(density[i][g != g[i]].mean()) for i in range(12)]))
    assert np.allclose(leave_one_out_scores(x, None if groups is None else g, grid), want, rtol=1e-5)
    # Of one person alone, the ray itself is left out.
    assert np.allclose(leave_one_out_scores(x, np.zeros(12), grid), leave_one_out_scores(x, None, grid))


def test_of_many_rays_some_are_drawn_by_the_chance_that_is_given():
    x, person, grid = gazes(600), np.arange(600) % 7, kappa_grid(300.0)
    given = leave_one_out_scores(x, person, grid, most=100, rng=np.random.default_rng(5))
    chosen = np.random.default_rng(5).choice(600, 100, replace=False)
    assert np.allclose(given, leave_one_out_scores(x[chosen], person[chosen], grid, most=100))
    for shared in (False, True):
        found = [
            loo_kappas(x, person, np.array([0, 600]), 300.0, shared, np.random.default_rng(seed))[0]
            for seed in (*range(8), 3)
        ]
        assert len(set(found)) > 1 and found[3] == found[8]


def test_one_width_for_all_is_that_of_the_sum_of_the_scores():
    x, offsets = np.concatenate([gazes(60, 5.0, 1), gazes(1, 5.0, 2), gazes(200, 60.0, 3)]), np.array([0, 60, 61, 261])
    person, grid = np.arange(261), kappa_grid(500.0)
    each = loo_kappas(x, person, offsets, 500.0, False, np.random.default_rng(0))
    runs = [(0, 60), (61, 261)]
    assert [each[0], each[2]] == [leave_one_out_kappa(x[a:b], person[a:b], kappa_max=500.0) for a, b in runs] and each[
        1
    ] == 1
    total = sum(leave_one_out_scores(x[a:b], person[a:b], grid) for a, b in runs)
    assert (
        loo_kappas(x, person, offsets, 500.0, True, np.random.default_rng(0)).tolist() == [grid[np.argmax(total)]] * 3
    )
    assert loo_kappas(x[:2], person[:2], np.array([0, 1, 2]), 500.0, True, np.random.default_rng(0)).tolist() == [1, 1]


def test_the_published_rule_counts_weighted_rays_by_what_they_are_worth():
    x, offsets = gazes(90), np.array([0, 40, 90])
    plain = silverman_kappas(x, None, offsets, 1e9, False)
    doubled = silverman_kappas(x, np.full(90, 2.0), offsets, 1e9, False)
    assert np.allclose(plain, doubled)
    # Rays of no weight are not there.
    weights = np.r_[np.ones(40), np.zeros(20), np.ones(30)]
    want = silverman_kappas(np.delete(x, np.s_[40:60], axis=0), None, np.array([0, 40, 70]), 1e9, False)
    assert np.allclose(silverman_kappas(x, weights, offsets, 1e9, False), want)
    shared = silverman_kappas(x, None, offsets, 1e9, True)
    assert np.allclose(1 / shared, np.mean(1 / plain)) and (silverman_kappas(x, None, offsets, 2.0, False) == 2).all()
