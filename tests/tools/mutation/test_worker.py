"""The process that runs tests on a mutant: every way in which they can end."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT


@pytest.mark.nightly
def test_a_trial_runs_on_its_own_tree_and_says_what_failed(tmp_path):
    """Pass, failure, hang and the end of the process, and a module that comes from elsewhere."""
    (tmp_path / "test_a.py").write_text(
        "import os, time\n"
        "def test_good(): pass\n"
        "def test_bad(): assert 1 == 2\n"
        "def test_hangs(): time.sleep(60)\n"
        "def test_dies(): os.kill(os.getpid(), 9)\n"
        "def test_stray():\n    import nerg_mi\n    assert 'nerg_mi' in nerg_mi.__file__\n"
    )
    code = (
        "import json, sys\nfrom pathlib import Path\n"
        f"sys.path.insert(0, {str(ROOT / 'tools' / 'mutation')!r})\n"
        "import worker\n"
        f"worker.serve(Path({str(tmp_path)!r}), sys.stdin, sys.stdout)\n"
    )
    names = ["test_good", "test_bad", "test_hangs", "test_dies", "test_stray"]
    requests = [
        {"tests": [f"test_a.py::{n}"], "limit": 3 if n == "test_hangs" else 60, "log": str(tmp_path / "log")}
        for n in names
    ]
    run = subprocess.run(
        [sys.executable, "-c", code],
        input="\n".join(map(json.dumps, requests)),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    assert [a["outcome"] for a in answers] == ["passed", "failed", "hang", "crash"]
    assert answers[1]["by"] == "test_a.py::test_bad"
    assert run.returncode != 0 and "another tree" in run.stderr and "nerg_mi" in (tmp_path / "log").read_text()
