"""Similarities near one that is given, by seven numbers, and the derivatives of points with respect to these.

A point x goes to c + exp(l) exp([w]) (S x - c) + t: S the given similarity, c a centre in the place, w a rotation
vector (radians), t a translation (units of the place), l the logarithm of a scale. The derivative of a rotated y by the
vector has the closed form -exp([w]) [y] Jr(w) with the right Jacobian Jr of the rotation group (J. Sola, J. Deray, D.
Atchuthan: A micro Lie theory for state estimation in robotics, 2018, eq. 143 and 184).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .umeyama import move, scale_of

ALL = np.eye(7)
"""Any similarity: (w, t, l)."""


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
        return float(np.exp(self.basis[6] @ q)) * scale_of(self.base)

    def moved(self, q: np.ndarray, points: np.ndarray) -> np.ndarray:
        """``points`` (N, 3) in the place."""
        return move(self.matrix(q), points)

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
