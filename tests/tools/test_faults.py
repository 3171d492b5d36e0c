"""The tool of the faults, cut short: kills and refusals of quick commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

import pytest

from tests.conftest import ROOT

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


@pytest.mark.nightly
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
