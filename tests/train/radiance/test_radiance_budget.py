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
    t = SimpleNamespace(seconds=0.0, progress=0.0, reserved_seconds=0.0, settings=SimpleNamespace(minutes=minutes))
    t.estimate_extraction_seconds = lambda: extraction
    t.estimate_samples = lambda view: 2**20
    t.reserve = lambda seconds: setattr(t, "reserved_seconds", seconds)
    return t


def evaluate(budget, clock, seconds, views=4, every=2):
    with budget.timing_evaluation([None] * views) as strides:
        clock[0] += seconds
        strides.append(every)


def test_time_is_reserved_for_measured_costs(clock):
    """Extraction, an evaluation and a twentieth of the limit for the final error; at most three tenths of the limit."""
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
    budget.update()
    assert t.reserved_seconds == pytest.approx(18)


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
