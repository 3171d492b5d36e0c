"""Tests of `nerg_mi.train.trainer`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import save_radiance
from nerg_mi.threads import set_thread_count
from nerg_mi.train import radiance_run
from nerg_mi.train import trainer as shared
from nerg_mi.train.radiance_run import load_run, save_run, train_field
from nerg_mi.train.radiance_trainer import RadianceTrainer
from nerg_mi.train.trainer import StepClock
from tests.refusals import mentions
from tests.train.radiance.ball import BOX, TINY, settings, state, trainer

EVALUATION = {"steps": 9, "seconds": 0.5, "psnr": 3.0, "psnr_train": None, "every_pixel": 2}

# ---- A killed and resumed training equals an uninterrupted one ----


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(dataset, one_thread, tmp_path):
    """Through grid updates, occupancy extraction and hard pixels, on both sides of the interruption."""
    full, first, second = (trainer(dataset) for _ in range(3))
    while full.progress < 1:
        full.step()
    while first.steps < 21:
        first.step()
    save_run(first, tmp_path / "a.run", {"sha": 1}, [EVALUATION])
    assert load_run(second, tmp_path / "a.run", {"sha": 1}) == [EVALUATION]
    assert second.steps == 21
    while second.progress < 1:
        second.step()
    expected, got = state(full), state(second)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name
    assert full.extraction.pieces_done == second.extraction.pieces_done > 0


class Killed(BaseException):
    """End of the process, of which the run knows nothing."""


@pytest.mark.parametrize(
    "held_out, depth, kills",
    [
        (True, False, (1, 16, 39)),
        pytest.param(True, True, (9, 47), marks=pytest.mark.nightly),
        pytest.param(False, False, (20, 41, 44), marks=pytest.mark.nightly),
    ],
)
def test_killed_runs_have_the_result_of_an_uninterrupted_one(
    dataset, one_thread, tmp_path, monkeypatch, held_out, depth, kills
):
    """Weights, occupancy, curves and the chosen state, with evaluations that have come due but are postponed, and
    between the end of free space (step 39) and the next update of the grid (42), during the extraction of occupancy.
    """
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 10)
    # The best state is an early one: grey noise is nearer to fog than to a ball.
    grey = 0.3 + 0.1 * np.random.default_rng(0).random((24, 24, 3)).astype(np.float32)
    views = [replace(v, pixels=grey, depth=None) for v in dataset.held_out] if held_out else []
    data = replace(dataset, held_out=views)
    if not depth:
        data = replace(data, train=[replace(v, depth=None) for v in data.train])
    plan = settings(steps=48, photo_colors=False, grid_interval=7, extraction_start=0.0, free_space_end=0.8)

    def kill(progress):
        if progress.phase == "training" and progress.steps in remaining:
            remaining.remove(progress.steps)
            raise Killed

    remaining = list(kills)
    expected, provenance = train_field(data, TINY, plan, ns, depth)
    options = {"state": tmp_path / "a.run", "save_every": 0.0, "on_progress": kill}
    for number in range(len(kills)):
        with pytest.raises(Killed):
            train_field(data, TINY, plan, ns, depth, resume=number > 0, **options)
    field, again = train_field(data, TINY, plan, ns, depth, resume=True, **options)
    without_time = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    watched, watched_again = provenance["psnr_watched"], again["psnr_watched"]
    assert without_time(watched["history"]) == without_time(watched_again["history"])
    if held_out:
        assert len(watched["history"]) >= 3
        assert without_time([watched["result"]]) == without_time([watched_again["result"]])
        assert watched["result"]["steps"] < 48
        assert provenance["psnr_held_out"] == again["psnr_held_out"]
    for name, value in expected.parameters().items():
        assert np.array_equal(value.numpy(), field.parameters()[name].numpy()), name
    cells = "masks" if hasattr(expected.occupancy, "masks") else "bits"  # An early state has no finer occupancy
    assert np.array_equal(getattr(expected.occupancy, cells), getattr(field.occupancy, cells))


def test_an_interruption_and_a_failed_write_change_nothing(dataset, one_thread, tmp_path, monkeypatch):
    """The result of an interrupted run is evaluated, but the resumed run evaluates as if it had not been."""
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 4)

    def stop(progress):
        if progress.steps == 5:
            raise KeyboardInterrupt

    def refuse(field, provenance):
        raise NergError("the disk is full")

    options = {"state": tmp_path / "a.run", "on_progress": stop}
    steps = lambda provenance: [row["steps"] for row in provenance["psnr_watched"]["history"]]
    expected = steps(train_field(dataset, TINY, settings(steps=12), ns)[1])
    with pytest.raises(NergError, check=mentions("resume")):
        train_field(dataset, TINY, settings(steps=12), ns, write=refuse, **options)
    for row in read_checkpoint(tmp_path / "a.run", "radiance run")[1]["history"]:
        assert row["steps"] < 5
    _, provenance = train_field(dataset, TINY, settings(steps=12), ns, resume=True, **options)
    assert steps(provenance) == expected


def test_ctrl_c_saves_the_state_and_writing_removes_it(dataset, tmp_path):
    path, seen, written = tmp_path / "a.run", [], []

    def stop(progress):
        seen.append(progress)
        if progress.steps == 5 and len(seen) == 5:
            raise KeyboardInterrupt

    options = {
        "state": path,
        "preview": tmp_path / "a.png",
        "on_progress": stop,
        "write": lambda field, provenance: written.append((provenance["steps"], path.is_file())),
    }
    _, provenance = train_field(dataset, TINY, settings(steps=12), ns, **options)
    assert provenance["interrupted"] and path.is_file()
    _, provenance = train_field(dataset, TINY, settings(steps=12), ns, resume=True, **options)
    assert not provenance["interrupted"] and seen[5].steps == 6 and (tmp_path / "a.png").stat().st_size > 100
    assert written == [(5, True), (12, True)] and not path.exists()


def test_a_result_that_cannot_be_written_is_saved(dataset, one_thread, tmp_path):
    """Weights beyond fp16, and then without half: no step is repeated."""
    path, seen = tmp_path / "a.run", []

    def refuse(field, provenance):
        parameters = field.parameters()
        field.set_parameters(parameters | {"grid.table": parameters["grid.table"] * 0 + 1e6})
        save_radiance(field, tmp_path / "a.safetensors", provenance, half=True)

    options = {"state": path, "save_every": 1e9, "on_progress": seen.append}
    with pytest.raises(NergError, match="fp16.*half.*resume"):
        train_field(dataset, TINY, settings(steps=6), ns, write=refuse, **options)
    assert [p.name for p in tmp_path.iterdir()] == ["a.run"]
    seen.clear()
    _, provenance = train_field(
        dataset,
        TINY,
        settings(steps=6),
        ns,
        resume=True,
        write=lambda f, a: save_radiance(f, tmp_path / "a.safetensors", a),
        **options,
    )
    assert provenance["steps"] == 6 and all(p.phase != "training" for p in seen)
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_second_ctrl_c_leaves_the_state_before_the_step(dataset, one_thread, monkeypatch, tmp_path):
    """Raised in the middle of a step, when weights and random numbers are inconsistent: that state is not saved."""
    path, descend = tmp_path / "a.run", RadianceTrainer._optimize_step

    def twice(self, *options):
        if self.steps == 5:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        descend(self, *options)

    monkeypatch.setattr(RadianceTrainer, "_optimize_step", twice)
    with pytest.raises(KeyboardInterrupt):
        train_field(dataset, TINY, settings(steps=12), ns, state=path, save_every=0.0)
    assert read_checkpoint(path, "radiance run")[1]["steps"] == 4


_CHILD = """
import sys
import drjit as dr, drjit.llvm.ad as ns
from pathlib import Path
from tests.conftest import pytest_sessionstart
from tests.train.radiance.ball import TINY, ball_dataset, settings
from nerg_mi.train.radiance_run import train_field
pytest_sessionstart()
dr.set_thread_count(1)
train_field(ball_dataset(), TINY, settings(steps=10**6), ns, state=Path(sys.argv[1]), save_every=0.0)
"""


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_run_leaves_a_complete_state(dataset, one_thread, sent, tmp_path):
    """Killed at any time, the state is one of an uninterrupted run; Ctrl-C is handled between steps."""
    path = tmp_path / "a.run"
    child = subprocess.Popen([sys.executable, "-c", _CHILD, str(path)], env={**os.environ, "PYTHONPATH": os.getcwd()})
    until = time.time() + 600
    while not path.exists() and child.poll() is None and time.time() < until:
        time.sleep(0.05)
    time.sleep(0.3)
    child.send_signal(sent)
    assert child.wait(600) == (0 if sent == signal.SIGINT else -sent)
    provenance = dict.fromkeys(("sha256", "training_frames", "width", "height"))
    killed = trainer(dataset, steps=10**6)
    load_run(killed, path, provenance)
    same = trainer(dataset, steps=10**6)
    while same.steps < killed.steps:
        same.step()
    for name, value in state(same).items():
        assert np.array_equal(value, state(killed)[name]), name


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors, meta: meta.pop("taken"),
        lambda tensors, meta: meta.update(about=[]),
        lambda tensors, meta: meta.update(steps="7"),
        lambda tensors, meta: meta.update(random={"bit_generator": "PCG64", "state": 3}),
        lambda tensors, meta: meta.update(seconds=None),
        lambda tensors, meta: tensors.pop("hard"),
        lambda tensors, meta: tensors.update({"grid.bits": np.zeros(3, np.uint8)}),
        lambda tensors, meta: tensors.update({"weights.grid.table": np.zeros(5, np.float32)}),
        lambda tensors, meta: meta.update(history=3),
        lambda tensors, meta: meta.update(history=[3]),
        lambda tensors, meta: meta.update(history=[{"psnr": 3.0}]),
        lambda tensors, meta: meta.update(history=[{**EVALUATION, "psnr": None}]),
        lambda tensors, meta: meta.update(history=[{**EVALUATION, "every_pixel": 0}]),
        lambda tensors, meta: meta.update(history=[{**EVALUATION, "seconds": "1"}]),
        lambda tensors, meta: meta.update(best={"psnr": 3.0}),
        lambda tensors, meta: meta.update(best=3),
        lambda tensors, meta: meta.update(reserved=[1.0]),
        lambda tensors, meta: meta.update(reserved=["1", 0, 0]),
    ],
)
def test_a_damaged_state_is_reported_with_its_name(dataset, tmp_path, change):
    from nerg_mi.formats.checkpoint import write_checkpoint

    t = trainer(dataset)
    save_run(t, tmp_path / "a.run", {"sha": 1}, [])
    tensors, meta = read_checkpoint(tmp_path / "a.run", "radiance run")
    change(tensors, meta)
    write_checkpoint(
        tmp_path / "b.run", "radiance run", tensors, {k: v for k, v in meta.items() if k not in ("kind", "format")}
    )
    with pytest.raises(NergError, match="b.run"):
        load_run(t, tmp_path / "b.run", {"sha": 1})


# ---- The clock of a training: stored times, and states of other runs ----


def timed(*seconds):
    clock = StepClock()
    for s in seconds:
        clock.add_step(s)
    return clock


@pytest.mark.parametrize("seconds", [(), (0.5,), (0.25, 1.0, 0.5)])
def test_a_state_is_restored_with_and_without_steps(seconds):
    clock, again = timed(*seconds), StepClock()
    again.restore(json.loads(json.dumps(clock.to_dict())))
    assert again.to_dict() == clock.to_dict() and again.summary() == clock.summary()
    again.add_step(2.0)
    clock.add_step(2.0)
    assert again.summary() == clock.summary() and again.summary()["step_ms"]["max"] == 2000


def test_stored_durations_are_evenly_spaced(monkeypatch):
    monkeypatch.setattr(shared, "MAX_DURATIONS", 4)
    for steps, each in ((4, 1), (5, 2), (9, 4), (30, 8)):
        clock = timed(*range(steps))
        assert clock.keep_every == each and clock.durations == list(range(0, steps, each))


@pytest.mark.parametrize("change", [{"durations": []}, {"steps": 0}, {"steps": -1}, {"each": 0}, {"extremes": [0.5]}])
def test_steps_without_durations_and_durations_without_steps_are_refused(change):
    with pytest.raises(ValueError, match='"clock"'):
        StepClock().restore({**timed(0.5, 0.25).to_dict(), **change})


# ---- The speed of a machine changes nothing for equal steps ----


def test_a_run_by_minutes_equals_a_run_by_steps(dataset, one_thread, monkeypatch):
    """The few steps of a slow machine go through the same schedules: strides, rates, damping and occupancy
    extraction."""
    by_steps, by_minutes = trainer(dataset, steps=40), trainer(dataset, steps=None, minutes=2.0)
    monkeypatch.setattr(RadianceTrainer, "seconds", property(lambda self: self.steps * 3.0))
    for t in (by_steps, by_minutes):
        while t.progress < 1:
            t.step()
    assert by_minutes.steps == 40
    expected, got = state(by_steps), state(by_minutes)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name


def test_time_for_the_result_is_part_of_the_limit(dataset, monkeypatch):
    """Progress neither jumps nor falls when it is reserved, and the schedule ends that much earlier."""
    now = [0.0]
    monkeypatch.setattr(RadianceTrainer, "seconds", property(lambda self: now[0]))
    t, resumed = (trainer(dataset, steps=None, minutes=1.0) for _ in range(2))
    before = []
    for now[0], reserved in ((15.0, 6.0), (30.0, 20.0), (35.0, 10.0)):
        before.append(t.progress)
        t.reserve(reserved)
        assert t.progress == pytest.approx(before[-1])
    assert before == sorted(before) and before[:2] == pytest.approx([0.25, 0.25 + 0.75 * 15 / 39])
    now[0] = 49.0
    assert t.progress < 1
    tensors, meta = t.get_state()
    resumed.restore(tensors, json.loads(json.dumps(meta)))
    assert resumed.progress == pytest.approx(t.progress)
    now[0] = 50.0
    assert t.progress == pytest.approx(1)


def test_density_passes_stay_within_their_limit(dataset, monkeypatch):
    """A field that never clears: its density pass stays within the limit at every stride, down to the finest."""
    t = RadianceTrainer(
        dataset.train,
        BOX,
        TINY,
        settings(steps=60, max_prepass_batches=1.5, march_step=1 / 512, grid_interval=10**6),
        ns,
        depth=False,
    )
    strides, calls = set(), []
    look = t._density_prepass
    t._density_prepass = lambda p, active: calls.append(dr.width(p)) or look(p, active)
    while t.progress < 1:
        t.step()
        strides.add(t.stride)
    assert t.grid.occupied_fraction > 0.5 and t.stride == 1 and len(strides) > 1
    assert 0.5 * t.settings.max_prepass_samples < max(calls) <= t.settings.max_prepass_samples


def test_the_clock_counts_what_steps_evaluate():
    clock = StepClock()
    clock.add_evaluations(1000)
    assert clock.summary() == {}
    for _ in range(3):
        with clock:
            clock.add_evaluations(100)
    clock.add_evaluations(1000)
    assert clock.evaluations == 300 and len(clock.durations) == 3
    clock = StepClock()
    clock.evaluations = 300
    for seconds in (0.01, 0.06, 0.02):
        clock.add_step(seconds)
    assert clock.summary() == {"evaluations_a_second": 3333, "step_ms": {"min": 10.0, "median": 20.0, "max": 60.0}}


def test_the_result_reports_speed_and_problems(dataset):
    _, provenance = train_field(dataset, TINY, settings(steps=8), ns)
    assert provenance["evaluations_a_second"] > 0 and set(provenance["step_ms"]) == {"min", "median", "max"}
    assert any("only 8 steps" in x for x in provenance["complaints"])
    # The last evaluation is that of the result.
    assert provenance["psnr_watched"]["history"][-1]["steps"] == 8
    assert provenance["psnr_held_out"]["every_pixel"] == 1


# ---- Number of threads ----


def test_another_thread_may_change_the_number_of_threads_after_a_step(dataset, one_thread):
    """A kernel of the step may still be queued, whose scatters were recorded for one thread."""
    make = lambda: RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False)
    expected = make()
    expected.step()
    expected = state(expected)
    for _ in range(12):
        set_thread_count(1)
        made = make()
        made.step()
        other = threading.Thread(target=_use_three_threads)
        other.start()
        other.join()
        for name, value in state(made).items():
            np.testing.assert_allclose(value, expected[name], rtol=1e-4, atol=1e-6, err_msg=name)


def _use_three_threads():
    set_thread_count(3)
    assert dr.all(dr.arange(ns.Float, 100) >= 0)
