"""A place as some ten thousand points that a browser draws by itself, with the gaze of observers baked into them.

Points are what panoramas from several eyes show, one a small cube. All lengths are scene units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.figures.overlay import srgb, to_bytes
from nerg_mi.rendering.channels import render_channels

GazeAt = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""``(observer (3,), points (V, 3), spacing) -> (V,)``: gaze in 1/sr after occlusion, of points known to ``spacing``."""

# What is farther away than so many times the usual distance is left out: a sky, a glance through a window.
_FAR = 5.0
# Cubes along the longest edge of the place, to begin with.
_FINE = 320


@dataclass(frozen=True, eq=False)
class Proxy:
    """``vertices`` (V, 3) float32; ``normals`` (V, 3) unit, towards where they were seen from; ``colors`` (V, 3) uint8
    sRGB; ``gaze`` (M, V) in 1/sr of M observers; ``spacing``: edge of the cube that a point stands for."""

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    gaze: np.ndarray
    spacing: float


def place_proxy(
    scene: Any,
    eyes: np.ndarray,
    up: np.ndarray,
    observers: np.ndarray,
    gaze: GazeAt,
    most: int = 80_000,
    size: tuple[int, int] = (320, 160),
    on_eye: Callable[[int, int], None] | None = None,
) -> Proxy | None:
    """What panoramas of ``size`` from ``eyes`` (K, 3) show of ``scene`` (`mi.Scene`), as ``most`` points at most.

    The scene's integrator is ``nerg`` with the AOVs opacity and position. ``up`` (3,): up axis of the panoramas.
    ``observers`` (M, 3): whose ``gaze`` is baked. ``on_eye`` is told the panoramas done, and of how many. None where
    there is no surface.
    """
    parts = []
    for number, eye in enumerate(eyes):
        parts.append(_panorama(scene, np.asarray(eye, float), np.asarray(up, float), size))
        if on_eye is not None:
            on_eye(number + 1, len(eyes))
    points, normals, facing, colors, distance = (np.concatenate(columns) for columns in zip(*parts))
    if not len(points):
        return None
    near = distance <= _FAR * np.median(distance)
    values = np.concatenate([colors, facing], axis=1)
    points, values, spacing = thin(points[near], normals[near], values[near], most)
    colors, normals = values[:, :3], smooth_normals(points, values[:, 3:])
    baked = [gaze(np.asarray(observer, float), points, spacing) for observer in observers]
    heat = np.stack(baked).astype(np.float32) if baked else np.zeros((0, len(points)), np.float32)
    return Proxy(points.astype(np.float32), normals.astype(np.float32), to_bytes(srgb(colors)), heat, spacing)


def thin(
    points: np.ndarray, normals: np.ndarray, values: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """The means of ``points`` (N, 3) and of their ``values`` (N, C) in each of at most ``most`` cubes, and the cubes'
    edge. Surfaces whose ``normals`` face opposite ways are kept apart, as the two sides of a thin wall are."""
    edge = float(np.ptp(points, axis=0).max()) / _FINE or 1.0
    side = np.argmax(np.abs(normals), axis=1)
    facing = 2 * side + (np.take_along_axis(normals, side[:, None], axis=1)[:, 0] > 0)
    while True:
        cell = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
        key = np.ravel_multi_index((*cell.T, facing), (*(cell.max(axis=0) + 1), 6))
        _, which, count = np.unique(key, return_inverse=True, return_counts=True)
        if len(count) <= most:
            break
        edge *= 1.1
    mean = lambda v: np.stack([np.bincount(which, weights=c) for c in v.T], axis=1) / count[:, None]
    return mean(points), mean(values), edge


def smooth_normals(points: np.ndarray, towards: np.ndarray, count: int = 12) -> np.ndarray:
    """Unit normals (N, 3) of the surface through ``points`` (N, 3), on the side of ``towards`` (N, 3): of the plane
    that lies nearest to each one's ``count`` nearest neighbours (its covariance's least axis). ``towards`` itself for
    fewer than three points."""
    from scipy.spatial import KDTree

    facing = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    count = min(count, len(points))
    if count < 3:
        return facing
    near = points[KDTree(points).query(points, k=count)[1]]
    apart = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
    return np.where((normals * facing).sum(axis=1, keepdims=True) < 0, -normals, normals)


def _panorama(
    scene: Any, eye: np.ndarray, up: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, directions to the eye, linear colours, (N, 3) each, and distances (N,) of what is met around
    ``eye``."""
    import mitsuba as mi

    level = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    look = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=(eye + level).tolist(), up=up.tolist())
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    film |= {"component_format": "float32", "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "panorama", "to_world": look, "film": film})
    found = render_channels(scene, sensor, spp=1)
    points = np.stack([found.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    met = found.mask & np.isfinite(points).all(axis=-1)
    away = eye - points
    distance = np.linalg.norm(away, axis=-1)
    met &= distance > 0
    normals = surface_normals(np.where(met[..., None], points, np.nan), away)
    facing = away[met] / distance[met][:, None]
    return points[met], normals[met], facing, np.array(found.color, np.float64)[met], distance[met]


def surface_normals(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) of the surface through a picture of ``points`` (h, w, 3), on the side of ``towards`` (h,
    w, 3); where neighbours tell of none, ``towards`` itself. Of the two neighbours along a row or column the nearer
    one counts, so that an edge does not lean over what is behind it."""
    along = lambda axis: _nearer_step(points, axis)
    normals = np.cross(along(0), along(1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    facing = towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)
    known = np.isfinite(length) & (length > 1e-12)
    normals = np.where(known, normals / np.where(known, length, 1), facing)
    return np.where((normals * facing).sum(axis=-1, keepdims=True) < 0, -normals, normals)


def _nearer_step(points: np.ndarray, axis: int) -> np.ndarray:
    """From each point to that of its two neighbours along ``axis`` which is nearer, forwards; rows end, columns go
    around."""
    forward = np.roll(points, -1, axis) - points
    backward = points - np.roll(points, 1, axis)
    if axis == 0:
        forward[-1], backward[0] = np.nan, np.nan
    far = lambda step: np.nan_to_num(np.linalg.norm(step, axis=-1, keepdims=True), nan=np.inf)
    return np.where(far(forward) <= far(backward), forward, backward)


def spread_out(points: np.ndarray, count: int, first: np.ndarray | None = None) -> np.ndarray:
    """Indices of up to ``count`` of ``points`` (N, 3), each the farthest from those before; the first one is the
    farthest from ``first`` (K, 3), or number 0."""
    if not len(points):
        return np.zeros(0, int)
    away = np.full(len(points), np.inf)
    if first is not None:
        away = np.linalg.norm(points[:, None] - np.atleast_2d(first)[None], axis=2).min(axis=1)
    chosen: list[int] = []
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(away)) if chosen or first is not None else 0)
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if away.max() <= 0:
            break
    return np.array(chosen, int)
