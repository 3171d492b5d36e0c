"""Tiny scenes and recordings, for tests that repeat an operation thousands of times."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)

SIDE = 24
"""Width and height of a photo in pixels."""
_FOCAL, _RADIUS = 30.0, 0.6
CORNERS = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
"""Corners of the box around the ball."""


def ball_pose(center: np.ndarray) -> np.ndarray:
    """Camera-to-world matrix (4, 4) of a camera at ``center`` that looks at the origin; x right, y up, z backward."""
    z = center / np.linalg.norm(center)
    x = np.cross([0, 0, 1.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), center
    return pose


def ball_photo(pose: np.ndarray) -> np.ndarray:
    """Photo of a ball at the origin, coloured by its normal: (SIDE, SIDE, 4) in 0..1, with alpha 0 outside the ball."""
    v, u = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5, indexing="ij")
    d = np.stack([(u - SIDE / 2) / _FOCAL, (SIDE / 2 - v) / _FOCAL, -np.ones_like(u)], axis=-1)
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)) @ pose[:3, :3].T
    o = pose[:3, 3]
    b, c = d @ o, o @ o - _RADIUS**2
    hit = b * b > c
    t = -b - np.sqrt(np.where(hit, b * b - c, 0))
    color = 0.5 + 0.4 * (o + d * t[..., None]) / _RADIUS
    return np.where(hit[..., None], np.concatenate([color, np.ones_like(t)[..., None]], axis=-1), 0)


def write_photos(folder: Path, count: int = 12) -> Path:
    """Write photos of the ball and their poses (``transforms.json``) to ``folder`` and return the folder."""
    import mitsuba as mi

    folder.mkdir(parents=True, exist_ok=True)
    rng, frames = np.random.default_rng(0), []
    for k in range(count):
        center = rng.normal(size=3) * [1, 1, 0.5]
        pose = ball_pose(2 * center / np.linalg.norm(center))
        mi.Bitmap((255 * ball_photo(pose) + 0.5).astype(np.uint8)).write(str(folder / f"{k:02}.png"))
        frames.append({"file_path": f"{k:02}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": _FOCAL, "fl_y": _FOCAL, "cx": SIDE / 2, "cy": SIDE / 2, "w": SIDE, "h": SIDE}
    (folder / "transforms.json").write_text(json.dumps({**lens, "aabb": CORNERS, "frames": frames}))
    return folder


def simulate_gaze(count: int = 400):
    """Simulate recordings of two participants who walk around and look at one point of the wall x = 1.5."""
    from nerg_mi.tracking.rays import Rays

    rng = np.random.default_rng(0)
    origin = np.stack(
        [rng.uniform(-1.2, 0, count), rng.uniform(-1.2, 1.2, count), rng.uniform(1.5, 1.7, count)], axis=1
    )
    direction = np.array([1.5, 0.4, 1.2]) + rng.normal(0, 0.15, (count, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hit = origin + direction * ((1.5 - origin[:, :1]) / direction[:, :1])
    return Rays(np.arange(count), np.arange(count) % 2, ("a", "b"), origin, direction, np.ones(count), hit)


def write_tracking(path: Path, count: int) -> Path:
    """Write the recordings as a tracker's table; see `MAP`."""
    rays = simulate_gaze(count)
    rows = np.column_stack([rays.t, rays.origin, rays.direction])
    with open(path, "w", encoding="utf-8") as out:
        out.write("t,person,x,y,z,dx,dy,dz\n")
        out.writelines(
            f"{row[0]:g},{person}," + ",".join(f"{v:.6f}" for v in row[1:]) + "\n"
            for row, person in zip(rows, rays.person)
        )
    return path


MAP = "origin=x,y,z direction=dx,dy,dz t=t person=person"
"""The column map of tables written by `write_tracking`."""
