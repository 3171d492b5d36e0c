"""A command that is killed loses no file and starts again."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

# In a process of its own: it forks, and this one has long begun to compute.
_KILLS = """
import json, sys
from pathlib import Path
import nerg_mi, mitsuba
from tests import tiny
from tools import faults
work = Path(sys.argv[1])
inputs, out = work / "inputs", work / "out"
inputs.mkdir(); out.mkdir()
tiny.write_tracking(inputs / "track.csv", 4000)
tiny.looks(2000).save(inputs / "rays.npz")
(command,) = [c for c in faults.COMMANDS if c.name == sys.argv[2]]
print(json.dumps(faults.try_kills(command, inputs, out, 4).__dict__))
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", ["rays import", "rays filter, in place"])
def test_kills_lose_nothing(name, tmp_path):
    command = [sys.executable, "-c", _KILLS, str(tmp_path), name]
    done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    tally = json.loads(done.stdout.splitlines()[-1])
    assert tally["tried"] == tally["started"] == 4 and tally["landed"] >= 1 and tally["lost"] == 0
