"""One kernel density on a table over the sphere: as good as exact for pictures, and for any number of directions.

A density of kernels is smooth on the scale 1/sqrt(κ). So it is evaluated exactly at the texels of a cube map whose
spacing is a fraction of that, and in between by cubic interpolation: a lookup costs sixteen values, however many rays
the probe holds.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import vector_of
from nerg_mi.maths.types import Array3f, Float, UInt32

from .estimate import SphericalKde

SPACING = 0.15
"""Texels' distance in units of 1/sqrt(κ). The error of the cubic interpolation goes with its fourth power; at 0.15 it
is below 1e-4 of the highest density that the kernel of one ray reaches (measured in the tests)."""
_PAD = 2  # texels that a face has beyond its edge, so that the interpolation never crosses from one face to another
_MOST = 4096


class SphericalKdeTable:
    """The density of probe ``probe`` of ``kde``, tabulated.

    ``used`` (N, 3): the directions that will be asked for, where they are known; other texels are then not evaluated,
    and lookups there are wrong. A face of the cube is divided in equal angles, u = (4/π) atan(x/z). Raises
    ``ValueError`` for a concentration whose texels would be too many (above about 1.5e5).
    """

    def __init__(
        self, kde: SphericalKde, probe: int = 0, used: np.ndarray | None = None, spacing: float = SPACING
    ) -> None:
        self.ns = ns = kde.ns
        kappa = float(kde.kappa[probe])
        self.n = n = _texels(kappa, spacing)
        if n > _MOST:
            raise ValueError(
                f"κ = {kappa:.3g} needs {6 * n * n:,} texels; evaluate the density directly (SphericalKde.evaluate)"
            )
        self.width = n + 2 * _PAD
        wanted = np.ones((6, self.width, self.width), bool) if used is None else self._touched(used)
        at = np.flatnonzero(wanted.ravel())
        face, row = np.divmod(at, self.width * self.width)
        j, i = np.divmod(row, self.width)
        angle = lambda k: np.tan(0.25 * math.pi * ((k - _PAD + 0.5) * 2.0 / n - 1.0))
        values = np.zeros(wanted.size, np.float32)
        values[at] = kde.part(probe, probe + 1).evaluate(_from_face(face, angle(i), angle(j)))[0]
        self.evaluated = len(at)
        self._values = ns.Float(values)

    @staticmethod
    def fits(kde: SphericalKde, count: int) -> bool:
        """Whether a table of the first probe has texels no denser than ``count`` directions over the sphere."""
        n = _texels(float(kde.kappa[0]), SPACING)
        return n <= _MOST and 6 * n * n <= 16 * count

    def _touched(self, directions: np.ndarray) -> np.ndarray:
        """Texels (6, width, width) that lookups in ``directions`` read."""
        ns = self.ns
        hit = dr.zeros(ns.UInt32, 6 * self.width * self.width)
        first = self._cell(vector_of(ns.Array3f, directions.reshape(-1, 3)))[0]
        dr.scatter(hit, ns.UInt32(1), first)
        corner = np.array(hit).reshape(6, self.width, self.width) > 0
        out = corner.copy()
        for dj in range(4):
            for di in range(4):
                out[:, dj:, di:] |= corner[:, : self.width - dj, : self.width - di]
        return out

    def _cell(self, d: Array3f) -> tuple[UInt32, list[Float]]:
        """Index of the first of a lookup's 4 x 4 texels, and where between the middle ones it lies, in [0, 1)."""
        ns = self.ns
        a = dr.abs(d)
        on_x, on_y = (a.x >= a.y) & (a.x >= a.z), (a.y > a.x) & (a.y >= a.z)
        major = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
        face = dr.select(on_x, ns.UInt32(0), dr.select(on_y, ns.UInt32(2), ns.UInt32(4)))
        face += dr.select(major < 0, ns.UInt32(1), ns.UInt32(0))
        u = dr.select(on_x, d.y, d.x) / dr.abs(major)
        v = dr.select(on_x | on_y, d.z, d.y) / dr.abs(major)
        place = [dr.fma(dr.atan(w), 2.0 / math.pi, 0.5) * self.n + (_PAD - 0.5) for w in (u, v)]
        whole = [dr.clip(dr.floor(p), 1, self.width - 3) for p in place]
        i, j = (ns.UInt32(w) - 1 for w in whole)
        return (face * self.width + j) * self.width + i, [p - w for p, w in zip(place, whole)]

    def density(self, direction: Array3f) -> Float:
        """Density in ``direction`` (unit), in 1/sr: traced, not evaluated, differentiable."""
        first, (s, t) = self._cell(direction)
        ws, wt = _cubic(s), _cubic(t)
        total: Float = 0
        for j in range(4):
            row = 0
            for i in range(4):
                row = dr.fma(dr.gather(self.ns.Float, self._values, first + (j * self.width + i)), ws[i], row)
            total = dr.fma(row, wt[j], total)
        # Interpolation may fall below zero by the size of its error.
        return dr.maximum(total, 0)

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Densities (N,) float32 in ``directions`` (N, 3), 1/sr."""
        d = vector_of(self.ns.Array3f, directions)
        return np.array(self.density(d))


def _texels(kappa: float, spacing: float) -> int:
    """Texels along a face's edge."""
    return max(8, math.ceil(0.5 * math.pi / spacing * math.sqrt(kappa)))


def _cubic(t: Float) -> tuple[Float, Float, Float, Float]:
    """Weights of four equidistant values at -1, 0, 1, 2 (Lagrange) for a place t between the middle two."""
    a, b, c = t + 1, t - 1, t - 2
    return -t * b * c / 6, a * b * c / 2, -a * t * c / 2, a * t * b / 6


def _from_face(face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of places on the cube's faces +x, -x, +y, -y, +z, -z."""
    out = np.empty((len(face), 3))
    axis = face // 2
    n = np.arange(len(face))
    out[n, axis] = np.where(face % 2, -1.0, 1.0)
    out[n, np.where(axis == 0, 1, 0)] = u
    out[n, np.where(axis == 2, 1, 2)] = v
    return out / np.linalg.norm(out, axis=1, keepdims=True)
