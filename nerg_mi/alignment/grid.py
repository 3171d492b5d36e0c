"""Distances on a lattice, between whose points they are interpolated trilinearly, with derivatives in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """``values`` (nx, ny, nz) at ``lower + step * (i, j, k)``; beyond the lattice the distance to it is added."""

    values: np.ndarray
    lower: np.ndarray
    step: float

    @property
    def upper(self) -> np.ndarray:
        """The last point (3,) of the lattice."""
        return self.lower + self.step * (np.array(self.values.shape) - 1)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Distances (N,) of ``points`` (N, 3)."""
        return self.with_slope(points)[0]

    def with_slope(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) of ``points`` (N, 3), and their gradients (N, 3)."""
        last = np.array(self.values.shape) - 1
        u = (points - self.lower) / self.step
        held = np.clip(u, 0, last)
        cell = np.minimum(held.astype(np.int64), np.maximum(last - 1, 0))
        f = held - cell
        strides = np.array([self.values.shape[1] * self.values.shape[2], self.values.shape[2], 1])
        first, flat = cell @ strides, self.values.reshape(-1)
        # A lattice of one layer has no second point.
        to_next = strides * (last > 0)
        v = [[[flat[first + to_next @ np.array((i, j, k))] for k in (0, 1)] for j in (0, 1)] for i in (0, 1)]
        x, y, z = f.T
        # Along z, then y, then x: on each line the slope is the difference of its ends.
        on_z = [[(1 - z) * v[i][j][0] + z * v[i][j][1] for j in (0, 1)] for i in (0, 1)]
        by_z = [[v[i][j][1] - v[i][j][0] for j in (0, 1)] for i in (0, 1)]
        on_y = [(1 - y) * on_z[i][0] + y * on_z[i][1] for i in (0, 1)]
        value = (1 - x) * on_y[0] + x * on_y[1]
        slope = np.empty((len(points), 3))
        slope[:, 0] = on_y[1] - on_y[0]
        slope[:, 1] = (1 - x) * (on_z[0][1] - on_z[0][0]) + x * (on_z[1][1] - on_z[1][0])
        along = [(1 - y) * by_z[i][0] + y * by_z[i][1] for i in (0, 1)]
        slope[:, 2] = (1 - x) * along[0] + x * along[1]
        slope /= self.step
        beyond = self.step * (u - held)
        far = np.linalg.norm(beyond, axis=1)
        out = far > 0
        slope[out] = np.where(beyond[out] != 0, beyond[out] / far[out, None], slope[out])
        return value + far, slope
