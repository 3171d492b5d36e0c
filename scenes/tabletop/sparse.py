"""COLMAP text model of the photos: cameras, poses, and points as structure from motion would reconstruct them.

Corners of the photos are matched by exact depth where image matching would succeed, and triangulated from their
detected positions. The points therefore have the distribution and errors of a real capture: dense on textured surfaces
seen from all sides, few and uncertain outside, none on uniform surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from nerg_mi.scenes.tabletop.photos import Photo

from nerg_mi.files.atomic import write_text
from nerg_mi.photos.cameras import PosedCamera, project

MAX_CORNERS = 700
"""Maximum number of corners of a photo, the strongest."""
_MIN_CONTRAST = 3e-4  # minimum squared brightness gradient around a corner in its weakest direction
_MAX_PIXEL_DISTANCE = 1.5  # pixels between the projection and a corner of another photo
_MAX_DEPTH_DIFFERENCE = 0.02  # relative difference of distances on the same surface
_MIN_ANGLE = np.radians(1.5)  # as in COLMAP: minimum angle between rays for triangulation
_MAX_ERROR = 4.0  # pixels, as in COLMAP


class SparsePoint(NamedTuple):
    """A triangulated point.

    ``position`` (3,) in metres; ``error`` the mean reprojection error in pixels; ``track`` photos and corner indices.
    """

    position: np.ndarray
    color: np.ndarray
    error: float
    track: list[tuple[int, int]]


def detect_corners(pixels: np.ndarray) -> np.ndarray:
    """Detect the corners of a picture (h, w, 3): pixel coordinates (N, 2), strongest first (Shi and Tomasi 1994)."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    grey = gaussian_filter(np.asarray(pixels, float).mean(axis=-1) / 255, 0.7)
    dy, dx = np.gradient(grey)
    a, b, c = (gaussian_filter(v, 1.5) for v in (dx * dx, dx * dy, dy * dy))
    strength = (a + c) / 2 - np.sqrt(((a - c) / 2) ** 2 + b * b)
    peak = (strength == maximum_filter(strength, 5)) & (strength > _MIN_CONTRAST)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    y, x = np.nonzero(peak)
    order = np.argsort(-strength[y, x], kind="stable")[:MAX_CORNERS]
    y, x = y[order], x[order]
    # sub-pixel peak of the parabola through a pixel and its neighbours
    shift = [
        (lo - hi) / (2 * np.minimum(lo + hi - 2 * strength[y, x], -1e-12))
        for lo, hi in ((strength[y, x - 1], strength[y, x + 1]), (strength[y - 1, x], strength[y + 1, x]))
    ]
    return np.stack([x, y], axis=-1) + 0.5 + np.clip(np.stack(shift, axis=-1), -0.5, 0.5)


def triangulate_points(photos: Sequence[Photo]) -> tuple[list[np.ndarray], list[SparsePoint]]:
    """Return the corners (N, 2) of each photo, and the points triangulated from at least two photos."""
    all_corners = [detect_corners(p.pixels) for p in photos]
    rays = [_make_rays(at, p.camera) for at, p in zip(all_corners, photos)]
    is_used = [np.zeros(len(at), bool) for at in all_corners]
    points = []
    for k, photo in enumerate(photos):
        x, y = all_corners[k].astype(int).T
        depth = photo.depth[y, x]
        matches = _find_matches(photo.camera.center + depth[:, None] * rays[k], photos, all_corners, k)
        for n in np.flatnonzero(depth > 0):
            track = [(k, int(n))] + [(j, int(m[n])) for j, m in matches if m[n] >= 0 and not is_used[j][m[n]]]
            if is_used[k][n] or len(track) < 2:
                continue
            point = _triangulate(track, photos, all_corners, rays, photo.pixels[y[n], x[n]])
            if point is not None:
                points.append(point)
                for j, m in track:
                    is_used[j][m] = True
    return all_corners, points


def _make_rays(at: np.ndarray, camera: PosedCamera) -> np.ndarray:
    """Return unit directions (N, 3) through pixel coordinates (N, 2)."""
    i = camera.intrinsics
    d = np.stack([(at[:, 0] - i.cx) / i.fx, (i.cy - at[:, 1]) / i.fy, -np.ones(len(at))], axis=-1)
    return d / np.linalg.norm(d, axis=1, keepdims=True) @ camera.to_world[:3, :3].T


def _find_matches(positions: np.ndarray, photos: Sequence[Photo], all_corners: list[np.ndarray], photo_index: int):
    """For each other photo: the index of the corner that shows each of ``places`` (N, 3), or -1."""
    from scipy.spatial import cKDTree

    out = []
    for j, photo in enumerate(photos):
        if j == photo_index or not len(all_corners[j]):
            continue
        at, is_visible = project(positions, photo.camera)
        h, w = photo.depth.shape
        is_visible &= np.all((at >= 0) & (at < (w, h)), axis=1)
        distance, nearest = cKDTree(all_corners[j]).query(np.where(is_visible[:, None], at, -100.0))
        x, y = all_corners[j][nearest].astype(int).T
        true_distance = np.linalg.norm(positions - photo.camera.center, axis=1)
        is_same = np.abs(photo.depth[y, x] - true_distance) < _MAX_DEPTH_DIFFERENCE * true_distance
        out.append((j, np.where(is_visible & (distance < _MAX_PIXEL_DISTANCE) & is_same, nearest, -1)))
    return out


def _triangulate(track, photos: Sequence[Photo], all_corners, rays, color) -> SparsePoint | None:
    """Return the point nearest to all rays of a track (least squares); None if COLMAP would reject it."""
    d = np.array([rays[j][m] for j, m in track])
    if (d @ d.T).min() > np.cos(_MIN_ANGLE):
        return None
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    centers = np.array([photos[j].camera.center for j, _ in track])
    position = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centers))
    errors = []
    for j, m in track:
        at, is_visible = project(position[None], photos[j].camera)
        if not is_visible[0]:
            return None
        errors.append(np.linalg.norm(at[0] - all_corners[j][m]))
    error = float(np.mean(errors))
    return SparsePoint(position, color, error, track) if error < _MAX_ERROR else None


def write_colmap(photos: Sequence[Photo], folder: str | Path) -> int:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt`` into ``folder``; returns the number of points."""
    from scipy.spatial.transform import Rotation

    folder = Path(folder)
    all_corners, points = triangulate_points(photos)
    lenses = list(dict.fromkeys(p.camera.intrinsics for p in photos))
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY"]
    lines += [f"{k} PINHOLE {i.width} {i.height} {i.fx} {i.fy} {i.cx} {i.cy}" for k, i in enumerate(lenses, 1)]
    write_text(folder / "cameras.txt", "\n".join([*lines, ""]))

    point_numbers = [np.full(len(at), -1) for at in all_corners]
    for number, point in enumerate(points, 1):
        for j, m in point.track:
            point_numbers[j][m] = number
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# X Y POINT3D_ID of each corner"]
    for k, photo in enumerate(photos):
        # COLMAP's cameras look along +z with y down, and its poses are world-to-camera.
        rotation = (photo.camera.to_world[:3, :3] * [1, -1, -1]).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = (w, x, y, z, *(-rotation @ photo.camera.center))
        numbers = " ".join(f"{v:.12g}" for v in pose)
        lines.append(f"{k + 1} {numbers} {lenses.index(photo.camera.intrinsics) + 1} {photo.name}")
        lines.append(" ".join(f"{u:.2f} {v:.2f} {n}" for (u, v), n in zip(all_corners[k], point_numbers[k])))
    write_text(folder / "images.txt", "\n".join([*lines, ""]))

    lines = ["# POINT3D_ID X Y Z R G B ERROR and, of each photo that shows it, IMAGE_ID POINT2D_IDX"]
    for number, p in enumerate(points, 1):
        position, color = (" ".join(f"{v:.6g}" for v in values) for values in (p.position, p.color))
        track = " ".join(f"{j + 1} {m}" for j, m in p.track)
        lines.append(f"{number} {position} {color} {p.error:.4f} {track}")
    write_text(folder / "points3D.txt", "\n".join([*lines, ""]))
    return len(points)
