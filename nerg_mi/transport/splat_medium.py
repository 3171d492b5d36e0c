"""Gaussian splats as a medium: their arrays, the bounding-volume hierarchy, and the next hits along a ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, ClassVar, cast

import drjit as dr
import numpy as np

from nerg_mi.fields.splats import Splats
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, UInt32, Vector3f

from .medium import LastHit, LocalRay, NextHits

# ---- BoxTree ----
#
# A bounding-volume hierarchy for stackless traversal: a complete binary tree of boxes.
#
# Node i has the children 2 i and 2 i + 1, the root is node 1, and all leaves lie on one level, so that a path from the
# root is a bit pattern (cf. Hapala et al. 2011, "Efficient Stack-less BVH Traversal for Ray Tracing"). Each node is
# split at the median of its longest side, into halves whose sizes differ by at most one. NumPy.

NODE_SIZE = 8
"""Numbers per node: lower and upper corner of its box, split axis, and one unused."""

_OUTSIDE = np.float32(1e30)
# Relative margin of boxes for the rounding of rays.
_MARGIN_REL = np.float32(1e-6)


@dataclass(frozen=True)
class BoxTree:
    """A tree over N boxes."""

    # Nodes from number 1 on, (2 leaves, NODE_SIZE) float32; an empty node is a point beyond all distances.
    nodes: np.ndarray
    # Index of each leaf's box, (leaves,) uint32; 0 for an empty leaf.
    boxes: np.ndarray


def count_levels(count: int) -> int:
    """Number of levels below the root of the tree of ``count`` boxes, which has two to this power leaves."""
    return max(count - 1, 0).bit_length()


def build_tree(lower: np.ndarray, upper: np.ndarray) -> BoxTree:
    """Build the tree of N boxes with finite corners ``lower`` and ``upper``, (N, 3) each."""
    lower, upper = (np.asarray(v, np.float32) for v in (lower, upper))
    n = len(lower)
    depth = count_levels(n)
    centers = 0.5 * (lower.astype(np.float64) + upper)
    nodes = np.zeros((2 << depth, NODE_SIZE), np.float32)
    order, part, sizes = np.arange(n), np.zeros(n, np.int64), np.array([n])
    for level in range(depth):
        # Empty parts take the box of a neighbour, which has no effect.
        starts = np.minimum(np.cumsum(sizes) - sizes, n - 1)
        level_centers = centers[order]
        low, high = np.minimum.reduceat(level_centers, starts), np.maximum.reduceat(level_centers, starts)
        axis = np.argmax(high - low, axis=1)
        nodes[1 << level : 2 << level, 6] = axis
        along = axis[part]
        start = low[part, along]
        size = np.maximum(high[part, along] - start, 1e-300)
        # One sort for all parts: the integer part of the key is the index of the part.
        sorting = np.argsort(part + 0.999 * ((level_centers[np.arange(n), along] - start) / size), kind="stable")
        order = order[sorting]
        left = (sizes + 1) // 2
        sizes = np.stack([left, sizes - left], axis=1).ravel()
        part = np.repeat(np.arange(len(sizes)), sizes)
    leaves = 1 << depth
    boxes = np.zeros(leaves, np.uint32)
    boxes[part] = order
    wider = _MARGIN_REL * np.maximum(np.abs(lower), np.abs(upper))
    nodes[:, :3], nodes[:, 3:6] = _OUTSIDE, -_OUTSIDE
    nodes[leaves + part, :3], nodes[leaves + part, 3:6] = (lower - wider)[order], (upper + wider)[order]
    for level in range(depth - 1, -1, -1):
        level_centers, below = slice(1 << level, 2 << level), nodes[2 << level : 4 << level]
        nodes[level_centers, :3] = np.minimum(below[::2, :3], below[1::2, :3])
        nodes[level_centers, 3:6] = np.maximum(below[::2, 3:6], below[1::2, 3:6])
    # An inverted box would be sorted like any other; a distant point is never hit.
    nodes[nodes[:, 0] > nodes[:, 3], :6] = _OUTSIDE
    return BoxTree(nodes, boxes)


# ---- Arrays ----
#
# Gaussian splats as Dr.Jit arrays: the trainable parameters, and the packed arrays that kernels read.

SHAPE_SIZE = 16
"""Numbers per Gaussian in ``shapes``: the matrix (row by row) to its own axes in units of its standard deviations, its
centre, its opacity, and three unused."""

MAX_ALPHA = 0.9999
"""Maximum fraction of light that one Gaussian absorbs, as in Mitsuba's ``volprim_rf_basic``."""

_PARAMETERS = ("centers", "scales", "rotations", "opacities", "harmonics")


class SplatArrays:
    """N Gaussians in their own frame, cut off at ``extent`` standard deviations.

    ``namespace``: of the arrays' backend. The attributes ``centers``, ``scales``, ``rotations`` (w first),
    ``opacities`` and ``harmonics`` are flat Floats in the order of ``splats``; call `pack` after changing them. It
    derives, differentiably, what kernels read: ``shapes`` and ``colors``; ``corners``: lower and upper corner of all
    Gaussians, 6 one-lane Floats. The ``tree`` is built when it is first read: lists do without it.
    """

    # Lets Dr.Jit find the arrays in frozen functions, which read the tree.
    DRJIT_STRUCT: ClassVar[dict[str, Any]] = dict.fromkeys((*_PARAMETERS, "shapes", "colors", "corners", "tree"))
    UNRECORDED = ("_boxes",)
    COMPUTED = ("tree",)

    centers: Float
    scales: Float
    rotations: Float
    opacities: Float
    harmonics: Float

    def __init__(self, splats: Splats, ns: ModuleType, extent: float = 3.0):
        self.namespace, self.count, self.extent = ns, len(splats), float(extent)
        self.rows = ns.ArrayXf
        self.terms = splats.harmonics.shape[1]
        self.leaves = 1 << count_levels(self.count)
        # Arrays are gathered in packets of four.
        self._stride = -(-3 * self.terms // 4) * 4
        for name in _PARAMETERS:
            setattr(self, name, ns.Float(copy_aligned(getattr(splats, name)).ravel()))
        self.pack()

    def parameters(self) -> dict[str, Any]:
        """The trainable arrays by name."""
        return {name: getattr(self, name) for name in _PARAMETERS}

    def pack(self) -> None:
        """Derive from the parameters what kernels read."""
        ns, n = self.namespace, self.count
        index = dr.arange(ns.UInt32, n)
        take = lambda values, width: [dr.gather(ns.Float, values, index * width + i) for i in range(width)]
        c, s, q = take(self.centers, 3), take(self.scales, 3), take(self.rotations, 4)
        inverse = dr.rcp(dr.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]))
        w, x, y, z = (v * inverse for v in q)
        axes = [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
        rows = [value / scale for scale, axis in zip(s, axes) for value in axis]
        zeros = dr.zeros(ns.Float, n)
        shape = [*rows, *c, *take(self.opacities, 1), zeros, zeros, zeros]
        color = take(self.harmonics, 3 * self.terms)
        color += [zeros] * (self._stride - len(color))
        self.shapes, self.colors = dr.ravel(ns.ArrayXf(shape)), dr.ravel(ns.ArrayXf(color))
        with dr.suspend_grad():
            # The half extents of an ellipsoid are the lengths of the rows of its matrix.
            half = ns.Array3f(*(dr.norm(ns.Array3f(*(s[k] * axes[k][i] for k in range(3)))) for i in range(3)))
            self._boxes = ns.Array3f(*c) - self.extent * half, ns.Array3f(*c) + self.extent * half
            thickness = dr.minimum(dr.minimum(s[0], s[1]), s[2])
            dr.eval(self.shapes, self.colors, self._boxes, thickness)
            # Arrays, and no literals, which would compile a new kernel each time a Gaussian moves.
            self.corners = [*dr.min(self._boxes[0], axis=1), *dr.max(self._boxes[1], axis=1)]
            dr.eval(self.corners)
        self.lower, self.upper = np.array(self.corners, np.float64).reshape(2, 3)
        self.thickness = float(np.median(thickness.numpy()))
        # That of other values.
        vars(self).pop("tree", None)

    @cached_property
    def tree(self) -> list[Any]:
        """``nodes`` and ``boxes`` of the `BoxTree` of the Gaussians."""
        # Evaluated components, since the first ray may ask in a symbolic loop.
        tree = build_tree(*(np.stack([v.numpy() for v in corner], axis=1) for corner in self._boxes))
        # Always the same alignment: frozen functions distinguish arrays by it and would be recorded again.
        return [
            self.namespace.Float(copy_aligned(tree.nodes).ravel()),
            self.namespace.UInt32(copy_aligned(tree.boxes, np.uint32)),
        ]

    def find_peak(self, index: UInt32, o: Any, d: Any, active: Bool) -> tuple[Float, Float, Float]:
        """``(t, absorbed, distance)`` of the Gaussian ``index`` on the ray ``o + t d``.

        ``t``: where the Gaussian is densest along the ray; ``absorbed``: the fraction of light absorbed, all of it
        there; ``distance``: squared distance to the centre at that point, in standard deviations.
        """
        g = dr.gather(self.namespace.ArrayXf, self.shapes, index, active, shape=(SHAPE_SIZE, dr.width(index)))
        x, y, z = o.x - g[9], o.y - g[10], o.z - g[11]
        from_center = [dr.fma(g[i], x, dr.fma(g[i + 1], y, g[i + 2] * z)) for i in (0, 3, 6)]
        along = [dr.fma(g[i], d.x, dr.fma(g[i + 1], d.y, g[i + 2] * d.z)) for i in (0, 3, 6)]
        return find_peak(from_center, along, g[12])

    def color(self, index: UInt32, w: Vector3f, active: Bool) -> Color:
        """Colour of the Gaussian ``index`` for the unit ray direction ``w``: a list of three."""
        c = dr.gather(self.namespace.ArrayXf, self.colors, index, active, shape=(self._stride, dr.width(index)))
        values = dr.sh_eval(w, round(self.terms**0.5) - 1)
        sums = [self.namespace.Float(0.5)] * 3
        for k, value in enumerate(values):
            sums = [dr.fma(value, c[3 * k + i], total) for i, total in enumerate(sums)]
        return [dr.maximum(total, 0) for total in sums]


def find_peak(from_center: Sequence[Float], along: Sequence[Float], opacity: Float) -> tuple[Float, Float, Float]:
    """`SplatArrays.find_peak` on a ray in the axes of a Gaussian, in standard deviations: ``from_center`` to the origin
    of the ray, and its displacement ``along`` per unit of t."""
    square = _dot(along, along)
    t = -_dot(from_center, along) / dr.select(square > 0, square, 1)
    off = [dr.fma(t, v, p) for v, p in zip(along, from_center)]
    distance = _dot(off, off)
    return t, dr.minimum(opacity * dr.exp(-0.5 * distance), MAX_ALPHA), distance


def _dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    return dr.fma(a[0], b[0], dr.fma(a[1], b[1], a[2] * b[2]))


# ---- The next Gaussians along rays, ordered by their peaks ----
#
# The order is that of the densest points along the ray, not that of the entry points or of the centres. The traversal
# visits the nearer child first and skips boxes that begin behind the last Gaussian needed, or behind the point where no
# light is left. A ray may start inside Gaussians; those with a peak in front of it count.

GROUP_SIZE = 12
"""Gaussians that one traversal of the tree returns."""


@dataclass
class _TreeWalk:
    """State of a traversal. ``path``: after a leading 1, one bit per level for the farther child."""

    active: Bool
    node: UInt32
    path: UInt32
    # Distance behind which hits are not needed.
    far: Float
    t: list[Float]
    absorbed: list[Float]
    index: list[UInt32]
    evals: Float


class SplatHits:
    """Hits of rays with ``arrays``: a `medium.Hits`."""

    group_size = GROUP_SIZE

    def __init__(self, arrays: SplatArrays):
        self.arrays = arrays

    def find_next(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """See `medium.Hits`."""
        a, o, d = self.arrays, ray.o, ray.d
        nodes, boxes = a.tree
        Float = type(before)
        UInt32: Any = dr.uint32_array_t(Float)
        # Axes without a direction component never decide, unless the ray is outside the box.
        inverse = [dr.rcp(dr.select(dr.abs(v) > 1e-30, v, 1e-30)) for v in (d.x, d.y, d.z)]
        origin = (o.x, o.y, o.z)

        def test(walk: _TreeWalk) -> _TreeWalk:
            index = dr.gather(UInt32, boxes, walk.node - a.leaves, walk.active)
            t, absorbed, distance = a.find_peak(index, o, d, walk.active)
            behind = (t > after.t) | ((t == after.t) & (index > after.index))
            is_candidate = walk.active & behind & (distance < a.extent**2) & (t < walk.far) & (t < before)
            t = dr.select(is_candidate, t, dr.inf)
            light, far, ts, absorptions, indices = transmittance, walk.far, [], [], []
            for held_t, held_absorbed, held_index in zip(walk.t, walk.absorbed, walk.index):
                first = (t < held_t) | ((t == held_t) & (index < held_index))
                ts.append(dr.select(first, t, held_t))
                absorptions.append(dr.select(first, absorbed, held_absorbed))
                indices.append(dr.select(first, index, held_index))
                t, absorbed = dr.select(first, held_t, t), dr.select(first, held_absorbed, absorbed)
                index = dr.select(first, held_index, index)
                light = light * dr.select(ts[-1] < dr.inf, 1 - absorptions[-1], 1)
                # Hits at the same distance are still needed: their index decides.
                far = dr.select(light <= stop, dr.minimum(far, _above(ts[-1])), far)
            far, evals = dr.minimum(far, _above(ts[-1])), walk.evals + dr.select(walk.active, 1, 0)
            return replace(walk, far=far, t=ts, absorbed=absorptions, index=indices, evals=evals)

        def step(walk: _TreeWalk) -> _TreeWalk:
            shape = (NODE_SIZE, dr.width(walk.node))
            box = dr.gather(a.rows, nodes, walk.node, walk.active, shape=shape)
            near, far = dr.maximum(after.t, 0), walk.far
            for i in range(3):
                t0, t1 = (box[i] - origin[i]) * inverse[i], (box[i + 3] - origin[i]) * inverse[i]
                near, far = dr.maximum(near, dr.minimum(t0, t1)), dr.minimum(far, dr.maximum(t0, t1))
            hits_box = walk.active & (near <= far)
            leaf = walk.node >= a.leaves
            tested = dr.if_stmt(
                (replace(walk, active=hits_box & leaf),), hits_box & leaf, test, lambda walk: walk, label="Gaussian"
            )
            down = hits_box & ~leaf
            along = dr.select(box[6] < 0.5, d.x, dr.select(box[6] < 1.5, d.y, d.z))
            nearer = (walk.node << 1) | dr.select(along < 0, UInt32(1), UInt32(0))
            # Up to the last node whose farther child has not been visited.
            up = dr.tzcnt(walk.path + 1)
            node = dr.select(down, nearer, (walk.node >> up) ^ 1)
            path = dr.select(down, walk.path << 1, (walk.path + 1) >> up)
            return replace(tested, active=walk.active & (path != 1), node=node, path=path)

        start = _TreeWalk(
            active,
            UInt32(1),
            UInt32(1),
            Float(before),
            [Float(dr.inf) for _ in range(GROUP_SIZE)],
            [Float(0) for _ in range(GROUP_SIZE)],
            [UInt32(0) for _ in range(GROUP_SIZE)],
            Float(0),
        )
        (walk,) = dr.while_loop((start,), lambda walk: walk.active, lambda walk: (step(walk),), label="nearest")
        return NextHits(walk.t, walk.absorbed, walk.index, walk.evals)

    def reevaluate(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """See `medium.Hits`."""
        t, absorbed, _ = self.arrays.find_peak(index, ray.o, ray.d, active)
        return t, absorbed


def _above(t: Float) -> Float:
    """A slightly larger number: ``t < _above(t)`` for finite ``t``."""
    return dr.fma(dr.abs(t), 2.0**-22, t + 1e-37)


# ---- Gaussian splats as a medium ----
#
# Splats are hits of a march, neither shapes nor a density. A shape ends a ray, while a Gaussian transmits light, and a
# depth or a surface results from many of them. Marching in steps does not suit them: a Gaussian can be a millimetre
# thick in a hall of fifty metres, and by the convention of splats it absorbs its full fraction at its peak, so that its
# optical depth is not the integral of a density. A hit therefore replaces a step (`medium.Hits`), and the results of a
# march keep their meaning.


class SplatMedium:
    """Gaussian splats placed in the scene: a `medium.Medium` in their own coordinates.

    ``to_world``: splats to scene; default: the identity. ``color_space``: ``srgb``, as trained from photos, or
    ``linear``. ``may_list``: whether rays of a camera or an observer may read lists (`splat_lists.list_splats`).
    """

    UNRECORDED = ("lists",)

    has_color = True
    is_deferred = False
    feature_count = 0
    is_density_separate = False
    default_dt_gamma = 0.0
    occupancy = None
    cells = None

    def __init__(
        self, arrays: SplatArrays, to_world: Similarity | None = None, color_space: str = "srgb", may_list: bool = True
    ):
        self.arrays, self.to_world, self.color_space = arrays, to_world or Similarity(), color_space
        self.may_list = may_list
        self.hits = SplatHits(arrays)
        # Lists of recent viewpoints (`splat_lists.list_splats`).
        self.lists: dict[Any, Any] = {}

    @property
    def length_scale(self) -> float:
        return float(np.linalg.norm(self.arrays.upper - self.arrays.lower)) * self.to_world.scale

    @property
    def default_step(self) -> float | None:
        """Median thickness (smallest standard deviation) of the Gaussians in scene units.

        Sets the depth tolerance of occlusion; splats are not marched.
        """
        return self.arrays.thickness * self.to_world.scale

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.arrays.lower.tolist(), self.arrays.upper.tolist())

    def parameters(self) -> list[Any]:
        return [self.arrays.shapes, self.arrays.colors]

    def refresh(self, force: bool = False) -> None:
        """No effect: setting parameters of the splats packs them."""

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
        raise ValueError("Gaussian splats have no density at a point: they are evaluated along rays")

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        raise ValueError("Gaussian splats have no density at a point: they are evaluated along rays")

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour of the Gaussian whose index is the only element of ``features``."""
        return self.arrays.color(cast("UInt32", features[0]), w, active)

    def background(self, o: Point3f, d: Vector3f) -> None:
        """None: the scene provides the background."""
        return None
