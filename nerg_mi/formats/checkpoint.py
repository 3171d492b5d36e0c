"""Our own checkpoints: safetensors with JSON metadata. Nothing in them runs code.

Metadata is one JSON object under the key ``nerg``: the kind of field, its
architecture, units, bounding box, colour space and provenance.
"""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from .atomic import write_bytes

FORMAT = 1


def write_checkpoint(path: str | Path, kind: str, tensors: dict[str, np.ndarray], metadata: dict) -> None:
    """Write ``tensors`` (contiguous arrays) and ``metadata`` (JSON) atomically.

    A reader sees the old file or the new one, never half of it.
    """
    from safetensors.numpy import save

    header = {"nerg": json.dumps({"format": FORMAT, "kind": kind, **metadata}, allow_nan=False)}
    data = save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata=header)
    write_bytes(path, data)


def _parse(raw: str, path: Path) -> dict:
    try:
        metadata = json.loads(raw)
    except json.JSONDecodeError as e:
        raise ValueError(f'the metadata of "{path}" are damaged: {e}') from e
    if not isinstance(metadata, dict):
        raise ValueError(f'the metadata of "{path}" are damaged: a JSON object is needed')
    return metadata


def read_checkpoint(path: str | Path, kind: str) -> tuple[dict[str, np.ndarray], dict]:
    """Tensors and metadata of a checkpoint of ``kind``.

    Raises ``FileNotFoundError`` when there is no such file and ``ValueError`` when it is not
    such a checkpoint.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f'the checkpoint "{path}" does not exist: correct its name, or make one with "nerg train"')
    try:
        with safe_open(path, framework="numpy") as f:
            raw = (f.metadata() or {}).get("nerg")
            if raw is None:
                raise ValueError(f'"{path}" is a safetensors file but not a nerg_mi checkpoint (no "nerg" metadata)')
            metadata = _parse(raw, path)
            if metadata.get("kind") != kind:
                raise ValueError(f'"{path}" holds a {metadata.get("kind")} field where a {kind} field is needed')
            if metadata.get("format") != FORMAT:
                raise ValueError(
                    f'"{path}" has checkpoint format {metadata.get("format")}; this version reads format {FORMAT}'
                )
            return {k: f.get_tensor(k) for k in f.keys()}, metadata
    except SafetensorError as e:
        raise ValueError(f'"{path}" is not a readable safetensors file: {e}') from e
