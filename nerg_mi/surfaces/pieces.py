"""Pieces of faces that are small as an observer sees them, with their exact solid angles.

A face is cut into four congruent ones until each is seen under a small angle, however near the observer stands: pieces
are many where they are near, and about as many in all wherever that is, since the sphere around an observer has room
for so many of them only. The solid angle of a triangle is that of A. van Oosterom and J. Strackee, "The Solid Angle of
a Plane Triangle" (1983); no Jacobian has to be evaluated where it is steep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .mesh import Mesh

LEVELS = 40
"""A face is cut in four so many times at most: to 10^-12 of its size."""

_FOUR = np.array(
    [
        [[1, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5]],
        [[0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5]],
        [[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]],
        [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]],
    ]
)


@dataclass(frozen=True, eq=False)
class Pieces:
    """``face`` (P,) that each lies in; ``place`` (P, 3), barycentric coordinates of its centroid there; ``center`` (P,
    3) of it in the scene; ``solid_angle`` (P,) under which the observer sees it, in steradian."""

    face: np.ndarray
    place: np.ndarray
    center: np.ndarray
    solid_angle: np.ndarray


def pieces_of(mesh: Mesh, eye: np.ndarray, angle: float) -> Pieces:
    """The faces of ``mesh``, cut into pieces none of whose edges is seen from ``eye`` (3,) under more than about
    ``angle`` (radian).

    An edge counts as seen from the nearest point of the ball around its piece; a piece that holds the eye itself is cut
    `LEVELS` times.
    """
    corners = mesh.corners - eye
    rows, place = np.arange(len(corners)), None
    faces, places, relative = [], [], []
    for level in range(LEVELS + 1):
        if place is None:
            here = corners
        else:
            here = np.einsum("pij,pjk->pik", place, corners[rows])
        middle = here.mean(axis=1)
        radius = np.linalg.norm(here - middle[:, None], axis=2).max(axis=1)
        edge = np.linalg.norm(here - np.roll(here, 1, axis=1), axis=2).max(axis=1)
        small = edge <= angle * np.maximum(np.linalg.norm(middle, axis=1) - radius, 0)
        if level == LEVELS:
            small[:] = True
        faces.append(rows[small])
        done = np.full((np.count_nonzero(small), 3), 1 / 3) if place is None else place[small].mean(axis=1)
        places.append(done)
        relative.append(here[small])
        if small.all():
            break
        left = np.broadcast_to(np.eye(3), (int(np.count_nonzero(~small)), 3, 3)) if place is None else place[~small]
        place = np.einsum("fij,pjk->pfik", _FOUR, left).reshape(-1, 3, 3)
        rows = np.repeat(rows[~small], 4)
    found = np.concatenate(relative)
    angles = solid_angles(found)
    return Pieces(np.concatenate(faces), np.concatenate(places), found.mean(axis=1) + eye, angles)


def solid_angles(corners: np.ndarray) -> np.ndarray:
    """Solid angle (P,), in steradian, of triangles (P, 3, 3) seen from the origin, from either side.

    Of one in whose plane the origin lies it is 0, also where it lies in the triangle.
    """
    a, b, c = (corners[:, k] for k in range(3))
    # The ratio is free of the scale, and products of tiny lengths are not.
    unit = np.abs(corners).max(axis=(1, 2))
    scale = np.where(unit > 0, unit, 1)[:, None]
    a, b, c = a / scale, b / scale, c / scale
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = lambda u, v: np.einsum("ij,ij->i", u, v)
    # Of differences: corners that are far away compared with their distance from each other lose no digits.
    volume = np.abs(dot(a, np.cross(b - a, c - a)))
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.where(volume > 0, 2 * np.arctan2(volume, below), 0.0)
