"""Similarities: the one that carries points to points in closed form, and those near it by seven numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.maths.coordinates import check_coordinates

# ---- The similarity that carries points to points, in closed form ----
#
# S. Umeyama: Least-squares estimation of transformation parameters between two point patterns, PAMI 13 (1991). Where up
# is known in both frames, what is left is a turn about it: the same in the plane.

LINE = 0.01  # Points lie on a line where their second extent is less than this share of the first
PLANE = 0.02
"""Points lie in a plane, which looks the same in a mirror, where their third extent is less than this share."""

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
"""A mirrored frame: x negated. Of any other axis, or of all three, it is this and a rotation."""


def fit_similarity(
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    upright: bool = False,
    scale: float | None = None,
) -> np.ndarray:
    """The (4, 4) proper similarity that carries ``source`` (N, 3) to ``target`` (N, 3) with the least weighted sum of
    squares.

    ``upright``: z is up in both, and stays up; ``scale``: known, else found. Nothing is asked of the points: see
    `check_points`.
    """
    w = np.full(len(source), 1 / len(source)) if weights is None else np.asarray(weights) / np.sum(weights)
    x0, y0 = w @ source, w @ target
    x, y = source - x0, target - y0
    covariance = (y * w[:, None]).T @ x
    rotation = _turn(covariance) if upright else _rotation(covariance)
    spread = float(w @ np.sum(x * x, axis=1))
    if scale is None:
        scale = float(np.sum(covariance * rotation)) / spread if spread > 0 else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = y0 - matrix[:3, :3] @ x0
    return matrix


def _rotation(covariance: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(covariance)
    sign = np.ones(3)
    # The nearest orthogonal matrix may be a mirror; the nearest rotation gives up the least of the three.
    sign[2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return (u * sign) @ vt


def _turn(covariance: np.ndarray) -> np.ndarray:
    c = covariance
    angle = np.arctan2(c[1, 0] - c[0, 1], c[0, 0] + c[1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """``points`` (..., 3) by a (4, 4) matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def similarity_scale(matrix: np.ndarray) -> float:
    """Length in the target of one unit of the source."""
    return float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))


def residual_distances(matrix: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """How far ``matrix`` carries points from where they belong, (N,), in units of the source."""
    return np.linalg.norm(transform_points(matrix, source) - target, axis=1) / similarity_scale(matrix)


def leave_one_out(
    source: np.ndarray, target: np.ndarray, *, upright: bool = False, scale: float | None = None
) -> np.ndarray:
    """How far each point is from where the others carry it, (N,) in units of the source; NaN where the others are too
    few or lie on a line."""
    out = np.full(len(source), np.nan)
    for k in range(len(source)):
        rest = np.arange(len(source)) != k
        if not _refused(source[rest], upright) and not _refused(target[rest], upright):
            matrix = fit_similarity(source[rest], target[rest], upright=upright, scale=scale)
            if similarity_scale(matrix) > 0:
                out[k] = residual_distances(matrix, source[k : k + 1], target[k : k + 1])[0]
    return out


def check_points(source: np.ndarray, target: np.ndarray, label: str, *, upright: bool = False) -> None:
    """Raise `NergError` for points that do not tell a similarity: too few, at one place, on a line, not finite.

    ``what``: whose points they are, for the message ('the file "pairs.csv"').
    """
    for points, frame in ((source, "tracking"), (target, "place")):
        check_coordinates(points, f"{label}: points in the frame of the {frame}")
    for points, frame in ((source, "tracking"), (target, "place")):
        why = _refused(points, upright)
        if why:
            raise NergError(f"{label}: {why} in the frame of the {frame}, which leaves the alignment open; pick others")


def _refused(points: np.ndarray, upright: bool) -> str:
    """Why ``points`` tell no similarity; empty where they do."""
    least = 2 if upright else 3
    if len(points) < least:
        return f"there are {len(points)} pairs of points where {least} or more are needed"
    around = points - points.mean(axis=0)
    around = around[:, :2] if upright else around
    size = np.linalg.svd(around, compute_uv=False)
    if not size[0] > 1e-9 * max(1.0, float(np.abs(points).max())):
        return f"all points lie {'above one another' if upright else 'at one place'}"
    return "" if upright or size[1] > LINE * size[0] else "all points lie on a line"


def in_plane(points: np.ndarray) -> bool:
    """Whether ``points`` (N, 3) lie in a plane, so that a mirrored frame fits them as well."""
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(size) < 3 or bool(size[2] < PLANE * size[0])


# ---- Similarities near one that is given, by seven numbers, and the derivatives of points with respect to these ----
#
# A point x goes to c + exp(l) exp([w]) (S x - c) + t: S the given similarity, c a centre in the place, w a rotation
# vector (radians), t a translation (units of the place), l the logarithm of a scale. The derivative of a rotated y by
# the vector has the closed form -exp([w]) [y] Jr(w) with the right Jacobian Jr of the rotation group (J. Sola, J.
# Deray, D. Atchuthan: A micro Lie theory for state estimation in robotics, 2018, eq. 143 and 184).

ALL = np.eye(7)  # Any similarity: (w, t, l)


def upright_basis(floor: bool) -> np.ndarray:
    """Columns (7, k) of the numbers that are left where z is up and stays up, and, with ``floor``, where nothing that
    stands on the floor leaves it (the centre of the chart must lie on it)."""
    return ALL[:, [2, 3, 4, 6]] if floor else ALL[:, [2, 3, 4, 5, 6]]


@dataclass(frozen=True, eq=False)
class Chart:
    """Similarities around ``base`` (4, 4), by ``basis`` (7, k) times a vector of k numbers."""

    base: np.ndarray
    center: np.ndarray
    basis: np.ndarray = field(default_factory=lambda: ALL)

    @property
    def size(self) -> int:
        """k."""
        return self.basis.shape[1]

    def matrix(self, q: np.ndarray) -> np.ndarray:
        """The similarity (4, 4) of the numbers ``q`` (k,)."""
        p = self.basis @ q
        turn = np.exp(p[6]) * Rotation.from_rotvec(p[:3]).as_matrix()
        step = np.eye(4)
        step[:3, :3] = turn
        step[:3, 3] = self.center + p[3:6] - turn @ self.center
        return step @ self.base

    def scale(self, q: np.ndarray) -> float:
        """Its scale."""
        return float(np.exp(self.basis[6] @ q)) * similarity_scale(self.base)

    def transform(self, q: np.ndarray, points: np.ndarray) -> np.ndarray:
        """``points`` (N, 3) in the place."""
        return transform_points(self.matrix(q), points)

    def pulled(self, q: np.ndarray, moved: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Derivatives (N, k) with respect to ``q`` of a function whose gradients at the ``moved`` points (N, 3) are
        ``slope`` (N, 3)."""
        p = self.basis @ q
        around = moved - self.center - p[3:6]
        turn = Rotation.from_rotvec(p[:3]).as_matrix() @ right_jacobian(p[:3])
        # R (y x v) = (R y) x (R v), and a . (b x c) = b . (c x a).
        by = np.empty((len(moved), 7))
        by[:, :3] = np.cross(around, slope) @ turn
        by[:, 3:6] = slope
        by[:, 6] = np.sum(slope * around, axis=1)
        return by @ self.basis


def right_jacobian(w: np.ndarray) -> np.ndarray:
    """How exp([w]) turns when ``w`` (3,) changes: exp([w + d]) = exp([w]) exp([Jr d]) to first order, (3, 3)."""
    angle = float(np.linalg.norm(w))
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-4:
        return np.eye(3) - 0.5 * cross + cross @ cross / 6
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) - a * cross + b * cross @ cross
