"""What a machine's speed changes in a training: nothing at equal steps, and the result says when there were few."""

import json
import time

import drjit as dr
import numpy as np

from nerg_mi.train.radiance_run import train_field
from nerg_mi.train.radiance_trainer import RadianceTrainer
from nerg_mi.train.trainer import StepClock

from .ball import BOX, TINY, ns, settings, state, trainer


def test_a_run_by_steps_does_not_see_the_clock(dataset, one_thread):
    """Bit for bit the same where steps take longer, some of them much."""
    quick, slow = (trainer(dataset, steps=40) for _ in range(2))
    for k in range(40):
        quick.step()
        slow.step()
        time.sleep(0.2 if k % 8 == 0 else 0.002)
    expected, got = state(quick), state(slow)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name


def test_a_run_by_minutes_is_the_run_of_as_many_steps(dataset, one_thread, monkeypatch):
    """A slow machine's few steps in its minutes go through the same schedules: strides, rates, damping and settling."""
    by_steps, by_minutes = trainer(dataset, steps=40), trainer(dataset, steps=None, minutes=2.0)
    monkeypatch.setattr(RadianceTrainer, "seconds", property(lambda self: self.steps * 3.0))
    for t in (by_steps, by_minutes):
        while t.progress < 1:
            t.step()
    assert by_minutes.steps == 40
    expected, got = state(by_steps), state(by_minutes)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name


def test_no_pass_of_a_run_is_larger_than_its_bound(dataset, monkeypatch):
    """A field that never clears: its density-only pass stays within the bound at every stride, down to the finest."""
    t = RadianceTrainer(
        dataset.train,
        BOX,
        TINY,
        settings(steps=60, look_most=1.5, march_step=1 / 512, grid_every=10**6),
        ns,
        depth=False,
    )
    strides, asked = set(), []
    look = t._look
    t._look = lambda p, active: asked.append(dr.width(p)) or look(p, active)
    while t.progress < 1:
        t.step()
        strides.add(t.stride)
    assert t.grid.fraction > 0.5 and t.stride == 1 and len(strides) > 1
    assert 0.5 * t.settings.most_looked < max(asked) <= t.settings.most_looked


def test_the_clock_counts_what_steps_evaluate():
    clock = StepClock()
    clock.count(1000)
    assert clock.summary() == {}
    for _ in range(3):
        with clock:
            clock.count(100)
    clock.count(1000)
    assert clock.evaluations == 300 and len(clock.durations) == 3
    clock = StepClock()
    clock.evaluations = 300
    for seconds in (0.01, 0.06, 0.02):
        clock.add(seconds)
    assert clock.summary() == {"evaluations_a_second": 3333, "step_ms": {"min": 10.0, "median": 20.0, "max": 60.0}}
    again = StepClock()
    again.restore(clock.to_dict())
    assert again.summary() == clock.summary()


def test_the_clock_of_a_long_run_stays_small():
    clock, seconds = StepClock(), np.random.default_rng(0).permutation(100_000) * 1e-5 + 0.02
    for s in seconds:
        clock.add(float(s))
    assert len(json.dumps(clock.to_dict())) < 50_000
    said = clock.summary()["step_ms"]
    assert said["min"] == 20.0 and said["max"] == 1020.0 and abs(said["median"] - 520) < 20
    assert abs(clock.seconds - seconds.sum()) < 1e-6


def test_the_result_tells_its_steps_speed_and_what_is_wrong(dataset):
    _, about = train_field(dataset, TINY, settings(steps=8), ns)
    assert about["evaluations_a_second"] > 0 and set(about["step_ms"]) == {"min", "median", "max"}
    assert any("only 8 steps" in x for x in about["complaints"])
    # The last look is that of the result.
    assert about["psnr_watched"]["history"][-1]["steps"] == 8
    assert about["psnr_held_out"]["every_pixel"] == 1
