"""`nerg report`: options reach the job."""

from __future__ import annotations

from pathlib import Path

import pytest

import nerg_mi.cli
from nerg_mi.workflows import report  # noqa: F401 (declares the command)

from .handed import keep_handed


def nerg(*arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0


def test_options_reach_the_job(monkeypatch):
    handed = keep_handed(monkeypatch, "report")
    line = "report gaze.safetensors day.npz -o a.html --objects o.json --names --min-persons 3 --no-paths --from 1,2,3"
    assert nerg(*line.split(), "--to", "0,0,1", "--evaluate", "--title", "Mine") == 0
    (given,) = handed
    files, output, options = (given[name] for name in ("files", "output", "options"))
    assert files == [Path("gaze.safetensors"), Path("day.npz")] and output == Path("a.html")
    assert options.objects == Path("o.json") and options.names and options.min_persons == 3 and not options.paths
    assert options.camera_from == (1, 2, 3) and options.camera_to == (0, 0, 1)
    assert options.evaluate and options.title == "Mine"


def test_what_can_be_mended_is_a_sentence(tmp_path, capsys):
    assert nerg("report", tmp_path / "no.safetensors", "-o", tmp_path / "a.html") == 1
    assert "there is no file or folder" in capsys.readouterr().err
