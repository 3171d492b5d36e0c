r"""Smoothing of attention along the surfaces of Gaussian splats: from neighbour to neighbour, never through the air.

Gaussians have no edges that heat could flow over (`smoothing`). What lies on a side of one of them moves in n equal
steps of the standard deviation e = s / √n, no less than `CLOSE` of what Gaussians are usually apart, to sides near it:

    u'_i = u_i + Σ_j w_ij (u_j / A_j - u_i / A_i),    w_ij = K_ij A_i A_j / max(S_i, S_j),    S_i = Σ_k K_ik A_k,

with their areas A and K_ij = exp(-|c_i - c_j|² / 2e²): an integral with that kernel over what is there (cf. Belkin,
Sun, Wang 2009, "Constructing Laplace operator from point clouds in R^d"). Since w_ij = w_ji, nothing is lost and a
density that is the same everywhere stays so; since its sums are A_i at most, no amount becomes negative.

K_ij is 0 unless both are sides of one surface: they are no farther than 3 e apart,
face the same way (`FACING`), and each lies in the other's plane, to `RISE` of their distance and to the tolerance with
which a point counts as seen. So nothing comes through a gap that is wider than 3 e sin `RISE` and the tolerance, and
neither from one face of a board to the other nor around an edge. Sides that are hidden, and what is on them, stay as
they are.

Gaussians closer than half a step, which face the same way, are one cell, whose density all of them have.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

FACING = np.cos(np.radians(30))
"""Cosine between the normals of neighbours at least."""

RISE = np.sin(np.radians(15))
"""Sine of the angle at which a neighbour may lie out of the plane."""

STEPS = 100
"""Steps at most, where all of a kernel's reach is covered."""

MOST = 400
"""Steps at most, where many Gaussians lie at borders."""

CLOSE = 0.7
"""Standard deviation of a step at least, as a share of the edge of a square of a Gaussian's area."""

REACH = 3.0
"""Standard deviations of a step after which it is cut off."""


class SplatSmoother:
    """Smoothing by ``length``, the standard deviation s along the surface, of what lies on sides of N Gaussians.

    They have ``centers`` and shortest ``axes`` (N, 3); the ``areas`` (2, N) of their sides (`splat_areas`), of which
    those are hidden that are no larger than ``hidden`` (N,). ``tolerance``: how far apart two ideas of one surface may
    be. All in scene units. ``steps``: that are taken."""

    def __init__(
        self,
        centers: np.ndarray,
        axes: np.ndarray,
        areas: np.ndarray,
        hidden: np.ndarray,
        length: float,
        tolerance: float,
    ):
        if not (np.isfinite(length) and length > 0):
            raise ValueError(f"smoothing needs a positive length, got {length}")
        self._sides = np.flatnonzero((areas > hidden).ravel())
        count = len(axes)
        which, sign = self._sides % count, np.where(self._sides < count, -1.0, 1.0)
        area = areas.ravel()[self._sides]
        apart = _weighted_median(np.sqrt(area), area) if len(area) else length
        step = min(max(CLOSE * apart, length / np.sqrt(STEPS)), length)
        step = length / np.sqrt(max(1, np.floor((length / step) ** 2)))
        # Normals of surfaces, which point to where they are seen from.
        normals, places = sign[:, None] * axes[which], np.asarray(centers, np.float64)[which]
        cells, self._cell = _cells(places, normals, step / 2)
        self._area = np.bincount(self._cell, area, cells)
        mean = lambda rows: np.stack(
            [np.bincount(self._cell, area * c, cells).astype(np.float64) for c in rows.T], axis=1
        )
        place, normal = mean(places) / self._area[:, None], mean(normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self._share, self.steps = area / self._area[self._cell], 1
        i, j, square = _neighbours(place, normal, REACH * step, tolerance)
        kernel = np.exp(-0.5 * square / step**2)
        near = np.bincount(i, kernel * self._area[j], cells)
        weight = kernel * self._area[i] * self._area[j] / np.maximum(near[i], near[j])
        # By a step's own variance, for cells are apart, and the kernel is cut off.
        variance = float((weight * square).sum() / 2 / self._area.sum()) if cells else 0.0
        stays = self._area - np.bincount(i, np.where(i == j, 0, weight), cells)
        flow = np.where(i == j, stays[i], weight) / self._area[j]
        self._flow = sparse.csr_array((flow, (i, j)), (cells, cells))
        if variance > 0:
            self.steps = min(max(1, round(length**2 / variance)), MOST)

    def __call__(self, amounts: np.ndarray) -> np.ndarray:
        """The amounts (2, N) on the sides after smoothing; their sum stays."""
        out = np.array(amounts, np.float64)
        flat = out.reshape(-1)
        heat = np.bincount(self._cell, flat[self._sides], len(self._area))
        for _ in range(self.steps):
            heat = self._flow @ heat
        flat[self._sides] = heat[self._cell] * self._share
        return out


def _cells(places: np.ndarray, normals: np.ndarray, size: float) -> tuple[int, np.ndarray]:
    """How many cells of the edge ``size`` and of alike normals there are, and the number of each row's."""
    key = np.concatenate([np.floor(places / size), np.rint(2 * normals)], axis=1).astype(np.int64)
    if not len(key):
        return 0, np.zeros(0, np.int64)
    order = np.lexsort(key.T)
    first = np.r_[True, (np.diff(key[order], axis=0) != 0).any(axis=1)]
    found = np.empty(len(key), np.int64)
    found[order] = np.cumsum(first) - 1
    return int(first.sum()), found


def _neighbours(
    place: np.ndarray, normal: np.ndarray, reach: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(i, j, square of the distance)`` of cells of one surface, in both orders, each with itself too."""
    from scipy.spatial import KDTree

    own = np.arange(len(place))
    if not len(place):
        return own, own, np.zeros(0)
    pairs = KDTree(place).query_pairs(reach, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    apart = place[j] - place[i]
    square = np.einsum("ij,ij->i", apart, apart)
    most = RISE * np.sqrt(square) + tolerance
    level = lambda k: np.abs(np.einsum("ij,ij->i", apart, normal[k])) <= most
    alike = (np.einsum("ij,ij->i", normal[i], normal[j]) >= FACING) & level(i) & level(j)
    i, j, square = i[alike], j[alike], square[alike]
    return np.r_[i, j, own], np.r_[j, i, own], np.r_[square, square, np.zeros(len(own))]


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
