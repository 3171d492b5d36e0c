"""Parts of pages that are made of the code: they are up to date, and nothing else of a page is touched."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import ROOT
from tools import generated


def test_every_page_is_up_to_date():
    # In a process of its own: other tests register what is made up.
    done = subprocess.run(
        [sys.executable, "-m", "tools.generated", "--check"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_every_part_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in generated.pages())
    for name in generated.PARTS:
        assert text.count(f"<!-- made by make docs: {name} -->") == 1, name
