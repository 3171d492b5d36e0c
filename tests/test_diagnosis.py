"""What is found out about a machine, and how it is told."""

from __future__ import annotations

import pytest

from nerg_mi import diagnosis, llvm
from tests.conftest import ROOT


def test_a_dying_backend_is_reported(monkeypatch):
    monkeypatch.setattr(
        diagnosis, "_TRIAL", "import os, sys; print('LLVM ERROR: no', file=sys.stderr, flush=True); os.abort()"
    )
    assert diagnosis.try_backend("llvm") == {"variants": [], "failed": {"llvm": "LLVM ERROR: no"}}


def test_extras_by_their_names(monkeypatch):
    """The names are those of distributions, as pyproject.toml has them: that of scikit-image is not that of its
    module."""
    project = (ROOT / "pyproject.toml").read_text()
    assert all(f'["{name}>=' in project for name in diagnosis.EXTRAS)


def test_a_trouble_stands_below_its_topic():
    found = diagnosis.Diagnosis(
        [diagnosis.Finding("LLVM", "none", "install it"), diagnosis.Finding("threads", "2")], usable=False
    )
    assert str(found) == "LLVM     none\n         -> install it\nthreads  2"


WORKS = {"variants": ["llvm_ad_rgb"], "failed": {}, "threads": 2, "version": [19, 1, 7]}
NOTHING = {"variants": [], "failed": {"llvm": "it died"}}


@pytest.mark.parametrize("found, verdict", [(WORKS, "ready to render"), (NOTHING, "nothing can be rendered")])
def test_the_verdict(monkeypatch, found, verdict):
    scalar = {"variants": ["scalar_rgb"], "failed": {}}
    monkeypatch.setattr(diagnosis, "try_backend", lambda backend: scalar if backend == "scalar" else found)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    monkeypatch.setattr(llvm, "problem", lambda: None)
    told = diagnosis.examine()
    assert told.usable is (found is WORKS) and verdict in str(told)
    assert ("it died" in str(told)) is (found is NOTHING)


@pytest.mark.parametrize("version, old", [([12, 4], True), ([12, 8], False), ([13, 0], False)])
def test_an_old_driver_is_named(monkeypatch, version, old):
    monkeypatch.setattr(diagnosis, "try_backend", lambda backend: {**WORKS, "version": version})
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert ("R570" in str(diagnosis.examine())) is old
