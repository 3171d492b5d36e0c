"""Where a point of a scene lies in a camera's picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.maths.types import Float, Point3f


def pixel_of(camera: Any, point: Point3f) -> tuple[float, float] | None:
    """Where ``point`` (one lane, scene units) lies in the picture of the perspective ``camera``: (x, y) in pixels,
    counted from the first one's centre; None outside of it, and behind the camera."""
    import mitsuba as mi

    film = camera.film()
    fov: Float = mi.traverse(camera)["x_fov"]
    local = camera.world_transform().inverse() @ point
    clip = camera.near_clip(), camera.far_clip()
    screen = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), fov, *clip)
    x, y, _ = (float(v[0]) for v in np.array(screen @ local).reshape(3, -1))
    depth = float(np.array(local).reshape(3, -1)[2, 0])
    if depth <= 0 or not (0 < x < 1 and 0 < y < 1):
        return None
    width, height = film.crop_size()
    return x * width - 0.5, y * height - 0.5
