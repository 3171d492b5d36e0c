"""Checkpoints of this package: safetensors files with JSON metadata. Reading them does not run code.

The metadata is one JSON object under the key ``nerg``: kind of field, architecture, units, bounding box, colour space
and provenance.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, sanitize
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.safe_read import open_file, parse_json, translate_read_errors

FORMAT = 1  # format version, increased when an earlier version of this package could misread the files
MAX_CHECKPOINT_BYTES = 16 << 30  # maximum size of a checkpoint in bytes
MAX_HEADER_BYTES = 16 << 20  # maximum size of the header, which contains array names and metadata, in bytes


def encode_checkpoint(kind: str, tensors: dict[str, np.ndarray], metadata: dict) -> bytes:
    """Encode ``tensors`` and ``metadata`` (JSON) as a checkpoint of ``kind``."""
    from safetensors.numpy import save

    header = {"nerg": json.dumps({"format": FORMAT, "kind": kind, **metadata}, allow_nan=False)}
    return save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata=header)


def decode_checkpoint(data: bytes) -> tuple[dict[str, np.ndarray], dict]:
    """Decode the tensors and the metadata of `encode_checkpoint`, which are not checked as those of a file are."""
    from safetensors.numpy import load

    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return load(data), json.loads(header["__metadata__"]["nerg"])


def write_checkpoint(path: str | Path, kind: str, tensors: dict[str, np.ndarray], metadata: dict) -> None:
    """Write ``tensors`` and ``metadata`` (JSON) atomically as a checkpoint of ``kind``."""
    write_bytes(path, encode_checkpoint(kind, tensors, metadata))


def read_checkpoint(path: str | Path, kind: str) -> tuple[dict[str, np.ndarray], dict]:
    """Read the tensors and the metadata of a checkpoint of ``kind``.

    Raises `MissingFile` if the file does not exist, and `NergError` if it is not such a checkpoint.
    """
    with _open_checkpoint(Path(path)) as file:
        metadata = _parse_metadata(file, Path(path), kind)
        return {name: file.get_tensor(name) for name in file.keys()}, metadata


def read_metadata(path: str | Path) -> dict:
    """Read the metadata of a checkpoint of any kind, which is its entry ``kind``. Raises the errors of
    `read_checkpoint`.
    """
    with _open_checkpoint(Path(path)) as file:
        return _parse_metadata(file, Path(path))


@contextmanager
def _open_checkpoint(path: Path) -> Iterator[Any]:
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise MissingFile(f'the checkpoint "{path}" does not exist: correct its name, or make one with "nerg train"')
    _check_header(path)
    # The library requests dtypes that NumPy lacks (bfloat16) if the file contains them.
    with translate_read_errors(path, "checkpoint", extra_errors=(TypeError, AttributeError)):
        try:
            with safe_open(path, framework="numpy") as file:
                yield file
        except SafetensorError as error:
            raise NergError(
                f'"{path}" is not a readable safetensors file: {sanitize(error)}; copy it again, or create it again'
            ) from error


def _check_header(path: Path) -> None:
    with open_file(path, "checkpoint", max_bytes=MAX_CHECKPOINT_BYTES) as file:
        size, header = os.fstat(file.fileno()).st_size, int.from_bytes(file.read(8), "little")
        start = file.read(1)
    if size < 8 or header > size - 8:
        if path.suffix.lower() != ".safetensors":
            raise NergError(
                f'"{path}" is not a checkpoint of a field; specify a .safetensors file that "nerg train" has written'
            )
        raise NergError(
            f'"{path}" is not a readable safetensors file: it states that its header has {header:,} bytes, but the '
            f"whole file has {size:,} bytes; copy it again, or create it again"
        )
    if header > MAX_HEADER_BYTES:
        raise NergError(f'the header of "{path}" has {header:,} bytes; the limit is {MAX_HEADER_BYTES:,}')
    if start != b"{":
        raise NergError(f'"{path}" is not a readable safetensors file: its header is not a JSON object; copy it again')


def _parse_metadata(file: Any, path: Path, kind: str | None = None) -> dict:
    """Parse the metadata in the header and check that the checkpoint has the given ``kind``; None for any kind."""
    raw = (file.metadata() or {}).get("nerg")
    if raw is None:
        raise NergError(
            f'"{path}" is a safetensors file but not a nerg_mi checkpoint (no "nerg" metadata); specify a nerg_mi '
            "checkpoint"
        )
    metadata = parse_json(raw, path, "checkpoint, in its metadata")
    if not isinstance(metadata, dict):
        raise NergError(f'the metadata of "{path}" is damaged: it must be a JSON object; copy it again')
    if kind is not None and metadata.get("kind") != kind:
        raise NergError(
            f'"{path}" contains a {sanitize(metadata.get("kind"), 40)} field, but a {kind} field is needed; '
            f"specify a {kind} field"
        )
    if metadata.get("format") != FORMAT:
        raise NergError(
            f'"{path}" has checkpoint format {sanitize(metadata.get("format"), 40)}, but this version of nerg_mi reads '
            f"format {FORMAT}: use a newer nerg_mi if the format of the file is higher; else train the field again"
        )
    if not isinstance(metadata.get("provenance", {}), dict):
        raise NergError(f'the metadata of "{path}" is damaged: "provenance" must be a JSON object; copy it again')
    return metadata
