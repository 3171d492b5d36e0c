"""Tests of tools/other_processor.py: libraries use fewer instructions, and Dr.Jit narrower vectors."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tools.other_processor import VARIABLE, make_environment

pytestmark = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64") or VARIABLE in os.environ,
    reason="not the processor itself, or not x86-64",
)


def run(code: str, *tool: str) -> list[str]:
    """Lines that ``code`` prints; a warning, as of a name that NumPy does not know, is an error."""
    line = [sys.executable, *tool, *([sys.executable] if tool else []), "-W", "error", "-c", code]
    return subprocess.run(line, capture_output=True, text=True, check=True).stdout.splitlines()


def test_numpy_uses_fewer_instructions():
    code = 'import numpy as np; print(*np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))'
    (before,), (_, after) = run(code), run(code, "-m", "tools.other_processor")
    disabled = make_environment()["NPY_DISABLE_CPU_FEATURES"].split()
    assert disabled and set(after.split()) == set(before.split()) - set(disabled)


def test_kernels_of_narrow_vectors_compute_the_same():
    code = """
import drjit as dr, mitsuba as mi
from tools.other_processor import limit_drjit
mi.set_variant("llvm_ad_rgb")
values = [dr.sin(dr.linspace(mi.Float, 0, 9, 99)).numpy()]
undo = limit_drjit(4)
values.append(dr.sin(dr.linspace(mi.Float, 0, 9, 99)).numpy())
undo()
values.append(dr.sin(dr.linspace(mi.Float, 0, 9, 99)).numpy())
print(abs(values[0] - values[1]).max(), abs(values[0] - values[2]).max())
"""
    narrow, again = map(float, run(code)[-1].split())
    assert narrow < 1e-6 and again == 0


def test_the_lint_finds_equality_of_computed_numbers():
    """In tests only: the package compares settings."""
    pytest.importorskip("ruff")
    code = "def test_unit():\n    assert sum([0.1, 0.9]) * 2 == 2.0\n"
    for folder, is_checked in (("tests/photos", True), ("nerg_mi/photos", False)):
        line = [sys.executable, "-m", "ruff", "check", "--output-format", "json", "--stdin-filename"]
        line += [f"{folder}/test_unit.py", "-"]
        done = subprocess.run(line, input=code, cwd=ROOT, capture_output=True, text=True)
        assert [finding["code"] for finding in json.loads(done.stdout)] == ["RUF069"] * is_checked, done.stderr
