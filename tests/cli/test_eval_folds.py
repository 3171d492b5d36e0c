"""`nerg eval folds`: what it hands on, and what it says."""

from pathlib import Path

import pytest

from nerg_mi.cli import main
from nerg_mi.jobs import folds
from nerg_mi.jobs.folds import FoldResult
from nerg_mi.jobs.options.folds import FoldOptions


def test_the_job_is_given_what_was_asked_for(monkeypatch, capsys):
    given, row = [], {"split": "pos", "method": "gaze field", "KLD": 0.25, "folds": 3}
    monkeypatch.setattr(
        folds, "evaluate_folds", lambda *a: given.append(a[:-1]) or FoldResult([row], [], [], [], [], [], [])
    )
    with pytest.raises(SystemExit) as end:
        main(
            "eval folds rays.npz -o out --geometry hits --folds 3 --splits pos --scheduler local:2 --threads 1".split()
        )
    assert not end.value.code
    options = FoldOptions(geometry="hits", folds=3, splits="pos", scheduler="local:2", threads=1)
    assert given == [(Path("rays.npz"), Path("out"), options)]
    said = capsys.readouterr().out
    assert "pos: means of 3 folds" in said and "0.250" in said
