"""Similarities: closed-form fits to point pairs, and a local parametrisation with seven parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.transforms import similarity_scale, transform_points

# ---- Closed-form fit ----
#
# S. Umeyama: Least-squares estimation of transformation parameters between two point patterns, PAMI 13 (1991). If the
# up direction is known in both frames, only a rotation about it is fitted, by the same method in the plane.

MAX_LINE_RATIO = 0.01  # points are collinear below this ratio of their second to their first singular value
MAX_PLANE_RATIO = 0.02
"""Points are coplanar, so that a mirrored frame fits as well, below this ratio of the third to the first singular
value."""

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
"""Mirror of the x axis. Mirroring another axis, or all three, equals this and a rotation."""


def fit_similarity(
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    upright: bool = False,
    scale: float | None = None,
    turn: float | None = None,
    shift: np.ndarray | None = None,
) -> np.ndarray:
    """Fit the proper similarity (4, 4) from ``source`` to ``target``, (N, 3) each, with the smallest weighted sum of
    squares.

    Parameters
    ----------
    source, target
        Corresponding points. They are not checked; see `check_points`.
    weights
        Weights (N,). Default: equal weights.
    upright
        Whether z is up in both frames and stays up.
    scale
        Fixed scale. None: estimated.
    turn
        Fixed rotation about z in radians. None: estimated.
    shift
        Fixed image (3,) of the origin. None: estimated.

    Raises
    ------
    NergError
        If no positive scale agrees with the points and a fixed turn or shift.
    """
    w = np.full(len(source), 1 / len(source)) if weights is None else np.asarray(weights) / np.sum(weights)
    x0, y0 = (w @ source, w @ target) if shift is None else (np.zeros(3), shift)
    x, y = source - x0, target - y0
    covariance = (y * w[:, None]).T @ x
    if turn is not None:
        rotation = vertical_rotation(turn)
    else:
        rotation = _fit_vertical_rotation(covariance) if upright else _fit_rotation(covariance)
    spread = float(w @ np.sum(x * x, axis=1))
    if scale is None:
        scale = float(np.sum(covariance * rotation)) / spread if spread > 0 else 1.0
        if not scale > 0 and (turn is not None or shift is not None):
            raise NergError(
                "no positive scale agrees with the points and the given turn or shift: correct "
                f"{parameter('turn')} or {parameter('shift')}, or leave them out"
            )
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = y0 - matrix[:3, :3] @ x0
    return matrix


def _fit_rotation(covariance: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(covariance)
    sign = np.ones(3)
    # The nearest orthogonal matrix may be a reflection; flip the axis with the smallest singular value.
    sign[2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return (u * sign) @ vt


def _fit_vertical_rotation(covariance: np.ndarray) -> np.ndarray:
    c = covariance
    return vertical_rotation(np.arctan2(c[1, 0] - c[0, 1], c[0, 0] + c[1, 1]))


def vertical_rotation(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about z by ``angle`` in radians, anticlockwise as seen from above."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the rotation about z, in radians from -pi to pi, that brings the rotation of ``a`` closest to that of
    ``b``, (4, 4) each."""
    c = b[:3, :3] @ a[:3, :3].T
    return float(np.arctan2(c[1, 0] - c[0, 1], c[0, 0] + c[1, 1]))


def residual_distances(matrix: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the distances (N,) between the transformed ``source`` and ``target``, in units of the source."""
    return np.linalg.norm(transform_points(matrix, source) - target, axis=1) / similarity_scale(matrix)


def leave_one_out_distances(
    source: np.ndarray, target: np.ndarray, *, upright: bool = False, **constraints: Any
) -> np.ndarray:
    """Return the distance of each point from the fit to the others, (N,) in units of the source; NaN if the others
    are degenerate. ``constraints`` are those of `fit_similarity`."""
    out = np.full(len(source), np.nan)
    for k in range(len(source)):
        others = np.arange(len(source)) != k
        if not _degeneracy(source[others], upright) and not _degeneracy(target[others], upright):
            matrix = fit_similarity(source[others], target[others], upright=upright, **constraints)
            if similarity_scale(matrix) > 0:
                out[k] = residual_distances(matrix, source[k : k + 1], target[k : k + 1])[0]
    return out


def check_points(source: np.ndarray, target: np.ndarray, label: str, *, upright: bool = False) -> None:
    """Raise `NergError` for points that do not determine a similarity: too few, coincident, collinear, or not finite.

    ``label`` names the points in the message, such as 'the file "pairs.csv"'.
    """
    for points, frame in ((source, "tracking"), (target, "environment")):
        check_coordinates(points, f"{label}: points in the frame of the {frame}")
    for points, frame in ((source, "tracking"), (target, "environment")):
        reason = _degeneracy(points, upright)
        if reason:
            raise NergError(
                f"{label}: in the frame of the {frame}, {reason}, so the alignment is undetermined; pick other points"
            )


def _degeneracy(points: np.ndarray, upright: bool) -> str:
    """Return why ``points`` do not determine a similarity; empty if they do."""
    min_points = 2 if upright else 3
    if len(points) < min_points:
        return f"there are {len(points)} pairs of points, but {min_points} or more are needed"
    centered = points - points.mean(axis=0)
    centered = centered[:, :2] if upright else centered
    size = np.linalg.svd(centered, compute_uv=False)
    if not size[0] > 1e-9 * max(1.0, float(np.abs(points).max())):
        return f"all points lie {'above one another' if upright else 'at one position'}"
    return "" if upright or size[1] > MAX_LINE_RATIO * size[0] else "all points lie on a line"


def is_planar(points: np.ndarray) -> bool:
    """Return whether ``points`` (N, 3) are coplanar, so that a mirrored frame fits as well."""
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(size) < 3 or bool(size[2] < MAX_PLANE_RATIO * size[0])


# ---- Local parametrisation ----
#
# A point x is mapped to c + exp(l) exp([w]) (S x - c) + t, with the base similarity S, a centre c in the scene, a
# rotation vector w (radians), a translation t (scene units) and the logarithm l of a scale. The derivative of a rotated
# y with respect to the vector is -exp([w]) [y] Jr(w), with the right Jacobian Jr of the rotation group (J. Sola, J.
# Deray, D. Atchuthan: A micro Lie theory for state estimation in robotics, 2018, eq. 143 and 184).

FULL_BASIS = np.eye(7)  # all parameters (w, t, l)


TURN, LOG_SCALE = 2, 6  # index of the rotation about z and of the logarithm of the scale


@dataclass(frozen=True, eq=False)
class LocalSimilarity:
    """Similarities near ``base`` (4, 4), parametrised by ``basis`` (7, k) times a vector of k numbers."""

    base: np.ndarray
    center: np.ndarray
    basis: np.ndarray = field(default_factory=lambda: FULL_BASIS)

    @property
    def size(self) -> int:
        """Number of parameters k."""
        return self.basis.shape[1]

    def matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the similarity (4, 4) of the parameters ``q`` (k,)."""
        p = self.basis @ q
        rotation = np.exp(p[6]) * Rotation.from_rotvec(p[:3]).as_matrix()
        update = np.eye(4)
        update[:3, :3] = rotation
        update[:3, 3] = self.center + p[3:6] - rotation @ self.center
        return update @ self.base

    def scale(self, q: np.ndarray) -> float:
        """Return the scale of the similarity."""
        return float(np.exp(self.basis[6] @ q)) * similarity_scale(self.base)

    def transform(self, q: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Transform ``points`` (N, 3) to the scene."""
        return transform_points(self.matrix(q), points)

    def gradient(self, q: np.ndarray, moved: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """Return derivatives (N, k) with respect to ``q`` of a function with the given gradients (N, 3) at the
        transformed points."""
        p = self.basis @ q
        offset = moved - self.center - p[3:6]
        rotation = Rotation.from_rotvec(p[:3]).as_matrix() @ right_jacobian(p[:3])
        # R (y x v) = (R y) x (R v), and a . (b x c) = b . (c x a).
        jacobian = np.empty((len(moved), 7))
        jacobian[:, :3] = np.cross(offset, gradients) @ rotation
        jacobian[:, 3:6] = gradients
        jacobian[:, 6] = np.sum(gradients * offset, axis=1)
        return jacobian @ self.basis


def right_jacobian(w: np.ndarray) -> np.ndarray:
    """Return the right Jacobian Jr (3, 3) of the rotation vector ``w`` (3,): exp([w + d]) = exp([w]) exp([Jr d]) to
    first order."""
    angle = float(np.linalg.norm(w))
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-4:
        return np.eye(3) - 0.5 * cross + cross @ cross / 6
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) - a * cross + b * cross @ cross
