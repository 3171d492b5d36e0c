"""Reading the parts of a dataset, row group by row group, each checked against the account."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import reading, size_of
from nerg_mi.files.inflating import inflated_limit
from nerg_mi.rays.io import pyarrow_modules
from nerg_mi.rays.rays import Rays

from .layout import GROUP_ROWS, VECTORS
from .manifest import Part, Source

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
