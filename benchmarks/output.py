"""What every benchmark writes beside the table that it prints."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.files.tables import write_csv


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write ``rows`` as CSV, and say where."""
    write_csv(path, rows)
    print(f"wrote {path}")
