"""Means over folds, against those of a table by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from nerg_mi.evaluation.folds import mean_rows


def fold(ours, bar, half=None):
    rows = [{"method": "gaze field", "KLD": ours, "integral": 1.0}, {"method": "nearest", "KLD": bar}]
    return rows + ([] if half is None else [{"method": "split half", "KLD": half}])


def test_means_intervals_and_differences_of_pairs():
    ours, bars = np.array([0.4, 0.6, 0.5]), np.array([0.7, 0.8, 0.75])
    rows = {row["method"]: row for row in mean_rows([fold(a, b) for a, b in zip(ours, bars)])}
    assert list(rows) == ["gaze field", "nearest", "gaze field less nearest"]
    # SciPy's own interval of a mean.
    low, high = stats.ttest_1samp(ours, 0).confidence_interval(0.95)
    field = rows["gaze field"]
    assert (field["KLD"], field["KLD.low"], field["KLD.high"]) == pytest.approx((0.5, low, high))
    assert field["folds"] == 3 and field["integral.low"] == field["integral.high"] == 1.0
    low, high = stats.ttest_rel(ours, bars).confidence_interval(0.95)
    less = rows["gaze field less nearest"]
    assert (less["KLD"], less["KLD.low"], less["KLD.high"]) == pytest.approx((-0.25, low, high))


def test_what_some_folds_lack_is_a_mean_of_the_others():
    rows = {row["method"]: row for row in mean_rows([fold(0.4, 0.7, 0.2), fold(0.6, math.nan)])}
    assert rows["split half"] == {"method": "split half", "folds": 1, "KLD": 0.2}
    assert rows["nearest"]["KLD"] == 0.7 and "KLD.low" not in rows["nearest"]
    # The bar is the last method, and no reference.
    assert "gaze field less nearest" in rows and mean_rows([fold(1, 2)[:1]])[0]["KLD"] == 1


def test_intervals_hold_the_mean_as_often_as_they_say():
    rng, held = np.random.default_rng(0), 0
    for _ in range(400):
        (row, *_) = mean_rows([fold(float(v), 1.0) for v in rng.normal(0.5, 0.1, 5)])
        held += row["KLD.low"] <= 0.5 <= row["KLD.high"]
    assert 0.92 <= held / 400 <= 0.98
