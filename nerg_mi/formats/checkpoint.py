"""Our own checkpoints: safetensors with JSON metadata. Nothing in them runs code.

Metadata is one JSON object under the key ``nerg``: the kind of field, its
architecture, units, bounding box, colour space and provenance.
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

FORMAT = 1  # the version of the files, raised when an earlier version of this package could misread them
MAX_CHECKPOINT_BYTES = 16 << 30  # a checkpoint may have so many bytes
MAX_HEADER_BYTES = 16 << 20  # the header, which names every array and holds the metadata, may have so many bytes


def write_checkpoint(path: str | Path, kind: str, tensors: dict[str, np.ndarray], metadata: dict) -> None:
    """Write ``tensors`` (contiguous arrays) and ``metadata`` (JSON) atomically.

    A reader sees the old file or the new one, never half of it.
    """
    from safetensors.numpy import save

    header = {"nerg": json.dumps({"format": FORMAT, "kind": kind, **metadata}, allow_nan=False)}
    data = save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata=header)
    write_bytes(path, data)


def read_checkpoint(path: str | Path, kind: str) -> tuple[dict[str, np.ndarray], dict]:
    """Tensors and metadata of a checkpoint of ``kind``.

    Raises `MissingFile` when there is no such file and `NergError` when it is not such a checkpoint.
    """
    with _opened(Path(path)) as file:
        metadata = _metadata(file, Path(path), kind)
        return {name: file.get_tensor(name) for name in file.keys()}, metadata


def read_metadata(path: str | Path) -> dict:
    """The metadata of a checkpoint of any kind, which they name as ``kind``; raises as `read_checkpoint`."""
    with _opened(Path(path)) as file:
        return _metadata(file, Path(path))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise MissingFile(f'the checkpoint "{path}" does not exist: correct its name, or make one with "nerg train"')
    _check_header(path)
    # The library asks NumPy for types that it has not (bfloat16), which is the file's doing.
    with translate_read_errors(path, "checkpoint", extra_errors=(TypeError, AttributeError)):
        try:
            with safe_open(path, framework="numpy") as file:
                yield file
        except SafetensorError as error:
            raise NergError(
                f'"{path}" is not a readable safetensors file: {sanitize(error)}; copy it again, or make it anew'
            ) from error


def _check_header(path: Path) -> None:
    with open_file(path, "checkpoint", max_bytes=MAX_CHECKPOINT_BYTES) as file:
        size, header = os.fstat(file.fileno()).st_size, int.from_bytes(file.read(8), "little")
        start = file.read(1)
    if size < 8 or header > size - 8:
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'"{path}" is no checkpoint of a field; name one (.safetensors), as "nerg train" makes it')
        raise NergError(
            f'"{path}" is not a readable safetensors file: its header claims {header:,} bytes and the file has '
            f"{size:,}; copy it again, or make it anew"
        )
    if header > MAX_HEADER_BYTES:
        raise NergError(f'the header of "{path}" has {header:,} bytes, more than the {MAX_HEADER_BYTES:,} that are read')
    if start != b"{":
        raise NergError(f'"{path}" is not a readable safetensors file: its header is no JSON object; copy it again')


def _metadata(file: Any, path: Path, kind: str | None = None) -> dict:
    """What the header says, of a checkpoint of ``kind``; None: of any."""
    raw = (file.metadata() or {}).get("nerg")
    if raw is None:
        raise NergError(
            f'"{path}" is a safetensors file but not a nerg_mi checkpoint (no "nerg" metadata); name one that is'
        )
    metadata = parse_json(raw, path, "checkpoint, in its metadata")
    if not isinstance(metadata, dict):
        raise NergError(f'the metadata of "{path}" are damaged: a JSON object is needed; copy it again')
    if kind is not None and metadata.get("kind") != kind:
        raise NergError(
            f'"{path}" holds a {sanitize(metadata.get("kind"), 40)} field where a {kind} field is needed; '
            "name one of those"
        )
    if metadata.get("format") != FORMAT:
        raise NergError(
            f'"{path}" has checkpoint format {sanitize(metadata.get("format"), 40)}, and this version reads '
            f"format {FORMAT}: use a newer nerg_mi, or train the field anew"
        )
    if not isinstance(metadata.get("provenance", {}), dict):
        raise NergError(f'the metadata of "{path}" are damaged: "provenance" must be a JSON object; copy it again')
    return metadata
