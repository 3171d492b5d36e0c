"""Ranks, risks and regions: closed forms, and what cannot be said."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from nerg_mi.evaluation import gaze, metrics, uncertainty
from nerg_mi.probes.probes import LEVELS, calibrated_levels, level_name, region_levels
from tests.evaluation.test_gaze import crowd


def row(support, error, group, **more):
    return {"support": support, "KLD": error, "group": group, **more}


@pytest.fixture(scope="module")
def asked():
    """A test of four people, and what is asked of it: a map, and the uniform one."""
    centres = np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6], [-0.5, -3, 1.6]])
    test = gaze.make_test(crowd(), centres, 0.6, 20.0, 256, min_rays=20)
    return test, test.truth[::-1], np.full_like(test.truth, 1 / (4 * np.pi))


def test_little_support_ranks_great_errors():
    rng = np.random.default_rng(0)
    support = rng.integers(0, 40, 60)
    error = 1 / (1 + support) + rng.normal(0, 0.1, 60)
    rows = [row(s, e, str(i // 6)) for i, (s, e) in enumerate(zip(support, error))]
    (found,) = uncertainty.rank_rows(rows)
    assert found["signal"] == "support" and found["error"] == "KLD" and found["positions"] == 60
    assert found["rho"] == pytest.approx(spearmanr(-support, error)[0])
    assert found["rho.low"] < found["rho"] < found["rho.high"]
    assert found["100%"] == pytest.approx(error.mean()) and found["25%"] < found["50%"] < found["100%"]


def test_a_wide_spread_ranks_great_errors_and_a_few_groups_have_no_interval():
    rows = [row(5.0, float(k), str(k % 4), spread=float(k), excess=-float(k)) for k in range(12)]
    found = {(r["signal"], r["error"]): r for r in uncertainty.rank_rows(rows)}
    assert found["spread", "KLD"]["rho"] == pytest.approx(1) and found["spread", "excess"]["rho"] == pytest.approx(-1)
    assert found["spread", "KLD"]["25%"] == 1 and "rho.low" not in found["spread", "KLD"]
    # What is the same everywhere says nothing, and leaves out nobody.
    same = found["support", "KLD"]
    assert math.isnan(same["rho"]) and same["25%"] == same["100%"] == 5.5


def test_positions_tell_their_errors(asked):
    test, maps, uniform = asked
    rows = uncertainty.position_rows(test, maps, uniform, support=np.array([1, 2, 3]), groups=["a", "a", "b"])
    assert [r["group"] for r in rows] == ["a", "a", "b"] and [r["support"] for r in rows] == [1, 2, 3]
    expected = metrics.kld(test.truth, maps, eps=1e-6)
    assert [r["KLD"] for r in rows] == pytest.approx(expected.tolist()) and "spread" not in rows[0]
    # Half of these four, who look at different heights, tells less of the other half than all tell of themselves.
    assert all(0 < r["half"] < r["blind"] and r["excess"] == r["KLD"] - r["half"] for r in rows)
    alone = gaze.make_test(crowd(people=1), test.centres, 0.6, 20.0, 256, min_rays=20)
    assert "half" not in uncertainty.position_rows(alone, maps, uniform)[0]


def test_halves_that_look_alike_agree():
    test = gaze.make_test(crowd(20_000), np.array([[-0.5, 0, 1.6]]), 0.6, 20.0, 256, cap=4096)
    apart = uncertainty.half_errors(test, np.zeros_like(test.truth))
    alike = type(test)(**{**vars(test), "parts": np.repeat(test.truth[:, None], 4, axis=1)})
    assert uncertainty.half_errors(alike, np.zeros_like(test.truth)) == pytest.approx(-np.log(1), abs=1e-6)
    assert apart[0] > 0.05


def test_rays_of_the_density_are_held_as_often_as_is_said(asked):
    test, _, _ = asked
    rng = np.random.default_rng(0)
    chosen = np.stack([rng.choice(256, 4000, p=row / row.sum()) for row in test.truth])
    drawn = type(test)(**{**vars(test), "who": rng.integers(0, 4, chosen.shape)})
    right = test.truth, np.take_along_axis(test.truth, chosen, axis=1)
    sharp = tuple(v**3 for v in right)
    right, sharp = uncertainty.calibration_rows(drawn, {"right": right, "sharp": sharp})
    for share in LEVELS:
        assert right[f"{share:.0%}"] == pytest.approx(share, abs=0.03) and sharp[f"{share:.0%}"] < share - 0.05
        assert right[f"{share:.0%}.low"] < right[f"{share:.0%}"] < right[f"{share:.0%}.high"]


def test_calibrated_regions_hold_what_is_asked(asked):
    """A density that is too sharp holds too little; the shares that its own misses ask for hold what they should."""
    test, _, _ = asked
    rng = np.random.default_rng(1)
    chosen = np.stack([rng.choice(256, 4000, p=row / row.sum()) for row in test.truth])
    drawn = type(test)(**{**vars(test), "who": rng.integers(0, 4, chosen.shape)})
    sharp = test.truth**3, np.take_along_axis(test.truth**3, chosen, axis=1)
    half = region_levels(sharp[0], sharp[1][:, :2000]).ravel()
    found = calibrated_levels(half, np.ones(len(half)))
    rows = uncertainty.calibration_rows(drawn, {"sharp": sharp, "other": sharp}, 0, 0, {"sharp": found})
    assert [r["method"] for r in rows] == ["sharp", "sharp, calibrated", "other"]
    for share in LEVELS:
        name = level_name(share)
        assert rows[0][name] == rows[2][name] < share - 0.05 and rows[1][name] == pytest.approx(share, abs=0.03)
