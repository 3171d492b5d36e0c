"""Pieces of faces that are small as an observer sees them, with their exact solid angles.

A face is cut into four congruent ones until each is seen under a small angle, however near the observer stands: pieces
are many where they are near, and about as many in all wherever that is, since the sphere around an observer has room
for so many of them only. The solid angle of a triangle is that of A. van Oosterom and J. Strackee, "The Solid Angle of
a Plane Triangle" (1983); no Jacobian has to be evaluated where it is steep.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.errors import NergError

from .mesh import Mesh

LEVELS = 40
"""A face is cut in four so many times at most: to 10^-12 of its size."""

MOST = 1 << 25
"""Pieces of a mesh at most, as one observer sees it: five gigabytes."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of faces as ``eye`` (3,) sees them: ``face`` (P,) that each lies in; ``cut`` (P, 3, 3), of each of its
    corners the barycentric coordinates there; ``relative`` (P, 3, 3), its corners from the eye in scene units."""

    eye: np.ndarray
    face: np.ndarray
    cut: np.ndarray
    relative: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    @property
    def place(self) -> np.ndarray:
        """Barycentric coordinates (P, 3) of the centroids."""
        return self.cut.mean(axis=1)

    @property
    def center(self) -> np.ndarray:
        """Centroids (P, 3) in the scene."""
        return self.relative.mean(axis=1) + self.eye

    @cached_property
    def solid_angle(self) -> np.ndarray:
        """Solid angles (P,) under which the eye sees them, in steradian."""
        return solid_angles(self.relative)

    def part(self, rows: np.ndarray | slice) -> Pieces:
        """Those numbered, or marked, by ``rows``."""
        return Pieces(self.eye, self.face[rows], self.cut[rows], self.relative[rows])

    def quartered(self) -> Pieces:
        """Each cut into four congruent ones, one after the other."""
        return Pieces(self.eye, np.repeat(self.face, 4), _quarters(self.cut), _quarters(self.relative))


def pieces_of(mesh: Mesh, eye: np.ndarray, angle: float, faces: slice = slice(None)) -> Pieces:
    """The ``faces`` of ``mesh``, cut into pieces none of whose edges is seen from ``eye`` (3,) under more than about
    ``angle`` (radian).

    An edge counts as seen from the nearest point of the ball around its piece; a piece that holds the eye itself is cut
    `LEVELS` times. Raises `NergError` for more than `MOST` pieces.
    """
    relative = mesh.corners[faces] - eye
    number = np.arange(len(mesh.faces))[faces]
    left = Pieces(eye, number, np.broadcast_to(np.eye(3), (len(number), 3, 3)), relative)
    found: list[Pieces] = []
    for level in range(LEVELS + 1):
        here = left.relative
        middle = here.mean(axis=1)
        radius = np.sqrt(_square(here - middle[:, None]).max(axis=1))
        edge = np.sqrt(_square(here - here[:, [2, 0, 1]]).max(axis=1))
        # Not "<=": what is not finite is cut no further.
        small = ~(edge > angle * np.maximum(np.sqrt(_square(middle)) - radius, 0))
        if level == LEVELS:
            small[:] = True
        found.append(left.part(small))
        if small.all():
            break
        if sum(map(len, found)) + 4 * np.count_nonzero(~small) > MOST:
            raise NergError(
                f"the observer at {','.join(f'{v:g}' for v in eye)} sees the surfaces in more than {MOST:,} pieces of "
                f"{np.degrees(angle):g} degrees; give a larger --angle"
            )
        left = left.part(~small).quartered()
    joined = (np.concatenate([getattr(part, name) for part in found]) for name in ("face", "cut", "relative"))
    return Pieces(eye, *joined)


def _square(v: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", v, v)


def _quarters(corners: np.ndarray) -> np.ndarray:
    """Corners (4 P, 3, 3) of the quarters of triangles (P, 3, 3)."""
    middle = 0.5 * (corners + corners[:, [1, 2, 0]])
    (a, b, c), (ab, bc, ca) = (np.moveaxis(v, 1, 0) for v in (corners, middle))
    out = np.empty((len(corners), 4, 3, 3))
    for k, three in enumerate(((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))):
        for n, corner in enumerate(three):
            out[:, k, n] = corner
    return out.reshape(-1, 3, 3)


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
