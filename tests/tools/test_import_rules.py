"""The import rules see the package as it is installed, and a broken one fails."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT

_BROKEN = """
import sys
from tools import import_rules
assemble = import_rules.assemble
def broken(folder):
    with open(assemble(folder) / sys.argv[1], "a") as source:
        source.write(sys.argv[2])
    return folder
import_rules.assemble = broken
sys.exit(import_rules.main())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, line, contract",
    [
        ("nerg_mi/maths/box.py", "import nerg_mi.transport.place", "Rooms import only from the rooms below them"),
        ("nerg_mi/plugins/nerf.py", "import nerg_mi.cli", "Plugins need what renders"),
        ("nerg_mi/field/mlp.py", "def f():\n    from nerg_mi.plugins import nerf", "Mitsuba loads the plugins"),
        ("nerg_mi/training/gaze/run.py", "import nerg_mi.scenes.store.twin", "know the ready scenes"),
    ],
)
def test_what_breaks_a_rule_is_named(file, line, contract):
    pytest.importorskip("importlinter", reason="import-linter is not installed (it comes with make lint)")
    command = [sys.executable, "-c", _BROKEN, file, f"\n{line}\n"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1, done.stdout + done.stderr
    assert [row for row in done.stdout.splitlines() if "BROKEN" in row and contract in row], done.stdout
