"""A gaze training that is interrupted and resumed comes to what an uninterrupted one comes to."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError

from .looks import LIKELIHOOD, LOG, NOWHERE, PROBES, PRODUCT, SMALL, stopping, train


@pytest.mark.parametrize(
    "settings, config, probes, count",
    [(PRODUCT, SMALL, PROBES, 1), (LIKELIHOOD, LOG, replace(PROBES, fresh=True), 1), (LIKELIHOOD, LOG, PROBES, 2)],
    ids=["product", "fresh", "two threads"],
)
def test_a_resumed_run_equals_an_uninterrupted_one(wall, settings, config, probes, count, threads, tmp_path):
    """Bit for bit at one thread, to 1e-5 at two; interrupted in both of its fits, past validations and epochs."""
    threads(count)
    expected, whole = train(wall, settings, config, probes)
    path = tmp_path / "a.run"
    _, about = train(wall, settings, config, probes, path=path, tell=stopping("fit", 5))
    assert about["interrupted"] and about["steps"] <= 5 and path.is_file()
    assert whole["validation"]["best_step"] > 3
    watch = stopping("refit", 3)
    _, about = train(wall, settings, config, probes, path=path, resume=True, tell=watch)
    assert about["interrupted"] and path.is_file() and ("fit", 5) not in watch.seen and ("fit", 6) in watch.seen
    watch = stopping("", 0)
    there = []
    got, about = train(
        wall,
        settings,
        config,
        probes,
        path=path,
        resume=True,
        tell=watch,
        write=lambda *_: there.append(path.is_file()),
    )
    assert (
        not about["interrupted"]
        and there == [True]
        and not path.exists()
        and {s for s, _ in watch.seen} == {"probes", "refit"}
    )
    assert ("refit", 3) not in watch.seen and ("refit", 4) in watch.seen
    for name, value in expected.parameters().items():
        compare = (
            np.testing.assert_array_equal
            if count == 1
            else lambda a, b, err_msg: np.testing.assert_allclose(a, b, atol=1e-5, err_msg=err_msg)
        )
        compare(np.array(got.parameters()[name]), np.array(value), err_msg=name)
    if count == 1:
        assert about["validation"] == whole["validation"] and about["steps"] == whole["steps"]


def test_another_run_is_not_resumed(wall, tmp_path):
    path = tmp_path / "a.run"
    train(wall, PRODUCT, SMALL, path=path, tell=stopping("fit", 1))
    with pytest.raises(NergError, match="other settings;"):
        train(wall, replace(PRODUCT, seed=3), SMALL, path=path, resume=True)
    with pytest.raises(NergError, match="other place, probes;"):
        train(wall, PRODUCT, SMALL, replace(PROBES, kappa=9.0), path=path, resume=True, about={"place": "elsewhere"})
    with pytest.raises(NergError, match="nothing to resume"):
        train(wall, PRODUCT, SMALL, path=tmp_path / "b.run", resume=True)


def test_the_state_is_kept_every_so_often_and_when_asked(monkeypatch, tmp_path):
    from nerg_mi.train import gaze_trainer as gaze_state

    clock, kept = [100.0], []
    monkeypatch.setattr(gaze_state.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(
        gaze_state, "write_checkpoint", lambda path, kind, tensors, meta: kept.append((clock[0], meta["spent"]))
    )
    file = gaze_state.GazeRunFile(tmp_path / "a.run", {}, 10.0, False)
    for clock[0] in (105.0, 109.0, 111.0, 112.0, 120.0, 122.5):
        file.keep("fit", None, {}, {}, now=clock[0] == 112.0)
    assert kept == [(111.0, 11.0), (112.0, 12.0), (122.5, 22.5)]
    gaze_state.GazeRunFile(None, {}, 10.0, False).keep("fit", None, {}, {}, now=True)


def test_what_was_found_is_kept_before_the_second_fit_is_prepared(wall, monkeypatch, tmp_path):
    """Probes and depths of all rays take long: whoever ends the run there does not train the first fit again."""
    from nerg_mi.train import gaze_run

    make_targets, calls = gaze_run.make_targets, []

    def killed(supervision, *rest):
        calls.append(len(supervision.rays))
        if len(calls) == 3:
            raise MemoryError("killed")
        return make_targets(supervision, *rest)

    path, how = tmp_path / "a.run", {"path": tmp_path / "a.run", "every": 1e9}
    monkeypatch.setattr(gaze_run, "make_targets", killed)
    with pytest.raises(MemoryError):
        train(wall, PRODUCT, SMALL, **how)
    # To watch, to learn without what is watched, and of all rays.
    assert calls[0] == calls[2] > calls[1] and path.is_file()
    watch = stopping("", 0)
    _, about = train(wall, PRODUCT, SMALL, resume=True, tell=watch, **how)
    assert {stage for stage, _ in watch.seen} == {"probes", "refit"} and about["refitted"]


@pytest.mark.parametrize("refit", [True, False])
def test_a_result_that_cannot_be_written_is_kept(wall, refit, threads, tmp_path):
    """A full disk at the end, once: nothing is trained again."""
    threads(1)
    path, written = tmp_path / "a.run", []

    def refuse(field, about):
        raise NergError("the disk is full.")

    settings = replace(PRODUCT, refit=refit)
    how = {"path": path, "every": 1e9}
    with pytest.raises(NergError, match="--resume"):
        train(wall, settings, SMALL, write=refuse, **how)
    assert path.is_file()
    watch = stopping("", 0)
    field, _ = train(wall, settings, SMALL, resume=True, tell=watch, write=lambda *given: written.append(given), **how)
    assert {s for s, _ in watch.seen} == {"probes"} and written[0][0] is field and not path.exists()
    expected = train(wall, settings, SMALL)[0].parameters()
    for name, value in field.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(expected[name]), err_msg=name)


_CHILD = """
import sys
import drjit as dr, mitsuba as mi
from pathlib import Path
import nerg_mi
from dataclasses import replace
from tests.train.gaze.looks import *
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
config = replace(LOG, geometry="none")
train(NOWHERE, replace(LIKELIHOOD, steps=10**6, zones=0), config, path=Path(sys.argv[1]), every=0.0)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_run_that_is_ended_from_outside_leaves_a_whole_state(rgb, how, threads, tmp_path):
    """Killed at any moment, the state is one that an uninterrupted run has been in; Ctrl-C is heard between steps."""
    from nerg_mi.formats.checkpoint import read_checkpoint

    threads(1)
    path = tmp_path / "a.run"
    child = subprocess.Popen([sys.executable, "-c", _CHILD, str(path)], env={**os.environ, "PYTHONPATH": os.getcwd()})
    until = time.time() + 120
    while not path.exists() and child.poll() is None and time.time() < until:
        time.sleep(0.05)
    time.sleep(0.05)
    child.send_signal(how)
    assert child.wait() == (0 if how == signal.SIGINT else -how)
    tensors, meta = read_checkpoint(path, "gaze run")
    same = tmp_path / "same.run"
    settings = replace(LIKELIHOOD, steps=10**6, zones=0)
    train(NOWHERE, settings, replace(LOG, geometry="none"), path=same, tell=stopping("fit", meta["steps"]))
    expected, _ = read_checkpoint(same, "gaze run")
    assert meta["steps"] > 0 and set(tensors) == set(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(tensors[name], value, err_msg=name)
