"""What every benchmark writes beside the table that it prints: CSV, and the table in a page."""

from __future__ import annotations

import sys
from pathlib import Path

from nerg_mi.files.tables import write_csv

# The checkout, of which this folder is no package.
sys.path.append(str(Path(__file__).resolve().parents[1]))

from tools.page import replace_table

__all__ = ["replace_table", "write_rows"]


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write ``rows`` as CSV, and say where."""
    write_csv(path, rows)
    print(f"wrote {path}")
