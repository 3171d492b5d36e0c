"""Columns of a table by the names that they usually have."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain

from .tables import table_columns

_ENOUGH = 20  # rows that tell a counter from people


class ColumnFinder:
    """Columns of one table by the names that they usually have.

    Spaces and dots are underscores, cases are one. Where no column is called so, names are taken apart into words too:
    ``gazeOrigin_x``, ``GazeOriginX`` and ``gaze origin [x]`` are ``gaze_origin_x``. Units in brackets are left out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.columns = path, table_columns(path)
        self._by_name = {re.sub(r"[ .]", "_", c).lower(): c for c in reversed(self.columns)}
        self._by_words = {column_words(c): c for c in reversed(self.columns)}

    def find_vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...] | None:
        """The columns ``stem_x``, ``stem_y``, ... of the first of ``stems`` that has all of ``axes``; None without. Of
        the stem "" and of those that no column has with an underscore: ``x`` and ``stemx``."""
        ways = [(self._by_name, "_", stems), (self._by_words, "_", stems), (self._by_words, "", stems)]
        for known, joint, tried in ways:
            for stem in tried:
                names = [f"{stem}{joint if stem else ''}{axis}" for axis in axes]
                if all(n in known for n in names):
                    return tuple(known[n] for n in names)
        return None

    def vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...]:
        """As `find_vector`; raises `NergError` naming what there is where there are none."""
        found = self.find_vector(*stems, axes=axes)
        if found is None:
            wanted = " or ".join(f"{s}{'_' if s else ''}{{{','.join(axes)}}}" for s in stems)
            there = ", ".join(plain(c, 40) for c in self.columns[:16])
            raise NergError(f"{self.path} has no columns {wanted}; its columns are {there}; name them with --map")
        return found

    def find(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        known = next((known for known in (self._by_name, self._by_words) if any(n in known for n in names)), {})
        return next((known[n] for n in names if n in known), None)


def is_counter(values: Sequence[str] | np.ndarray) -> bool:
    """Whether values (n,) of rows are hardly ever the same, as those of a counter are, and not those of people."""
    return len(values) >= _ENOUGH and len(np.unique(values)) > 0.5 * len(values)


def column_words(column: str) -> str:
    """The words of a column's name in lower case with underscores between them, without a unit in brackets that is none
    of the axes: ``Gaze Origin.X (mm)`` is ``gaze_origin_x``."""
    axis = lambda unit: f"_{unit[1]}" if unit[1].lower() in tuple("xyzw") else ""
    # No name that is looked for is longer, and a bracket is looked for the end of.
    name = re.sub(r"[(\[]([^)\]]*)[)\]]", axis, column[:200])
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")
