"""Gaussian splats as SPZ (Niantic), versions 1 to 3: columns of few bytes each, compressed by gzip.

Axes are the file's: x right, y up, z back, unless its writer was told otherwise.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from nerg_mi.fields.splats import Splats, from_trained, logits_of
from nerg_mi.files.safe_read import open_file, open_gzip, reading

COUNT = 50_000_000
"""A file may hold so many Gaussians."""

_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15


def read_spz(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``; `NergError` for a damaged file and for a later version."""
    with open_file(path, "splat file") as file:
        start = file.read(4)
    convert = f'convert it by: npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
    with reading(path, "splat file", convert):
        if start == struct.pack("<I", _MAGIC):
            raise ValueError("it is SPZ of version 4 or later, and versions 1 to 3 are read")
        with open_gzip(path, "splat file") as stream:
            head = stream.read(16)
            magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", head)
            if magic != _MAGIC or not 1 <= version <= 3 or degree > 3 or fraction > 23 or len(head) < 16:
                raise ValueError("it is no SPZ of version 1 to 3")
            if count > COUNT:
                raise ValueError(f"it announces {count:,} Gaussians, more than the {COUNT:,} that are read")
            more = (degree + 1) ** 2 - 1
            widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * more)
            data = stream.read(count * sum(widths))
        if len(data) < count * sum(widths):
            raise EOFError
        columns, at = [], 0
        for width in widths:
            columns.append(np.frombuffer(data, np.uint8, count * width, at).reshape(count, width))
            at += count * width
        center, alpha, color, scale, rotation, rest = columns
        centers = center.view("<f2").astype(np.float64) if version == 1 else _fixed(center) / (1 << fraction)
        base = (color / 255.0 - 0.5) / _COLOR_SCALE
        shaped = (rest.reshape(count, more, 3) - 128.0) / 128
        harmonics = np.concatenate([base[:, None], shaped], axis=1)
        rotations = _smallest_three(rotation) if version == 3 else _vector_part(rotation)
        return from_trained(centers, scale / 16.0 - 10, rotations, logits_of(alpha[:, 0] / 255.0), harmonics)


def _fixed(data: np.ndarray) -> np.ndarray:
    """Whole numbers (N, 3) of 24 bits with a sign, of their bytes (N, 9)."""
    b = data.reshape(-1, 3, 3).astype(np.int64)
    value = b[..., 0] | b[..., 1] << 8 | b[..., 2] << 16
    return value - ((value >> 23) << 24)


def _vector_part(data: np.ndarray) -> np.ndarray:
    xyz = data / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(data: np.ndarray) -> np.ndarray:
    """Quaternions, w first, of 32 bits each: which of x, y, z, w is the largest, and the others with 10 bits."""
    bits = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    largest = bits >> 30
    xyzw = np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        here = largest != i
        value = np.sqrt(0.5) * (bits & 511) / 511
        xyzw[:, i] = np.where(here, np.where(bits >> 9 & 1, -value, value), 0)
        bits = np.where(here, bits >> 10, bits)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw * xyzw).sum(axis=1)))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return xyzw[:, [3, 0, 1, 2]]
