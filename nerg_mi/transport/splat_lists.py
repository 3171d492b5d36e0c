"""Lists of the Gaussians that rays from one point can meet, by direction: splats as a rasteriser draws them.

Rays of a camera, or of an observer, start at one point. The directions around it are divided into cells; each cell has
the list of the Gaussians that its rays can meet, sorted by the distance of their centres (tiles of Kerbl et al. 2023,
"3D Gaussian Splatting"). A ray reads the list of its cell, where the tree of `splat_medium` would search. Gaussians are
evaluated exactly along the ray. What differs from the tree: their order on a ray is that of their centres, their colour
is that in the direction of their centre, and those that absorb less than `MIN_ALPHA` are left out. Derivatives are
those of the same sums: a ray reads its list again (`march.ListMarchOp`).
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

_MARGIN = 0.02  # Cells by which the bounds of a Gaussian are extended for the rounding of directions


class Window(NamedTuple):
    """Directions that a plane shows: u = x / z and v = y / z between ``lower`` and ``upper``, with z > 0."""

    axes: np.ndarray  # Unit vectors x, y and z in the frame of the Gaussians (3, 3)
    lower: tuple[float, float]
    upper: tuple[float, float]
    cells: tuple[int, int]  # Cells along u and v


def cube_windows(cells: int) -> tuple[Window, ...]:
    """The faces of a cube, with ``cells`` along each edge: windows 2 a and 2 a + 1 look along axis a and against it."""
    unit = np.eye(3)
    return tuple(
        Window(np.stack([unit[(a + 1) % 3], unit[(a + 2) % 3], sign * unit[a]]), (-1, -1), (1, 1), (cells, cells))
        for a in range(3)
        for sign in (1, -1)
    )


class SplatLists(SplatHits):
    """The lists of the cells of ``windows`` (one, or the six of `cube_windows`) around ``center``.

    ``center`` (3,) in the frame of the Gaussians ``arrays``.
    """

    # Read with derivatives only, or never by traced programs.
    UNRECORDED = ("size", "viewpoint")

    def __init__(self, arrays: SplatArrays, center: np.ndarray, windows: tuple[Window, ...]):
        super().__init__(arrays)
        self._num_windows, self._cells = len(windows), windows[0].cells
        ns = arrays.namespace
        self._ns = ns
        self.center = ns.Array3f(*(float(c) for c in center))
        # Literals would compile kernels for each viewpoint.
        dr.make_opaque(self.center)
        # The centre with its derivatives.
        self.viewpoint = self.center
        with dr.suspend_grad():
            bounds = self._find_cells(windows)
            order = self._sort_visible(np.any([b.count > 0 for b in bounds], axis=0))
            starts, ranks = [np.zeros(1, np.int64)], []
            for window, rectangle in zip(windows, bounds):
                begin, members = _list_members(rectangle, order, window.cells)
                starts.append(begin[1:].astype(np.int64) + starts[-1][-1])
                ranks.append(members)
            # Numbers of all lists.
            self.size = ROW_SIZE * len(order) + int(starts[-1][-1])
            self._starts = ns.UInt32(copy_aligned(np.concatenate(starts), np.uint32))
            self._entries = ns.UInt32(copy_aligned(np.concatenate([*ranks, np.zeros(1, np.int32)]), np.uint32))
            self._indices = ns.UInt32(copy_aligned(order, np.uint32)) if len(order) else dr.zeros(ns.UInt32, 1)
            self.rows = self._make_rows()
        first = windows[0]
        self._axes = [ns.Array3f(*map(float, axis)) for axis in first.axes]
        self._lower = [ns.Float(float(v)) for v in first.lower]
        self._rate = [ns.Float(n / (b - a)) for n, a, b in zip(first.cells, first.lower, first.upper)]
        dr.make_opaque(self._axes, self._lower, self._rate)

    # ---- Lists ----

    def _find_cells(self, windows: Sequence[Window]) -> list[_Rectangles]:
        """The cells of each window that each Gaussian overlaps."""
        ns, a = self._ns, self.arrays
        index = dr.arange(ns.UInt32, a.count)
        g = [dr.gather(ns.Float, a.shapes, index * SHAPE_SIZE + i) for i in range(13)]
        rows = [ns.Array3f(*g[i : i + 3]) for i in (0, 3, 6)]
        semi_axes = [row / dr.squared_norm(row) for row in rows]
        m = ns.Array3f(*g[9:12]) - self.center
        # Squared extent in standard deviations, within which enough light is absorbed.
        square = dr.minimum(2 * dr.log(dr.maximum(g[12], 1e-30) / MIN_ALPHA), a.extent**2)
        bounds = [self._bound(window, m, semi_axes, square) for window in windows]
        dr.eval(bounds)
        return [_Rectangles(*(v.numpy() for v in values)) for values in bounds]

    def _bound(self, window: Window, m: Any, semi_axes: list[Any], square: Float) -> list[Any]:
        """`_Rectangles` of ``window``, as arrays of the backend: of Gaussians with the centres ``m`` seen from the
        viewpoint, whose ellipsoids have the ``square`` extent."""
        ns = self._ns
        axes = [ns.Array3f(*map(float, axis)) for axis in window.axes]
        dr.make_opaque(axes)
        x, y, z = (_Extent(dr.dot(axis, m), ns.Array3f(*(dr.dot(axis, s) for s in semi_axes))) for axis in axes)
        is_visible, limits = square > 0, []
        for k, across in enumerate((x, y)):
            low, high = dr.opaque(ns.Float, window.lower[k]), dr.opaque(ns.Float, window.upper[k])
            left, right, is_seen = _project(across, z, square, low, high)
            is_visible &= is_seen
            cells = window.cells[k]
            to_cell = lambda v, low=low, high=high, n=cells: dr.clip((v - low) / (high - low) * n, -1, n + 1)
            limits.append(dr.clip(dr.floor(to_cell(left) - _MARGIN), 0, cells))
            limits.append(dr.clip(dr.floor(to_cell(right) + _MARGIN) + 1, 0, cells))
        # Empty rectangles for those that are not visible.
        return [ns.Int32(dr.select(is_visible, v, 0)) for v in limits]

    def _sort_visible(self, is_visible: np.ndarray) -> np.ndarray:
        """Indices of the Gaussians that any cell shows, sorted by the distance of their centres."""
        ns, (index,) = self._ns, np.nonzero(is_visible)
        if len(index) == 0:
            return index
        i = ns.UInt32(copy_aligned(index, np.uint32)) * SHAPE_SIZE
        m = ns.Array3f(*(dr.gather(ns.Float, self.arrays.shapes, i + 9 + k) for k in range(3))) - self.center
        # A stable order in a quarter of the time of `np.argsort`: floats from 0 on are sorted as their bits.
        keys = dr.squared_norm(m).numpy().view(np.uint32).astype(np.uint64) << np.uint64(32)
        return index[np.sort(keys | np.arange(len(index), dtype=np.uint64)) & np.uint64(0xFFFFFFFF)]

    def _make_rows(self) -> Float:
        """Numbers of the Gaussians that any cell shows, `ROW_SIZE` each, by rank."""
        ns, a, index = self._ns, self.arrays, self._indices
        g = [dr.gather(ns.Float, a.shapes, index * SHAPE_SIZE + i) for i in range(13)]
        m = ns.Array3f(*g[9:12]) - self.center
        from_center = [-(g[i] * m.x + g[i + 1] * m.y + g[i + 2] * m.z) for i in (0, 3, 6)]
        seen = ns.Array3f(*g[9:12]) - self.viewpoint
        color = a.color(index, seen * dr.rsqrt(dr.maximum(dr.squared_norm(seen), 1e-30)), ns.Bool(True))
        rows: Any = dr.ravel(ns.ArrayXf([*g[:9], *from_center, g[12], *color]))
        dr.eval(rows)
        return rows

    def attach(self) -> SplatLists:
        """These lists with rows that carry the derivatives of the Gaussians, and of the viewpoint through colours."""
        lists = copy(self)
        lists.rows = self._make_rows()
        return lists

    # ---- Rays ----

    def _find_list(self, d: Vector3f) -> tuple[UInt32, UInt32]:
        """First and last entry (exclusive) of the cell with the direction ``d``."""
        ns, (nu, nv) = self._ns, self._cells
        if self._num_windows == 1:
            x, y, z = (dr.dot(axis, d) for axis in self._axes)
            face = ns.UInt32(0)
        else:
            size = [dr.abs(d.x), dr.abs(d.y), dr.abs(d.z)]
            is_x = (size[0] >= size[1]) & (size[0] >= size[2])
            is_y = ~is_x & (size[1] >= size[2])
            pick = lambda a, b, c: dr.select(is_x, a, dr.select(is_y, b, c))
            x, y, along = pick(d.y, d.z, d.x), pick(d.z, d.x, d.y), pick(d.x, d.y, d.z)
            z = dr.abs(along)
            face = pick(ns.UInt32(0), ns.UInt32(2), ns.UInt32(4)) + dr.select(along < 0, ns.UInt32(1), ns.UInt32(0))
        cell = []
        for value, low, rate, count in zip((x, y), self._lower, self._rate, (nu, nv)):
            cell.append(ns.UInt32(dr.clip((value / z - low) * rate, 0, count - 1)))
        number = (face * nv + cell[1]) * nu + cell[0]
        return dr.gather(ns.UInt32, self._starts, number), dr.gather(ns.UInt32, self._starts, number + 1)

    def distance_to(self, ray: LocalRay) -> Float:
        """Distance along ``ray`` from the viewpoint, through which its line passes, to its origin."""
        return dr.norm(ray.o - self.center) * dr.rsqrt(dr.squared_norm(ray.d))

    def evaluate(self, row: Sequence[Float], d: Vector3f, shift: Vector3f | None = None) -> tuple[Float, Float, Float]:
        """`SplatArrays.find_peak` of the Gaussian with the numbers ``row`` on the ray from the viewpoint, moved by
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
        """Loop over the hits of ``ray``, whose line passes through the viewpoint in front of its origin, of the march
        and of its derivatives.

        ``visit(state, hit, extra)`` processes a hit of the lanes on which ``state.active`` is true. It returns the
        state, on whose ``active`` lanes the march goes on, and ``extra``. Distances are measured from the viewpoint.
        Returns both at the end, and the number of Gaussians that were evaluated.
        """
        ns, Float = self._ns, type(t0)
        first, last = self._find_list(ray.d)

        def process(walk: _ListWalk, hit: ListHit, waiting: list[ListHit], active: Bool) -> _ListWalk:
            here = active & (hit.alpha > 0)
            state, extra = visit(replace(walk.state, active=here), hit, walk.extra)
            return replace(walk, active=walk.active & (~here | state.active), waiting=waiting, state=state, extra=extra)

        def read(walk: _ListWalk) -> tuple[_ListWalk]:
            """Read an entry of the list, and process the nearest hit that is known by then."""
            rank = dr.gather(ns.UInt32, self._entries, walk.entry, walk.active)
            row = self.gather(rank, range(13), walk.active)
            t, alpha, distance = self.evaluate(row, ray.d)
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
        """March ``ray``, whose line passes through the viewpoint in front of its origin, as `march_hits` does, without
        derivatives."""
        ns, Float = self._ns, type(t0)
        medium, shader, occlusion = request.medium, request.color, request.occlusion
        goal, stop = light_limits(Float, request)
        offset = self.distance_to(ray)
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


class _Extent(NamedTuple):
    """Gaussians along one axis: their centres, and their semi-axes of one standard deviation."""

    center: Float
    semi_axes: Any


def _project(across: _Extent, along: _Extent, square: Float, low: Float, high: Float) -> tuple[Float, Float, Bool]:
    """Bounds of ellipsoids on a plane at distance 1, and whether they overlap the interval from ``low`` to ``high``.

    A plane through the viewpoint, x = u z, touches the ellipsoid of squared extent k^2 where (m_x - u m_z)^2 = k^2
    |L_x - u L_z|^2, with the centre m and the semi-axes L. The discriminant is written without differences of large
    numbers.
    """
    (mx, Lx), (mz, Lz) = across, along
    in_front = mz * mz - square * dr.squared_norm(Lz)
    root = square * (dr.squared_norm(mz * Lx - mx * Lz) - square * dr.squared_norm(dr.cross(Lx, Lz)))
    mean, spread = mx * mz - square * dr.dot(Lx, Lz), dr.sqrt(dr.maximum(root, 0))
    inverse = dr.rcp(dr.select(in_front != 0, in_front, 1e-30))
    tangents = (mean - spread) * inverse, (mean + spread) * inverse
    first, last = dr.minimum(*tangents), dr.maximum(*tangents)
    # An ellipsoid that reaches behind the viewpoint is seen outside of both tangents, if there are any.
    is_around = (in_front <= 0) & (root > 0)
    is_between = lambda v: is_around & (v > first) & (v < last)
    left = dr.select(in_front > 0, first, dr.select(is_between(low), last, low))
    right = dr.select(in_front > 0, last, dr.select(is_between(high), first, high))
    is_behind = (in_front > 0) & (mz < 0)
    return left, right, ~is_behind & (left <= high) & (right >= low) & (left <= right)


class _Rectangles(NamedTuple):
    """Cells of a window that each of N Gaussians overlaps: begin and end (exclusive) along both axes, (N,) each."""

    left: np.ndarray
    right: np.ndarray
    bottom: np.ndarray
    top: np.ndarray

    @property
    def count(self) -> np.ndarray:
        """Number of cells (N,)."""
        return (self.right - self.left) * (self.top - self.bottom)


def _list_members(bounds: _Rectangles, order: np.ndarray, cells: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
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
    """A Gaussian on a ray: distance from the viewpoint, absorbed fraction (0: none) and rank."""

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

_MAX_NUMBERS = 1 << 26  # Numbers in the lists of earlier viewpoints that a medium keeps, 4 bytes each


def cells_of_observer(count: int) -> int:
    """Cells along the edge of a face of the cube around an observer among ``count`` Gaussians."""
    return int(np.clip(round(np.sqrt(count) / 8), 16, 128))


def list_splats(medium: SplatMedium, center: Point3f, rays: int, windows: tuple[Window, ...] = ()) -> SplatMedium:
    """The ``medium`` for ``rays`` rays from ``center``, with lists where they take less time than the tree.

    Parameters
    ----------
    center : Point3f
        Viewpoint in the frame of the Gaussians, one lane. The line of each ray passes through it, in front of the ray's
        origin.
    windows : tuple of Window
        Directions of the rays, in that frame; default: all.
    """
    arrays = medium.arrays
    if not medium.may_list or arrays.count < MIN_GAUSSIANS or rays < MIN_RAYS_PER_GAUSSIAN * arrays.count:
        return medium
    windows = windows or cube_windows(cells_of_observer(arrays.count))
    position = np.array(dr.detach(center), np.float64).ravel()
    key = (tuple(map(float, position)), tuple((w.axes.tobytes(), w.lower, w.upper, w.cells) for w in windows))
    made_of = Fingerprint(dr.detach([arrays.shapes, arrays.colors]))
    # Lists of other Gaussians, as before a step of an optimisation, are of no use any more.
    for other in [k for k, (earlier, _) in medium.lists.items() if earlier != made_of]:
        del medium.lists[other]
    _, lists = medium.lists.pop(key, (None, None))
    if lists is None:
        lists = SplatLists(arrays, position, windows)
        # The lists of a camera and of an observer are kept in any case.
        while len(medium.lists) > 1 and sum(other.size for _, other in medium.lists.values()) > _MAX_NUMBERS:
            del medium.lists[next(iter(medium.lists))]
    medium.lists[key] = made_of, lists
    seen = copy(medium)
    seen.hits = copy(lists)
    seen.hits.viewpoint = arrays.namespace.Array3f(center)
    return seen
