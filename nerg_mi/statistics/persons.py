"""The table of single people: each one's own sums of each area, made row by row as it is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

from .sums import ALL, Sums
from .tables import Row


class PersonRows(Sequence[Row]):
    """A row for each person and area, over all that was recorded, in the order of the people's names.

    Rows are made when they are asked for, so that the table of a quarter of a million people takes no memory beside
    the ``sums``. ``names``: what each person is called; ``seen``: whether it is known what they could see. A row:
    ``person``, ``thing``, ``time`` in seconds, ``rays``, and of the area ``dwell`` in seconds, ``looks``,
    ``first_look`` and ``visible`` in seconds, None where there is no look and where nobody knows.
    """

    columns = ("person", "thing", "time", "rays", "dwell", "looks", "first_look", "visible")

    def __init__(self, sums: Sums, names: Mapping[str, str], seen: bool):
        rows, persons = sums.persons_of(ALL)
        self._of = sorted((names[person], r) for person, r in zip(persons, rows.tolist()))
        self._sums, self._seen = sums, seen

    def __len__(self) -> int:
        return len(self._of) * len(self._sums.areas)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        if isinstance(index, slice):
            return [self._row(k) for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"row {index} of {len(self):,}")
        return self._row(index % len(self))

    def __iter__(self) -> Iterator[Row]:
        return map(self._row, range(len(self)))

    def _row(self, k: int) -> Row:
        s = self._sums
        (name, r), a = self._of[k // len(s.areas)], k % len(s.areas)
        first: Any = None
        if s.looks[r, a] > 0:
            first = float(s.first_sum[r, a] / s.first_count[r, a])
        return {
            "person": name,
            "thing": s.areas[a],
            "time": float(s.time[r]),
            "rays": int(s.rays[r]),
            "dwell": float(s.on_time[r, a]),
            "looks": int(s.looks[r, a]),
            "first_look": first,
            "visible": float(s.visible[r, a]) if self._seen else None,
        }
