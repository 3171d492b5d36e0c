"""Writing the parts of one source: rays by place, day and bucket, in the order of persons and times."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import replacing
from nerg_mi.rays.io import pyarrow_modules
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.summary import GAP

from .layout import GROUP_ROWS, PART_ROWS, REACH, UNKNOWN, bucket_of, days_of, table_of
from .manifest import Part, Source, write_source

_RUNS = 1000
"""So many runs of dropped rows are named of a source: accounts of thousands of sources are read at once."""

_WORDS = ["person", "cohort", "confidence"]


class SourceWriter:
    """Takes the rays of a source, block by block, and writes them; then its account.

    ``folder``: the dataset; ``source``: the source's id.
    """

    def __init__(self, folder: Path, source: str, buckets: int) -> None:
        self._folder, self.source, self._buckets = folder, source, buckets
        self._parts: list[Part] = []
        self._persons: Counter[str] = Counter()
        self._cohorts: Counter[str] = Counter()

    @property
    def persons(self) -> tuple[str, ...]:
        """Those whose rays were taken."""
        return tuple(sorted(self._persons))

    @property
    def rays(self) -> int:
        """How many were taken."""
        return sum(part.rays for part in self._parts)

    def add(self, rays: Rays, place: str = UNKNOWN, day: str | None = None) -> None:
        """Write more rays of the source. ``day``: None: by their times, if these are seconds since 1970, else unknown.

        Raises `NergError` for origins beyond `REACH`, and what cannot be written.
        """
        if not len(rays):
            return
        far = float(np.abs(rays.origin).max())
        if far > REACH:
            raise NergError(
                f"origins lie up to {far:.3g} m from zero, and a dataset places them to {REACH:g} m: check the unit "
                "(--units), or move zero into the place"
            )
        for name in (*rays.persons, *rays.cohorts):
            if not _is_text(name):
                raise NergError(
                    f"the name {name!r} of a person or cohort is no text; rename it, or the file that it is of"
                )
        bucket = np.array([bucket_of(name, self._buckets) for name in rays.persons])[rays.person]
        # Parts are in the order of names, whatever that of their numbers.
        rank = np.argsort(np.argsort(np.array(rays.persons, dtype=object)))[rays.person]
        found = days_of(rays.t) if day is None else None
        number = np.zeros(len(rays), np.int64) if found is None else found
        order = np.lexsort((rays.t, rank, bucket, number))
        new = np.flatnonzero((np.diff(bucket[order]) != 0) | (np.diff(number[order]) != 0)) + 1
        for a, b in zip(np.r_[0, new], np.r_[new, len(rays)]):
            name = str(np.datetime64(int(number[order[a]]), "D")) if found is not None else day or UNKNOWN
            for start in range(a, b, PART_ROWS):
                self._write(rays, order[start : min(start + PART_ROWS, b)], place, name, int(bucket[order[a]]))

    def _write(self, rays: Rays, rows: np.ndarray, place: str, day: str, bucket: int) -> None:
        _, pq = pyarrow_modules()
        persons, cohorts = _counts(rays.person[rows], rays.persons), Counter()
        if rays.cohort is not None:
            cohorts = _counts(rays.cohort[rows], rays.cohorts)
        names = list(persons)
        t, origin = rays.t[rows], rays.origin[rows].astype(np.float32).astype(np.float64)
        step = np.diff(t)[np.diff(rays.person[rows]) == 0]
        about: dict[str, Any] = {
            "place": place,
            "day": day,
            "bucket": bucket,
            "number": len(self._parts),
            "rays": len(rows),
            "bytes": 0,
            "first": min(names),
            "last": max(names),
            "start": float(t.min()),
            "end": float(t.max()),
            "low": origin.min(axis=0).tolist(),
            "high": origin.max(axis=0).tolist(),
            "recorded": float(step[(step > 0) & (step <= GAP)].sum()),
            "duplicates": int(np.count_nonzero(step == 0)),
            "hits": 0 if rays.hit is None else int(np.isfinite(rays.hit[rows]).all(axis=1).sum()),
            "cohorts": rays.cohort is not None,
            "heads": rays.head is not None and bool(np.isfinite(rays.head[rows]).any()),
        }
        path = self._folder / Part(**about).path(self.source)
        table = table_of(rays, rows)
        floats = {name: "BYTE_STREAM_SPLIT" for name in table.schema.names if name not in _WORDS}
        with replacing(path) as temporary:
            pq.write_table(
                table,
                temporary,
                row_group_size=GROUP_ROWS,
                compression="zstd",
                use_dictionary=_WORDS,
                column_encoding=floats,
            )
            about["bytes"] = temporary.stat().st_size
        self._parts.append(Part(**about))
        self._persons += persons
        self._cohorts += cohorts

    def finish(self, metadata: dict[str, Any], **about: Any) -> Source:
        """Write the account of the source, by which its parts belong to the dataset.

        ``metadata``: those of its rays. ``about``: ``file``, ``where``, ``stamp``, ``recipe`` and ``generation`` of
        `Source`.
        """
        metadata = {k: v for k, v in metadata.items() if k not in ("persons", "cohorts")}
        metadata["dropped"] = [_shortened(entry) for entry in metadata.get("dropped", [])]
        source = Source(
            id=self.source,
            persons=dict(sorted(self._persons.items())),
            cohorts=dict(sorted(self._cohorts.items())),
            parts=self._parts,
            metadata=metadata,
            **about,
        )
        write_source(self._folder, source)
        return source


def _is_text(name: str) -> bool:
    """Whether Parquet can hold a name: file names may hold bytes that are no characters."""
    try:
        return bool(name.encode())
    except UnicodeEncodeError:
        return False


def _counts(codes: np.ndarray, names: tuple[str, ...]) -> Counter[str]:
    counts = np.bincount(codes, minlength=len(names))
    return Counter({names[k]: int(counts[k]) for k in np.flatnonzero(counts)})


def _shortened(entry: dict[str, Any]) -> dict[str, Any]:
    """The account of dropped rows of which the first runs alone are named."""
    rows = entry.get("rows", [])
    if len(rows) <= _RUNS:
        return entry
    more = sum(last - first + 1 for first, last in rows[_RUNS:])
    return {**entry, "rows": rows[:_RUNS], "rows_not_named": entry.get("rows_not_named", 0) + more}
