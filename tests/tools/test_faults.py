"""The tool of the faults, cut short: kills and refusals of quick commands; and it sees a file that is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest

from tests.conftest import ROOT
from tools import child_commands, tiny, whole_files

# In a process of its own: it forks, and this one has long begun to compute.
_KILLS = """
import json, sys
from pathlib import Path
import nerg_mi, mitsuba
from tools import faults, tiny
work = Path(sys.argv[1])
inputs, out = work / "inputs", work / "out"
inputs.mkdir(); out.mkdir()
tiny.write_tracking(inputs / "track.csv", 4000)
tiny.looks(2000).save(inputs / "rays.npz")
(command,) = [c for c in faults.COMMANDS if c.name == sys.argv[2]]
tally = faults.try_kills(command, inputs, out, 4)
print(json.dumps([tally.__dict__, *faults.refusals(work, inputs, sys.argv[2])]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rays import", "rays filter, in place"])
def test_kills_and_refusals_lose_nothing(name):
    # Not in pytest's folder, into which nobody else may look.
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        done = subprocess.run(
            [sys.executable, "-c", _KILLS, folder, name],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
    assert done.returncode == 0, done.stderr[-2000:]
    tally, rows, wrong = json.loads(done.stdout.splitlines()[-1])
    assert tally["tried"] == tally["started"] == 4 and tally["landed"] >= 1 and tally["lost"] == 0
    assert wrong == [] and len(rows) >= 3 and all(row[3] in (0, "-") for row in rows)


def test_a_file_that_is_cut_off_is_lost(tmp_path):
    tiny.looks(50).save(tmp_path / "rays.npz")
    whole, before = (tmp_path / "rays.npz").read_bytes(), whole_files.contents(tmp_path)
    assert whole_files.lost_files(before, whole_files.contents(tmp_path)) == []
    tiny.looks(60).save(tmp_path / "rays.npz")
    assert whole_files.lost_files(before, whole_files.contents(tmp_path)) == []
    (tmp_path / "rays.npz").write_bytes(whole[:-30])
    (said,) = whole_files.lost_files(before, whole_files.contents(tmp_path))
    assert "rays.npz is not whole" in said
    (tmp_path / "rays.npz").unlink()
    (said,) = whole_files.lost_files(before, whole_files.contents(tmp_path))
    assert "rays.npz is gone" in said


@pytest.mark.parametrize(
    "name, data",
    [
        ("a.vol", b"VOL\3" + np.array([1, 2, 2, 2, 1], "<i4").tobytes() + bytes(24) + bytes(31)),
        ("a.json", b'{"a": 1'),
        ("a.csv", b"a,b\n1,"),
        ("a.safetensors", b"\x20\0\0\0\0\0\0\0{}"),
        ("a.ply", b"ply\nformat ascii 1.0\n"),
        ("a.exr", b"v/1\1"),
    ],
)
def test_what_is_no_whole_file(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    (said,) = whole_files.lost_files({}, whole_files.contents(tmp_path))
    assert f"{name} is not whole" in said


def test_a_file_being_written_is_hidden_and_no_result(tmp_path):
    (tmp_path / ".rays.12-ab.part.npz").write_bytes(b"half")
    assert whole_files.contents(tmp_path) == {}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_kill_lands_and_an_end_is_seen():
    pid = os.fork()
    if pid == 0:
        time.sleep(60)
        os._exit(0)
    assert child_commands.kill_at(pid, 0.05) == -9
    pid = os.fork()
    if pid == 0:
        os._exit(3)
    assert child_commands.kill_at(pid, 30) == 3
