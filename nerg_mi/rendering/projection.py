"""Where a point of a scene lies in a camera's picture, and how near and far the camera sees."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.maths.types import Point3f, variant_types


def clip_distances(extent: float, unit: float = 1.0) -> tuple[float, float]:
    """Distances at which a camera begins and ends to see, in scene units: a centimetre and ten kilometres, and nearer
    and farther where the scene is smaller or larger than what people are in, or in other units.

    ``extent``: diagonal of a box around the scene and the camera; ``unit``: scene units of a metre. Of traced rays the
    ratio of both costs no precision.
    """
    return min(0.01 * unit, 3e-3 * extent), max(1e4 * unit, 100 * extent)


def pixel_of(camera: Any, point: Point3f) -> tuple[float, float] | None:
    """Where ``point`` (one lane, scene units) lies in the picture of the perspective ``camera``: (x, y) in pixels,
    counted from the first one's centre; None outside of it, and behind the camera."""
    mi = variant_types()
    film = camera.film()
    fov = mi.traverse(camera)["x_fov"]
    local = camera.world_transform().inverse() @ point
    clip = camera.near_clip(), camera.far_clip()
    screen = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), fov, *clip)
    x, y, _ = (float(v[0]) for v in np.array(screen @ local).reshape(3, -1))
    depth = float(np.array(local).reshape(3, -1)[2, 0])
    if depth <= 0 or not (0 < x < 1 and 0 < y < 1):
        return None
    width, height = film.crop_size()
    return x * width - 0.5, y * height - 0.5
