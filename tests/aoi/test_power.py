"""Tests of `nerg_mi.aoi.power`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nerg_mi.aoi.power import PARTICIPANT_COUNTS, estimate_power, power_rows
from nerg_mi.aoi.tables import MEASURED, MinParticipantsFilter, Participants
from nerg_mi.aoi.visits import ALL, Cell
from tests.notes import find_wrong_notes

COUNTS = (8, 16, 32)


def t_power(shift: float, error: float, freedom: float) -> float:
    """Power of the two-sided t test at 5 % for a shift and the standard error of its estimate."""
    critical, noncentrality = stats.t.ppf(0.975, freedom), shift / error
    return float(stats.nct.sf(critical, freedom, noncentrality) + stats.nct.cdf(-critical, freedom, noncentrality))


def normal_values(count: int, mean: float, spread: float) -> np.ndarray:
    """Quantiles of a normal distribution, in random order."""
    values = stats.norm.ppf((np.arange(count) + 0.5) / count, mean, spread)
    return np.random.default_rng(0).permutation(values)


def test_power_of_paired_participants_matches_the_closed_form():
    x = normal_values(3000, 10, 0.5)
    u = x + np.random.default_rng(1).normal(0, 1.5, 3000)
    y = np.ones(3000)
    power = estimate_power((x, y), (u, y), 0.1, COUNTS, simulations=1000)
    scaled = u * 1.1 * x.mean() / u.mean()
    expected = [t_power(0.1 * x.mean(), (scaled - x).std() / np.sqrt(n), n - 1) for n in COUNTS]
    assert expected[0] < 0.45 and expected[-1] > 0.9
    assert power[1:] == pytest.approx(expected[1:], abs=0.06)
    # For eight participants the bootstrap is more conservative than Student's t.
    assert expected[0] - 0.12 < power[0] < expected[0] + 0.03


def test_power_of_independent_groups_matches_the_closed_form():
    # 2000 and 1000 participants: the smaller group stays half as large.
    x, u, zeros = normal_values(2000, 10, 1.2), normal_values(1000, 10, 1.2), np.zeros
    first = np.r_[x, zeros(1000)], np.r_[np.ones(2000), zeros(1000)]
    second = np.r_[zeros(2000), u], np.r_[zeros(2000), np.ones(1000)]
    power = estimate_power(first, second, 0.1, COUNTS, simulations=1000)
    error = lambda n: np.sqrt(1.2**2 / n + (1.1 * 1.2) ** 2 / (n / 2))
    expected = [t_power(1.0, error(n), 1.5 * n - 2) for n in COUNTS]
    assert power[1:] == pytest.approx(expected[1:], abs=0.07)
    assert power[0] == pytest.approx(expected[0], abs=0.12)


def test_no_effect_is_detected_at_the_significance_level():
    x, y = normal_values(500, 10, 1), np.ones(500)
    u = np.random.default_rng(2).permutation(x)
    assert estimate_power((x, y), (u * 3, y), 0.0, (16,), simulations=1000)[0] == pytest.approx(0.05, abs=0.025)


def test_power_of_proportions():
    # 50 % and, after the effect, 80 % of independent participants; the test is Wald's with one more of each outcome.
    x = np.tile([0.0, 1.0], 200)
    first = np.r_[x, 0 * x], np.r_[np.ones(400), np.zeros(400)]
    second = np.r_[0 * x, x], np.r_[np.zeros(400), np.ones(400)]
    power = estimate_power(first, second, 0.6, (24,), is_proportion=True, simulations=2000)[0]
    a, b = (np.arange(25) + 1) / 26, (np.arange(25)[:, None] + 1) / 26
    error = np.sqrt(a * (1 - a) / 26 + b * (1 - b) / 26)
    weight = stats.binom.pmf(np.arange(25), 24, 0.5) * stats.binom.pmf(np.arange(25)[:, None], 24, 0.8)
    expected = weight[np.abs(a - b) > stats.norm.ppf(0.975) * error].sum()
    assert power == pytest.approx(expected, abs=0.04)
    # A proportion that becomes smaller.
    less = estimate_power(first, second, -0.6, (24,), is_proportion=True, simulations=2000)[0]
    assert less == pytest.approx(expected, abs=0.04)


def test_undefined_power():
    x, y = np.array([1.0, 2, 0, 0, 0]), np.ones(5)
    assert np.isnan(estimate_power((x, y), (x + 1, y), 0.5, COUNTS)).all(), "two contributors"
    share = np.linspace(0.6, 0.9, 5)
    assert np.isnan(estimate_power((share, y), (share, y), 0.5, COUNTS, upper_limit=1.0)).all(), "a share above 1"
    assert np.isfinite(estimate_power((share, y), (share, y), 0.1, COUNTS, upper_limit=1.0, simulations=9)).all()


def people(names: str, mean: float, rng: np.random.Generator) -> Participants:
    time, count = np.full(len(names), 100.0), len(names)
    dwell = rng.gamma(4, mean / 4, (count, 1))
    return Participants(tuple(names), time, dwell, dwell, None, np.ones((count, 1)), np.ones((count, 1)))


def test_rows_of_cells_and_of_all_participants():
    rng = np.random.default_rng(3)
    cells = {
        ALL: {MEASURED: people("abcdefghij", 5, rng)},
        Cell("window", "early"): {MEASURED: people("abcdefghij", 5, rng)},
        Cell("window", "late"): {MEASURED: people("abcdefgh", 5, rng)},
    }
    options = {"seed": 0, "simulations": 60, "measures": ("dwell",)}
    (row,) = power_rows(("x",), cells, MinParticipantsFilter(), 0.5, **options)
    assert (row["cell"], row["first"], row["second"], row["measure"]) == ("window", "early", "late", "dwell")
    power = [row[f"power_{n}"] for n in PARTICIPANT_COUNTS]
    assert 0 <= power[0] < power[-1] <= 1 and power[-1] > 0.9
    (alone,) = power_rows(("x",), {ALL: cells[ALL]}, MinParticipantsFilter(), 0.5, **options)
    assert alone["cell"] == "all" and alone["power_96"] > alone["power_8"]
    floor = MinParticipantsFilter(9)
    (blank,) = power_rows(("x",), cells, floor, 0.5, **options)
    assert blank["power_96"] is None and floor.num_suppressed == 1 and "suppressed" in blank["note"]


def test_undefined_power_has_a_reason():
    """Two contributors, a share above 1, and a power that is defined."""
    rng = np.random.default_rng(4)
    few, many = people("ab", 5, rng), people("abcdefgh", 80, rng)
    options = {"seed": 0, "simulations": 9, "measures": ("share",)}
    rows = [
        power_rows(("x",), {ALL: {MEASURED: who}}, MinParticipantsFilter(), effect, **options)[0]
        for who, effect in ((few, 0.5), (many, 5.0), (many, 0.01))
    ]
    assert not find_wrong_notes(rows)
    assert [bool(row["note"]) for row in rows] == [True, True, False] and rows[0]["note"] != rows[1]["note"]
