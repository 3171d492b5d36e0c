"""The pictures of the architecture are those of today's code."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tools import architecture


@pytest.mark.slow
def test_the_pictures_are_up_to_date():
    # In a process of its own, in which nothing has been traced before.
    command = [sys.executable, "-m", "tools.architecture", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_they_stand_on_the_page():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for file in architecture.PICTURES:
        assert f"]({file.removeprefix('docs/')})" in page, file


def test_check_writes_nothing(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(architecture, "ROOT", tmp_path)
    monkeypatch.setattr(architecture, "PICTURES", {"a.svg": lambda: "<svg/>"})
    assert architecture.main(["--check"]) == 1 and "run make docs" in capsys.readouterr().out
    assert not (tmp_path / "a.svg").exists()
    assert architecture.main([]) == 0 and (tmp_path / "a.svg").read_text() == "<svg/>"
    assert architecture.main(["--check"]) == 0
    (tmp_path / "a.svg").write_text("<svg></svg>")
    assert architecture.main(["--check"]) == 1
