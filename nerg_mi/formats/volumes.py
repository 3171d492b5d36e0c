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
# Voxels whose colour is looked for at a time.
_BLOCK = 1 << 18


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
    filled = np.flatnonzero(alpha > _FAINT)
    if len(filled) == 0:
        return density, out, lower, upper
    for start in range(0, len(filled), _BLOCK):
        at = np.stack(np.unravel_index(filled[start : start + _BLOCK], alpha.shape), 1)
        normals = -_slope(alpha, at)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        p = _to_the_surface(sampler, lattice, lattice.points(at[:, ::-1]), normals)
        # Where density is even there is no normal, and any direction will do.
        normals[np.linalg.norm(normals, axis=1) < 0.5] = [0, 0, 1]
        c = sampler.diffuse(p, normals)
        out[tuple(at.T)] = decode_srgb(c) if field.color_space == "srgb" else c
    del filled
    nearest: Any = distance_transform_edt(alpha <= _FAINT, return_distances=False, return_indices=True)
    y, x = np.ogrid[: alpha.shape[1], : alpha.shape[2]]
    for z in range(len(out)):
        layer = out[z]
        squared = (nearest[0, z] - z) ** 2 + (nearest[1, z] - y) ** 2 + (nearest[2, z] - x) ** 2
        near = (squared > 0) & (squared < 2.5**2)
        layer[near] = out[tuple(nearest[:, z][:, near])]
    return density, out, lower, upper


def _slope(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Central differences (N, 3), along x, y and z, of a grid (z, y, x) at the voxels ``at`` (N, 3) of it; one-sided on
    its faces."""
    slopes = []
    for axis in (2, 1, 0):
        before, after = at.copy(), at.copy()
        before[:, axis] = np.maximum(at[:, axis] - 1, 0)
        after[:, axis] = np.minimum(at[:, axis] + 1, values.shape[axis] - 1)
        slopes.append((values[tuple(after.T)] - values[tuple(before.T)]) / (after - before)[:, axis])
    return np.stack(slopes, 1)


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
