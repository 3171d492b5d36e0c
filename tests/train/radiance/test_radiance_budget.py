"""Tests of `nerg_mi.train.radiance_budget`."""

from types import SimpleNamespace

import pytest

from nerg_mi.train import radiance_budget
from nerg_mi.train.radiance_budget import MAX_SAMPLES, MIN_SAMPLES, Budget


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(radiance_budget.time, "perf_counter", lambda: now[0])
    return now


def make_trainer(minutes, extraction=6.0):
    """A trainer whose views have 2^20 samples each."""
    t = SimpleNamespace(
        seconds=0.0,
        progress=0.0,
        reserved_seconds=0.0,
        seconds_per_density=0.0,
        settings=SimpleNamespace(minutes=minutes),
    )
    t.estimate_extraction_seconds = lambda: extraction
    t.estimate_samples = lambda view: 2**20
    t.reserve = lambda seconds: setattr(t, "reserved_seconds", seconds)
    return t


def evaluate(budget, clock, seconds, views=4, every=2):
    with budget.timing_evaluation([None] * views) as strides:
        clock[0] += seconds
        strides.append(every)


def test_time_is_reserved_for_measured_costs(clock):
    """Extraction, an evaluation and a twentieth of the limit for the final error; at most half of the limit."""
    t = make_trainer(1.0)
    budget = Budget(t, [None] * 8)
    budget.update()
    assert t.reserved_seconds == 0
    evaluate(budget, clock, 1.5)
    t.progress = 0.06
    budget.update()
    assert t.reserved_seconds == pytest.approx(1.2 * 7.5 + 3)
    evaluate(budget, clock, 100.0)
    budget.update()
    assert t.reserved_seconds == pytest.approx(1.2 * 7.5 + 3)  # Estimated again later in the run
    t.progress = 0.2
    line = budget.update()
    needed = 1.2 * 106 + 200  # Fewest samples at the measured rate
    assert t.reserved_seconds == pytest.approx(30) and line is not None
    assert f"about {needed:.0f} s" in line and f"{(60 + needed - 30) / 60:.2g} minutes" in line
    t.progress = 0.3
    assert budget.update() is None  # once


def test_short_runs_reserve_an_evaluation_before_the_first_one():
    t = make_trainer(0.2, extraction=1.0)
    budget = Budget(t, [None] * 8)
    t.progress, t.seconds_per_density = 0.06, 1e-6
    assert budget.update() is None
    assert t.reserved_seconds == pytest.approx(1.2 * (1 + 2**20 * 1e-6) + 0.05 * 12)


def test_progress_follows_the_extraction():
    """Also one that takes five times as long as estimated; 10 seconds remain after it."""
    t = make_trainer(1.0, extraction=2.0)
    budget, fractions = Budget(t, []), []
    t.seconds, t.progress, t.reserved_seconds = 48.0, 1.0, 12.0
    budget.start_result()
    for k in range(1, 11):
        t.seconds = 48.0 + k
        budget.update_extraction(k / 10)
        fraction, remaining = budget.estimate()
        fractions.append(fraction)
    assert remaining == pytest.approx(10) and fractions == sorted(fractions) and fractions[-1] < 0.9


def test_the_final_error_takes_the_time_that_is_left(clock):
    t = make_trainer(1.0)
    budget = Budget(t, [None] * 8)
    assert budget.choose_final_samples() == MAX_SAMPLES
    evaluate(budget, clock, 1.0)  # 2^20 samples in a second
    for t.seconds, expected in ((0.0, MAX_SAMPLES), (55.0, 5 * 2**20), (59.0, 2**21), (90.0, 2**21)):
        assert budget.choose_final_samples() == pytest.approx(expected), t.seconds
    evaluate(budget, clock, 1000.0)
    assert budget.choose_final_samples() == MIN_SAMPLES
    without_limit = Budget(make_trainer(None), [None] * 8)
    evaluate(without_limit, clock, 1000.0)
    assert without_limit.choose_final_samples() == MAX_SAMPLES


@pytest.mark.parametrize("minutes", [None, 1.0])
def test_estimates_include_the_result(clock, minutes):
    t = make_trainer(minutes)
    budget, fractions = Budget(t, [None] * 8), []

    def note(expected=None, part=0.0):
        fraction, remaining = budget.estimate(part)
        fractions.append(fraction)
        assert 0 <= fraction < 1 and (remaining > 0 or t.seconds == 0)
        if expected is not None:
            assert remaining == pytest.approx(expected) and fraction == pytest.approx(
                t.seconds / (t.seconds + expected)
            )

    note()
    evaluate(budget, clock, 1.0)
    t.seconds, t.progress = 20.0, 0.5
    budget.update()
    note(40.0 if minutes else 20 + 6 + 1 + 8)
    t.seconds, t.progress = 40.0, 1.0
    note(20.0 if minutes else 6 + 1 + 8)
    budget.start_result()
    for t.seconds, part in ((41.0, 0.0), (50.0, 0.0), (500.0, 0.0), (501.0, 0.5), (502.0, 1.0)):
        note(part=part)
    assert fractions == sorted(fractions) and fractions[-1] > 0.9
