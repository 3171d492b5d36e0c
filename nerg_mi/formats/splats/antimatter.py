"""Gaussian splats as ``.splat`` (antimatter15): 32 bytes each, colours that are the same from everywhere."""

from __future__ import annotations

import os

import numpy as np

from nerg_mi.fields.splats import Splats, harmonics_of
from nerg_mi.files.bounded import read_bytes, reading

SPLAT_BYTES = 4 << 30
"""A file may have so many bytes."""

_ROW = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def read_splat(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``; `NergError` for what cannot be such a file."""
    raw = read_bytes(path, "splat file", SPLAT_BYTES)
    with reading(path, "splat file", "export it again"):
        if len(raw) % _ROW.itemsize:
            raise ValueError(f"its {len(raw):,} bytes are no multiple of {_ROW.itemsize}")
        rows = np.frombuffer(raw, _ROW)
        rotations = (rows["rotation"].astype(np.float64) - 128) / 128
        colors = rows["color"] / 255.0
        return Splats(rows["center"], rows["scale"], rotations, colors[:, 3], harmonics_of(colors[:, :3]))
