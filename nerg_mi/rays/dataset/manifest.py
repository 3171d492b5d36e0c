"""The account of a dataset, in JSON: what it is, and what became of each source that was imported.

An account of a source is written after all of its parts, whole or not at all: what no account names does not belong to
the dataset. Nothing in it is the path of a file: where a part lies follows from its place, day, bucket and number.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.files.bounded import is_count, read_json
from nerg_mi.rays.metadata import VERSION as RAYS_VERSION
from nerg_mi.rays.metadata import read_metadata

from .layout import HEAD, PART_ROWS, SOURCES, check_day, check_place, folder_of

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
