"""A radiance field as Mitsuba grid volumes (``gridvolume``): density and colour in voxels."""
from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..field.extraction import Lattice, Sampler
from ..field.radiance import RadianceField


def write_volume(path: str | Path, data: np.ndarray, lower, upper) -> None:
    """Mitsuba's .vol format, version 3: ``data`` (z, y, x) or (z, y, x, channels) as float32, and the box it fills."""
    data = np.asarray(data, "<f4")
    data = data[..., None] if data.ndim == 3 else data
    nz, ny, nx, channels = data.shape
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, nx, ny, nz, channels, *map(float, lower), *map(float, upper))
    path.write_bytes(head + np.ascontiguousarray(data).tobytes())


def density_and_color(field: RadianceField, resolution: int = 256, color: bool = True, samples: int = 2):
    """``(density (z, y, x), colour (z, y, x, 3) or None, lower, upper)`` of voxels, ``resolution`` along the longest edge.

    Density is the mean over ``samples``³ points of each voxel, in 1/unit. Colour is linear, the mean over six directions:
    a grid has no view. It stands in voxels with density and, as interpolation reaches there, in their neighbours.
    """
    from scipy.ndimage import binary_dilation

    sampler, lattice = Sampler(field), Lattice.over(field, resolution)
    density = sampler.on(lattice, samples)
    lower = np.array(lattice.lower)
    upper = lower + np.array(lattice.shape) * lattice.step
    if not color:
        return density, None, lower, upper
    z, y, x = np.nonzero(binary_dilation(density > 0, np.ones((3, 3, 3), bool)))
    p = lattice.points(np.stack([x, y, z], 1))
    total = np.zeros((len(p), 3), np.float32)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            total += sampler.color(p, np.broadcast_to(sign * np.eye(3)[axis], p.shape)) / 6
    if field.color_space == "srgb":
        total = np.where(total <= 0.04045, total / 12.92, ((np.maximum(total, 0.04045) + 0.055) / 1.055) ** 2.4)
    out = np.zeros((*density.shape, 3), np.float32)
    out[z, y, x] = total
    return density, out, lower, upper
