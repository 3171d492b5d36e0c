"""Datasets of rays: their folders and manifests, conditions on rays, and reading what is selected part by part."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.files.safe_read import inflated_limit, is_count, read_json, reading, size_of

from .filters import select_mask
from .rays import COLUMNS, FRAME, Rays, pyarrow_modules, read_metadata
from .rays import VERSION as RAYS_VERSION

# ---- Which of very many rays are taken as a sample, without room for all of their numbers ----


def sample_rows(count: int, n: int, seed: int = 0, runs: int | None = None) -> np.ndarray:
    """``n`` of the numbers from 0 to ``count`` - 1, sorted (n,) int64; all, where there are no more.

    Every number is as likely as any other. Without ``runs`` so is every set of ``n`` of them. With it they are so many
    runs of neighbours, wherever these begin: less has to be read for them, and they tell less, since neighbours are
    alike.
    """
    rng = np.random.default_rng(seed)
    if n >= count:
        return np.arange(count)
    if runs is not None and runs < n:
        length = n // runs
        # Cells of equal length on a circle that is turned at random.
        cells = _distinct(count // length, runs, rng)
        start = (rng.integers(count) + cells * length) % count
        return np.sort((start[:, None] + np.arange(length)).ravel() % count)
    if n > count // 2:
        keep = np.ones(count, bool)
        keep[_distinct(count, count - n, rng)] = False
        return np.flatnonzero(keep)
    return _distinct(count, n, rng)


def _distinct(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """``n`` different numbers below ``count``, sorted: drawn until there are enough, and of too many some are left out
    at random."""
    found = np.zeros(0, np.int64)
    while len(found) < n:
        # Sorted, where numpy.unique would make a table of hashes: several times as fast.
        found = np.sort(np.concatenate([found, rng.integers(0, count, n - len(found) + 16)]))
        found = found[np.r_[True, found[1:] != found[:-1]]]
    return np.delete(found, rng.choice(len(found), len(found) - n, replace=False))


# ---- Where the parts of a dataset lie, and which columns they have ----
#
#     shop.rays/_dataset.json                     version, number of buckets, pseudonyms
#     shop.rays/_sources/ID.json                  what became of one source: its account, and its parts
#     shop.rays/place=P/day=D/bucket=B/part-ID-N.parquet
#
# The folders are those of Hive, which pyarrow, DuckDB and others read as columns ``place``, ``day`` and ``bucket``;
# names that begin with an underscore they pass over. Rows of a part are in the order of persons and times. Times are
# float64 seconds, as those of rays: exact for any clock that a reader can give, where whole nanoseconds would round
# some times and end after 292 years. Origins, directions, hit points and heads are float32, NaN where they are unknown.


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


# ---- Manifest ----
#
# The account of a dataset, in JSON: what it is, and what became of each source that was imported.
#
# An account of a source is written after all of its parts, whole or not at all: what no account names does not belong
# to the dataset. Nothing in it is the path of a file: where a part lies follows from its place, day, bucket and number.


VERSION = 1
_ID = re.compile(r"[0-9a-f]{32}")
_MOST_BUCKETS = 4096


@dataclass(frozen=True)
class Head:
    """What holds for a whole dataset."""

    buckets: int
    # None: names are as they were. Else the mark of the salt under which all were replaced; "" if nobody kept it.
    salt: str | None = None
    # Whether it was made of another dataset, so that files cannot be imported into it.
    closed: bool = False


@dataclass(frozen=True)
class Part:
    """A file of rays of one source, place, day and bucket."""

    place: str
    day: str
    bucket: int
    number: int  # of the source's parts, from 0
    rays: int
    bytes: int
    first: str  # of the persons, in their order
    last: str
    start: float  # first and last time, seconds
    end: float
    low: list[float]  # the origins' box, metres
    high: list[float]
    recorded: float  # seconds between rays of a person, without pauses
    duplicates: int  # rays with person and time of the one before
    hits: int  # rays whose hit point is known
    cohorts: bool  # whether rays have one
    heads: bool  # whether it is known of some where the head points

    def path(self, source: str) -> Path:
        """Its file within the dataset; ``source``: id of the account that it is named in."""
        return folder_of(self.place, self.day, self.bucket) / f"part-{source}-{self.number}.parquet"


@dataclass(frozen=True)
class Source:
    """What became of one source, a file or a folder that a reader was given."""

    id: str  # 32 hexadecimal digits: of its name, its content and how it was read
    file: str  # its name, or an alias of it
    where: str  # mark of its path, by which it is known again when its content has changed
    stamp: str | None  # mark of its size and time of change; None: too fresh to be trusted
    recipe: str  # mark of how it was read
    generation: int  # of the accounts of this path the latest counts
    persons: dict[str, int]  # rays of each
    cohorts: dict[str, int]
    parts: list[Part]
    metadata: dict[str, Any] = field(default_factory=dict)  # of its rays: frame, sources, rows_read, dropped, ...

    @property
    def rays(self) -> int:
        return sum(part.rays for part in self.parts)


def write_head(folder: Path, head: Head) -> None:
    """Write what makes ``folder`` a dataset."""
    write_text(folder / HEAD, json.dumps({"version": VERSION, **asdict(head)}) + "\n")


def read_head(folder: Path) -> Head:
    """What holds for the dataset ``folder``. Raises `NergError` for a folder that is none."""
    path = folder / HEAD
    found = _document(path)
    salt = found.get("salt")
    if not (is_count(found.get("buckets")) and 0 < found["buckets"] <= _MOST_BUCKETS):
        raise _damaged(path, '"buckets" is no number of buckets')
    if salt is not None and not isinstance(salt, str):
        raise _damaged(path, '"salt" is no text')
    if not isinstance(found.get("closed"), bool):
        raise _damaged(path, '"closed" is neither yes nor no')
    return Head(found["buckets"], salt, found["closed"])


def source_path(folder: Path, source: str) -> Path:
    """The account of the source with this id."""
    return folder / SOURCES / f"{source}.json"


def write_source(folder: Path, source: Source) -> None:
    """Write the account of a source whose parts are there."""
    write_text(source_path(folder, source.id), json.dumps({"version": VERSION, **asdict(source)}) + "\n")


def read_sources(folder: Path, head: Head) -> list[Source]:
    """The accounts of all sources of a dataset in the order of their ids; of those of one path the latest."""
    found = [read_source(path, head) for path in sorted((folder / SOURCES).glob("[!.]*.json"))]
    latest: dict[str, Source] = {}
    for source in found:
        if source.where not in latest or source.generation > latest[source.where].generation:
            latest[source.where] = source
    return [source for source in found if latest[source.where] is source]


def read_source(path: Path, head: Head) -> Source:
    """The account ``path`` of a source, checked. Raises `NergError` for one that is damaged."""
    found = _document(path)
    found.pop("version")
    if set(found) != {f.name for f in fields(Source)}:
        raise _damaged(path, "its keys are not those of an account")
    if found["id"] != path.stem or not _ID.fullmatch(path.stem):
        raise _damaged(path, '"id" is not that of its name')
    for key in ("file", "where", "recipe"):
        _check(path, key, isinstance(found[key], str), "text")
    _check(path, "stamp", found["stamp"] is None or isinstance(found["stamp"], str), "text")
    _check(path, "generation", is_count(found["generation"]), "count")
    for key in ("persons", "cohorts"):
        _check(path, key, isinstance(found[key], dict) and all(map(is_count, found[key].values())), "counts")
    _check(path, "metadata", isinstance(found["metadata"], dict), "object")
    # The same of them is relied on as of a file's.
    about = {"version": RAYS_VERSION, "persons": [], **found["metadata"]}
    read_metadata(json.dumps(about), path)
    _check(path, "parts", _all(found["parts"], lambda v: isinstance(v, dict)), "list of parts")
    parts = [_part(path, part, head, found["persons"]) for part in found["parts"]]
    if sum(found["persons"].values()) != sum(part.rays for part in parts):
        raise _damaged(path, "its persons have not as many rays as its parts")
    if len({part.number for part in parts}) != len(parts):
        raise _damaged(path, "two of its parts have the same number")
    return Source(**{**found, "parts": parts})


def _part(path: Path, found: dict[str, Any], head: Head, persons: dict[str, int]) -> Part:
    if set(found) != {f.name for f in fields(Part)}:
        raise _damaged(path, "the keys of a part are not those of one")
    for key in ("bucket", "number", "rays", "bytes", "duplicates", "hits"):
        _check(path, key, is_count(found[key]), "count")
    _check(path, "bucket", found["bucket"] < head.buckets, "bucket of this dataset")
    _check(path, "rays", 0 < found["rays"] <= PART_ROWS, "number of rays of a part")
    for key in ("cohorts", "heads"):
        _check(path, key, isinstance(found[key], bool), "yes or no")
    for key in ("start", "end", "recorded"):
        _check(path, key, _number(found[key]), "number")
    for key in ("low", "high"):
        _check(path, key, _all(found[key], _number) and len(found[key]) == 3, "point")
    for key in ("first", "last"):
        _check(path, key, isinstance(found[key], str) and found[key] in persons, "person of this source")
    for key, check in (("place", check_place), ("day", check_day)):
        _check(path, key, isinstance(found[key], str), "text")
        try:
            check(found[key])
        except NergError as error:
            raise _damaged(path, str(error)) from error
    return Part(**found)


def _document(path: Path) -> dict[str, Any]:
    found = read_json(path, "account of a dataset")
    if not isinstance(found, dict):
        raise _damaged(path, "it is no JSON object")
    if found.get("version") != VERSION:
        raise NergError(f'"{path}" is of another version of datasets; import the tracking files into a new one')
    return found


def _check(path: Path, key: str, holds: bool, what: str) -> None:
    if not holds:
        raise _damaged(path, f'"{key}" is no {what}')


def _damaged(path: Path, why: str) -> NergError:
    remedy = "copy it again" if path.name == HEAD else "copy it again, or remove it and import its source again"
    return NergError(f'the account "{path}" of a dataset is damaged ({why}); {remedy}')


def _all(value: object, test: Any) -> bool:
    return isinstance(value, list) and all(map(test, value))


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


# ---- Rays of several blocks or sources as one, and what their metadata say of all of them ----

_MERGED = ("sources", "dropped", "rows_read", "complaints", "eye_distance", "missing", "unused_columns")
_EMPTY = np.zeros((0, 3))


def merge_rays(blocks: Iterable[Rays], metadata: dict[str, Any] | None = None) -> Rays:
    """The rays of all ``blocks``, in this order, with the sorted persons and cohorts that occur.

    Blocks without hit points or heads get NaN, and those without cohorts the cohort "unknown", where others have some.
    """
    held = [(block.columns(), block.persons, block.cohorts, len(block)) for block in map(_compact, blocks)]
    metadata = {"frame": dict(FRAME)} if metadata is None else metadata
    if not held:
        none = _EMPTY[:, 0]
        return Rays(none, np.zeros(0, np.int32), (), _EMPTY, _EMPTY, none, metadata=metadata)
    persons = tuple(sorted({name for _, names, _, _ in held for name in names}))
    grouped = any("cohort" in columns for columns, *_ in held)
    alike = {"unknown"} if any("cohort" not in columns for columns, *_ in held) else set()
    cohorts = tuple(sorted({name for _, _, names, _ in held for name in names} | alike)) if grouped else ()
    place, group = ({name: k for k, name in enumerate(names)} for names in (persons, cohorts))
    for columns, known, groups, n in held:
        columns["person"] = _renumbered(columns["person"], known, place)
        if grouped:
            codes, groups = (
                (columns["cohort"], groups) if "cohort" in columns else (np.zeros(n, np.int32), ("unknown",))
            )
            columns["cohort"] = _renumbered(codes, groups, group)
        for name, kind in (("hit", np.float64), ("head", np.float32)):
            if name not in columns and any(name in other for other, *_ in held):
                columns[name] = np.full((n, 3), np.nan, kind)
    # Column by column, so that no more than one is there twice.
    joined = {
        name: np.concatenate([columns.pop(name) for columns, *_ in held]) for name in COLUMNS if name in held[0][0]
    }
    return Rays(**joined, persons=persons, cohorts=cohorts, metadata=metadata)


def _compact(rays: Rays) -> Rays:
    """The same rays, without the names of people and cohorts that have none of them."""
    persons, cohorts = _used(rays.person, rays.persons), _used(rays.cohort, rays.cohorts)
    if persons == rays.persons and cohorts == rays.cohorts:
        return rays
    cohort = None if rays.cohort is None else _places(rays.cohort)
    return replace(rays, person=_places(rays.person), persons=persons, cohort=cohort, cohorts=cohorts)


def _used(codes: np.ndarray | None, names: tuple[str, ...]) -> tuple[str, ...]:
    return () if codes is None else tuple(names[k] for k in np.flatnonzero(np.bincount(codes)).tolist())


def _places(codes: np.ndarray) -> np.ndarray:
    """The codes (N,) among those that occur."""
    return (np.cumsum(np.bincount(codes) > 0) - 1)[codes]


def _renumbered(codes: np.ndarray, names: Sequence[str], place: dict[str, int]) -> np.ndarray:
    return np.array([place[name] for name in names], np.int32)[codes]


def merge_metadata(sources: Sequence[Source]) -> dict[str, Any]:
    """What holds for all sources, what was dropped of any, and how many rows were read; ``steps`` that all have had."""
    about = [source.metadata for source in sources]
    first = about[0] if about else {"frame": dict(FRAME)}
    same = {k: v for k, v in first.items() if k not in _MERGED and all(other.get(k) == v for other in about)}
    eyes = {name: metres for other in about for name, metres in other.get("eye_distance", {}).items()}
    complaints = list(dict.fromkeys(sentence for other in about for sentence in other.get("complaints", [])))
    missing = merge_counts(other.get("missing", {}) for other in about)
    unused = list(dict.fromkeys(name for other in about for name in other.get("unused_columns", [])))
    return {
        **same,
        **({"missing": missing} if missing else {}),
        **({"unused_columns": unused} if unused else {}),
        **({"complaints": complaints} if complaints else {}),
        **({"eye_distance": eyes} if eyes else {}),
        "frame": first["frame"],
        "sources": [entry for other in about for entry in other.get("sources", [])],
        "rows_read": sum(other.get("rows_read", 0) for other in about),
        "dropped": [entry for other in about for entry in other.get("dropped", [])],
    }


def merge_counts(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    """Sums by name, in the order of names."""
    total: Counter[str] = Counter()
    for found in counts:
        total.update(found)
    return dict(sorted(total.items()))


# ---- Conditions ----
#
# Which rays of a dataset are asked for: parts and row groups are passed over by what is known of them, and rays by
# `nerg_mi.rays.filters`.


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What rays must meet, as `nerg_mi.rays.filters.select_mask` has it; None, or nothing: all do."""

    time: tuple[float | None, float | None] | None = None
    persons: Sequence[str] | None = None
    without_persons: Sequence[str] | None = None
    cohorts: Sequence[str] | None = None
    box: Sequence[float] | None = None
    min_confidence: float | None = None
    with_hit: bool = False

    def check(self) -> None:
        """Raise `NergError` for a box that is none."""
        select_mask(merge_rays([]), box=self.box)

    @property
    def any(self) -> bool:
        """Whether any is given."""
        return self != Conditions()

    def may_hold(self, part: Part, buckets: int) -> bool:
        """Whether rays of a part may meet them, by its account."""
        if self.with_hit and not part.hits:
            return False
        if self.persons is not None and not any(
            bucket_of(p, buckets) == part.bucket and part.first <= p <= part.last for p in self.persons
        ):
            return False
        return self._meets_time(part.start, part.end) and self._meets_box(part.low, part.high)

    def may_hold_group(self, found: dict[str, tuple[Any, Any]]) -> bool:
        """Whether rays of a row group may meet them; ``found``: least and greatest of its columns, as far as they are
        known."""
        axes = [found.get(f"origin_{axis}") for axis in "xyz"]
        if all(axes) and not self._meets_box([a[0] for a in axes if a], [a[1] for a in axes if a]):
            return False
        if "t" in found and not self._meets_time(*found["t"]):
            return False
        if "person" in found and self.persons is not None:
            low, high = found["person"]
            return any(low <= p <= high for p in self.persons)
        return True

    def _meets_time(self, start: float, end: float) -> bool:
        begin, until = self.time or (None, None)
        return (begin is None or end >= begin) and (until is None or start < until)

    def _meets_box(self, low: Sequence[float], high: Sequence[float]) -> bool:
        if self.box is None:
            return True
        sides = np.asarray(self.box, np.float64)
        return bool((np.asarray(high) >= sides[0::2]).all() and (np.asarray(low) <= sides[1::2]).all())

    def select(self, rays: Rays) -> Rays:
        """The rays that meet them. Names that do not occur among ``rays`` are no error here."""
        if not self.any:
            return rays
        here = lambda names, known: None if names is None else [name for name in names if name in known]
        asked = replace(
            self,
            persons=here(self.persons, rays.persons),
            without_persons=here(self.without_persons, rays.persons),
            cohorts=here(self.cohorts, rays.cohorts),
        )
        if asked.cohorts is not None and rays.cohort is None:
            # Of a source without cohorts.
            return rays.select(np.zeros(len(rays), bool))
        mask = select_mask(rays, **{name: getattr(asked, name) for name in asked.__dataclass_fields__})
        return rays if mask.all() else rays.select(mask)


EVERYTHING = Conditions()
"""What all rays meet."""


# ---- Reading the parts of a dataset, row group by row group, each checked against the account ----

# Columns of rays: of floats, or of texts.
_KINDS = dict(t="f", person="s", origin="f", direction="f", confidence="f", hit="f", cohort="s", head="f")
_WHAT = "part of a dataset"


def read_groups(
    folder: Path,
    source: Source,
    part: Part,
    wanted: Callable[[int, int, dict[str, tuple[Any, Any]]], bool],
    hits: bool = True,
) -> Iterator[tuple[int, Rays]]:
    """The row groups of a part that are ``wanted``, each with the row of the part at which it begins.

    ``wanted``: is given a group's first row, its number of rows, and of its columns the least and greatest value where
    the file tells. ``hits``: whether hit points are read. Persons and cohorts of each are those that occur in it.
    Raises `NergError` for a part that is missing, damaged, or not the one of the account.
    """
    pa, pq = pyarrow_modules()
    path = _inside(folder, folder / part.path(source.id))
    size = size_of(path, _WHAT)
    if size != part.bytes:
        raise _foreign(path, f"it has {size:,} bytes, and {part.bytes:,} by the account")
    with reading(path, _WHAT, "import its source again", also=(pa.ArrowException,)), pq.ParquetFile(path) as file:
        about = file.metadata
        if about.num_rows != part.rays:
            raise _foreign(path, f"it has {about.num_rows:,} rays, and {part.rays:,} by the account")
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        if sum(group.total_byte_size for group in groups) > inflated_limit(size):
            raise _foreign(path, f"it claims more than its {size:,} bytes warrant")
        if sum(group.num_rows for group in groups) != part.rays or any(g.num_rows > GROUP_ROWS for g in groups):
            raise _foreign(path, "its row groups are not those that are written here")
        left_out = {"hit": not (hits and part.hits), "cohort": not part.cohorts, "head": not part.heads}
        columns = _needed(pa, file.schema_arrow, path, [name for name in _KINDS if not left_out.get(name)])
        first = 0
        for k, group in enumerate(groups):
            if group.num_rows and wanted(first, group.num_rows, _bounds(group)):
                table = file.read_row_group(k, columns=columns, use_threads=False)
                yield first, _rays(pa, table, path, source)
            first += group.num_rows


def _inside(folder: Path, path: Path) -> Path:
    """``path``, if it lies in the dataset ``folder`` also where links are followed."""
    root = os.path.realpath(folder)
    if os.path.commonpath([root, os.path.realpath(path)]) != root:
        raise NergError(f'the {_WHAT} "{path}" is a link that leaves "{folder}"; put the file itself there')
    return path


def _foreign(path: Path, why: str) -> NergError:
    return NergError(f'"{path}" is not the part that the account names: {why}; import its source again')


def _needed(pa: Any, schema: Any, path: Path, names: list[str]) -> list[str]:
    """The columns that hold those of rays with these names. Raises `NergError` where they are not there, or not of
    their kinds."""
    found = []
    for name in names:
        for column in [f"{name}_{axis}" for axis in "xyz"] if name in VECTORS else [name]:
            if schema.names.count(column) != 1:
                raise _foreign(path, f'it has no column "{column}"')
            type_ = schema.field(column).type
            type_ = type_.value_type if pa.types.is_dictionary(type_) else type_
            if not (pa.types.is_floating(type_) if _KINDS[name] == "f" else pa.types.is_string(type_)):
                raise _foreign(path, f'its column "{column}" is not of the kind that it has here')
            found.append(column)
    return found


def _bounds(group: Any) -> dict[str, tuple[Any, Any]]:
    found = {}
    for k in range(group.num_columns):
        column = group.column(k)
        if column.is_stats_set and column.statistics.has_min_max:
            found[column.path_in_schema] = column.statistics.min, column.statistics.max
    return found


def _rays(pa: Any, table: Any, path: Path, source: Source) -> Rays:
    """The rays of a row group."""
    number = lambda name: table.column(name).to_numpy()
    vector = lambda name: np.stack([number(f"{name}_{axis}") for axis in "xyz"], axis=1)
    names = table.schema.names
    person, persons = _codes(pa, table.column("person"), path)
    strangers = [name for name in persons if name not in source.persons]
    if strangers:
        raise _foreign(path, "it holds rays of somebody whom the account does not name")
    cohort, cohorts = _codes(pa, table.column("cohort"), path) if "cohort" in names else (None, ())
    try:
        return Rays(
            t=number("t"),
            person=person,
            persons=persons,
            origin=vector("origin"),
            direction=vector("direction"),
            confidence=number("confidence"),
            hit=vector("hit") if "hit_x" in names else None,
            head=vector("head") if "head_x" in names else None,
            cohort=cohort,
            cohorts=cohorts,
        )
    except NergError as error:
        raise _foreign(path, str(error).split(";")[0]) from error


def _codes(pa: Any, column: Any, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Numbers (N,) int32 of the sorted names of a column that occur."""
    if column.null_count:
        raise _foreign(path, "some of its names are missing")
    chunk = column.combine_chunks()
    chunk = chunk.chunk(0) if isinstance(chunk, pa.ChunkedArray) else chunk
    chunk = chunk if pa.types.is_dictionary(chunk.type) else chunk.dictionary_encode()
    known, codes = chunk.dictionary.to_pylist(), chunk.indices.to_numpy()
    if codes.size and (codes.min() < 0 or codes.max() >= len(known) or None in known):
        raise _foreign(path, "its names are damaged")
    used = np.flatnonzero(np.bincount(codes))
    # A dictionary may name somebody twice.
    persons = tuple(sorted({known[k] for k in used.tolist()}))
    place = {name: k for k, name in enumerate(persons)}
    to = np.zeros(len(known), np.int32)
    to[used] = [place[known[k]] for k in used.tolist()]
    return to[codes], persons


# ---- Dataset ----
#
# A dataset of rays that was written: scanned block by block, loaded as far as it fits, or sampled.


MOST = 50_000_000
"""So many rays are loaded at once, unless another bound is given."""

RAY_BYTES = 110
"""Memory of a ray that is loaded, roughly."""


@dataclass(frozen=True, eq=False)
class RayDataset:
    """Rays in a folder that `nerg_mi.rays.dataset` has written; or those of a place, day or bucket of it.

    Nothing but the accounts is held in memory.
    """

    folder: Path
    head: Head
    sources: tuple[Source, ...]  # those that have rays in it, or that gave none at all
    parts: tuple[tuple[Source, Part], ...]  # in the order in which they are read: place, day, bucket, source, number

    @classmethod
    def open(cls, path: str | os.PathLike) -> RayDataset:
        """The dataset ``path``, or what of it lies in a folder such as ``shop.rays/place=north/day=2026-11-22``.

        Raises `NergError` for a folder that is no dataset, whose account is damaged, or which holds no such rays.
        """
        folder, chosen = split_path(path)
        if not (folder / HEAD).is_file():
            raise NergError(f"\"{path}\" is no dataset of rays; make one with 'nerg rays import ... -o NAME.rays'")
        head = read_head(folder)
        sources = read_sources(folder, head)
        parts = [
            (source, part)
            for source in sources
            for part in source.parts
            if all(str(getattr(part, key)) == value for key, value in chosen.items())
        ]
        if not parts:
            what = ", ".join(f"{key} {value}" for key, value in chosen.items())
            raise NergError(f'the dataset "{folder}" holds no rays{f" of {what}" if what else ""}; import some into it')
        if chosen:
            there = {source.id for source, _ in parts}
            sources = [source for source in sources if source.id in there]
        parts.sort(key=lambda p: (p[1].place, p[1].day, p[1].bucket, p[0].id, p[1].number))
        return cls(folder, head, tuple(sources), tuple(parts))

    def __len__(self) -> int:
        return sum(part.rays for _, part in self.parts)

    @property
    def bytes(self) -> int:
        """Of all parts."""
        return sum(part.bytes for _, part in self.parts)

    @cached_property
    def places(self) -> tuple[str, ...]:
        return tuple(sorted({part.place for _, part in self.parts}))

    @cached_property
    def days(self) -> tuple[str, ...]:
        return tuple(sorted({part.day for _, part in self.parts}))

    @cached_property
    def persons(self) -> tuple[str, ...]:
        """Names of all people of its sources, sorted."""
        return tuple(sorted({name for source in self.sources for name in source.persons}))

    @cached_property
    def cohorts(self) -> dict[str, int]:
        """Rays of each cohort, of the sources that have some."""
        return merge_counts(source.cohorts for source in self.sources)

    @property
    def metadata(self) -> dict[str, Any]:
        """What the metadata of its rays say of all of them."""
        return merge_metadata(self.sources)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of which sources and parts there are; another one as soon as rays are added or replaced."""
        named = "\n".join(f"{source.id} {part.path(source.id)} {part.rays} {part.bytes}" for source, part in self.parts)
        return hashlib.sha256(named.encode()).hexdigest()

    def of_place(self, place: str) -> RayDataset:
        """Its rays of one place, and the sources that have some there or gave none at all."""
        parts = tuple(found for found in self.parts if found[1].place == place)
        there = {source.id for source, _ in parts}
        return replace(self, parts=parts, sources=tuple(s for s in self.sources if s.id in there or not s.parts))

    def one_place(self) -> RayDataset:
        """Itself. Raises `NergError` where it holds several places, each of which has a frame of its own."""
        if len(self.places) > 1:
            raise NergError(
                f'"{self.folder}" holds {len(self.places)} places, each in a frame of its own; name one of them: '
                + ", ".join(str(self.folder / f"place={place}") for place in self.places[:8])
            )
        return self

    def scan(self, conditions: Conditions = EVERYTHING, *, hits: bool = True, whole: bool = False) -> Iterator[Rays]:
        """The rays that meet ``conditions``, in blocks of at most `GROUP_ROWS`, or with ``whole`` of a part each: all
        rays of its people of one day and source, in the order of persons and times, unless that has more than a
        million.

        Parts and row groups that cannot hold any are not read. ``hits``: whether hit points are read. Persons and
        cohorts of a block are those that occur in it; its metadata hold the frame alone. Raises `NergError` for
        people and cohorts that the dataset does not know, and for what is damaged.
        """
        self._check(conditions)
        for source, part in self.parts:
            if not conditions.may_hold(part, self.head.buckets):
                continue
            wanted = lambda first, n, bounds: conditions.may_hold_group(bounds)
            blocks = (
                kept
                for _, block in read_groups(self.folder, source, part, wanted, hits)
                if len(kept := conditions.select(block))
            )
            if whole:
                found = list(blocks)
                blocks = [merge_rays(found)] if found else []
            yield from blocks

    def _check(self, conditions: Conditions) -> None:
        """Raise `NergError` for names that are not known, and a box that is none."""
        conditions.check()
        for what, names in (
            ("person", conditions.persons),
            ("person", conditions.without_persons),
            ("cohort", conditions.cohorts),
        ):
            if names is None:
                continue
            known = set(self.persons) if what == "person" else {*self.cohorts, "unknown"}
            unknown = [name for name in names if name not in known]
            if unknown:
                some = sorted(known)
                listed = ", ".join(some[:20]) + (", ..." if len(some) > 20 else "")
                raise NergError(f"no {what} is called {', '.join(map(repr, unknown))}; there are {listed}")

    def load(self, conditions: Conditions = EVERYTHING, *, most: int = MOST, hits: bool = True) -> Rays:
        """The rays that meet ``conditions``, in memory. Raises `NergError` where they are more than ``most``, as soon
        as that is known, or of several places."""
        self.one_place()
        if not conditions.any and len(self) > most:
            raise self._too_many(f"{len(self):,}", most)
        found, count = [], 0
        for block in self.scan(conditions, hits=hits):
            found.append(block)
            count += len(block)
            if count > most:
                raise self._too_many(f"more than {count:,}", most)
        return merge_rays(found, self.metadata)

    def _too_many(self, count: str, most: int) -> NergError:
        return NergError(
            f'"{self.folder}" holds {count} such rays, and {most:,} ({most * RAY_BYTES / 1e9:.2g} GB) are loaded at '
            "most: choose some by 'nerg rays filter' (--box, --person, --from, or --sample for some of all), or name a "
            "day of it"
        )

    def sample(self, n: int, seed: int = 0, *, runs: int | None = None, hits: bool = True) -> Rays:
        """``n`` rays, each as likely as any other, in the order of the dataset; all, where there are no more.

        Row groups that hold none of them are not read. Of a large dataset a small sample has some in nearly every
        group: with ``runs`` the rays are so many runs of neighbours in this order, of fewer people, and less is read
        (see `dataset.sample_rows`). The metadata have a step ``sample``. Equal seeds give equal samples of equal
        datasets. Raises `NergError` as `load` does, but for how many rays there are.
        """
        self.one_place()
        rows = sample_rows(len(self), n, seed, runs)
        blocks, start = [], 0
        for source, part in self.parts:
            a, b = np.searchsorted(rows, [start, start + part.rays])
            here = rows[a:b] - start
            start += part.rays
            if not len(here):
                continue
            wanted = partial(_some, here)
            for first, block in read_groups(self.folder, source, part, wanted, hits):
                chosen = _within(here, first, len(block)) - first
                blocks.append(block if len(chosen) == len(block) else block.select(chosen))
        step = {} if runs is None else {"runs": runs}
        found = merge_rays(blocks, self.metadata)
        return (
            found
            if len(rows) == len(self)
            else found.with_step(step="sample", kept=len(rows), of=len(self), seed=seed, **step)
        )


def _within(rows: np.ndarray, first: int, count: int) -> np.ndarray:
    """Those of sorted ``rows`` that are of the ``count`` from ``first`` on."""
    return rows[np.searchsorted(rows, first) : np.searchsorted(rows, first + count)]


def _some(rows: np.ndarray, first: int, count: int, bounds: dict[str, tuple[Any, Any]]) -> bool:
    return len(_within(rows, first, count)) > 0
