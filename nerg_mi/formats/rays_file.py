"""Rays on disk: ``.npz`` (NumPy alone) or ``.parquet`` (through pyarrow).

Both hold the same columns and one JSON document of metadata. Vectors are
(N, 3) arrays in the ``.npz`` and three columns ``name_x, name_y, name_z`` in
the Parquet table, where other tools expect them.
"""
from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import replacing

VERSION = 1
SUFFIXES = (".npz", ".parquet")
_REQUIRED = ("t", "person", "origin", "direction", "confidence")
_OPTIONAL = ("hit", "cohort")
_VECTORS = ("origin", "direction", "hit")


def write_rays_file(path: str | os.PathLike, columns: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Write columns of N rows (``t``, ``person``, ``origin``, ``direction``,
    ``confidence``, optionally ``hit`` and ``cohort``) and JSON-serialisable metadata, whole or not at all.

    Raises ``ValueError`` for another suffix, and ``ImportError`` with the
    remedy where Parquet is asked for without pyarrow.
    """
    document = json.dumps({"version": VERSION, **metadata})
    if _suffix(path) == ".npz":
        # What savez_compressed writes, with a faster level of zlib: millions of rays in seconds.
        with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, value in {"metadata": np.array(document), **columns}.items():
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


def read_rays_file(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Columns and metadata as :func:`write_rays_file` took them.

    Raises ``ValueError`` when the file is not one of ours or lacks a column.
    """
    if _suffix(path) == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                columns = {name: archive[name] for name in archive.files}
        except (zipfile.BadZipFile, ValueError) as error:
            raise ValueError(f"{path} is not a rays file ({error}); make one with 'nerg rays import'") from error
        document = str(columns.pop("metadata", ""))
    else:
        _, pq = pyarrow_modules()
        table = pq.read_table(path)
        document = ((table.schema.metadata or {}).get(b"nerg_mi") or b"").decode()
        flat = {name: table.column(name).to_numpy() for name in table.column_names}
        columns = {}
        for name in (*_REQUIRED, *_OPTIONAL):
            if name in flat:
                columns[name] = flat[name]
            elif name in _VECTORS and f"{name}_x" in flat:
                columns[name] = np.stack([flat[f"{name}_{axis}"] for axis in "xyz"], axis=1)
    missing = [name for name in _REQUIRED if name not in columns]
    if missing or not document:
        raise ValueError(
            f"{path} is not a rays file (it lacks {', '.join(missing) or 'the metadata'}); make one with 'nerg rays import'"
        )
    metadata = json.loads(document)
    if metadata.pop("version") != VERSION:
        raise ValueError(f"{path} was written by another version of the format; import the tracking files again")
    return columns, metadata


def _suffix(path: str | os.PathLike) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: rays are kept as .npz or .parquet; choose a name with one of these endings")
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
