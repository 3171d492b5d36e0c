"""A COLMAP text model of the photos: cameras, poses, and the points that structure from motion would have found.

Corners of the photos are matched by the exact depth where matching by looks would find them, and triangulated from
their own places in the photos. So points lie where a capture has them, and err as it does: close together on what is
textured and seen from all sides, few and uncertain outside, none where everything is of one colour.
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
"""Corners of a photo at most, the strongest."""
_CONTRAST = 3e-4  # least change of brightness about a corner, in its direction of least change, squared
_NEAR = 1.5  # pixels between a corner and where another photo's corner is to be seen
_SAME = 0.02  # distances that differ by less, as a share, are of one surface
_LEAST_ANGLE = np.radians(1.5)  # as COLMAP has it: of rays that meet at flatter angles no point is made
_MOST_ERROR = 4.0  # pixels, as COLMAP has it


class SparsePoint(NamedTuple):
    """``place`` (3,) in metres; ``error``: mean distance in pixels; ``track``: photos and corners in them."""

    position: np.ndarray
    color: np.ndarray
    error: float
    track: list[tuple[int, int]]


def detect_corners(pixels: np.ndarray) -> np.ndarray:
    """Pixel coordinates (N, 2) of the corners of a picture (h, w, 3), strongest first (Shi and Tomasi 1994)."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    grey = gaussian_filter(np.asarray(pixels, float).mean(axis=-1) / 255, 0.7)
    dy, dx = np.gradient(grey)
    a, b, c = (gaussian_filter(v, 1.5) for v in (dx * dx, dx * dy, dy * dy))
    strength = (a + c) / 2 - np.sqrt(((a - c) / 2) ** 2 + b * b)
    peak = (strength == maximum_filter(strength, 5)) & (strength > _CONTRAST)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    y, x = np.nonzero(peak)
    order = np.argsort(-strength[y, x], kind="stable")[:MAX_CORNERS]
    y, x = y[order], x[order]
    # the peak of the parabola through a pixel and its neighbours
    shift = [
        (lo - hi) / (2 * np.minimum(lo + hi - 2 * strength[y, x], -1e-12))
        for lo, hi in ((strength[y, x - 1], strength[y, x + 1]), (strength[y - 1, x], strength[y + 1, x]))
    ]
    return np.stack([x, y], axis=-1) + 0.5 + np.clip(np.stack(shift, axis=-1), -0.5, 0.5)


def triangulate_points(photos: Sequence[Photo]) -> tuple[list[np.ndarray], list[SparsePoint]]:
    """The corners (N, 2) of each photo, and the points that at least two photos triangulate."""
    found = [detect_corners(p.pixels) for p in photos]
    rays = [_rays(at, p.camera) for at, p in zip(found, photos)]
    taken = [np.zeros(len(at), bool) for at in found]
    points = []
    for k, photo in enumerate(photos):
        x, y = found[k].astype(int).T
        depth = photo.depth[y, x]
        matches = _matches(photo.camera.center + depth[:, None] * rays[k], photos, found, k)
        for n in np.flatnonzero(depth > 0):
            track = [(k, int(n))] + [(j, int(m[n])) for j, m in matches if m[n] >= 0 and not taken[j][m[n]]]
            if taken[k][n] or len(track) < 2:
                continue
            point = _triangulate(track, photos, found, rays, photo.pixels[y[n], x[n]])
            if point is not None:
                points.append(point)
                for j, m in track:
                    taken[j][m] = True
    return found, points


def _rays(at: np.ndarray, camera: PosedCamera) -> np.ndarray:
    """Unit directions (N, 3) through pixel coordinates (N, 2)."""
    i = camera.intrinsics
    d = np.stack([(at[:, 0] - i.cx) / i.fx, (i.cy - at[:, 1]) / i.fy, -np.ones(len(at))], axis=-1)
    return d / np.linalg.norm(d, axis=1, keepdims=True) @ camera.to_world[:3, :3].T


def _matches(places: np.ndarray, photos: Sequence[Photo], found: list[np.ndarray], own: int):
    """For each other photo: of each of ``places`` (N, 3) the number of the corner that shows it, -1 for none."""
    from scipy.spatial import cKDTree

    out = []
    for j, photo in enumerate(photos):
        if j == own or not len(found[j]):
            continue
        at, shown = project(places, photo.camera)
        h, w = photo.depth.shape
        shown &= np.all((at >= 0) & (at < (w, h)), axis=1)
        distance, nearest = cKDTree(found[j]).query(np.where(shown[:, None], at, -100.0))
        x, y = found[j][nearest].astype(int).T
        there = np.linalg.norm(places - photo.camera.center, axis=1)
        same = np.abs(photo.depth[y, x] - there) < _SAME * there
        out.append((j, np.where(shown & (distance < _NEAR) & same, nearest, -1)))
    return out


def _triangulate(track, photos: Sequence[Photo], found, rays, color) -> SparsePoint | None:
    """The point nearest to all rays of a track (least squares); None where COLMAP would leave it out."""
    d = np.array([rays[j][m] for j, m in track])
    if (d @ d.T).min() > np.cos(_LEAST_ANGLE):
        return None
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    centers = np.array([photos[j].camera.center for j, _ in track])
    place = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centers))
    errors = []
    for j, m in track:
        at, shown = project(place[None], photos[j].camera)
        if not shown[0]:
            return None
        errors.append(np.linalg.norm(at[0] - found[j][m]))
    error = float(np.mean(errors))
    return SparsePoint(place, color, error, track) if error < _MOST_ERROR else None


def write_colmap(photos: Sequence[Photo], folder: str | Path) -> int:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt`` into ``folder``; returns the number of points."""
    from scipy.spatial.transform import Rotation

    folder = Path(folder)
    found, points = triangulate_points(photos)
    lenses = list(dict.fromkeys(p.camera.intrinsics for p in photos))
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY"]
    lines += [f"{k} PINHOLE {i.width} {i.height} {i.fx} {i.fy} {i.cx} {i.cy}" for k, i in enumerate(lenses, 1)]
    write_text(folder / "cameras.txt", "\n".join([*lines, ""]))

    shows = [np.full(len(at), -1) for at in found]
    for number, point in enumerate(points, 1):
        for j, m in point.track:
            shows[j][m] = number
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# X Y POINT3D_ID of each corner"]
    for k, photo in enumerate(photos):
        # COLMAP's cameras look along +z with y down, and it states the way from the world to them.
        rotation = (photo.camera.to_world[:3, :3] * [1, -1, -1]).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = (w, x, y, z, *(-rotation @ photo.camera.center))
        numbers = " ".join(f"{v:.12g}" for v in pose)
        lines.append(f"{k + 1} {numbers} {lenses.index(photo.camera.intrinsics) + 1} {photo.name}")
        lines.append(" ".join(f"{u:.2f} {v:.2f} {n}" for (u, v), n in zip(found[k], shows[k])))
    write_text(folder / "images.txt", "\n".join([*lines, ""]))

    lines = ["# POINT3D_ID X Y Z R G B ERROR and, of each photo that shows it, IMAGE_ID POINT2D_IDX"]
    for number, p in enumerate(points, 1):
        place, color = (" ".join(f"{v:.6g}" for v in values) for values in (p.position, p.color))
        track = " ".join(f"{j + 1} {m}" for j, m in p.track)
        lines.append(f"{number} {place} {color} {p.error:.4f} {track}")
    write_text(folder / "points3D.txt", "\n".join([*lines, ""]))
    return len(points)
