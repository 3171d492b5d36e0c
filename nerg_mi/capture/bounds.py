"""The box around a place that cameras looked at, guessed from the cameras alone."""
from __future__ import annotations

import numpy as np

from ..field.box import Box
from .cameras import Camera

# Cameras whose axes miss their common point by less than this look at one thing.
_CONVERGING = np.radians(30)


def scene_box(cameras: list[Camera], object_only: bool = False) -> tuple[Box, str]:
    """A box in the cameras' coordinates, and a sentence saying how it was found.

    Cameras that look at a common point: a cube around that point, which holds the cameras and as much
    again behind the point as they stand away from it, or, with ``object_only`` (pictures with alpha,
    without background), the region that the frusta share. Other cameras stand inside of what they
    see: the box of their centres, grown on every side by half of its longest edge.
    """
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.axis for c in cameras])
    focus, angle = _focus(centers, axes)
    if len(cameras) >= 2 and np.median(angle) < _CONVERGING:
        distance = np.linalg.norm(centers - focus, axis=1)
        if object_only:
            half = float(np.max(distance * [_half_angle_tangent(c) for c in cameras]))
            return _cube(focus, half), "the region that the views share"
        return _cube(focus, 1.25 * float(distance.max())), "around the point that the cameras look at"
    lower, upper = centers.min(axis=0), centers.max(axis=0)
    margin = 0.5 * float(np.max(upper - lower))
    if margin == 0:
        raise ValueError("all cameras stand at one point, so that no scene box can be guessed; give one with --aabb")
    return Box(tuple(lower - margin), tuple(upper + margin)), "around the cameras"


def _cube(center: np.ndarray, half: float) -> Box:
    return Box(tuple(center - half), tuple(center + half))


def _focus(centers: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point nearest to all viewing axes (least squares), and each camera's angle to it in radians."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Parallel axes have no nearest point; lstsq then returns the one of least norm, at large angles.
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=1e-6)[0]
    to = focus - centers
    length = np.maximum(np.linalg.norm(to, axis=1), 1e-12)
    return focus, np.arccos(np.clip(np.sum(to * axes, axis=1) / length, -1, 1))


def _half_angle_tangent(camera: Camera) -> float:
    i = camera.intrinsics
    return min(i.width / (2 * i.fx), i.height / (2 * i.fy))
