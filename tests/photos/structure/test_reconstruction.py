"""The process that finds poses, from outside: what it is given, and how its end is told."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos import structure
from nerg_mi.photos.structure import Picture, Settings, check_installed, reconstruct

PICTURES = [Picture(f"{k}.jpg", (400, 300), (200, 150), focal=380.0 if k else None) for k in range(4)]


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(structure, "check_installed", lambda: None)


def ending(monkeypatch, program: str) -> None:
    """A process of ours in place of the worker."""
    started = structure.subprocess.Popen
    monkeypatch.setattr(
        structure.subprocess,
        "Popen",
        lambda command, **more: started([sys.executable, "-c", program, command[-1]], **more),
    )


def told(tmp_path: Path) -> str:
    with pytest.raises(NergError) as said:
        reconstruct(PICTURES, tmp_path, Settings(), lambda *now: None)
    return str(said.value)


def test_without_pycolmap(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for call in (check_installed, lambda: reconstruct(PICTURES, tmp_path, Settings(), lambda *now: None)):
        with pytest.raises(ImportError, match=r'"nerg-mi\[poses\]"'):
            call()


def test_what_is_asked_for(installed, monkeypatch, tmp_path):
    ending(monkeypatch, "import os; os._exit(3)")
    told(tmp_path)
    job = json.loads((tmp_path / "job.json").read_text())
    # The focal length is that of the small pictures; the median of what photos say counts for their camera.
    assert job["cameras"] == [{"size": [400, 300], "small": [200, 150], "focal": 190.0, "pictures": 4}]
    assert [p["camera"] for p in job["pictures"]] == [0] * 4 and job["lens"] is None and job["threads"] == -1


@pytest.mark.parametrize(
    "settings, said", [(Settings(lens="fish"), "lens must be auto"), (Settings(matching="a"), "matching must be auto")]
)
def test_wrong_settings(installed, settings, said, tmp_path):
    with pytest.raises(NergError, match=said):
        reconstruct(PICTURES, tmp_path, settings, lambda *now: None)


@pytest.mark.parametrize(
    "program, said",
    [
        ("import sys; sys.exit('E1 a.cc:1] Check failed: x\\n  @ trace')", "Check failed: x"),
        ("raise ValueError('some reason')", r"with code 1 \(ValueError: some reason\)"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "want of memory"),
        ("import os; os.abort()", f"with code {-signal.SIGABRT}"),
    ],
)
def test_an_end_of_its_own_is_told_in_a_sentence(installed, program, said, monkeypatch, tmp_path):
    ending(monkeypatch, program)
    words = told(tmp_path)
    assert re.search(said, words) and "\n" not in words


def test_it_ends_with_whoever_started_it(installed, monkeypatch, tmp_path):
    """Ctrl-C comes while its lines are read."""
    program = "import os, sys, time; print([os.getpid(), 0, 1], flush=True); time.sleep(600)"
    ending(monkeypatch, program)
    found = []

    def progress(pid, done, of):
        found.append(pid)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(PICTURES, tmp_path, Settings(), progress)
    with pytest.raises(ProcessLookupError):
        os.kill(found[0], 0)
