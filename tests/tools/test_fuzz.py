"""The tool that damages files, on a few of them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT


@pytest.mark.slow
def test_a_row_for_each_reader(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n## Readers\n\nSome words.\n")
    command = [sys.executable, "-m", "tools.fuzz", "--cases", "12", "--only", "rays metadata", "--update", page]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in page.read_text().splitlines()[5:] if line}
    assert set(rows) == {"reader", "---", "rays metadata", "all"}
    cases, results, refusals, *breaches = (c.strip() for c in rows["all"][:7])
    assert int(cases) == int(results) + int(refusals) == 12 and set(breaches) == {"0"}
