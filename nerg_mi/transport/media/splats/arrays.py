"""Gaussian splats as arrays of Dr.Jit: what can be trained, and what kernels read."""

from __future__ import annotations

from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.fields.splats import Splats, matrices_of
from nerg_mi.maths.arrays import aligned
from nerg_mi.maths.types import Bool, Color, Float, UInt32, Vector3f

from .tree import build_tree

SHAPE = 16
"""Numbers a Gaussian in ``shapes``: the matrix (row by row) that leads to its own axes and standard deviations, its
centre, its opacity, and three unused."""

MOST_ABSORBED = 0.9999
"""Share of light that one Gaussian absorbs at most, as in Mitsuba's ``volprim_rf_basic``."""

_NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")
_PACKED = ("shapes", "colors", "nodes", "places", "order", "corners")


class SplatArrays:
    """N Gaussians, cut off ``extent`` standard deviations from their centres, in their own frame.

    ``ns``: namespace of the backend. The attributes ``centers``, ``scales``, ``rotations`` (w first), ``opacities`` and
    ``harmonics`` are flat Floats in the order of ``splats``; after a change of them ``pack`` is to be called. What
    kernels read is derived from them, with derivatives, in the order of a tree: ``shapes`` and ``colors``; ``nodes``
    and ``places``: see `tree`; ``corners``: the lower and the upper corner of all, 6 Floats of one number.
    """

    # So that Dr.Jit finds them in frozen functions.
    DRJIT_STRUCT: ClassVar[dict[str, Any]] = dict.fromkeys((*_NAMES, *_PACKED))

    centers: Float
    scales: Float
    rotations: Float
    opacities: Float
    harmonics: Float

    def __init__(self, splats: Splats, ns: ModuleType, extent: float = 3.0):
        self._ns, self.count, self.extent = ns, len(splats), float(extent)
        self.rows = ns.ArrayXf
        self.terms = splats.harmonics.shape[1]
        # Packets of four are gathered at once.
        self._stride = -(-3 * self.terms // 4) * 4
        for name in _NAMES:
            setattr(self, name, ns.Float(aligned(getattr(splats, name))))
        self.pack()

    def parameters(self) -> dict[str, Any]:
        """The arrays that can be set, by name."""
        return {name: getattr(self, name) for name in _NAMES}

    def pack(self) -> None:
        """Derive from the parameters what kernels read."""
        ns, n = self._ns, self.count
        centers, scales, rotations = (
            np.array(dr.detach(getattr(self, name)), np.float64).reshape(n, -1) for name in _NAMES[:3]
        )
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        # An ellipsoid's half extents are the lengths of its matrix' rows.
        half = self.extent * np.sqrt(((matrices_of(rotations) * scales[:, None]) ** 2).sum(axis=2))
        tree = build_tree(centers - half, centers + half)
        self.lower, self.upper = (centers - half).min(axis=0), (centers + half).max(axis=0)
        # Read by kernels, which would be compiled anew if they held the numbers, as often as Gaussians are moved.
        self.corners = [dr.opaque(ns.Float, float(v)) for v in (*self.lower, *self.upper)]
        self.thickness = float(np.median(scales.min(axis=1)))
        self.leaves = tree.leaves
        # Aligned alike each time: frozen functions tell arrays by it, and would be recorded anew.
        self.nodes, self.places = ns.Float(aligned(tree.nodes)), ns.UInt32(aligned(tree.places, np.uint32))
        order = ns.UInt32(aligned(tree.order, np.uint32))
        take = lambda values, width: [dr.gather(ns.Float, values, order * width + i) for i in range(width)]
        c, s, q = take(self.centers, 3), take(self.scales, 3), take(self.rotations, 4)
        inverse = dr.rcp(dr.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]))
        w, x, y, z = (v * inverse for v in q)
        axes = [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
        rows = [value / scale for scale, axis in zip(s, axes) for value in axis]
        nothing = dr.zeros(ns.Float, n)
        shape = [*rows, *c, *take(self.opacities, 1), nothing, nothing, nothing]
        color = take(self.harmonics, 3 * self.terms)
        color += [nothing] * (self._stride - len(color))
        self.shapes, self.colors = dr.ravel(ns.ArrayXf(shape)), dr.ravel(ns.ArrayXf(color))
        # Places of the order that the parameters have, for whoever looks a Gaussian up there.
        self.order = order
        dr.eval(self.shapes, self.colors, self.nodes, self.places)

    def peak(self, place: UInt32, o: Any, d: Any, active: Bool) -> tuple[Float, Float, Float]:
        """``(t, absorbed, distance)`` of the Gaussian at ``place`` of the tree's order on the ray ``o + t d``.

        Where the ray is nearest to its centre by the Gaussian's own measure, the share of light absorbed, all of it
        there, and the square of that distance in standard deviations."""
        g = dr.gather(self._ns.ArrayXf, self.shapes, place, active, shape=(SHAPE, dr.width(place)))
        x, y, z = o.x - g[9], o.y - g[10], o.z - g[11]
        from_center = [dr.fma(g[i], x, dr.fma(g[i + 1], y, g[i + 2] * z)) for i in (0, 3, 6)]
        along = [dr.fma(g[i], d.x, dr.fma(g[i + 1], d.y, g[i + 2] * d.z)) for i in (0, 3, 6)]
        square = _dot(along, along)
        t = -_dot(from_center, along) / dr.select(square > 0, square, 1)
        off = [dr.fma(t, v, p) for v, p in zip(along, from_center)]
        distance = _dot(off, off)
        return t, dr.minimum(g[12] * dr.exp(-0.5 * distance), MOST_ABSORBED), distance

    def color(self, place: UInt32, w: Vector3f, active: Bool) -> Color:
        """Colour of the Gaussian at ``place`` in the unit direction ``w`` of the ray: a list of three."""
        c = dr.gather(self._ns.ArrayXf, self.colors, place, active, shape=(self._stride, dr.width(place)))
        values = dr.sh_eval(w, round(self.terms**0.5) - 1)
        sums = [self._ns.Float(0.5)] * 3
        for k, value in enumerate(values):
            sums = [dr.fma(value, c[3 * k + i], total) for i, total in enumerate(sums)]
        return [dr.maximum(total, 0) for total in sums]


def _dot(a: list[Float], b: list[Float]) -> Float:
    return dr.fma(a[0], b[0], dr.fma(a[1], b[1], a[2] * b[2]))
