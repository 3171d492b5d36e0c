"""Datasets of rays: folders and manifests, conditions on rays, and reading the selected parts.

A dataset is a folder whose name ends in ``.rays``:

- ``shop.rays/_dataset.json``: version, buckets, pseudonyms
- ``shop.rays/_sources/ID.json``, one per source: samples per participant, dropped rows, parts with counts, times and
  boxes. It is written after all parts of the source, so that an import can be interrupted at any time and continued.
- ``shop.rays/place=north/day=2026-11-22/bucket=7/part-ID-0.parquet``: the samples, sorted by participant, then time

Columns are ``t`` (float64), ``person``, ``origin_x`` and so on, ``direction_x``, ``hit_x``, ``head_x`` (float32, NaN
where unknown), ``confidence`` and ``cohort``. Origins lie within 8,192 m of zero, where float32 resolves half a
millimetre. The day is that of the times in UTC if these count from 1970, else ``day``, or ``unknown``; the bucket
is one of 16 hashes of the participant's name. A row group, the smallest unit that is decoded, has at most 131,072
samples. pyarrow and DuckDB read the folders as columns. No absolute path is stored. A link that leaves the folder, a
damaged or foreign part, and one that contradicts its source file are refused.
"""

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

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import file_sha256, write_text
from nerg_mi.files.html import Summary
from nerg_mi.files.safe_read import (
    check_regular_file,
    compute_inflation_limit,
    is_count,
    read_json,
    translate_read_errors,
)
from nerg_mi.files.values import FilePath, find_names, fold_name, to_name

from .filters import select_mask
from .rays import (
    FRAME,
    Rays,
    import_pyarrow,
    merge_counts,
    merge_metadata,
    merge_rays,
    parquet_columns,
    read_metadata,
    sample_rows,
)
from .rays import VERSION as RAYS_VERSION

# ---- Layout of a dataset ----
#
#     shop.rays/_dataset.json                     dataset manifest: version, number of buckets, pseudonyms
#     shop.rays/_sources/ID.json                  source manifest: one imported source, and its parts
#     shop.rays/place=P/day=D/bucket=B/part-ID-N.parquet
#
# The folders are Hive partitions, which pyarrow, DuckDB and others read as columns ``place``, ``day`` and ``bucket``;
# they ignore names that begin with an underscore. Rows of a part are sorted by participant and time. Times are float64
# seconds as in `Rays`: exact for any clock of a reader, whereas integer nanoseconds would round some times and
# overflow after 292 years. Origins, directions, hit points and heads are float32, NaN if unknown.

SUFFIX = ".rays"  # Suffix of the name of a new dataset
DATASET_MANIFEST = "_dataset.json"
SOURCES_FOLDER = "_sources"
DATASET = ".rays"
"""Suffix by which a dataset to write is recognised; any other name is that of a file."""
UNKNOWN = "unknown"  # Day of a clock without dates, and environment without a name
PART_ROWS = 1 << 20  # Maximum number of rays of a part, which is written as a whole
GROUP_ROWS = 1 << 17  # Maximum number of rays of a row group, the smallest unit that is decoded
_DAY = re.compile(r"\d{4}-\d\d-\d\d")
_MAX_PLACE_LENGTH = 64  # characters


def compute_bucket(person: str, buckets: int) -> int:
    """Number of the bucket with the rays of a participant."""
    return int(hashlib.sha256(person.encode("utf-8", "surrogatepass")).hexdigest()[:15], 16) % buckets


def check_place(place: str) -> str:
    """Return ``place``, an environment, if it is a valid name. Raises `NergError` otherwise."""
    if not place or len(place) > _MAX_PLACE_LENGTH or not place.isprintable() or place != place.strip():
        raise NergError(
            f"the name of an environment has 1 to {_MAX_PLACE_LENGTH} characters, got {place[:80]!r} "
            f"({parameter('environment')})"
        )
    return place


def check_day(day: str) -> str:
    """Return ``day`` if it is a valid date or `UNKNOWN`. Raises `NergError` otherwise."""
    try:
        if day != UNKNOWN and not (_DAY.fullmatch(day) and np.datetime64(day, "D")):
            raise ValueError
    except ValueError:
        raise NergError(f"a day is written as 2026-11-22, got {day[:40]!r} ({parameter('day')})") from None
    return day


def partition_folder(place: str, day: str, bucket: int) -> Path:
    """Folder of the parts of a partition, relative to the dataset."""
    return Path(f"place={quote(place, safe='')}", f"day={day}", f"bucket={bucket}")


def split_partition_path(path: str | os.PathLike) -> tuple[Path, dict[str, str]]:
    """Split ``path`` into the dataset and the partition in it: ``shop.rays/place=north/day=2026-11-22`` is one day of
    one environment in ``shop.rays``."""
    folder, partition = Path(path), {}
    while match := re.fullmatch(r"(place|day|bucket)=(.+)", folder.name):
        partition[match[1]] = unquote(match[2])
        folder = folder.parent
    return folder, partition


def is_dataset(path: str | os.PathLike) -> bool:
    """Whether ``path`` is a dataset, or a partition in one."""
    return (split_partition_path(path)[0] / DATASET_MANIFEST).is_file()


# ---- Manifests in JSON: of the dataset, and of each imported source ----
#
# A source manifest is written atomically after all parts of the source: files that no manifest names do not belong to
# the dataset. Manifests contain no paths: the path of a part follows from its environment, day, bucket and number.

VERSION = 1
_ID = re.compile(r"[0-9a-f]{32}")
_MAX_BUCKETS = 4096


@dataclass(frozen=True)
class DatasetManifest:
    """Manifest of a dataset."""

    buckets: int
    # None: no pseudonyms. Otherwise the digest of the salt of the pseudonyms; "" if the salt was discarded.
    salt: str | None = None
    # Whether it was filtered from another dataset, so that no files can be imported into it.
    closed: bool = False


@dataclass(frozen=True)
class PartFile:
    """Entry of a part: a file of rays of one source, environment, day and bucket."""

    place: str
    day: str
    bucket: int
    number: int  # among the source's parts, from 0
    rays: int
    bytes: int
    first: str  # first and last name of a participant
    last: str
    start: float  # minimum and maximum time, seconds
    end: float
    low: list[float]  # bounding box of the origins, metres
    high: list[float]
    recorded: float  # recorded seconds, without gaps
    duplicates: int  # rays with the participant and time of the previous ray
    hits: int  # rays with a hit point
    cohorts: bool  # whether rays have a cohort
    heads: bool  # whether some rays have the direction of the head

    def path(self, source: str) -> Path:
        """Path of its file within the dataset; ``source`` is the id of the source."""
        return partition_folder(self.place, self.day, self.bucket) / f"part-{source}-{self.number}.parquet"


@dataclass(frozen=True)
class SourceManifest:
    """Manifest of one imported source: a file, or a folder that a reader takes as a whole."""

    id: str  # 32 hexadecimal digits: digest of its name, its content and the import settings
    file: str  # its name, or an alias
    where: str  # digest of its path, to recognise it after its content has changed
    stamp: str | None  # digest of its size and modification time; None: modified too recently to rely on it
    recipe: str  # digest of the import settings
    generation: int  # of the manifests of one path, the one with the highest generation is valid
    persons: dict[str, int]  # number of rays per participant
    cohorts: dict[str, int]
    parts: list[PartFile]
    metadata: dict[str, Any] = field(default_factory=dict)  # of its rays: frame, sources, rows_read, dropped, ...

    @property
    def rays(self) -> int:
        return sum(part.rays for part in self.parts)


def write_dataset_manifest(folder: Path, head: DatasetManifest) -> None:
    """Write the manifest that makes ``folder`` a dataset."""
    write_text(folder / DATASET_MANIFEST, json.dumps({"version": VERSION, **asdict(head)}) + "\n")


def read_dataset_manifest(folder: Path) -> DatasetManifest:
    """Read the manifest of the dataset ``folder``. Raises `NergError` if it is not a dataset."""
    path = folder / DATASET_MANIFEST
    content = _read_document(path)
    head: dict[str, Any] = {key: content.get(key) for key in ("buckets", "salt", "closed")}
    _require_valid(
        path, "buckets", is_count(head["buckets"]) and 0 < head["buckets"] <= _MAX_BUCKETS, "a number of buckets"
    )
    _require_valid(path, "salt", head["salt"] is None or isinstance(head["salt"], str), "text")
    _require_valid(path, "closed", isinstance(head["closed"], bool), "a boolean")
    return DatasetManifest(**head)


def source_manifest_path(folder: Path, source: str) -> Path:
    """Path of the manifest of the source with this id."""
    return folder / SOURCES_FOLDER / f"{source}.json"


def write_source_manifest(folder: Path, source: SourceManifest) -> None:
    """Write the manifest of a source, after its parts."""
    write_text(source_manifest_path(folder, source.id), json.dumps({"version": VERSION, **asdict(source)}) + "\n")


def read_source_manifests(folder: Path, head: DatasetManifest) -> list[SourceManifest]:
    """Read the manifests of all sources, sorted by id; of several for one path, only the latest."""
    manifests = [read_source_manifest(path, head) for path in sorted((folder / SOURCES_FOLDER).glob("[!.]*.json"))]
    latest: dict[str, SourceManifest] = {}
    for source in manifests:
        if source.where not in latest or source.generation > latest[source.where].generation:
            latest[source.where] = source
    return [source for source in manifests if latest[source.where] is source]


def read_source_manifest(path: Path, head: DatasetManifest) -> SourceManifest:
    """Read and validate the source manifest ``path``. Raises `NergError` if it is damaged."""
    content = _read_document(path)
    content.pop("version")
    if set(content) != {f.name for f in fields(SourceManifest)}:
        raise _damaged_manifest(path, "its keys are not those of a source manifest")
    if content["id"] != path.stem or not _ID.fullmatch(path.stem):
        raise _damaged_manifest(path, '"id" does not match its file name')
    for key, (is_valid, expected) in _SOURCE_CHECKS.items():
        _require_valid(path, key, is_valid(content[key]), expected)
    # The metadata must be as valid as those of a rays file.
    read_metadata(json.dumps({"version": RAYS_VERSION, "persons": [], **content["metadata"]}), path)
    parts = [_read_part(path, part, head, content["persons"]) for part in content["parts"]]
    if sum(content["persons"].values()) != sum(part.rays for part in parts):
        raise _damaged_manifest(path, "the numbers of rays of its participants and of its parts differ")
    if len({part.number for part in parts}) != len(parts):
        raise _damaged_manifest(path, "two of its parts have the same number")
    return SourceManifest(**{**content, "parts": parts})


def _read_part(path: Path, content: dict[str, Any], head: DatasetManifest, persons: dict[str, int]) -> PartFile:
    if set(content) != {f.name for f in fields(PartFile)}:
        raise _damaged_manifest(path, "a part has other keys than those of a part")
    for key, (is_valid, expected) in _PART_CHECKS.items():
        _require_valid(path, key, is_valid(content[key]), expected)
    _require_valid(path, "bucket", content["bucket"] < head.buckets, "a bucket of this dataset")
    _require_valid(path, "rays", 0 < content["rays"] <= PART_ROWS, "a number of rays of a part")
    for key in ("first", "last"):
        _require_valid(path, key, content[key] in persons, "a participant of this source")
    try:
        check_place(content["place"])
        check_day(content["day"])
    except NergError as error:
        raise _damaged_manifest(path, str(error)) from error
    return PartFile(**content)


def _read_document(path: Path) -> dict[str, Any]:
    content = read_json(path, "manifest of a dataset")
    if not isinstance(content, dict):
        raise _damaged_manifest(path, "it is not a JSON object")
    if content.get("version") != VERSION:
        raise NergError(f'"{path}" was written by another version of the format; import the files into a new dataset')
    return content


def _require_valid(path: Path, key: str, is_valid: bool, expected: str) -> None:
    if not is_valid:
        raise _damaged_manifest(path, f'"{key}" is not {expected}')


def _damaged_manifest(path: Path, reason: str) -> NergError:
    remedy = (
        "copy it again" if path.name == DATASET_MANIFEST else "copy it again, or remove it and import its source again"
    )
    return NergError(f'the manifest "{path}" of a dataset is damaged ({reason}); {remedy}')


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


_SOURCE_CHECKS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("file", "where", "recipe"), (_is_text, "text")),
    "stamp": (lambda value: value is None or _is_text(value), "text"),
    "generation": (is_count, "a count"),
    **dict.fromkeys(
        ("persons", "cohorts"), (lambda value: isinstance(value, dict) and all(map(is_count, value.values())), "counts")
    ),
    "metadata": (lambda value: isinstance(value, dict), "an object"),
    "parts": (lambda value: isinstance(value, list) and all(isinstance(v, dict) for v in value), "a list of parts"),
}
_PART_CHECKS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("bucket", "number", "rays", "bytes", "duplicates", "hits"), (is_count, "a count")),
    **dict.fromkeys(("cohorts", "heads"), (lambda value: isinstance(value, bool), "a boolean")),
    **dict.fromkeys(("start", "end", "recorded"), (_is_number, "a number")),
    **dict.fromkeys(
        ("low", "high"),
        (lambda value: isinstance(value, list) and len(value) == 3 and all(map(_is_number, value)), "a point"),
    ),
    **dict.fromkeys(("place", "day", "first", "last"), (_is_text, "text")),
}
"""Validation of each value of a manifest: a predicate, and the name of the type for messages."""


# ---- Conditions ----
#
# Conditions select rays of a dataset. Parts and row groups are skipped by their statistics in the manifest and the
# file, rays are selected by `nerg_mi.tracking.filters`.


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions on rays, as the parameters of `nerg_mi.tracking.filters.select_mask`; by default, all rays match."""

    time: tuple[float | None, float | None] | None = None
    persons: Sequence[str] | None = None
    without_persons: Sequence[str] | None = None
    cohorts: Sequence[str] | None = None
    box: Sequence[float] | None = None
    min_confidence: float | None = None
    with_hit: bool = False

    def validate(self) -> None:
        """Raise `NergError` for an invalid box."""
        select_mask(merge_rays([]), box=self.box)

    @property
    def has_any(self) -> bool:
        """Whether any condition is set."""
        return self != Conditions()

    def may_match_part(self, part: PartFile, buckets: int) -> bool:
        """Whether rays of a part may match, by its entry in the manifest."""
        if self.with_hit and not part.hits:
            return False
        if self.persons is not None and not any(
            compute_bucket(p, buckets) == part.bucket and part.first <= p <= part.last for p in self.persons
        ):
            return False
        return self._overlaps_time(part.start, part.end) and self._overlaps_box(part.low, part.high)

    def may_match_group(self, bounds: dict[str, tuple[Any, Any]]) -> bool:
        """Whether rays of a row group may match. ``bounds`` are the minimum and maximum of its columns; a column
        without recorded bounds excludes nothing."""
        axes = [bounds.get(f"origin_{axis}") for axis in "xyz"]
        if all(axes) and not self._overlaps_box([a[0] for a in axes if a], [a[1] for a in axes if a]):
            return False
        if "t" in bounds and not self._overlaps_time(*bounds["t"]):
            return False
        if "person" in bounds and self.persons is not None:
            low, high = bounds["person"]
            return any(low <= p <= high for p in self.persons)
        return True

    def _overlaps_time(self, start: float, end: float) -> bool:
        begin, until = self.time or (None, None)
        return (begin is None or end >= begin) and (until is None or start < until)

    def _overlaps_box(self, low: Sequence[float], high: Sequence[float]) -> bool:
        if self.box is None:
            return True
        sides = np.asarray(self.box, np.float64)
        return bool((np.asarray(high) >= sides[0::2]).all() and (np.asarray(low) <= sides[1::2]).all())

    def select(self, rays: Rays) -> Rays:
        """The rays that match. Names that do not occur in ``rays`` are not an error here."""
        if not self.has_any:
            return rays
        keep_present = lambda names, available: (
            None if names is None else [name for name in map(to_name, names) if name in available]
        )
        applicable = replace(
            self,
            persons=keep_present(self.persons, rays.persons),
            without_persons=keep_present(self.without_persons, rays.persons),
            cohorts=keep_present(self.cohorts, rays.cohorts),
        )
        if applicable.cohorts is not None and rays.cohort is None:
            # The source has no cohorts.
            return rays.select(np.zeros(len(rays), bool))
        mask = select_mask(rays, **{name: getattr(applicable, name) for name in applicable.__dataclass_fields__})
        return rays if mask.all() else rays.select(mask)


NO_CONDITIONS = Conditions()  # Matches all rays


# ---- Reading the row groups of a part, validated against the manifest ----

# Type of each column of rays: f for floats, s for strings.
_COLUMN_KINDS = dict(t="f", person="s", origin="f", direction="f", confidence="f", hit="f", cohort="s", head="f")
_WHAT = "part of a dataset"


def read_groups(
    folder: Path,
    source: SourceManifest,
    part: PartFile,
    is_wanted: Callable[[int, int, dict[str, tuple[Any, Any]]], bool],
    read_hits: bool = True,
) -> Iterator[tuple[int, Rays]]:
    """Iterate over the row groups of a part, each with the number of its first row.

    Participants and cohorts of each block are those that occur in it.

    Parameters
    ----------
    is_wanted
        Called with the first row of a group, its number of rows, and the minimum and maximum of its columns if the
        file contains them; groups for which it returns false are skipped.
    read_hits
        Whether to read hit points.

    Raises
    ------
    NergError
        For a part that is missing, damaged, or not that of the manifest.
    """
    pa, pq = import_pyarrow()
    path = _require_inside(folder, folder / part.path(source.id))
    size = check_regular_file(path, _WHAT)
    if size != part.bytes:
        raise _mismatched_part(path, f"it has {size:,} bytes, but {part.bytes:,} in the manifest")
    with (
        translate_read_errors(path, _WHAT, "import its source again", extra_errors=(pa.ArrowException,)),
        pq.ParquetFile(path) as file,
    ):
        file_metadata = file.metadata
        if file_metadata.num_rows != part.rays:
            raise _mismatched_part(path, f"it has {file_metadata.num_rows:,} rays, but {part.rays:,} in the manifest")
        groups = [file_metadata.row_group(k) for k in range(file_metadata.num_row_groups)]
        if sum(group.total_byte_size for group in groups) > compute_inflation_limit(size):
            raise _mismatched_part(path, f"it declares more data than its {size:,} bytes can contain")
        if sum(group.num_rows for group in groups) != part.rays or any(g.num_rows > GROUP_ROWS for g in groups):
            raise _mismatched_part(path, "its row groups have unexpected sizes")
        is_left_out = {"hit": not (read_hits and part.hits), "cohort": not part.cohorts, "head": not part.heads}
        columns = _find_columns(
            pa, file.schema_arrow, path, [name for name in _COLUMN_KINDS if not is_left_out.get(name)]
        )
        first = 0
        for k, group in enumerate(groups):
            if group.num_rows and is_wanted(first, group.num_rows, _read_bounds(group)):
                table = file.read_row_group(k, columns=columns, use_threads=False)
                yield first, _make_rays(pa, table, path, source)
            first += group.num_rows


def _require_inside(folder: Path, path: Path) -> Path:
    """Return ``path`` if it is within the dataset ``folder`` after resolving links. Raises `NergError` otherwise."""
    root = os.path.realpath(folder)
    if os.path.commonpath([root, os.path.realpath(path)]) != root:
        raise NergError(f'the {_WHAT} "{path}" is a link to outside of "{folder}"; replace it by the file itself')
    return path


def _mismatched_part(path: Path, reason: str) -> NergError:
    return NergError(f'"{path}" is not the part in the manifest: {reason}; import its source again')


def _find_columns(pa: Any, schema: Any, path: Path, names: list[str]) -> list[str]:
    """Parquet columns of the columns ``names`` of rays. Raises `NergError` for missing columns or other types."""
    columns = []
    for name in names:
        for column in parquet_columns(name):
            if schema.names.count(column) != 1:
                raise _mismatched_part(path, f'it has no column "{column}"')
            type_ = schema.field(column).type
            type_ = type_.value_type if pa.types.is_dictionary(type_) else type_
            if not (pa.types.is_floating(type_) if _COLUMN_KINDS[name] == "f" else pa.types.is_string(type_)):
                raise _mismatched_part(path, f'its column "{column}" has another type')
            columns.append(column)
    return columns


def _read_bounds(group: Any) -> dict[str, tuple[Any, Any]]:
    bounds = {}
    for k in range(group.num_columns):
        column = group.column(k)
        if column.is_stats_set and column.statistics.has_min_max:
            bounds[column.path_in_schema] = column.statistics.min, column.statistics.max
    return bounds


def _make_rays(pa: Any, table: Any, path: Path, source: SourceManifest) -> Rays:
    """Make rays from a row group."""
    number = lambda name: table.column(name).to_numpy()
    vector = lambda name: np.stack([number(part) for part in parquet_columns(name)], axis=1)
    names = table.schema.names
    person, persons = _decode_names(pa, table.column("person"), path)
    unknown = [name for name in persons if name not in source.persons]
    if unknown:
        raise _mismatched_part(path, "it contains rays of a person who is not in the manifest")
    cohort, cohorts = _decode_names(pa, table.column("cohort"), path) if "cohort" in names else (None, ())
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
            metadata={
                "frame": dict(FRAME),
                **{k: v for k, v in source.metadata.items() if k in ("tracking", "tracking_by_person")},
            },
        )
    except NergError as error:
        raise _mismatched_part(path, str(error).split(";")[0]) from error


def _decode_names(pa: Any, column: Any, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Decode a column of names: codes (N,) int32, and the sorted names that occur."""
    if column.null_count:
        raise _mismatched_part(path, "some of its names are missing")
    chunk = column.combine_chunks()
    chunk = chunk.chunk(0) if isinstance(chunk, pa.ChunkedArray) else chunk
    chunk = chunk if pa.types.is_dictionary(chunk.type) else chunk.dictionary_encode()
    dictionary, codes = chunk.dictionary.to_pylist(), chunk.indices.to_numpy()
    if codes.size and (codes.min() < 0 or codes.max() >= len(dictionary) or None in dictionary):
        raise _mismatched_part(path, "its names are damaged")
    used = np.flatnonzero(np.bincount(codes))
    # A dictionary may contain a name twice.
    persons = tuple(sorted({dictionary[k] for k in used.tolist()}))
    new_codes = {name: k for k, name in enumerate(persons)}
    mapping = np.zeros(len(dictionary), np.int32)
    mapping[used] = [new_codes[dictionary[k]] for k in used.tolist()]
    return mapping[codes], persons


# ---- Reading a dataset: scanning block by block, loading, sampling ----

MAX_LOADED_RAYS = 50_000_000  # Default maximum number of rays that are loaded at once
BYTES_PER_RAY = 110  # Approximate memory of a loaded ray


@dataclass(frozen=True, eq=False, repr=False)
class RayDataset(Summary):
    """A dataset of rays, or a partition of it: an environment, day or bucket.

    Only manifests are held in memory.
    """

    folder: Path
    manifest: DatasetManifest
    sources: tuple[SourceManifest, ...]  # with rays in the partition, or without any rays at all
    parts: tuple[tuple[SourceManifest, PartFile], ...]  # in reading order: environment, day, bucket, source, number

    @classmethod
    def open(cls, path: str | os.PathLike) -> RayDataset:
        """Open a dataset, or a partition of it such as ``shop.rays/place=north/day=2026-11-22``.

        Raises `NergError` if the folder is not a dataset, a manifest is damaged, or the partition is empty.
        """
        folder, partition = split_partition_path(path)
        if not (folder / DATASET_MANIFEST).is_file():
            raise NergError(f"\"{path}\" is not a dataset; create one with 'nerg rays import ... -o NAME.rays'")
        head = read_dataset_manifest(folder)
        sources = read_source_manifests(folder, head)
        parts = [
            (source, part)
            for source in sources
            for part in source.parts
            if all(fold_name(str(getattr(part, key))) == fold_name(value) for key, value in partition.items())
        ]
        if not parts:
            what = ", ".join(f"{key} {value}" for key, value in partition.items())
            raise NergError(f'the dataset "{folder}" has no rays{f" of {what}" if what else ""}; import some into it')
        if partition:
            source_ids = {source.id for source, _ in parts}
            sources = [source for source in sources if source.id in source_ids]
        parts.sort(key=lambda p: (p[1].place, p[1].day, p[1].bucket, p[0].id, p[1].number))
        return cls(folder, head, tuple(sources), tuple(parts))

    def __len__(self) -> int:
        return sum(part.rays for _, part in self.parts)

    @property
    def bytes(self) -> int:
        """Total size of all parts."""
        return sum(part.bytes for _, part in self.parts)

    @cached_property
    def places(self) -> tuple[str, ...]:
        """Names of the environments, sorted."""
        return tuple(sorted({part.place for _, part in self.parts}))

    @cached_property
    def days(self) -> tuple[str, ...]:
        """Days of the recordings, sorted."""
        return tuple(sorted({part.day for _, part in self.parts}))

    @cached_property
    def persons(self) -> tuple[str, ...]:
        """Names of all participants of its sources, sorted."""
        return tuple(sorted({name for source in self.sources for name in source.persons}))

    @cached_property
    def cohorts(self) -> dict[str, int]:
        """Number of rays of each cohort, of sources with cohorts."""
        return merge_counts(source.cohorts for source in self.sources)

    @property
    def metadata(self) -> dict[str, Any]:
        """Merged metadata of its rays (`merge_metadata`)."""
        return merge_metadata([source.metadata for source in self.sources])

    @cached_property
    def digest(self) -> str:
        """SHA-256 of its list of sources and parts; changes when rays are added or replaced."""
        listing = "\n".join(
            f"{source.id} {part.path(source.id)} {part.rays} {part.bytes}" for source, part in self.parts
        )
        return hashlib.sha256(listing.encode()).hexdigest()

    def select_place(self, place: str) -> RayDataset:
        """Select one environment: its parts, the sources with rays there, and the sources without any rays."""
        parts = tuple(entry for entry in self.parts if entry[1].place == place)
        source_ids = {source.id for source, _ in parts}
        return replace(self, parts=parts, sources=tuple(s for s in self.sources if s.id in source_ids or not s.parts))

    def require_single_place(self) -> RayDataset:
        """Return the dataset itself. Raises `NergError` if it has several environments, each with its own frame."""
        if len(self.places) > 1:
            raise NergError(
                f'"{self.folder}" has {len(self.places)} environments, each in a frame of its own; select one: '
                + ", ".join(str(self.folder / f"place={place}") for place in self.places[:8])
            )
        return self

    def scan(
        self, conditions: Conditions = NO_CONDITIONS, *, read_hits: bool = True, whole_parts: bool = False
    ) -> Iterator[Rays]:
        """Iterate over the rays that match ``conditions``, in blocks. Skips parts and row groups that cannot match.

        Participants and cohorts of a block are those that occur in it; its metadata only contain the frame
        and the kind of tracking.

        Parameters
        ----------
        read_hits
            Whether to read hit points.
        whole_parts
            Whether a block is a part, with all rays of its participants of one day and source, sorted by participant
            and time (unless these exceed a million), instead of a row group of at most `GROUP_ROWS` rays.

        Raises
        ------
        NergError
            For unknown participants and cohorts, and for damaged files.
        """
        conditions = self._resolve_conditions(conditions)
        for source, part in self.parts:
            if not conditions.may_match_part(part, self.manifest.buckets):
                continue
            is_wanted = lambda first, n, bounds: conditions.may_match_group(bounds)
            blocks = (
                selected
                for _, block in read_groups(self.folder, source, part, is_wanted, read_hits)
                if len(selected := conditions.select(block))
            )
            if whole_parts:
                part_blocks = list(blocks)
                blocks = [merge_rays(part_blocks)] if part_blocks else []
            yield from blocks

    def _resolve_conditions(self, conditions: Conditions) -> Conditions:
        """Return ``conditions`` with names as they are stored. Raises `NergError` for unknown names and an invalid
        box."""
        conditions.validate()
        persons, cohorts = self.persons, tuple(sorted({*self.cohorts, "unknown"}))
        stored = {}
        for key, available in {"persons": persons, "without_persons": persons, "cohorts": cohorts}.items():
            if (names := getattr(conditions, key)) is not None:
                what = "cohort" if key == "cohorts" else "person"
                wanted = {to_name(available[k]) for k in find_names(names, available, what)}
                # A dataset of an earlier version may store a name in two forms.
                stored[key] = [name for name in available if to_name(name) in wanted]
        return replace(conditions, **stored)

    def load(
        self, conditions: Conditions = NO_CONDITIONS, *, max_rays: int = MAX_LOADED_RAYS, read_hits: bool = True
    ) -> Rays:
        """Load the rays that match ``conditions``. Raises `NergError` for more than ``max_rays`` rays, or several
        environments."""
        self.require_single_place()
        if not conditions.has_any and len(self) > max_rays:
            raise self._too_many(f"{len(self):,}", max_rays)
        blocks, count = [], 0
        for block in self.scan(conditions, read_hits=read_hits):
            blocks.append(block)
            count += len(block)
            if count > max_rays:
                raise self._too_many(f"more than {count:,}", max_rays)
        return merge_rays(blocks, self.metadata)

    def _too_many(self, count: str, max_rays: int) -> NergError:
        return NergError(
            f'"{self.folder}" has {count} such rays, more than the maximum of {max_rays:,} '
            f"({max_rays * BYTES_PER_RAY / 1e9:.2g} GB): select rays with 'nerg rays filter' ({parameter('box')}, "
            f"{parameter('persons')}, {parameter('start')}, or {parameter('sample')}), or use one day of the "
            "dataset"
        )

    def sample(self, n: int, seed: int = 0, *, runs: int | None = None, read_hits: bool = True) -> Rays:
        """Sample ``n`` rays uniformly, in the order of the dataset; all rays if there are at most ``n``.

        Row groups without sampled rays are not read. A small sample of a large dataset has rays in nearly every group:
        with ``runs``, it consists of that many runs of neighbouring rays, of fewer participants, and is faster to read
        (see `sample_rows`). The metadata get a step ``sample``. Equal seeds give equal samples of equal datasets.
        Raises `NergError` as `load` does, except for the number of rays.
        """
        self.require_single_place()
        rows = sample_rows(len(self), n, seed, runs)
        blocks, start = [], 0
        for source, part in self.parts:
            a, b = np.searchsorted(rows, [start, start + part.rays])
            part_rows = rows[a:b] - start
            start += part.rays
            if not len(part_rows):
                continue
            is_wanted = lambda first, count, bounds, part_rows=part_rows: len(_rows_within(part_rows, first, count)) > 0
            for first, block in read_groups(self.folder, source, part, is_wanted, read_hits):
                block_rows = _rows_within(part_rows, first, len(block)) - first
                blocks.append(block if len(block_rows) == len(block) else block.select(block_rows))
        step = {} if runs is None else {"runs": runs}
        rays = merge_rays(blocks, self.metadata)
        return (
            rays
            if len(rows) == len(self)
            else rays.with_step(step="sample", kept=len(rows), of=len(self), seed=seed, **step)
        )


def _rows_within(rows: np.ndarray, first: int, count: int) -> np.ndarray:
    """The sorted ``rows`` among the ``count`` rows from ``first`` on."""
    return rows[np.searchsorted(rows, first) : np.searchsorted(rows, first + count)]


def open_recordings(rays: Rays | RayDataset | FilePath) -> Rays | RayDataset:
    """Return rays and datasets unchanged, or open their file. Raises `NergError` for anything else."""
    if isinstance(rays, (Rays, RayDataset)):
        return rays
    if not isinstance(rays, (str, os.PathLike)):
        raise NergError(
            f"{parameter('rays')} must be Rays or a file of them, got {type(rays).__name__}; make rays of a table in "
            "memory with Rays.from_dataframe or Rays.from_arrays, and of other files with import_rays"
        )
    return RayDataset.open(rays) if os.path.isdir(rays) else Rays.load(rays)


def open_rays(rays: Rays | RayDataset | FilePath, max_rays: int | None = None, seed: int = 0) -> Rays:
    """Return rays unchanged, or load them from a file or a dataset, as `Rays.load` does."""
    data = open_recordings(rays)
    if isinstance(data, Rays):
        return data
    if max_rays is not None and len(data) > max_rays:
        return data.sample(max_rays, seed)
    return data.load(max_rays=MAX_LOADED_RAYS if max_rays is None else max_rays)


def hash_rays(path: str | os.PathLike) -> str:
    """SHA-256 of a rays file, or of the list of sources and parts of a dataset."""
    return RayDataset.open(path).digest if is_dataset(path) else file_sha256(Path(path))
