"""Processes beside each other: the same dataset as from one, and neither Mitsuba nor Dr.Jit in them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays import dataset_write
from nerg_mi.rays.dataset_write import update_dataset

from .making import recipe
from .test_updating import content, sources

pytest.importorskip("pyarrow")


def test_two_processes_give_what_one_does(tmp_path):
    files = sources(tmp_path, 4)
    files[2].write_text("nothing\n")
    one = update_dataset(tmp_path / "one.rays", files, recipe())
    two = update_dataset(tmp_path / "two.rays", files, recipe(), workers=2)
    assert content(tmp_path / "one.rays") == content(tmp_path / "two.rays")
    assert (two.imported, two.rays) == (one.imported, one.rays) == (3, 177) and len(two.errors) == 1 == len(one.errors)


def ended(task):
    os._exit(1)


def test_a_process_that_is_ended_from_outside(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "import_source", ended)
    with pytest.raises(NergError, match="--workers"):
        update_dataset(tmp_path / "a.rays", sources(tmp_path, 2), recipe(), workers=2)


def test_processes_are_light():
    code = (
        "import nerg_mi.rays.dataset_write, nerg_mi.rays.dataset_write, sys; "
        "print([m for m in sys.modules if m.split('.')[0] in ('mitsuba', 'drjit', 'scipy', 'matplotlib', 'trimesh')])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
