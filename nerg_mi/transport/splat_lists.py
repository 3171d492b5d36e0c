"""Lists of the Gaussians that rays of a camera or an observer can meet, by cells: splats as a rasteriser draws them.

The rays are divided into cells (`ray_cells`); each cell has the list of the Gaussians that its rays can meet, sorted by
the distance of their centres (tiles of Kerbl et al. 2023, "3D Gaussian Splatting"). A ray reads the list of its cell,
where the tree of `splat_medium` would search. Gaussians are evaluated exactly along the ray. What differs from the
tree: their order on a ray is that of their centres, their colour is that in the direction of their centre, and those
that absorb less than `MIN_ALPHA` are left out. Derivatives are those of the same sums: a ray reads its list again
(`march.ListMarchOp`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.types import Bool, Float, Point3f, UInt32, Vector3f

from .jit import Fingerprint
from .march_primal import MarchRequest, MarchResult, optical_depth_limits
from .medium import ColorShader, LocalRay
from .ray_cells import Ellipsoids, RayCells
from .splat_medium import SHAPE_SIZE, SplatArrays, SplatHits, SplatMedium, find_peak

if TYPE_CHECKING:
    from typing_extensions import Self

MIN_ALPHA = 1 / 255
"""Absorbed fraction below which a Gaussian is left out, as in 3DGS."""

CAMERA_CELLS = 1 << 14
"""Approximate number of cells of a camera: fewer have longer lists, and more take longer to fill."""

ROW_SIZE = 16
"""Numbers per Gaussian: the matrix to its own axes, the vector from its centre to the viewpoint there, its opacity and
its colour."""

NUM_WAITING = 8
"""Hits of a ray that wait for nearer ones: the order of centres is corrected as far as that."""

_FACES_PER_KERNEL = 6
_MARGIN = 0.02  # Cells by which the bounds of a Gaussian are extended for the rounding of directions


class SplatLists(SplatHits):
    """The lists of ``cells`` around ``center`` (3,), in the frame of the Gaussians ``arrays``; ``rectangles``: of
    `find_rectangles`."""

    # Read with derivatives only, or never by traced programs.
    UNRECORDED = ("size", "view")

    def __init__(self, arrays: SplatArrays, center: np.ndarray, cells: RayCells, rectangles: list[Rectangles]):
        super().__init__(arrays)
        ns = arrays.namespace
        self._ns, self.cells = ns, cells.prepare(ns)
        self.center = ns.Array3f(*(float(c) for c in center))
        # Literals would compile kernels for each viewpoint.
        dr.make_opaque(self.center)
        # The centre or the direction of the rays, with its derivatives.
        self.view = self.cells.view(self.center)
        with dr.suspend_grad():
            order = self._sort_visible(np.any([r.count > 0 for r in rectangles], axis=0))
            starts, ranks = [np.zeros(1, np.int64)], []
            for rectangle in rectangles:
                begin, members = _list_members(rectangle, order, cells.cells)
                starts.append(begin[1:].astype(np.int64) + starts[-1][-1])
                ranks.append(members)
            # Numbers of all lists.
            self.size = ROW_SIZE * len(order) + int(starts[-1][-1])
            self._starts = ns.UInt32(copy_aligned(np.concatenate(starts), np.uint32))
            self._entries = ns.UInt32(copy_aligned(np.concatenate([*ranks, np.zeros(1, np.int32)]), np.uint32))
            self._indices = ns.UInt32(copy_aligned(order, np.uint32)) if len(order) else dr.zeros(ns.UInt32, 1)
            self.rows = self._make_rows()

    # ---- Lists ----

    def _sort_visible(self, is_visible: np.ndarray) -> np.ndarray:
        """Indices of the Gaussians that any cell shows, sorted by their centres."""
        ns, (index,) = self._ns, np.nonzero(is_visible)
        if len(index) == 0:
            return index
        i = ns.UInt32(copy_aligned(index, np.uint32)) * SHAPE_SIZE
        m = ns.Array3f(*(dr.gather(ns.Float, self.arrays.shapes, i + 9 + k) for k in range(3))) - self.center
        # A stable order in a quarter of the time of `np.argsort`: floats from 0 on are sorted as their bits.
        keys = self.cells.order(m).numpy().view(np.uint32).astype(np.uint64) << np.uint64(32)
        return index[np.sort(keys | np.arange(len(index), dtype=np.uint64)) & np.uint64(0xFFFFFFFF)]

    def _make_rows(self) -> Float:
        """Numbers of the Gaussians that any cell shows, `ROW_SIZE` each, by rank."""
        ns, a, index = self._ns, self.arrays, self._indices
        g = [dr.gather(ns.Float, a.shapes, index * SHAPE_SIZE + i) for i in range(13)]
        m = ns.Array3f(*g[9:12]) - self.center
        from_center = [-(g[i] * m.x + g[i + 1] * m.y + g[i + 2] * m.z) for i in (0, 3, 6)]
        seen = self.cells.direction_to(ns.Array3f(*g[9:12]), self.view)
        color = a.color(index, seen * dr.rsqrt(dr.maximum(dr.squared_norm(seen), 1e-30)), ns.Bool(True))
        rows: Any = dr.ravel(ns.ArrayXf([*g[:9], *from_center, g[12], *color]))
        dr.eval(rows)
        return rows

    def attach(self) -> SplatLists:
        """These lists with rows that carry the derivatives of the Gaussians, and of the view through colours."""
        lists = copy(self)
        lists.rows = self._make_rows()
        return lists

    # ---- Rays ----

    def locate(self, ray: LocalRay) -> tuple[Float, Vector3f | None]:
        """The point from which distances along ``ray`` are measured.

        Returns the distance from there to the origin of the ray, and the displacement from the centre to that point;
        None: they are the same point.
        """
        if self.cells.has_center:
            return dr.norm(ray.o - self.center) * dr.rsqrt(dr.squared_norm(ray.d)), None
        return dr.zeros(self._ns.Float), self._ns.Array3f(ray.o) - self.center

    def evaluate(self, row: Sequence[Float], d: Vector3f, shift: Vector3f | None = None) -> tuple[Float, Float, Float]:
        """`SplatArrays.find_peak` of the Gaussian with the numbers ``row`` on the ray from the centre, moved by
        ``shift``, in the direction ``d``."""
        turn = lambda v: [dr.fma(row[i], v.x, dr.fma(row[i + 1], v.y, row[i + 2] * v.z)) for i in (0, 3, 6)]
        from_center = row[9:12]
        if shift is not None:
            from_center = [a + b for a, b in zip(from_center, turn(shift))]
        return find_peak(from_center, turn(d), row[12])

    def gather(self, rank: UInt32, numbers: range, active: Bool) -> list[Float]:
        """The ``numbers`` of the rows of the Gaussians ``rank``."""
        return [dr.gather(self._ns.Float, self.rows, rank * ROW_SIZE + i, active) for i in numbers]

    def gather_rows(self, rank: UInt32, active: Bool) -> list[Float]:
        """All numbers: slower, but their derivatives are added together."""
        shape = (ROW_SIZE, dr.width(rank))
        return list(dr.gather(self._ns.ArrayXf, self.rows, rank, active, shape=shape))

    def loop_hits(
        self, ray: LocalRay, t0: Float, t1: Float, start: Any, visit: Callable[..., Any], extra: Any = None
    ) -> tuple[Any, Any, Float]:
        """Loop over the hits of ``ray``, one of those that ``cells`` divide, of the march and of its derivatives.

        ``visit(state, hit, extra)`` processes a hit of the lanes on which ``state.active`` is true. It returns the
        state, on whose ``active`` lanes the march goes on, and ``extra``. Distances are measured as by `locate`.
        Returns both at the end, and the number of Gaussians that were evaluated.
        """
        ns, Float = self._ns, type(t0)
        shift = self.locate(ray)[1]
        cell = self.cells.find_cell(ray.o - self.center, ray.d)
        first, last = dr.gather(ns.UInt32, self._starts, cell), dr.gather(ns.UInt32, self._starts, cell + 1)

        def process(walk: _ListWalk, hit: ListHit, waiting: list[ListHit], active: Bool) -> _ListWalk:
            here = active & (hit.alpha > 0)
            state, extra = visit(replace(walk.state, active=here), hit, walk.extra)
            return replace(walk, active=walk.active & (~here | state.active), waiting=waiting, state=state, extra=extra)

        def read(walk: _ListWalk) -> tuple[_ListWalk]:
            """Read an entry of the list, and process the nearest hit that is known by then."""
            rank = dr.gather(ns.UInt32, self._entries, walk.entry, walk.active)
            row = self.gather(rank, range(13), walk.active)
            t, alpha, distance = self.evaluate(row, ray.d, shift)
            hit = walk.active & (t >= t0) & (t < t1) & (alpha >= MIN_ALPHA) & (distance < self.arrays.extent**2)
            # What is no hit comes first, and absorbs nothing.
            new = ListHit(dr.select(hit, t, -dr.inf), dr.select(hit, alpha, 0), rank)
            nearest, waiting = _exchange(walk.waiting, new)
            return (replace(process(walk, nearest, waiting, hit), entry=walk.entry + 1),)

        def drain(walk: _ListWalk) -> tuple[_ListWalk]:
            """Process the nearest hit that waits."""
            end = ListHit(Float(dr.inf), Float(0), ns.UInt32(0))
            return (process(walk, walk.waiting[0], [*walk.waiting[1:], end], walk.active),)

        waiting = [ListHit(Float(-dr.inf), Float(0), ns.UInt32(0)) for _ in range(NUM_WAITING)]
        walk = _ListWalk(start.active, first, waiting, start, extra)
        (walk,) = dr.while_loop((walk,), lambda walk: walk.active & (walk.entry < last), read, label="entries")
        (walk,) = dr.while_loop((walk,), lambda walk: walk.active & (walk.waiting[0].t < dr.inf), drain, label="last")
        return walk.state, walk.extra, Float(walk.entry - first)

    def march(self, ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
        """March ``ray``, one of those that ``cells`` divide, as `march_hits` does, without derivatives."""
        ns, Float = self._ns, type(t0)
        medium, shader, occlusion = request.medium, request.color, request.occlusion
        goal, stop = light_limits(Float, request)
        offset, _ = self.locate(ray)
        t0, t1 = t0 + offset, t1 + offset

        def visit(state: _Blend, hit: ListHit, _: None) -> tuple[_Blend, None]:
            active = state.active
            after, weight, crosses = state.absorb(hit, t0, goal, stop)
            after.median = dr.select(crosses, hit.t, state.median)
            after.light_before = dr.select(crosses, state.light, state.light_before)
            if isinstance(shader, ColorShader):
                after.color = state.color + weight * shader.array_type(*self.gather(hit.rank, range(13, 16), active))
            elif shader is not None:
                index = dr.gather(ns.UInt32, self._indices, hit.rank, active)
                p = ray.o + ray.d * (hit.t - offset)
                after.color = state.color + weight * shader.shade(medium, [cast("Float", index)], p, ray.w, active)
            if state.color_evals is not None:
                after.color_evals = state.color_evals + dr.select(active, 1, 0)
            if occlusion is not None and state.decided is not None:
                # Not whether the ray is clear: a nearer Gaussian can follow in the list.
                is_hidden = active & occlusion.is_hidden(hit.t - offset, -dr.log(after.light))
                after.decided, after.active = state.decided | is_hidden, after.active & ~is_hidden
            return after, None

        zero = request.init_result(Float)
        start = _Blend(
            active=request.active,
            light=Float(1),
            moment=Float(0),
            color=zero.color,
            median=Float(dr.inf),
            light_before=Float(1),
            decided=zero.decided,
            color_evals=zero.color_evals,
        )
        blended, _, evaluations = self.loop_hits(ray, t0, t1, start, visit)
        is_crossed = dr.isfinite(blended.median)
        distance = dr.select(is_crossed, blended.median - offset, dr.inf)
        return replace(
            zero,
            tau=-dr.log(blended.light),
            moment=blended.moment,
            median_depth=distance,
            crossing_start=dr.select(is_crossed, distance, 0),
            crossing_start_tau=dr.select(is_crossed, -dr.log(blended.light_before), 0),
            color=blended.color,
            decided=blended.decided,
            density_evals=evaluations if request.count else None,
            color_evals=blended.color_evals,
        )


def light_limits(Float: type, request: MarchRequest) -> tuple[Float, Float]:
    """Transmittances ``(goal, stop)``: the crossing that is searched for, and the end of the march."""
    goal, end = optical_depth_limits(Float, request.settings, request.until)
    return dr.exp(-goal), dr.exp(-end)


class Rectangles(NamedTuple):
    """Cells of a face that each of N Gaussians overlaps: begin and end (exclusive) along both axes, (N,) each."""

    left: np.ndarray
    right: np.ndarray
    bottom: np.ndarray
    top: np.ndarray

    @property
    def count(self) -> np.ndarray:
        """Number of cells (N,)."""
        return (self.right - self.left) * (self.top - self.bottom)


def find_rectangles(arrays: SplatArrays, center: np.ndarray, cells: RayCells) -> list[Rectangles]:
    """The cells of each face of ``cells`` around ``center`` that each Gaussian overlaps."""
    ns, cells = arrays.namespace, cells.prepare(arrays.namespace)
    with dr.suspend_grad():
        origin = dr.opaque(ns.Array3f, center.tolist())
        index = dr.arange(ns.UInt32, arrays.count)
        g = [dr.gather(ns.Float, arrays.shapes, index * SHAPE_SIZE + i) for i in range(13)]
        rows = [ns.Array3f(*g[i : i + 3]) for i in (0, 3, 6)]
        # Squared extent in standard deviations, within which enough light is absorbed.
        square = dr.minimum(2 * dr.log(dr.maximum(g[12], 1e-30) / MIN_ALPHA), arrays.extent**2)
        semi_axes = [row / dr.squared_norm(row) for row in rows]
        ellipsoids = Ellipsoids(ns.Array3f(*g[9:12]) - origin, semi_axes, square)
        bounds = []
        for face in range(cells.num_faces):
            is_visible, limits = square > 0, []
            for (low, high), count in zip(cells.bound(ellipsoids, face), cells.cells):
                is_visible &= (low <= high) & (low <= count) & (high >= 0)
                limits.append(dr.clip(dr.floor(low - _MARGIN), 0, count))
                limits.append(dr.clip(dr.floor(high + _MARGIN) + 1, 0, count))
            # Empty rectangles for those that are not visible.
            bounds.append([ns.Int32(dr.select(is_visible, v, 0)) for v in limits])
            # One kernel for the faces of a cube; those of the tiles of a lens would make it long.
            if face % _FACES_PER_KERNEL == _FACES_PER_KERNEL - 1:
                dr.eval(bounds)
        dr.eval(bounds)
    return [Rectangles(*(v.numpy() for v in values)) for values in bounds]


def _list_members(bounds: Rectangles, order: np.ndarray, cells: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Sort Gaussians into cells.

    Returns
    -------
    starts : array (cells + 1,)
        First entry of each cell, row by row.
    ranks : array
        For all cells one after the other, the ranks in ``order`` of the Gaussians that overlap it, ascending.
    """
    from scipy.sparse import csr_array

    count = bounds.count[order]
    # Each face of a cube shows a part of all.
    (shown,) = np.nonzero(count)
    order, count = order[shown], count[shown]
    left, bottom, width = bounds.left[order], bounds.bottom[order], (bounds.right - bounds.left)[order]
    starts = np.concatenate([[0], np.cumsum(count, dtype=np.int64)])
    within = np.arange(starts[-1], dtype=np.int32) - np.repeat(starts[:-1].astype(np.int32), count)
    row, column = np.divmod(within, np.repeat(width, count))
    cell = (np.repeat(bottom, count) + row) * cells[0] + np.repeat(left, count) + column
    # A matrix with a row per Gaussian: its columns are the lists, whose entries keep the order of the rows.
    matrix = csr_array((np.ones(len(cell), np.int8), cell, starts), shape=(len(order), cells[0] * cells[1])).tocsc()
    return matrix.indptr, shown.astype(np.int32)[matrix.indices]


@dataclass
class ListHit:
    """A Gaussian on a ray: distance as by `SplatLists.locate`, absorbed fraction (0: none) and rank."""

    t: Float
    alpha: Float
    rank: UInt32


@dataclass(kw_only=True)
class ListSums:
    """Sums over the hits of a ray."""

    active: Bool
    # Light that is not absorbed yet.
    light: Float
    # Sum of the absorption distances, measured from the start of the march.
    moment: Float
    color: Any

    def absorb(self, hit: ListHit, t0: Float, goal: Float, stop: Float) -> tuple[Self, Float, Bool]:
        """Absorb light in ``hit`` and return ``(sums, weight, crosses)`` like `MarchSums.absorb`.

        ``t0``: start of the march; ``goal``, ``stop``: see `light_limits`.
        """
        active, weight = self.active, dr.select(self.active, self.light * hit.alpha, 0)
        light, distance = self.light - weight, dr.select(active, hit.t - t0, 0)
        moment = dr.fma(weight, distance, self.moment)
        after = replace(self, active=active & (light > stop), light=light, moment=moment)
        return after, weight, active & (self.light > goal) & (light <= goal)


@dataclass(kw_only=True)
class _Blend(ListSums):
    """Loop state of `SplatLists.march`."""

    # Distance at which the light falls below the goal, and the light in front of it.
    median: Float
    light_before: Float
    decided: Bool | None
    color_evals: Float | None


@dataclass
class _ListWalk:
    """Loop state of a ray along its list."""

    active: Bool
    entry: UInt32
    # Hits that wait for nearer ones in the rest of the list, nearest first.
    waiting: list[ListHit]
    state: Any
    extra: Any


def _exchange(waiting: list[ListHit], new: ListHit) -> tuple[ListHit, list[ListHit]]:
    """Insert ``new`` into the sorted hits ``waiting``; return the nearest of all, and the others."""

    def order(a: ListHit, b: ListHit) -> tuple[ListHit, ListHit]:
        swap = b.t < a.t
        pick = lambda x, y: ListHit(*(dr.select(swap, v, w) for v, w in zip(vars(x).values(), vars(y).values())))
        return pick(b, a), pick(a, b)

    if not waiting:
        return new, []
    nearest, rest = order(waiting[0], new)
    others = []
    for hit in waiting[1:]:
        nearer, rest = order(hit, rest)
        others.append(nearer)
    return nearest, [*others, rest]


# ---- Choice ----

MIN_GAUSSIANS = 1 << 12
"""Number of Gaussians below which the tree is fast enough."""

MIN_RAYS_PER_GAUSSIAN = 1 / 16
"""Number of rays per Gaussian from which the lists, which are made for them, take less time than the tree."""

_MAX_ENTRIES = 1 << 25  # Entries of the lists of rays without a centre, which can be long for blurred Gaussians
_MAX_NUMBERS = 1 << 26  # Numbers in the lists of earlier viewpoints that a medium keeps, 4 bytes each
_MAX_VIEWPOINTS = 256  # Earlier viewpoints that a medium keeps, of which some have no lists


def list_splats(medium: SplatMedium, center: Point3f, rays: int, cells: RayCells) -> SplatMedium:
    """The ``medium`` for ``rays`` rays around ``center``, with lists where they take less time than the tree.

    Parameters
    ----------
    center : Point3f
        Centre of the rays in the frame of the Gaussians, one lane.
    cells : RayCells
        The rays, in that frame. Where all pass through the centre, it is in front of their origins.
    """
    arrays = medium.arrays
    if not medium.may_list or arrays.count < MIN_GAUSSIANS or rays < MIN_RAYS_PER_GAUSSIAN * arrays.count:
        return medium
    position = np.array(dr.detach(center), np.float64).ravel()
    cells = cells.adapt(arrays.count, position)
    key = (tuple(map(float, position)), cells.key)
    made_of = Fingerprint(dr.detach([arrays.shapes, arrays.colors]))
    # Lists of other Gaussians, as before a step of an optimisation, are of no use any more.
    for other in [k for k, (earlier, _) in medium.lists.items() if earlier != made_of]:
        del medium.lists[other]
    if key in medium.lists:
        _, lists = medium.lists.pop(key)
    else:
        rectangles = find_rectangles(arrays, position, cells)
        is_small = cells.has_center or sum(int(r.count.sum(dtype=np.int64)) for r in rectangles) <= _MAX_ENTRIES
        lists = SplatLists(arrays, position, cells, rectangles) if is_small else None
        # The lists of a camera and of an observer are kept in any case.
        while len(medium.lists) > 1 and (
            len(medium.lists) >= _MAX_VIEWPOINTS
            or sum(other.size for _, other in medium.lists.values() if other) > _MAX_NUMBERS
        ):
            del medium.lists[next(iter(medium.lists))]
    medium.lists[key] = made_of, lists
    if lists is None:
        return medium
    seen = copy(medium)
    seen.hits = copy(lists)
    seen.hits.view = arrays.namespace.Array3f(cells.view(center))
    return seen
