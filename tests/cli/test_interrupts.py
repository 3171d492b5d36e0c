"""Ctrl-C in a process of its own: exit code 130, outputs whole or absent, trainings to be gone on with."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys

import pytest

from nerg_mi.formats.checkpoint import read_checkpoint

from .outputs import make_inputs

_CHILD = """
import os, pkgutil, signal, sys
import nerg_mi.cli
name, calls, *arguments = sys.argv[1:]
owner, _, function = name.rpartition(".")
owner = pkgutil.resolve_name(owner)
original, left = getattr(owner, function), int(calls)

def interrupted(*given, **more):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGINT)
    return original(*given, **more)

setattr(owner, function, interrupted)
nerg_mi.cli.main(arguments)
"""


def interrupted(name: str, calls: int, *arguments) -> subprocess.CompletedProcess:
    """`nerg` in a process that gets SIGINT as a function is called for the so-many-th time."""
    command = [sys.executable, "-c", _CHILD, f"nerg_mi.{name}", str(calls), *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, env={**os.environ, "PYTHONPATH": os.getcwd()}
    )


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return make_inputs(tmp_path_factory.mktemp("inputs"))


ENDLESS = "--steps 1000000 --save-every 0"
GAZE = "--geometry none --radius 0.6 --probes 8 --directions 64 --zones 0 --min-rays 8"


# Steps that a radiance training takes, and forgets, before its first.
WARM_UP = 5


def test_a_gaze_training_keeps_its_state_and_its_result(inputs, tmp_path):
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} --variant capture {ENDLESS}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 4, *line.split())
    assert done.returncode == 130 and "go on with --resume" in done.stderr, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.run", "a.safetensors"]
    # The step during which it came is finished.
    assert read_checkpoint(tmp_path / "a.run", "gaze run")[1]["steps"] == 4
    assert read_checkpoint(tmp_path / "a.safetensors", "gaze")[1]["provenance"]["interrupted"]


def test_a_gaze_training_whose_variant_is_not_chosen_yet_says_that_nothing_was_kept(inputs, tmp_path):
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} {ENDLESS}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 4, *line.split())
    assert done.returncode == 130 and "nothing was kept" in done.stderr and "--resume" not in done.stderr, done.stderr
    assert not os.listdir(tmp_path)


def test_a_radiance_training_keeps_its_state_and_its_result(inputs, tmp_path):
    line = f"train radiance {inputs}/photos -o {tmp_path}/a.safetensors {ENDLESS}"
    done = interrupted("train.radiance_trainer.RadianceTrainer.step", WARM_UP + 4, *line.split())
    assert done.returncode == 130 and "go on with --resume" in done.stderr, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.preview.png", "a.run", "a.safetensors"]
    assert read_checkpoint(tmp_path / "a.run", "radiance run")[1]["steps"] == 4
    assert read_checkpoint(tmp_path / "a.safetensors", "radiance")[1]["provenance"]["interrupted"]


def test_an_ensemble_keeps_its_members_and_its_state(inputs, tmp_path):
    some = "--variant capture --steps 3 --ensemble 2 --save-every 0"
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} {some}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 5, *line.split())
    assert done.returncode == 130 and "member 2 of 2; go on with --resume" in done.stderr, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.member0.safetensors", "a.run"]


ENDS = {
    "eval": (
        "evaluation.metrics.Renderer.__call__",
        2,
        "eval radiance {i}/field.safetensors {i}/photos --holdout 2 -o {o}",
    ),
    "study": (
        "evaluation.study.measure",
        1,
        "study slab -o {o} --quick --width 12 --height 8 --only jitter -m llvm_ad_rgb",
    ),
    "ablate": (
        "train.gaze_log_density.LikelihoodTrainer.step",
        3,
        "ablate {i}/rays.npz -o {o} --geometry none --recipes default --variant emit --zones 1 --positions 4 "
        "--min-rays 8 --radius 0.5 --cameras 0 --probes 8",
    ),
    "rays import": (
        "rays.readers.table.add_tables",
        1,
        "rays import {i}/day.csv -o {o}/a.npz --map 'origin=x,y,z direction=a,b,c t=t person=p'",
    ),
    "export": ("fields.extraction.Sampler.on", 1, "export points {i}/field.safetensors -o {o}/a.ply --resolution 16"),
}
"""Function during whose so-many-th call Ctrl-C comes, and the command line with its folders of inputs and outputs."""


@pytest.mark.parametrize("name", ENDS)
def test_a_command_ends_at_once(name, inputs, tmp_path):
    function, calls, line = ENDS[name]
    done = interrupted(function, calls, *shlex.split(line.format(i=inputs, o=tmp_path / "out")))
    assert done.returncode == 130 and "Interrupted." in done.stderr and "Traceback" not in done.stderr, done.stderr
    found = sorted(p.name for p in tmp_path.rglob("*") if p.is_file())
    assert found == (["0.png"] if name == "eval" else [])
