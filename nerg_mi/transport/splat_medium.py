"""Gaussian splats as a medium: their arrays, the tree over them, and those nearest to a ray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, ClassVar, cast

import drjit as dr
import numpy as np

from nerg_mi.fields.splats import Splats, quaternions_to_matrices
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, UInt32, Vector3f

from .medium import LastHit, LocalRay, NextHits

# ---- Tree ----
#
# A bounding-volume hierarchy that is walked without a stack: a complete binary tree of boxes.
#
# Node i has the children 2 i and 2 i + 1, the root is 1, and all leaves lie on one level, so that the way from the root
# is a number of bits (cf. Hapala et al. 2011, "Efficient Stack-less BVH Traversal for Ray Tracing"). Every node is
# split at the median of its longest side, into halves that are one apart at most. Plain NumPy.

COLUMNS = 8
"""Numbers a node: the lower and the upper corner of its box, the axis that it is split along, and one unused."""

_NOWHERE = np.float32(1e30)
# Boxes are this much wider than what is in them, for the rounding of rays.
_SLACK = np.float32(1e-6)


@dataclass(frozen=True)
class Tree:
    """Of N boxes."""

    # The box that stands at each place of the tree's order, (N,) int64.
    order: np.ndarray
    # The nodes from number 1 on, (2 leaves, COLUMNS) float32; what holds nothing is a point
    # beyond all distances.
    nodes: np.ndarray
    # Which place of the order a leaf holds, (leaves,) uint32.
    places: np.ndarray

    @property
    def leaves(self) -> int:
        """How many there are: a power of 2."""
        return len(self.places)


def build_tree(lower: np.ndarray, upper: np.ndarray) -> Tree:
    """The tree of N boxes with the corners ``lower`` and ``upper``, (N, 3) each, finite."""
    lower, upper = (np.asarray(v, np.float32) for v in (lower, upper))
    n = len(lower)
    depth = max(n - 1, 0).bit_length()
    centers = 0.5 * (lower.astype(np.float64) + upper)
    nodes = np.zeros((2 << depth, COLUMNS), np.float32)
    order, part, sizes = np.arange(n), np.zeros(n, np.int64), np.array([n])
    for level in range(depth):
        # Parts that have become empty are given some neighbour's box, of which nothing comes.
        starts = np.minimum(np.cumsum(sizes) - sizes, n - 1)
        here = centers[order]
        low, high = np.minimum.reduceat(here, starts), np.maximum.reduceat(here, starts)
        axis = np.argmax(high - low, axis=1)
        nodes[1 << level : 2 << level, 6] = axis
        along = axis[part]
        start = low[part, along]
        size = np.maximum(high[part, along] - start, 1e-300)
        # One sort for all parts: each has a whole number of its own.
        sorting = np.argsort(part + 0.999 * ((here[np.arange(n), along] - start) / size), kind="stable")
        order = order[sorting]
        left = (sizes + 1) // 2
        sizes = np.stack([left, sizes - left], axis=1).ravel()
        part = np.repeat(np.arange(len(sizes)), sizes)
    leaves = 1 << depth
    places = np.zeros(leaves, np.uint32)
    places[part] = np.arange(n)
    wider = _SLACK * np.maximum(np.abs(lower), np.abs(upper))
    nodes[:, :3], nodes[:, 3:6] = _NOWHERE, -_NOWHERE
    nodes[leaves + part, :3], nodes[leaves + part, 3:6] = (lower - wider)[order], (upper + wider)[order]
    for level in range(depth - 1, -1, -1):
        here, below = slice(1 << level, 2 << level), nodes[2 << level : 4 << level]
        nodes[here, :3] = np.minimum(below[::2, :3], below[1::2, :3])
        nodes[here, 3:6] = np.maximum(below[::2, 3:6], below[1::2, 3:6])
    # A ray's distances to a box without an inside would be put in order like any others: a point far away has none.
    nodes[nodes[:, 0] > nodes[:, 3], :6] = _NOWHERE
    return Tree(order, nodes, places)


# ---- Arrays ----
#
# Gaussian splats as arrays of Dr.Jit: what can be trained, and what kernels read.

SHAPE = 16
"""Numbers a Gaussian in ``shapes``: the matrix (row by row) that leads to its own axes and standard deviations, its
centre, its opacity, and three unused."""

MAX_ALPHA = 0.9999
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
            setattr(self, name, ns.Float(copy_aligned(getattr(splats, name)).ravel()))
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
        half = self.extent * np.sqrt(((quaternions_to_matrices(rotations) * scales[:, None]) ** 2).sum(axis=2))
        tree = build_tree(centers - half, centers + half)
        self.lower, self.upper = (centers - half).min(axis=0), (centers + half).max(axis=0)
        # Read by kernels, which would be compiled anew if they held the numbers, as often as Gaussians are moved.
        self.corners = [dr.opaque(ns.Float, float(v)) for v in (*self.lower, *self.upper)]
        self.thickness = float(np.median(scales.min(axis=1)))
        self.leaves = tree.leaves
        # Aligned alike each time: frozen functions tell arrays by it, and would be recorded anew.
        self.nodes, self.places = (
            ns.Float(copy_aligned(tree.nodes).ravel()),
            ns.UInt32(copy_aligned(tree.places, np.uint32).ravel()),
        )
        order = ns.UInt32(copy_aligned(tree.order, np.uint32).ravel())
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

    def find_peak(self, place: UInt32, o: Any, d: Any, active: Bool) -> tuple[Float, Float, Float]:
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
        return t, dr.minimum(g[12] * dr.exp(-0.5 * distance), MAX_ALPHA), distance

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


# ---- The next Gaussians along rays, in the order of their peaks ----
#
# Where a Gaussian is densest along the ray decides its place among them, not where the ray enters its ellipsoid, nor
# how far its centre is. The tree is walked nearer child first; a box is left out where it begins behind the last of the
# Gaussians that are wanted, or behind where those already found leave no light. A ray may start inside of Gaussians:
# what counts is that their peak lies before it.

AT_ONCE = 12
"""So many are found in one walk through the tree."""


@dataclass
class _Walk:
    """Where a walk is. ``way``: a bit for each level, after a leading 1, whether it is in the farther child."""

    active: Bool
    node: UInt32
    way: UInt32
    # Distance behind which nothing is wanted.
    far: Float
    t: list[Float]
    absorbed: list[Float]
    index: list[UInt32]
    evals: Float


class SplatHits:
    """What rays meet of ``arrays``: a `medium.Hits`."""

    group_size = AT_ONCE

    def __init__(self, arrays: SplatArrays):
        self.arrays = arrays

    def find_next(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """See `medium.Hits`."""
        a, o, d = self.arrays, ray.o, ray.d
        Float = type(before)
        UInt32: Any = dr.uint32_array_t(Float)
        # Axes along which the ray stands still never decide, unless it is outside of a box.
        inverse = [dr.rcp(dr.select(dr.abs(v) > 1e-30, v, 1e-30)) for v in (d.x, d.y, d.z)]
        origin = (o.x, o.y, o.z)

        def test(walk: _Walk) -> _Walk:
            place = dr.gather(UInt32, a.places, walk.node - a.leaves, walk.active)
            t, absorbed, distance = a.find_peak(place, o, d, walk.active)
            behind = (t > after.t) | ((t == after.t) & (place > after.index))
            good = walk.active & behind & (distance < a.extent**2) & (t < walk.far) & (t < before)
            t = dr.select(good, t, dr.inf)
            light, far, ts, shares, places = transmittance, walk.far, [], [], []
            for here, share, held in zip(walk.t, walk.absorbed, walk.index):
                first = (t < here) | ((t == here) & (place < held))
                ts.append(dr.select(first, t, here))
                shares.append(dr.select(first, absorbed, share))
                places.append(dr.select(first, place, held))
                t, absorbed = dr.select(first, here, t), dr.select(first, share, absorbed)
                place = dr.select(first, held, place)
                light = light * dr.select(ts[-1] < dr.inf, 1 - shares[-1], 1)
                # What is equally far is still wanted: its place decides.
                far = dr.select(light <= stop, dr.minimum(far, _above(ts[-1])), far)
            far, evals = dr.minimum(far, _above(ts[-1])), walk.evals + dr.select(walk.active, 1, 0)
            return replace(walk, far=far, t=ts, absorbed=shares, index=places, evals=evals)

        def step(walk: _Walk) -> _Walk:
            shape = (COLUMNS, dr.width(walk.node))
            box = dr.gather(a.rows, a.nodes, walk.node, walk.active, shape=shape)
            near, far = dr.maximum(after.t, 0), walk.far
            for i in range(3):
                t0, t1 = (box[i] - origin[i]) * inverse[i], (box[i + 3] - origin[i]) * inverse[i]
                near, far = dr.maximum(near, dr.minimum(t0, t1)), dr.minimum(far, dr.maximum(t0, t1))
            met = walk.active & (near <= far)
            leaf = walk.node >= a.leaves
            tested = dr.if_stmt(
                (replace(walk, active=met & leaf),), met & leaf, test, lambda walk: walk, label="Gaussian"
            )
            down = met & ~leaf
            along = dr.select(box[6] < 0.5, d.x, dr.select(box[6] < 1.5, d.y, d.z))
            nearer = (walk.node << 1) | dr.select(along < 0, UInt32(1), UInt32(0))
            # Up to the last node whose farther child is still to be seen.
            up = dr.tzcnt(walk.way + 1)
            node = dr.select(down, nearer, (walk.node >> up) ^ 1)
            way = dr.select(down, walk.way << 1, (walk.way + 1) >> up)
            return replace(tested, active=walk.active & (way != 1), node=node, way=way)

        start = _Walk(
            active,
            UInt32(1),
            UInt32(1),
            Float(before),
            [Float(dr.inf) for _ in range(AT_ONCE)],
            [Float(0) for _ in range(AT_ONCE)],
            [UInt32(0) for _ in range(AT_ONCE)],
            Float(0),
        )
        (walk,) = dr.while_loop((start,), lambda walk: walk.active, lambda walk: (step(walk),), label="nearest")
        return NextHits(walk.t, walk.absorbed, walk.index, walk.evals)

    def reevaluate(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """See `medium.Hits`."""
        t, absorbed, _ = self.arrays.find_peak(index, ray.o, ray.d, active)
        return t, absorbed


def _above(t: Float) -> Float:
    """The next greater number, or a little more: ``t < _above(t)`` for finite ``t``."""
    return dr.fma(dr.abs(t), 2.0**-22, t + 1e-37)


# ---- Gaussian splats as a medium ----
#
# They enter where a march sums what absorbs light, and not as shapes: a shape ends a ray, while a Gaussian lets light
# through, and a depth or a surface is what comes of many. A march's steps would not do either. A Gaussian may be a
# millimetre thick in a hall of fifty metres, and its optical depth by the convention of splats is no integral of a
# density: it absorbs all its share at its peak. So a hit takes the place of a step (`media.hits`), and what a march
# returns means what it always does.


class SplatMedium:
    """Gaussian splats placed in the scene: a ``medium.Medium`` in their own coordinates.

    ``to_world``: splats to scene; the identity by default. ``color_space``: ``srgb``, as photos train them, or
    ``linear``.
    """

    has_color = True
    is_deferred = False
    feature_count = 0
    default_dt_gamma = 0.0
    occupancy = None
    cells = None

    def __init__(self, arrays: SplatArrays, to_world: Similarity | None = None, color_space: str = "srgb"):
        self.arrays, self.to_world, self.color_space = arrays, to_world or Similarity(), color_space
        self.hits = SplatHits(arrays)

    @property
    def length_scale(self) -> float:
        return float(np.linalg.norm(self.arrays.upper - self.arrays.lower)) * self.to_world.scale

    @property
    def default_step(self) -> float | None:
        """The median thickness of a Gaussian: how far apart two ideas of a surface usually are."""
        return self.arrays.thickness * self.to_world.scale

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.arrays.lower.tolist(), self.arrays.upper.tolist())

    def parameters(self) -> list[Any]:
        return [self.arrays.shapes, self.arrays.colors]

    def refresh(self, anyway: bool = False) -> None:
        """Nothing: whoever sets parameters of the splats packs them."""

    def ray_to_local(self, o: Point3f, d: Vector3f) -> LocalRay:
        along = self.to_world.vector_to_local(d)
        w = self.to_world.direction_to_local(d)
        p = self.to_world.point_to_local(o)
        near, far = intersect_box(p, along, self.arrays.corners[:3], self.arrays.corners[3:])
        return LocalRay(p, along, w, near, far)

    def to_local(self, p: Point3f) -> Point3f:
        return self.to_world.point_to_local(p)

    def to_unit(self, p: Point3f) -> Array3f:
        return (p - type(p)(*self.arrays.lower.tolist())) * self._inverse_size(p)

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        return v * self._inverse_size(v)

    def _inverse_size(self, v: Array3f) -> Array3f:
        return type(v)(*(1 / (self.arrays.upper - self.arrays.lower)).tolist())

    def density(self, p: Point3f, active: Bool) -> Float:
        raise ValueError("Gaussian splats have no density at a point: they are met along rays")

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        raise ValueError("Gaussian splats have no density at a point: they are met along rays")

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour of the Gaussian whose index is the only one of ``features``."""
        return self.arrays.color(cast("UInt32", features[0]), w, active)

    def background(self, o: Point3f, d: Vector3f) -> None:
        """None: what is behind splats is the scene's."""
        return None
