"""Gaussian splats of a radiance field: flat ones on the surface that rays meet.

No training: where a lattice crosses the field's surface a Gaussian is laid along it, as wide as its neighbours are far,
in the colour that the field has there from in front. Depths are then those of the field to a fraction of a cell.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.splats import Splats, harmonics_of, quaternions_of
from nerg_mi.formats.surfaces import points
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth

WIDTH = 0.7
"""Standard deviation along the surface, in distances to the nearest neighbours: one more widely smears colours, one
less leaves gaps."""

_THIN, _OPACITY = 0.1, 0.9
_NEIGHBORS, _NEAREST = 12, 4


def splats_of_field(
    field: RadianceField, resolution: int = 256, threshold: float | None = None
) -> tuple[Splats, dict[str, float]]:
    """Gaussians in the field's own frame, and what was done: ``cell`` of the lattice and ``moved``, the median distance
    by which Gaussians were moved to the depth that rays find, both in the field's units.

    ``resolution``: cells along the longest edge; ``threshold``: density at which the surface lies (default: that of
    ``points``). Raises `NergError` where there is none.
    """
    surface = points(field, resolution, threshold)
    cell = surface.report["cell"]
    p, normals = surface.vertices, surface.normals
    lost = np.linalg.norm(normals, axis=1) < 0.5
    normals[lost] = (0, 0, 1)
    spacing, normals = _laid_flat(p, normals)
    # A ray against the normal, from a cell in front: it meets the surface at about that distance.
    depth, opacity = trace_depth(FieldMedium(field), (p + cell * normals), -normals)
    met = (opacity >= 0.5) & (depth < 2 * cell)
    shift = np.where(met, cell - depth, 0)
    p = p + shift[:, None] * normals
    wide = WIDTH * np.clip(spacing, 0.25 * cell, 2 * cell)
    scales = np.stack([wide, wide, _THIN * wide / WIDTH], axis=1)
    opacities = np.full(len(p), _OPACITY)
    splats = Splats(p, scales, quaternions_of(_frames(normals)), opacities, harmonics_of(surface.colors))
    return splats, {"cell": float(cell), "moved": float(np.median(np.abs(shift)))}


def _laid_flat(p: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each point's nearest neighbours, and the mean normals of all around it that face its way."""
    from scipy.spatial import KDTree

    count = min(_NEIGHBORS + 1, len(p))
    apart, near = (v.reshape(len(p), -1) for v in KDTree(p).query(p, k=count))
    for _ in range(2):
        alike = np.clip(np.einsum("nkc,nc->nk", normals[near], normals), 0, 1) ** 4
        total = np.einsum("nk,nkc->nc", alike, normals[near])
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    if count == 1:
        return np.full(len(p), np.inf), normals
    return np.median(apart[:, 1 : _NEAREST + 1], axis=1), normals


def _frames(normals: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) whose third axis is the normal."""
    aside = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=2)
