"""The clock of a training's steps: what it gives to a state, and which states are none of its own."""

from __future__ import annotations

import json

import pytest

from nerg_mi.train import checkpointing
from nerg_mi.train.checkpointing import StepClock


def timed(*seconds):
    clock = StepClock()
    for s in seconds:
        clock.add(s)
    return clock


@pytest.mark.parametrize("seconds", [(), (0.5,), (0.25, 1.0, 0.5)])
def test_a_state_is_restored_with_and_without_steps(seconds):
    clock, again = timed(*seconds), StepClock()
    again.restore(json.loads(json.dumps(clock.to_dict())))
    assert again.to_dict() == clock.to_dict() and again.summary() == clock.summary()
    again.add(2.0)
    clock.add(2.0)
    assert again.summary() == clock.summary() and again.summary()["step_ms"]["max"] == 2000


def test_durations_are_kept_of_steps_that_are_equally_far_apart(monkeypatch):
    monkeypatch.setattr(checkpointing, "KEPT", 4)
    for steps, each in ((4, 1), (5, 2), (9, 4), (30, 8)):
        clock = timed(*range(steps))
        assert clock.each == each and clock.durations == list(range(0, steps, each))


@pytest.mark.parametrize("change", [{"durations": []}, {"steps": 0}, {"steps": -1}, {"each": 0}, {"extremes": [0.5]}])
def test_steps_without_durations_and_durations_without_steps_are_refused(change):
    with pytest.raises(ValueError, match='"clock"'):
        StepClock().restore({**timed(0.5, 0.25).to_dict(), **change})
