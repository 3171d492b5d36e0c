"""A radiance field as Mitsuba grid volumes (``gridvolume``): density and colour in voxels."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.fields.extraction import Lattice, Sampler, surface_density
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import write_bytes
from nerg_mi.maths.color import decode_srgb

# Optical depth of a voxel at most, and the opacity from which on it has a colour.
_DEEPEST, _FAINT = 5.0, 1e-3


def write_volume(path: str | Path, data: np.ndarray, lower, upper) -> None:
    """Mitsuba's .vol format, version 3: ``data`` (z, y, x) or (z, y, x, channels) as float32, and the box it fills.

    A ``gridvolume`` with ``use_grid_bbox`` set to true reads it, and fills that box.
    """
    data = np.asarray(data, "<f4")
    data = data[..., None] if data.ndim == 3 else data
    nz, ny, nx, channels = data.shape
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, nx, ny, nz, channels, *map(float, lower), *map(float, upper))
    write_bytes(path, head, np.ascontiguousarray(data).data)


def density_and_color(field: RadianceField, resolution: int = 256, color: bool = True, samples: int = 2):
    """``(density (z, y, x), colour (z, y, x, 3) or None, lower, upper)`` of voxels, ``resolution`` along the longest
    edge.

    Density, in 1/unit, is what gives a voxel the mean opacity of its ``samples``³ points, at most 5 mean free paths a
    voxel: interpolation would blow up surfaces further. Colour is linear and that of the surface in or before the
    voxel, seen head on and at 45 degrees, for a grid has no view; voxels about the dense ones have their neighbour's.
    """
    from scipy.ndimage import distance_transform_edt

    sampler, lattice = Sampler(field), Lattice.over(field, resolution)
    alpha = sampler.opacity_on(lattice, samples)
    density = -np.log(np.maximum(1 - alpha, math.exp(-_DEEPEST))) / lattice.step
    lower = np.array(lattice.lower)
    upper = lower + np.array(lattice.shape) * lattice.step
    if not color:
        return density, None, lower, upper
    out = np.zeros((*density.shape, 3), np.float32)
    z, y, x = np.nonzero(alpha > _FAINT)
    if len(z) == 0:
        return density, out, lower, upper
    slope = np.stack([-np.gradient(alpha, axis=axis)[z, y, x] for axis in (2, 1, 0)], 1)
    normals = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    p = _to_the_surface(sampler, lattice, lattice.points(np.stack([x, y, z], 1)), normals)
    # Where density is even there is no normal, and any direction will do.
    normals[np.linalg.norm(normals, axis=1) < 0.5] = [0, 0, 1]
    c = sampler.diffuse(p, normals)
    if field.color_space == "srgb":
        c = decode_srgb(c)
    out[z, y, x] = c
    found: Any = distance_transform_edt(alpha <= _FAINT, return_indices=True)
    away, nearest = found
    return density, np.where((away < 2.5)[..., None], out[tuple(nearest)], 0), lower, upper


def _to_the_surface(sampler: Sampler, lattice: Lattice, p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Points moved out of (or into) the matter along ``normals`` to where it begins, if that is within two voxels."""
    threshold, reach = surface_density(lattice), 2 * lattice.step
    dense = sampler.density(p) >= threshold
    far = reach * np.where(dense, 1.0, -1.0)
    crosses = dense != (sampler.density(p + far[:, None] * normals) >= threshold)
    a, b = np.zeros(len(p)), far
    for _ in range(8):
        middle = 0.5 * (a + b)
        same = (sampler.density(p + middle[:, None] * normals) >= threshold) == dense
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    # The side that is matter.
    return p + (np.where(crosses, np.where(dense, a, b), 0))[:, None] * normals
