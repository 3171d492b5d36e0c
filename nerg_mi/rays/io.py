"""Rays on disk: ``.npz`` (NumPy alone) or ``.parquet`` (through pyarrow).

Both hold the same columns and one JSON document of metadata. Vectors are
(N, 3) arrays in the ``.npz`` and three columns ``name_x, name_y, name_z`` in
the Parquet table, where other tools expect them.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import replacing
from nerg_mi.files.bounded import JSON_BYTES, reading, size_of
from nerg_mi.files.inflating import inflated_limit
from nerg_mi.files.npy import open_npz

from .metadata import VERSION, not_rays, read_metadata

SUFFIXES = (".npz", ".parquet")
_REQUIRED = ("t", "person", "origin", "direction", "confidence")
_OPTIONAL = ("hit", "cohort", "head")
COLUMNS = (*_REQUIRED, *_OPTIONAL)
"""Columns of rays, one row each; hit points, cohorts and heads may be missing."""
_VECTORS = ("origin", "direction", "hit", "head")
# Columns of numbers of names; all others are measurements.
_CODES = ("person", "cohort")
# Memory of a ray with all columns.
_BYTES = 108
# Numbers on either side of a column's middle by which it is told whether it shrinks.
_SAMPLE = 1 << 15


def write_rays_file(path: str | os.PathLike, columns: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Write columns of N rows (``t``, ``person``, ``origin``, ``direction``,
    ``confidence``, optionally ``hit``, ``cohort`` and ``head``) and JSON-serialisable metadata, whole or not at all.

    Raises `NergError` for another suffix and for metadata that `read_rays_file` would refuse, and ``ImportError`` with
    the remedy where Parquet is asked for without pyarrow.
    """
    document = json.dumps({"version": VERSION, **metadata})
    try:
        read_metadata(document, path)
    except NergError as error:
        # What is written can be read again.
        raise NergError(f"these rays cannot be kept: {error}") from error
    if _suffix(path) == ".npz":
        # What savez_compressed writes, with a faster level of zlib, and stored what hardly shrinks: millions of rays in
        # seconds.
        with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", compresslevel=1) as archive:
            for name, value in {"metadata": np.array(document), **columns}.items():
                archive.compression = zipfile.ZIP_DEFLATED if _shrinks(value) else zipfile.ZIP_STORED
                with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                    np.lib.format.write_array(out, value, allow_pickle=False)
        return
    pa, pq = pyarrow_modules()
    table = {}
    for name, value in columns.items():
        if name in _VECTORS:
            table.update({f"{name}_{axis}": value[:, i] for i, axis in enumerate("xyz")})
        else:
            table[name] = value
    with replacing(path) as temporary:
        pq.write_table(pa.table(table).replace_schema_metadata({"nerg_mi": document}), temporary, compression="zstd")


def _shrinks(value: np.ndarray) -> bool:
    """Whether deflate makes a column smaller by a fifth, as far as a sample from its middle tells."""
    flat = value.reshape(-1)
    middle = len(flat) // 2
    sample = np.ascontiguousarray(flat[max(0, middle - _SAMPLE) : middle + _SAMPLE]).tobytes()
    return len(zlib.compress(sample, 1)) < 0.8 * len(sample)


def read_rays_file(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Columns and metadata as :func:`write_rays_file` took them.

    Numbers of any width are read; other columns are not. Room is made for what the file's bytes warrant, column by
    column. Raises `NergError` when the file is damaged, is no rays file, or lacks a column.
    """
    if _suffix(path) == ".npz":
        columns, document = _read_npz(path)
    else:
        columns, document = _read_parquet(path)
    return columns, read_metadata(document, path)


def _read_npz(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], str]:
    with open_npz(path, "rays file") as archive:
        there = {name: archive.about(name) for name in archive.names if name in COLUMNS}
        _check_columns(path, {name: (shape, dtype.kind) for name, (shape, dtype) in there.items()})
        if "metadata" not in archive:
            raise not_rays(path, "it lacks the metadata")
        shape, dtype = archive.about("metadata")
        if shape != () or dtype.kind != "U" or dtype.itemsize > 4 * JSON_BYTES:
            raise not_rays(path, "its metadata are no text")
        with reading(path, "rays file"):
            document = str(archive["metadata"])
        return {name: archive[name] for name in there}, document


def _read_parquet(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], bytes]:
    pa, pq = pyarrow_modules()
    size = size_of(path, "rays file")
    with reading(path, "rays file", also=(pa.ArrowException,)), pq.ParquetFile(path) as table:
        about, schema = table.metadata, table.schema_arrow
        claimed = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
        if claimed > inflated_limit(size):
            raise _not_warranted(path, about.num_rows, size)
        there = {}
        for name in COLUMNS:
            if all(part in schema.names for part in _parts(name)):
                kinds = "".join(sorted({_arrow_kind(pa, schema.field(part).type) for part in _parts(name)}))
                shape = (about.num_rows, 3) if name in _VECTORS else (about.num_rows,)
                there[name] = shape, {"fi": "f"}.get(kinds, kinds)
        _check_columns(path, there)
        document = (schema.metadata or {}).get(b"nerg_mi")
        if document is None:
            raise not_rays(path, "it lacks the metadata")
        columns = {
            name: np.empty(shape, np.int64 if name in _CODES else np.float64) for name, (shape, _) in there.items()
        }
        at = 0
        for batch in table.iter_batches(batch_size=1 << 17, columns=[part for name in there for part in _parts(name)]):
            for name, column in columns.items():
                for i, part in enumerate(_parts(name)):
                    values = batch.column(batch.schema.get_field_index(part))
                    if values.null_count and name in _CODES:
                        raise not_rays(path, f'its column "{part}" has cells without a value')
                    into = column[at : at + batch.num_rows]
                    (into[:, i] if name in _VECTORS else into)[...] = values.to_numpy(zero_copy_only=False)
            at += batch.num_rows
        if at != about.num_rows:
            raise not_rays(path, f"it holds {at:,} of the {about.num_rows:,} rays that it claims")
    return columns, document


def _parts(name: str) -> list[str]:
    """Columns of a Parquet table that hold the column ``name``."""
    return [f"{name}_{axis}" for axis in "xyz"] if name in _VECTORS else [name]


def _arrow_kind(pa: Any, kind: Any) -> str:
    return "f" if pa.types.is_floating(kind) else "i" if pa.types.is_integer(kind) else "O"


def _check_columns(path: str | os.PathLike, there: dict[str, tuple[tuple[int, ...], str]]) -> None:
    """Raise `NergError` where columns of these shapes and kinds (NumPy's letters) do not make rays, or are more than
    the file's bytes warrant."""
    missing = [name for name in _REQUIRED if name not in there]
    if missing:
        raise not_rays(path, f"it lacks {', '.join(missing)}")
    n = (there["t"][0] or (0,))[0]
    for name, (shape, kind) in there.items():
        wanted = (n, 3) if name in _VECTORS else (n,)
        if shape != wanted:
            raise not_rays(path, f"{name} has the shape {shape}, where {wanted} is expected")
        if kind not in (("i", "u") if name in _CODES else ("f", "i", "u")):
            raise not_rays(path, f"{name} is not {'whole numbers' if name in _CODES else 'numbers'}")
    # Narrow numbers become wide ones, and equal values may be stored once: what counts is the memory that rays take.
    size = size_of(path, "rays file")
    if _BYTES * n > inflated_limit(size):
        raise _not_warranted(path, n, size)


def _not_warranted(path: str | os.PathLike, rays: int, size: int) -> NergError:
    return NergError(
        f'the rays file "{path}" claims {rays:,} rays, which its {size:,} bytes do not warrant; copy it again'
    )


def _suffix(path: str | os.PathLike) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise NergError(f"{path}: rays are kept as .npz or .parquet; choose a name with one of these endings")
    return suffix


def pyarrow_modules() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError(
            "Parquet needs pyarrow, which is not installed; run \"pip install 'nerg-mi[parquet]'\" or use a .npz file"
        ) from error
    return pyarrow, pyarrow.parquet
