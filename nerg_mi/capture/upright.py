"""Which way is up, by what photographers do and what places have.

People hold cameras level: the horizontal axes of their pictures lie in one plane, whose normal is the vertical, however
far a camera looks down. Places have a floor, or a table, which most things stand on: a plane of many points, below the
cameras, whose normal is the vertical too, and by far the more exact one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# How much the mean of the pictures' own up counts where their horizontal axes leave the vertical open.
_MEAN = 0.005
# Rolls beyond this sine count less and less (an L1 fit).
_LEVEL = 0.02
# A plane is looked for by so many triples of points; its normal may be so far from the cameras' up.
_TRIPLES, _TILT = 20_000, np.cos(np.radians(20.0))
# So thick is a plane, as a share of the points' median distance from their median; so many of the points it must hold.
_THICK, _SHARE = 0.02, 0.10
_POINTS = 4000
# Cameras that are held at larger angles than this, at the median, do not tell what is up.
_SURE = 10.0


@dataclass(frozen=True)
class Up:
    """``direction``: (3,) unit vector. ``roll``: median angle in degrees by which the horizontal axes of the pictures
    are off the horizon; ``plane``: share of the points on a plane that is level, None where there is none;
    ``between``: degrees between the plane's normal and what the cameras say."""

    direction: np.ndarray
    roll: float
    plane: float | None = None
    between: float | None = None

    @property
    def sure(self) -> bool:
        """Whether the cameras agree."""
        return self.roll <= _SURE

    def __str__(self) -> str:
        cameras = f"the cameras are held level to {self.roll:.1f} degrees (median)"
        if self.plane is None:
            return f"{cameras}; no plane of the points is level"
        return f"{cameras}, and a plane of {self.plane:.0%} of the points is {self.between:.1f} degrees from their up"


def find_up(to_world: np.ndarray, points: np.ndarray) -> Up:
    """Up in the coordinates of OpenGL camera-to-world poses (N, 4, 4) and of ``points`` (M, 3) on surfaces."""
    rights, tops, centers = to_world[:, :3, 0], to_world[:, :3, 1], to_world[:, :3, 3]
    by_cameras = _level(rights, tops)
    roll = float(np.degrees(np.median(np.arcsin(np.clip(np.abs(rights @ by_cameras), 0, 1)))))
    found = _plane(points, centers, by_cameras) if len(points) >= 100 else None
    if found is None:
        return Up(by_cameras, roll)
    normal, share = found
    between = float(np.degrees(np.arccos(np.clip(normal @ by_cameras, -1, 1))))
    return Up(normal, roll, share, between)


def turn_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that takes the unit vector ``up`` to +z."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()


def _level(rights: np.ndarray, tops: np.ndarray) -> np.ndarray:
    """The direction to which most horizontal axes are perpendicular, on the side of the pictures' tops."""
    mean = tops[0] * 0.0
    weights = np.ones(len(tops))
    for _ in range(20):
        mean = weights @ tops
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        weights = 1 / np.maximum(np.linalg.norm(tops - mean, axis=1), _LEVEL)
    up = mean
    for _ in range(20):
        weights = 1 / np.maximum(np.abs(rights @ up), _LEVEL)
        spread = (rights * weights[:, None]).T @ rights / weights.sum()
        vectors = np.linalg.eigh(spread + _MEAN * (np.eye(3) - np.outer(mean, mean)))[1]
        up = vectors[:, 0] if vectors[:, 0] @ mean >= 0 else -vectors[:, 0]
    return up


def _plane(points: np.ndarray, centers: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Normal of the level plane below the cameras with most points, and their share; None where none has enough."""
    rng = np.random.default_rng(0)
    points = points if len(points) <= _POINTS else rng.choice(points, _POINTS, replace=False)
    middle = np.median(points, axis=0)
    thick = _THICK * float(np.median(np.linalg.norm(points - middle, axis=1)))
    a, b, c = points[rng.integers(0, len(points), (3, _TRIPLES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-300)[:, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = (length > 0) & (normals @ up > _TILT)
    best: tuple[int, np.ndarray, float] | None = None
    for normal, offset in zip(normals[level], np.sum(normals * a, axis=1)[level]):
        if np.mean(centers @ normal > offset) < 0.9:
            continue
        held = int(np.count_nonzero(np.abs(points @ normal - offset) < thick))
        if best is None or held > best[0]:
            best = held, normal, offset
    if best is None or best[0] < _SHARE * len(points):
        return None
    _, normal, offset = best
    for _ in range(3):
        on = points[np.abs(points @ normal - offset) < thick]
        _, spread, axes = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)
        if spread[1] < 0.2 * spread[0]:
            return None  # an edge, through which many planes go
        normal = axes[2] if axes[2] @ up > 0 else -axes[2]
        offset = float(on.mean(axis=0) @ normal)
    if normal @ up < _TILT:
        return None
    return normal, float(np.mean(np.abs(points @ normal - offset) < thick))
