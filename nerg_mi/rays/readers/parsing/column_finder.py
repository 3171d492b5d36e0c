"""Columns of a table by the names that they usually have."""

from __future__ import annotations

import re
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain

from .tables import table_columns


class ColumnFinder:
    """Columns of one table by the names that they usually have: spaces and dots are underscores, cases are one."""

    def __init__(self, path: Path) -> None:
        self.path, self.columns = path, table_columns(path)
        self._by_name = {re.sub(r"[ .]", "_", c).lower(): c for c in reversed(self.columns)}

    def find_vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...] | None:
        """The columns ``stem_x``, ``stem_y``, ... of the first of ``stems`` that has all of ``axes``; None without."""
        for stem in stems:
            names = [f"{stem}_{axis}" for axis in axes]
            if all(n in self._by_name for n in names):
                return tuple(self._by_name[n] for n in names)
        return None

    def vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...]:
        """As `find_vector`; raises `NergError` naming what there is where there are none."""
        found = self.find_vector(*stems, axes=axes)
        if found is None:
            wanted = " or ".join(f"{s}_{{{','.join(axes)}}}" for s in stems)
            there = ", ".join(plain(c, 40) for c in self.columns[:16])
            raise NergError(f"{self.path} has no columns {wanted}; its columns are {there}; name them with --map")
        return found

    def find(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        return next((self._by_name[n] for n in names if n in self._by_name), None)
