"""Where the parts of a dataset lie, and which columns they have.

    shop.rays/_dataset.json                     version, number of buckets, pseudonyms
    shop.rays/_sources/ID.json                  what became of one source: its account, and its parts
    shop.rays/place=P/day=D/bucket=B/part-ID-N.parquet

The folders are those of Hive, which pyarrow, DuckDB and others read as columns ``place``, ``day`` and ``bucket``; names
that begin with an underscore they pass over. Rows of a part are in the order of persons and times. Times are float64
seconds, as those of rays: exact for any clock that a reader can give, where whole nanoseconds would round some times
and end after 292 years. Origins, directions, hit points and heads are
float32, NaN where they are unknown.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.io import pyarrow_modules
from nerg_mi.rays.rays import Rays

SUFFIX = ".rays"
"""How the name of a dataset ends where one is made."""

HEAD = "_dataset.json"
SOURCES = "_sources"
UNKNOWN = "unknown"
"""The day of a clock that does not tell it, and the place that nobody has named."""

BUCKETS = 16
"""People of a day are in so many buckets, by a hash of their names."""

PART_ROWS = 1 << 20
"""A part has so many rays at most: it is read as a whole."""

GROUP_ROWS = 1 << 17
"""And a row group so many: the least that is decoded to find some of them."""

REACH = 8192.0
"""Origins lie within so many metres of zero: float32 places them there to half a millimetre."""

VECTORS = ("origin", "direction", "hit", "head")
_EPOCH = 946_684_800.0, 4_102_444_800.0  # the years 2000 to 2100
_DAY = re.compile(r"\d{4}-\d\d-\d\d")
_PLACE = 64  # characters


def bucket_of(person: str, buckets: int) -> int:
    """The bucket of somebody's rays."""
    return int(hashlib.sha256(person.encode("utf-8", "surrogatepass")).hexdigest()[:15], 16) % buckets


def days_of(t: np.ndarray) -> np.ndarray | None:
    """Days since 1970 (N,) int64 of times (N,), where all of them are seconds since then in the years 2000 to 2099;
    None for another clock. Days are those of UTC."""
    if not len(t) or t.min() < _EPOCH[0] or t.max() >= _EPOCH[1]:
        return None
    return (t // 86_400).astype(np.int64)


def check_place(place: str) -> str:
    """``place``, if it can be the name of one. Raises `NergError`."""
    if not place or len(place) > _PLACE or not place.isprintable() or place != place.strip():
        raise NergError(f"a place has a name of 1 to {_PLACE} characters, got {place[:80]!r} (--place-name)")
    return place


def check_day(day: str) -> str:
    """``day``, if it is one. Raises `NergError`."""
    try:
        if day != UNKNOWN and not (_DAY.fullmatch(day) and np.datetime64(day, "D")):
            raise ValueError
    except ValueError:
        raise NergError(f"a day is written as 2026-11-22, got {day[:40]!r} (--day)") from None
    return day


def folder_of(place: str, day: str, bucket: int) -> Path:
    """The folder of parts, within the dataset."""
    return Path(f"place={quote(place, safe='')}", f"day={day}", f"bucket={bucket}")


def split_path(path: str | os.PathLike) -> tuple[Path, dict[str, str]]:
    """The dataset that ``path`` is in, and what of it is meant: ``shop.rays/place=north/day=2026-11-22`` is a day of a
    place in ``shop.rays``."""
    folder, chosen = Path(path), {}
    while found := re.fullmatch(r"(place|day|bucket)=(.+)", folder.name):
        chosen[found[1]] = unquote(found[2])
        folder = folder.parent
    return folder, chosen


def is_dataset(path: str | os.PathLike) -> bool:
    """Whether ``path`` is a dataset, or a folder of parts in one."""
    return (split_path(path)[0] / HEAD).is_file()


def schema() -> Any:
    """The columns of a part, as pyarrow has them."""
    pa, _ = pyarrow_modules()
    names = pa.dictionary(pa.int32(), pa.string())
    vector = lambda name: [(f"{name}_{axis}", pa.float32()) for axis in "xyz"]
    return pa.schema(
        [
            ("t", pa.float64()),
            ("person", names),
            *vector("origin"),
            *vector("direction"),
            ("confidence", pa.float64()),
            *vector("hit"),
            ("cohort", names),
            *vector("head"),
        ]
    )


def table_of(rays: Rays, rows: np.ndarray) -> Any:
    """The rays ``rows`` (n,), in this order, as a table of `schema`."""
    pa, _ = pyarrow_modules()
    columns: dict[str, Any] = {"t": rays.t[rows], "confidence": rays.confidence[rows]}
    for name in VECTORS:
        value = getattr(rays, name)
        for k, axis in enumerate("xyz"):
            part = np.full(len(rows), np.nan, np.float32) if value is None else value[rows, k].astype(np.float32)
            columns[f"{name}_{axis}"] = part
    columns["person"] = _names(pa, rays.person[rows], rays.persons)
    if rays.cohort is None:
        columns["cohort"] = pa.nulls(len(rows), schema().field("cohort").type)
    else:
        columns["cohort"] = _names(pa, rays.cohort[rows], rays.cohorts)
    kinds = schema()
    return pa.table([columns[name] for name in kinds.names], schema=kinds)


def _names(pa: Any, codes: np.ndarray, names: tuple[str, ...]) -> Any:
    """Names as a dictionary of those that occur."""
    there = np.bincount(codes, minlength=len(names)) > 0
    known = pa.array([names[k] for k in np.flatnonzero(there)], pa.string())
    return pa.DictionaryArray.from_arrays(pa.array((np.cumsum(there) - 1)[codes].astype(np.int32)), known)
