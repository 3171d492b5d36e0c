"""Which cohort people are of, from a table."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.errors import NergError, plain
from nerg_mi.files.tables import with_formula
from nerg_mi.rays.readers.parsing.tables import iterate_table

MOST = 10_000_000
"""So many people may have a cohort."""


def read_cohorts(path: Path) -> dict[str, str]:
    """The cohort of each person, from the columns ``person`` and ``cohort`` of a CSV. Raises `NergError` for a table
    without them, and for somebody who is of two."""
    found: dict[str, str] = {}
    for block in iterate_table(path, (), ("person", "cohort")):
        for person, cohort in (map(with_formula, row) for row in block.texts.tolist()):
            if found.setdefault(person, cohort) != cohort:
                raise NergError(f'"{path}" has "{plain(person, 40)}" in two cohorts; leave one')
        if len(found) > MOST:
            raise NergError(f'"{path}" names more than {MOST:,} people; give fewer')
    if not found:
        raise NergError(f'"{path}" names nobody; write a line person,cohort and one for each')
    return found
