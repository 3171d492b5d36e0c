"""Datasets of rays: their folders and manifests, conditions on rays, and reading what is selected part by part."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256, write_text
from nerg_mi.files.safe_read import compute_inflation_limit, is_count, read_json, translate_read_errors, check_regular_file

from .filters import select_mask
from .rays import VERSION as RAYS_VERSION
from .rays import (
    Rays,
    column_parts,
    merge_counts,
    merge_metadata,
    merge_rays,
    import_pyarrow,
    read_metadata,
    sample_rows,
)

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

SUFFIX = ".rays"  # How the name of a dataset ends where one is made
DATASET_MANIFEST = "_dataset.json"
SOURCES = "_sources"
UNKNOWN = "unknown"  # The day of a clock that does not tell it, and the place that nobody has named
PART_ROWS = 1 << 20  # A part has so many rays at most: it is read as a whole
GROUP_ROWS = 1 << 17  # And a row group so many: the least that is decoded to find some of them
_DAY = re.compile(r"\d{4}-\d\d-\d\d")
_PLACE = 64  # characters


def bucket_of(person: str, buckets: int) -> int:
    """The bucket of somebody's rays."""
    return int(hashlib.sha256(person.encode("utf-8", "surrogatepass")).hexdigest()[:15], 16) % buckets


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
    return (split_path(path)[0] / DATASET_MANIFEST).is_file()


# ---- The account of a dataset, in JSON: what it is, and what became of each source that was imported ----
#
# An account of a source is written after all of its parts, whole or not at all: what no account names does not belong
# to the dataset. Nothing in it is the path of a file: where a part lies follows from its place, day, bucket and number.

VERSION = 1
_ID = re.compile(r"[0-9a-f]{32}")
_MOST_BUCKETS = 4096


@dataclass(frozen=True)
class DatasetManifest:
    """What holds for a whole dataset."""

    buckets: int
    # None: names are as they were. Else the mark of the salt under which all were replaced; "" if nobody kept it.
    salt: str | None = None
    # Whether it was made of another dataset, so that files cannot be imported into it.
    closed: bool = False


@dataclass(frozen=True)
class PartFile:
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
    parts: list[PartFile]
    metadata: dict[str, Any] = field(default_factory=dict)  # of its rays: frame, sources, rows_read, dropped, ...

    @property
    def rays(self) -> int:
        return sum(part.rays for part in self.parts)


def write_dataset_manifest(folder: Path, head: DatasetManifest) -> None:
    """Write what makes ``folder`` a dataset."""
    write_text(folder / DATASET_MANIFEST, json.dumps({"version": VERSION, **asdict(head)}) + "\n")


def read_dataset_manifest(folder: Path) -> DatasetManifest:
    """What holds for the dataset ``folder``. Raises `NergError` for a folder that is none."""
    path = folder / DATASET_MANIFEST
    content = _document(path)
    head: dict[str, Any] = {key: content.get(key) for key in ("buckets", "salt", "closed")}
    _check(path, "buckets", is_count(head["buckets"]) and 0 < head["buckets"] <= _MOST_BUCKETS, "number of buckets")
    _check(path, "salt", head["salt"] is None or isinstance(head["salt"], str), "text")
    _check(path, "closed", isinstance(head["closed"], bool), "yes or no")
    return DatasetManifest(**head)


def source_manifest_path(folder: Path, source: str) -> Path:
    """The account of the source with this id."""
    return folder / SOURCES / f"{source}.json"


def write_source(folder: Path, source: Source) -> None:
    """Write the account of a source whose parts are there."""
    write_text(source_manifest_path(folder, source.id), json.dumps({"version": VERSION, **asdict(source)}) + "\n")


def read_sources(folder: Path, head: DatasetManifest) -> list[Source]:
    """The accounts of all sources of a dataset in the order of their ids; of those of one path the latest."""
    found = [read_source_manifest(path, head) for path in sorted((folder / SOURCES).glob("[!.]*.json"))]
    latest: dict[str, Source] = {}
    for source in found:
        if source.where not in latest or source.generation > latest[source.where].generation:
            latest[source.where] = source
    return [source for source in found if latest[source.where] is source]


def read_source_manifest(path: Path, head: DatasetManifest) -> Source:
    """The account ``path`` of a source, checked. Raises `NergError` for one that is damaged."""
    content = _document(path)
    content.pop("version")
    if set(content) != {f.name for f in fields(Source)}:
        raise _damaged(path, "its keys are not those of an account")
    if content["id"] != path.stem or not _ID.fullmatch(path.stem):
        raise _damaged(path, '"id" is not that of its name')
    for key, (holds, what) in _SOURCE_KINDS.items():
        _check(path, key, holds(content[key]), what)
    # The same of them is relied on as of a file's.
    read_metadata(json.dumps({"version": RAYS_VERSION, "persons": [], **content["metadata"]}), path)
    parts = [_part(path, part, head, content["persons"]) for part in content["parts"]]
    if sum(content["persons"].values()) != sum(part.rays for part in parts):
        raise _damaged(path, "its persons have not as many rays as its parts")
    if len({part.number for part in parts}) != len(parts):
        raise _damaged(path, "two of its parts have the same number")
    return Source(**{**content, "parts": parts})


def _part(path: Path, content: dict[str, Any], head: DatasetManifest, persons: dict[str, int]) -> PartFile:
    if set(content) != {f.name for f in fields(PartFile)}:
        raise _damaged(path, "the keys of a part are not those of one")
    for key, (holds, what) in _PART_KINDS.items():
        _check(path, key, holds(content[key]), what)
    _check(path, "bucket", content["bucket"] < head.buckets, "bucket of this dataset")
    _check(path, "rays", 0 < content["rays"] <= PART_ROWS, "number of rays of a part")
    for key in ("first", "last"):
        _check(path, key, content[key] in persons, "person of this source")
    try:
        check_place(content["place"])
        check_day(content["day"])
    except NergError as error:
        raise _damaged(path, str(error)) from error
    return PartFile(**content)


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
    remedy = "copy it again" if path.name == DATASET_MANIFEST else "copy it again, or remove it and import its source again"
    return NergError(f'the account "{path}" of a dataset is damaged ({why}); {remedy}')


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_point(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))


def _are_counts(value: object) -> bool:
    return isinstance(value, dict) and all(map(is_count, value.values()))


_SOURCE_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("file", "where", "recipe"), (_is_text, "text")),
    "stamp": (lambda value: value is None or _is_text(value), "text"),
    "generation": (is_count, "count"),
    **dict.fromkeys(("persons", "cohorts"), (_are_counts, "counts")),
    "metadata": (lambda value: isinstance(value, dict), "object"),
    "parts": (lambda value: isinstance(value, list) and all(isinstance(v, dict) for v in value), "list of parts"),
}
_PART_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("bucket", "number", "rays", "bytes", "duplicates", "hits"), (is_count, "count")),
    **dict.fromkeys(("cohorts", "heads"), (lambda value: isinstance(value, bool), "yes or no")),
    **dict.fromkeys(("start", "end", "recorded"), (_is_number, "number")),
    **dict.fromkeys(("low", "high"), (_is_point, "point")),
    **dict.fromkeys(("place", "day", "first", "last"), (_is_text, "text")),
}
"""What each value of an account is: whether it is one, and its name."""


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

    def may_hold(self, part: PartFile, buckets: int) -> bool:
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


EVERYTHING = Conditions()  # What all rays meet


# ---- Reading the parts of a dataset, row group by row group, each checked against the account ----

# Columns of rays: of floats, or of texts.
_KINDS = dict(t="f", person="s", origin="f", direction="f", confidence="f", hit="f", cohort="s", head="f")
_WHAT = "part of a dataset"


def read_groups(
    folder: Path,
    source: Source,
    part: PartFile,
    wanted: Callable[[int, int, dict[str, tuple[Any, Any]]], bool],
    hits: bool = True,
) -> Iterator[tuple[int, Rays]]:
    """The row groups of a part that are ``wanted``, each with the row of the part at which it begins.

    ``wanted``: is given a group's first row, its number of rows, and of its columns the least and greatest value where
    the file tells. ``hits``: whether hit points are read. Persons and cohorts of each are those that occur in it.
    Raises `NergError` for a part that is missing, damaged, or not the one of the account.
    """
    pa, pq = import_pyarrow()
    path = _inside(folder, folder / part.path(source.id))
    size = check_regular_file(path, _WHAT)
    if size != part.bytes:
        raise _foreign(path, f"it has {size:,} bytes, and {part.bytes:,} by the account")
    with translate_read_errors(path, _WHAT, "import its source again", extra_errors=(pa.ArrowException,)), pq.ParquetFile(path) as file:
        about = file.metadata
        if about.num_rows != part.rays:
            raise _foreign(path, f"it has {about.num_rows:,} rays, and {part.rays:,} by the account")
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        if sum(group.total_byte_size for group in groups) > compute_inflation_limit(size):
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
        for column in column_parts(name):
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
    vector = lambda name: np.stack([number(part) for part in column_parts(name)], axis=1)
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


# ---- A dataset of rays that was written: scanned block by block, loaded as far as it fits, or sampled ----

MAX_LOADED_RAYS = 50_000_000  # So many rays are loaded at once, unless another bound is given
BYTES_PER_RAY = 110  # Memory of a ray that is loaded, roughly


@dataclass(frozen=True, eq=False)
class RayDataset:
    """Rays in a folder that `nerg_mi.rays.dataset` has written; or those of a place, day or bucket of it.

    Nothing but the accounts is held in memory.
    """

    folder: Path
    manifest: DatasetManifest
    sources: tuple[Source, ...]  # those that have rays in it, or that gave none at all
    parts: tuple[tuple[Source, PartFile], ...]  # in the order of reading: place, day, bucket, source, number

    @classmethod
    def open(cls, path: str | os.PathLike) -> RayDataset:
        """The dataset ``path``, or what of it lies in a folder such as ``shop.rays/place=north/day=2026-11-22``.

        Raises `NergError` for a folder that is no dataset, whose account is damaged, or which holds no such rays.
        """
        folder, chosen = split_path(path)
        if not (folder / DATASET_MANIFEST).is_file():
            raise NergError(f"\"{path}\" is no dataset of rays; make one with 'nerg rays import ... -o NAME.rays'")
        head = read_dataset_manifest(folder)
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
        return merge_metadata([source.metadata for source in self.sources])

    @cached_property
    def digest(self) -> str:
        """SHA-256 of which sources and parts there are; another one as soon as rays are added or replaced."""
        named = "\n".join(f"{source.id} {part.path(source.id)} {part.rays} {part.bytes}" for source, part in self.parts)
        return hashlib.sha256(named.encode()).hexdigest()

    def select_place(self, place: str) -> RayDataset:
        """Its rays of one place, and the sources that have some there or gave none at all."""
        parts = tuple(found for found in self.parts if found[1].place == place)
        there = {source.id for source, _ in parts}
        return replace(self, parts=parts, sources=tuple(s for s in self.sources if s.id in there or not s.parts))

    def require_single_place(self) -> RayDataset:
        """Itself. Raises `NergError` where it holds several places, each of which has a frame of its own."""
        if len(self.places) > 1:
            raise NergError(
                f'"{self.folder}" holds {len(self.places)} places, each in a frame of its own; name one of them: '
                + ", ".join(str(self.folder / f"place={place}") for place in self.places[:8])
            )
        return self

    def scan(self, conditions: Conditions = EVERYTHING, *, hits: bool = True, whole_parts: bool = False) -> Iterator[Rays]:
        """The rays that meet ``conditions``, in blocks of at most `GROUP_ROWS`, or with ``whole`` of a part each: all
        rays of its people of one day and source, in the order of persons and times, unless that has more than a
        million.

        Parts and row groups that cannot hold any are not read. ``hits``: whether hit points are read. Persons and
        cohorts of a block are those that occur in it; its metadata hold the frame alone. Raises `NergError` for
        people and cohorts that the dataset does not know, and for what is damaged.
        """
        self._check(conditions)
        for source, part in self.parts:
            if not conditions.may_hold(part, self.manifest.buckets):
                continue
            wanted = lambda first, n, bounds: conditions.may_hold_group(bounds)
            blocks = (
                kept
                for _, block in read_groups(self.folder, source, part, wanted, hits)
                if len(kept := conditions.select(block))
            )
            if whole_parts:
                found = list(blocks)
                blocks = [merge_rays(found)] if found else []
            yield from blocks

    def _check(self, conditions: Conditions) -> None:
        """Raise `NergError` for names that are not known, and a box that is none."""
        conditions.check()
        for what, known, names in (
            ("person", self.persons, conditions.persons),
            ("person", self.persons, conditions.without_persons),
            ("cohort", sorted({*self.cohorts, "unknown"}), conditions.cohorts),
        ):
            unknown = [name for name in names or () if name not in known]
            if unknown:
                listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
                raise NergError(f"no {what} is called {', '.join(map(repr, unknown))}; there are {listed}")

    def load(self, conditions: Conditions = EVERYTHING, *, most: int = MAX_LOADED_RAYS, hits: bool = True) -> Rays:
        """The rays that meet ``conditions``, in memory. Raises `NergError` where they are more than ``most``, as soon
        as that is known, or of several places."""
        self.require_single_place()
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
            f'"{self.folder}" holds {count} such rays, and {most:,} ({most * BYTES_PER_RAY / 1e9:.2g} GB) are loaded at '
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
        self.require_single_place()
        rows = sample_rows(len(self), n, seed, runs)
        blocks, start = [], 0
        for source, part in self.parts:
            a, b = np.searchsorted(rows, [start, start + part.rays])
            here = rows[a:b] - start
            start += part.rays
            if not len(here):
                continue
            wanted = lambda first, count, bounds, here=here: len(_within(here, first, count)) > 0
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


def load_rays(path: str | os.PathLike, max_rays: int | None = None, seed: int = 0) -> Rays:
    """The rays of a file, or of a dataset or a part of it (``shop.rays/place=north``).

    ``most``: of a dataset, take so many at most: of more, a sample by ``seed`` in which each is as likely as any other.
    None: all, of which there may be 50 million. Raises `NergError` for what is neither, or damaged.
    """
    if not Path(path).is_dir():
        return Rays.load(path)
    dataset = RayDataset.open(path)
    if max_rays is not None and len(dataset) > max_rays:
        return dataset.sample(max_rays, seed)
    return dataset.load(most=MAX_LOADED_RAYS if max_rays is None else max_rays)


def hash_rays(path: str | os.PathLike) -> str:
    """SHA-256 of a file of rays, or that of which rays a dataset holds."""
    return RayDataset.open(path).digest if is_dataset(path) else file_sha256(Path(path))
