"""A gaze training that is interrupted and resumed comes to what an uninterrupted one comes to."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.field.backend import namespace
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.log_density import LogGazeConfig
from nerg_mi.training.gaze.run import train_gaze
from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings

from .test_trainer import BOX, GRID, SMALL, looking_at, wall  # noqa: F401  (fixture)

RAYS = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
PROBES = ProbeSettings(radius=0.5, count=16, cap=64, min_rays=8, kappa=20.0, directions=64)
LOG = LogGazeConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=2, finest=4), width=16, prior=16, mix=0.1)
PRODUCT = GazeSettings(steps=16, looks=8, zones=2, watched=6, probes=4, directions=32)
LIKELIHOOD = replace(PRODUCT, loss="likelihood", integral=0.0, rays=16)


@pytest.fixture
def threads():
    """Sets the number of threads, which the end puts back."""
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


def train(medium, settings, config, probes=PROBES, **options):
    return train_gaze(RAYS, medium, BOX, config, settings, probes, namespace("llvm"), **options)


def stopping(stage, step):
    """Ctrl-C as soon as a stage has come to a step."""
    seen = []

    def watch(state):
        seen.append((state.stage, state.steps))
        if len([s for s in seen if s == (stage, step)]) == 1 and (state.stage, state.steps) == (stage, step):
            raise KeyboardInterrupt

    watch.seen = seen
    return watch


@pytest.mark.parametrize(
    "settings, config, probes, count",
    [(PRODUCT, SMALL, PROBES, 1), (LIKELIHOOD, LOG, replace(PROBES, fresh=True), 1), (LIKELIHOOD, LOG, PROBES, 2)],
    ids=["product", "fresh", "two threads"],
)
def test_a_resumed_run_equals_an_uninterrupted_one(wall, settings, config, probes, count, threads, tmp_path):  # noqa: F811
    """Bit for bit at one thread, to 1e-5 at two; interrupted in both of its fits, past validations and epochs."""
    threads(count)
    expected, whole = train(wall, settings, config, probes)
    path = tmp_path / "a.run"
    _, about = train(wall, settings, config, probes, state=path, on_progress=stopping("fit", 5))
    assert about["interrupted"] and about["steps"] <= 5 and path.is_file()
    assert whole["validation"]["best_step"] > 3
    watch = stopping("refit", 3)
    _, about = train(wall, settings, config, probes, state=path, resume=True, on_progress=watch)
    assert about["interrupted"] and path.is_file() and ("fit", 5) not in watch.seen and ("fit", 6) in watch.seen
    watch = stopping("", 0)
    there = []
    got, about = train(
        wall,
        settings,
        config,
        probes,
        state=path,
        resume=True,
        on_progress=watch,
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


def test_another_run_is_not_resumed(wall, tmp_path):  # noqa: F811
    path = tmp_path / "a.run"
    train(wall, PRODUCT, SMALL, state=path, on_progress=stopping("fit", 1))
    with pytest.raises(NergError, match="other settings;"):
        train(wall, replace(PRODUCT, seed=3), SMALL, state=path, resume=True)
    with pytest.raises(NergError, match="other place, probes;"):
        train(wall, PRODUCT, SMALL, replace(PROBES, kappa=9.0), state=path, resume=True, about={"place": "elsewhere"})
    with pytest.raises(NergError, match="nothing to resume"):
        train(wall, PRODUCT, SMALL, state=tmp_path / "b.run", resume=True)


def test_the_state_is_kept_every_so_often_and_when_asked(monkeypatch, tmp_path):
    from nerg_mi.training.gaze import state as gaze_state

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


def test_what_was_found_is_kept_before_the_second_fit_is_prepared(wall, monkeypatch, tmp_path):  # noqa: F811
    """Probes and depths of all rays take long: whoever ends the run there does not train the first fit again."""
    from nerg_mi.training.gaze import run as gaze_run

    supervise, calls = gaze_run.supervise_both, []

    def killed(rays, *rest):
        calls.append(len(rays))
        if len(calls) == 3:
            raise MemoryError("killed")
        return supervise(rays, *rest)

    path, how = tmp_path / "a.run", {"state": tmp_path / "a.run", "save_every": 1e9}
    monkeypatch.setattr(gaze_run, "supervise_both", killed)
    with pytest.raises(MemoryError):
        train(wall, PRODUCT, SMALL, **how)
    # To watch, to learn without what is watched, and of all rays.
    assert calls[0] == calls[2] > calls[1] and path.is_file()
    watch = stopping("", 0)
    _, about = train(wall, PRODUCT, SMALL, resume=True, on_progress=watch, **how)
    assert {stage for stage, _ in watch.seen} == {"probes", "refit"} and about["refitted"]


def test_directions_are_fresh_in_every_epoch(wall, monkeypatch):  # noqa: F811
    """16 probes, 4 a step: an epoch is four steps. Without it there is one set of directions."""
    from nerg_mi.training.gaze import supervision as gaze_supervision

    drawn, sets = [], gaze_supervision.rotated_sets
    monkeypatch.setattr(gaze_supervision, "rotated_sets", lambda *given: drawn.append(sets(*given)) or drawn[-1])
    settings = replace(PRODUCT, zones=0, steps=9)
    train(wall, settings, SMALL, replace(PROBES, fresh=True))
    assert len(drawn) == 3 and np.abs(drawn[0] - drawn[1]).max() > 0.1 and np.abs(drawn[1] - drawn[2]).max() > 0.1
    drawn.clear()
    train(wall, settings, SMALL)
    assert len(drawn) == 1


@pytest.mark.parametrize("refit", [True, False])
def test_a_result_that_cannot_be_written_is_kept(wall, refit, threads, tmp_path):  # noqa: F811
    """A full disk at the end, once: nothing is trained again."""
    threads(1)
    path, seen, written = tmp_path / "a.run", [], []

    def refuse(field, about):
        raise NergError("the disk is full.")

    settings = replace(PRODUCT, refit=refit)
    how = {"state": path, "save_every": 1e9}
    with pytest.raises(NergError, match="the disk is full; .* --resume writes it"):
        train(wall, settings, SMALL, write=refuse, **how)
    assert path.is_file()
    watch = stopping("", 0)
    field, _ = train(
        wall, settings, SMALL, resume=True, on_progress=watch, write=lambda *given: written.append(given), **how
    )
    assert {s for s, _ in watch.seen} == {"probes"} and written[0][0] is field and not path.exists()
    expected = train(wall, settings, SMALL)[0].parameters()
    for name, value in field.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(expected[name]), err_msg=name)


def test_the_command_goes_on(rgb, tmp_path, monkeypatch, capsys):
    from nerg_mi.cli import main
    from nerg_mi.cli import train_gaze as command
    from nerg_mi.formats.fields import load_gaze

    def nerg(*more):
        with pytest.raises(SystemExit) as end:
            main([*arguments, *more])
        return end.value.code, capsys.readouterr().err

    RAYS.save(tmp_path / "rays.npz")
    out = tmp_path / "gaze.safetensors"
    arguments = f"train gaze {tmp_path / 'rays.npz'} --geometry none -o {out} --radius 0.5 --probes 6 --steps 8 --directions 64 --zones 0 --fresh-directions".split()
    code, said = nerg("--resume")
    assert code == 1 and "nothing to resume" in said
    with monkeypatch.context() as change:
        change.setattr(command._Bar, "update", lambda self, state: stopping("fit", 5)(state))
        code, said = nerg()
    assert code == 130 and "go on with --resume" in said and out.is_file() and out.with_suffix(".run").is_file()
    code, said = nerg("--resume")
    about = load_gaze(out, namespace("llvm"))[1]["provenance"]
    assert (
        about["steps"] == 8
        and not about["interrupted"]
        and about["probes"]["fresh"]
        and not out.with_suffix(".run").exists()
    )
    assert code == 0 and "go on" not in said


_CHILD = """
import sys
import drjit as dr, mitsuba as mi
from pathlib import Path
import nerg_mi
from tests.training.gaze.test_state import *
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
train(None, replace(LIKELIHOOD, steps=10**6, zones=0), replace(LOG, geometry="none"), state=Path(sys.argv[1]), save_every=0.0)
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
    train(None, settings, replace(LOG, geometry="none"), state=same, on_progress=stopping("fit", meta["steps"]))
    expected, _ = read_checkpoint(same, "gaze run")
    assert meta["steps"] > 0 and set(tensors) == set(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(tensors[name], value, err_msg=name)
