"""Long use, cut short: memory is watched, and growth is seen."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tools import soak

# In a process of its own, since this one's memory is that of all tests before.
_PROGRAM = """
import json, sys
from dataclasses import asdict
from tools import soak
name, count, bound = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
leak = round(4 * 1024 * bound)
unit, hoard = soak.PARTS[name].prepare(), []
def leaking(k):
    unit(k)
    hoard.append(b"x" * leak)
sound = soak.watch(unit, count, bound)
leaking = soak.watch(leaking, 12, bound)
print("\\n" + json.dumps([asdict(sound), asdict(leaking)]))
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    "part, count, bound",
    [
        ("moving observer", 60, 100.0),
        ("gaze training", 300, 50.0),
        ("changes of variant", 30, 2000.0),
        ("two threads, two scenes", 24, 200.0),
    ],
)
def test_memory_stays_flat_and_a_leak_is_seen(part, count, bound):
    """Sixty frames, or as much of another part, keep a bound (KiB a unit) that leaking four times as much exceeds."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, part, str(count), str(bound)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    sound, leaking = (soak.Course(**said) for said in json.loads(done.stdout.splitlines()[-1]))
    assert sound.flat, sound
    assert not leaking.flat and leaking.slope == pytest.approx(4 * bound, rel=0.5)


def test_slope_is_that_of_a_hoard(monkeypatch):
    grown = [1000.0]

    def unit(k):
        # A cache that fills up first is no growth.
        grown[0] += 500 if k < 20 else 2

    monkeypatch.setattr(soak, "resident", lambda: grown[0])
    seen = soak.watch(unit, 90, 1.0)
    assert seen.slope == pytest.approx(2) and not seen.flat
    assert seen.cells("x")[-1] == "grows" and seen.end - seen.begin == pytest.approx(2 * 59 / 1024, rel=0.05)
    assert soak.watch(lambda k: None, 90, 1.0).flat
