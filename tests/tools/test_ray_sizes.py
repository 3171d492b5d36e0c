"""The tool that measures millions of rays, on a few."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT


@pytest.mark.nightly
def test_a_row_for_each_command(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n## Millions of rays\n\nSome words.\n")
    done = subprocess.run(
        [sys.executable, "-m", "tools.ray_sizes", "--rays", "5000", "--folder", tmp_path / "made", "--update", page],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    rows = [line.split("|") for line in page.read_text().splitlines() if line.startswith("| rays ")]
    assert len(rows) == 3 and all(row[2].strip() == "5,000" and float(row[5]) > 0 for row in rows)
    from nerg_mi.rays.rays import Rays

    half = Rays.load(tmp_path / "made" / "half.npz")
    assert 2000 < len(half) < 3000 and half.confidence.min() >= 0.5
