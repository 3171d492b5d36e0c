"""Gaussian splats as ``.splat`` (antimatter15): 32 bytes each, colours that are the same from everywhere."""

from __future__ import annotations

import os

import numpy as np

from nerg_mi.fields.splats import Splats, harmonics_of
from nerg_mi.files.safe_read import open_file

SPLAT_BYTES = 4 << 30
"""A file may have so many bytes."""

_ROW = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
_SPLAT_BLOCK = 1 << 14  # Gaussians that are converted at once


def read_splat(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``, in some 2.4 times the memory of the file; `NergError` for what cannot be such a
    file."""
    with open_file(path, "splat file", "export it again", SPLAT_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        count, rest = divmod(size, _ROW.itemsize)
        if rest:
            raise ValueError(f"its {size:,} bytes are no multiple of {_ROW.itemsize}")
        centers, scales, harmonics = (np.empty((count, *shape), np.float32) for shape in ((3,), (3,), (1, 3)))
        rotations, opacities = np.empty((count, 4), np.float32), np.empty(count, np.float32)
        for at in range(0, count, _SPLAT_BLOCK):
            block = slice(at, min(at + _SPLAT_BLOCK, count))
            rows = np.frombuffer(file.read(_ROW.itemsize * (block.stop - at)), _ROW)
            centers[block], scales[block] = rows["center"], rows["scale"]
            rotations[block] = (rows["rotation"].astype(np.float64) - 128) / 128
            colors = rows["color"] / 255.0
            opacities[block], harmonics[block] = colors[:, 3], harmonics_of(colors[:, :3])
        return Splats(centers, scales, rotations, opacities, harmonics)
