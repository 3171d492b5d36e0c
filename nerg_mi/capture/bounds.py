"""The box around a place that cameras looked at: from points on its surfaces, or from the cameras alone."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.box import Box
from nerg_mi.maths.ray_box import box_interval

from . import lens
from .cameras import Camera, project

# Cameras whose axes miss their common point by less than this look at one thing.
_CONVERGING = np.radians(30)
# So few points, or so many beyond either end of an axis, are no evidence of where a place ends.
_MIN_POINTS, _OUTLIERS = 100, 0.005
# Of the points' longest edge, for what lies between them and the wall that they are on.
_MARGIN = 0.05


def scene_box(cameras: list[Camera], object_only: bool = False, points: np.ndarray | None = None) -> tuple[Box, str]:
    """A box in the cameras' coordinates, and a sentence saying how it was found.

    ``points`` (N, 3) on surfaces: the box that holds all of them but half a percent beyond each end, with a
    margin; cameras that stand around something also bound it, as below, because points may lie far behind it. Without
    points, cameras that look at a common point: a cube around that point, which holds the cameras and as much
    again behind the point as they stand away from it, or, with ``object_only`` (pictures with alpha,
    without background), the region that the frusta share. Other cameras stand inside of what they
    see: the box of their centres, grown on every side by half of its longest edge.
    """
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.axis for c in cameras])
    focus, angle = _focus(centers, axes)
    around = None
    if len(cameras) >= 2 and np.median(angle) < _CONVERGING:
        distance = np.linalg.norm(centers - focus, axis=1)
        if object_only:
            half = float(np.max(distance * [_half_angle_tangent(c) for c in cameras]))
            around = focus - half, focus + half, "the region that the views share"
        else:
            half = 1.25 * float(distance.max())
            around = focus - half, focus + half, "around the point that the cameras look at"
    if points is not None and len(points) >= _MIN_POINTS:
        lower, upper = np.quantile(points, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
        margin = _MARGIN * float(np.max(upper - lower))
        lower, upper = lower - margin, upper + margin
        if around is not None:
            lower, upper = np.maximum(lower, around[0]), np.minimum(upper, around[1])
        if np.all(upper > lower):
            return Box(tuple(lower), tuple(upper)), f"around {len(points)} points on surfaces"
    if around is not None:
        return Box(tuple(around[0]), tuple(around[1])), around[2]
    lower, upper = centers.min(axis=0), centers.max(axis=0)
    margin = 0.5 * float(np.max(upper - lower))
    if margin == 0:
        raise NergError("all cameras stand at one point, so that no scene box can be guessed; give one with --aabb")
    return Box(tuple(lower - margin), tuple(upper + margin)), "around the cameras"


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


def unmatched(cameras: list[Camera], box: Box, grid: int = 4, depths: int = 12) -> list[int]:
    """Cameras that share nothing within ``box`` with any other: no sample point of their pictures is in another's.

    ``grid`` by ``grid`` pixels of each are followed through the box and looked for at ``depths`` places.
    """
    centers = np.array([c.center for c in cameras])
    order = np.arange(len(cameras))
    out = []
    for k, camera in enumerate(cameras):
        p = _samples(camera, box, grid, depths)
        # Neighbours first: one that sees a point ends the search.
        others = order[np.argsort(np.linalg.norm(centers - centers[k], axis=1), kind="stable")]
        if not any(_sees(cameras[j], p) for j in others if j != k):
            out.append(k)
    return out


def _samples(camera: Camera, box: Box, grid: int, depths: int) -> np.ndarray:
    """Points (N, 3) within the box on rays of the picture."""
    i = camera.intrinsics
    u, v = np.meshgrid((np.arange(grid) + 0.5) / grid * i.width, (np.arange(grid) + 0.5) / grid * i.height)
    d = lens.rays(np.stack([(u.ravel() - i.cx) / i.fx, (v.ravel() - i.cy) / i.fy], axis=-1), i) * [1, -1, -1]
    d = d @ camera.to_world[:3, :3].T
    near, far = box_interval(camera.center, d, box.lower, box.upper)
    near = np.maximum(near, 0)
    hit = far > near
    t = near[hit, None] + (far - near)[hit, None] * (np.arange(depths) + 0.5) / depths
    return (camera.center + t[..., None] * d[hit, None]).reshape(-1, 3)


def _sees(camera: Camera, points: np.ndarray) -> bool:
    if not len(points):
        return False
    at, shown = project(points, camera)
    i = camera.intrinsics
    return bool(np.any(shown & np.all((at >= 0) & (at <= [i.width, i.height]), axis=1)))
