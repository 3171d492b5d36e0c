"""Cells of the rays of a camera or an observer, and the cells in which an ellipsoid can be seen.

Rays are divided by where they cross a plane in front of their common centre, whose coordinates are u and v. Each kind
of camera is a class: it finds the cell of a ray, and bounds an ellipsoid on the plane as all its rays see it. Gaussian
splats are listed by these cells (`splat_lists`).
"""

from __future__ import annotations

from copy import copy
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Array3f, Float, Point3f, UInt32, Vector3f

_MAX_APERTURE_TILES = 8  # Along each edge of the square around the aperture
_MAX_BOUNDS = 1 << 26  # Bounds of ellipsoids in all tiles, of 16 bytes each
_ROUNDING = 2.0**-20  # Relative error of origins of rays by which apertures are extended


class Extent(NamedTuple):
    """Ellipsoids along one axis, relative to the centre of the rays: their centres and their semi-axes."""

    center: Float
    semi_axes: Array3f

    def move(self, shift: Float) -> Extent:
        """The same ellipsoids, moved along the axis."""
        return Extent(self.center + shift, self.semi_axes)


class Ellipsoids(NamedTuple):
    """N ellipsoids: their centres relative to that of the rays, their three semi-axes, and the square of a factor of
    the semi-axes."""

    center: Array3f
    semi_axes: list[Array3f]
    square: Float

    def along(self, axis: Array3f) -> Extent:
        """The ellipsoids along a unit vector."""
        return Extent(dr.dot(axis, self.center), type(axis)(*(dr.dot(axis, s) for s in self.semi_axes)))


class RayCells:
    """Rays whose lines pass through one point, which cross the plane z = 1: the base of all kinds.

    Parameters
    ----------
    axes : array (3, 3)
        Unit vectors u, v and z in the frame of the ellipsoids.
    lower, upper : tuple of float
        Coordinates u and v of the corners of all cells.
    cells : tuple of int
        Cells along u and v.
    """

    # Compiled kernels read the arrays of `prepare`.
    UNRECORDED: ClassVar[tuple[str, ...]] = ("axes", "lower", "upper")

    num_faces = 1
    """Planes with cells."""

    has_center = True
    """Whether the lines of all rays pass through one point."""

    _axes: list[Array3f]
    _lower: list[Float]
    _rate: list[Float]

    def __init__(
        self, axes: np.ndarray, lower: tuple[float, float], upper: tuple[float, float], cells: tuple[int, int]
    ):
        self.axes, self.lower, self.upper, self.cells = np.asarray(axes, np.float64), lower, upper, cells

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for equal cells."""
        return type(self), self.num_faces, self.cells, self.lower, self.upper, self.axes.tobytes()

    def to_local(self, to_world: Similarity) -> RayCells:
        """These cells in the frame of a field that ``to_world`` places in the scene."""
        local = copy(self)
        local.axes = self.axes @ to_world.matrix[:3, :3] / to_world.scale
        return local

    def adapt(self, num_gaussians: int, center: np.ndarray) -> RayCells:
        """These cells for the number of ellipsoids, and for rays around ``center`` (3,)."""
        return self

    def prepare(self, ns: ModuleType) -> RayCells:
        """These cells with arrays for kernels, which are not compiled again for other cameras."""
        ready = copy(self)
        ready._axes = [ns.Array3f(*map(float, axis)) for axis in self.axes]
        ready._lower = [ns.Float(float(v)) for v in self.lower]
        ready._rate = [ns.Float(n / (b - a)) for n, a, b in zip(self.cells, self.lower, self.upper)]
        dr.make_opaque(ready._axes, ready._lower, ready._rate)
        return ready

    # ---- Ellipsoids ----

    def bound(self, ellipsoids: Ellipsoids, face: int) -> list[tuple[Float, Float]]:
        """Bounds of ellipsoids along u and v of a face, in cells; lower > upper if no ray meets them."""
        *both, z = (ellipsoids.along(axis) for axis in self._face_axes(face))
        projected = [self._project(across, z, ellipsoids.square, face, k) for k, across in enumerate(both)]
        to_cells = zip(projected, self._lower, self._rate)
        return [((left - low) * rate, (right - low) * rate) for (left, right), low, rate in to_cells]

    def _face_axes(self, face: int) -> list[Array3f]:
        return self._axes

    def _project(self, across: Extent, z: Extent, square: Float, face: int, k: int) -> tuple[Float, Float]:
        """Bounds of ellipsoids in the coordinate k."""
        return project(across, z, square)

    def order(self, p: Array3f) -> Float:
        """Numbers from 0 on by which points relative to the centre are sorted as along the rays."""
        return dr.squared_norm(p)

    def view(self, center: Point3f) -> Array3f:
        """What directions towards points depend on, with its derivatives: the centre of the rays."""
        return center

    def direction_to(self, p: Array3f, view: Array3f) -> Vector3f:
        """Direction of the rays at points ``p``, of any length."""
        return p - view

    # ---- Rays ----

    def find_cell(self, o: Array3f, d: Vector3f) -> UInt32:
        """Number of the cell of rays with origins ``o`` relative to the centre."""
        return self._number(*self._find_position(o, d))

    def _find_position(self, o: Array3f, d: Vector3f) -> tuple[Float, Float]:
        x, y, z = (dr.dot(axis, d) for axis in self._axes)
        return x / z, y / z

    def _number(self, u: Float, v: Float, face: Any = 0) -> UInt32:
        UInt32: Any = dr.uint32_array_t(type(u))
        (nu, nv), cell = self.cells, []
        for value, low, rate, count in zip((u, v), self._lower, self._rate, self.cells):
            cell.append(UInt32(dr.clip((value - low) * rate, 0, count - 1)))
        return (UInt32(face) * nv + cell[1]) * nu + cell[0]


class CubeCells(RayCells):
    """Rays from one point in all directions: the faces of a cube, with ``edge`` cells along each edge; 0: by the number
    of ellipsoids."""

    num_faces = 6

    def __init__(self, edge: int = 0):
        super().__init__(np.eye(3), (-1.0, -1.0), (1.0, 1.0), (edge, edge))

    def to_local(self, to_world: Similarity) -> CubeCells:
        # Any axes will do.
        return self

    def adapt(self, num_gaussians: int, center: np.ndarray) -> CubeCells:
        return self if self.cells[0] else CubeCells(int(np.clip(round(np.sqrt(num_gaussians) / 8), 16, 128)))

    def _face_axes(self, face: int) -> list[Array3f]:
        # Faces 2 a and 2 a + 1 look along axis a and against it.
        a, sign = face // 2, 1 - 2 * (face % 2)
        along = dr.opaque(type(self._lower[0]), float(sign)) * self._axes[a]
        return [self._axes[(a + 1) % 3], self._axes[(a + 2) % 3], along]

    def find_cell(self, o: Array3f, d: Vector3f) -> UInt32:
        UInt32: Any = dr.uint32_array_t(type(d.x))
        size = [dr.abs(d.x), dr.abs(d.y), dr.abs(d.z)]
        is_x = (size[0] >= size[1]) & (size[0] >= size[2])
        is_y = ~is_x & (size[1] >= size[2])
        pick = lambda a, b, c: dr.select(is_x, a, dr.select(is_y, b, c))
        x, y, along = pick(d.y, d.z, d.x), pick(d.z, d.x, d.y), pick(d.x, d.y, d.z)
        face = pick(UInt32(0), UInt32(2), UInt32(4)) + dr.select(along < 0, UInt32(1), UInt32(0))
        return self._number(x / dr.abs(along), y / dr.abs(along), face)


class ParallelCells(RayCells):
    """Parallel rays along z: u and v are coordinates of their lines relative to the centre.

    ``forward``: the direction of the rays in the scene, if it carries derivatives.
    """

    UNRECORDED = (*RayCells.UNRECORDED, "forward")
    has_center = False

    def __init__(self, *args: Any, forward: Vector3f | None = None):
        super().__init__(*args)
        self.forward = forward

    def to_local(self, to_world: Similarity) -> ParallelCells:
        local = cast("ParallelCells", super().to_local(to_world))
        local.lower, local.upper = (tuple(v / to_world.scale for v in corner) for corner in (self.lower, self.upper))
        if self.forward is not None:
            local.forward = to_world.direction_to_local(self.forward)
        return local

    def prepare(self, ns: ModuleType) -> ParallelCells:
        ready = cast("ParallelCells", super().prepare(ns))
        ready.forward = None
        return ready

    def _project(self, across: Extent, z: Extent, square: Float, face: int, k: int) -> tuple[Float, Float]:
        radius = dr.sqrt(square * dr.squared_norm(across.semi_axes))
        return across.center - radius, across.center + radius

    def order(self, p: Array3f) -> Float:
        depth = dr.dot(self._axes[2], p)
        return depth - dr.min(depth)

    def view(self, center: Point3f) -> Array3f:
        return dr.opaque(type(center), self.axes[2].tolist()) if self.forward is None else self.forward

    def direction_to(self, p: Array3f, view: Array3f) -> Vector3f:
        return view

    def _find_position(self, o: Array3f, d: Vector3f) -> tuple[Float, Float]:
        return dr.dot(self._axes[0], o), dr.dot(self._axes[1], o)


class LensCells(RayCells):
    """Rays from the points of a disk of ``radius`` around the centre, z = 0, to the plane at the distance ``focus``,
    whose points are (u, v, 1) ``focus``.

    Seen from the lens point (a, b), a point (x, y, z) is at u = (x - a) / z + a / focus. For each point of an ellipsoid
    this is linear in a, so that the bounds are those seen from the ends of the interval of a. The square around the
    disk is divided into tiles, each of which has cells of its own: blurred ellipsoids have fewer of them than all rays
    of a cell meet.
    """

    UNRECORDED = (*RayCells.UNRECORDED, "radius", "focus", "_slack")
    has_center = False

    _inverse_focus: Float
    _inverse_radius: Float

    def __init__(self, *args: Any, radius: float, focus: float):
        super().__init__(*args)
        self.radius, self.focus = radius, focus
        self._tiles, self._slack = 1, _ROUNDING

    @property
    def key(self) -> tuple[Any, ...]:
        return *super().key, self.radius, self.focus

    def to_local(self, to_world: Similarity) -> LensCells:
        local = cast("LensCells", super().to_local(to_world))
        local.radius, local.focus = self.radius / to_world.scale, self.focus / to_world.scale
        return local

    def adapt(self, num_gaussians: int, center: np.ndarray) -> LensCells:
        adapted = copy(self)
        # The blur far behind the plane in cells: cells that are much smaller only make more lists longer.
        blur = 2 * self.radius / self.focus * self.cells[0] / (self.upper[0] - self.lower[0])
        max_tiles = int(np.clip(np.sqrt(_MAX_BOUNDS / num_gaussians), 1, _MAX_APERTURE_TILES))
        adapted._tiles = int(np.clip(np.ceil(1.4 * np.sqrt(blur)), 1, max_tiles))
        size = max(blur / adapted._tiles, 1)
        nu, nv = (max(round(n / size), 1) for n in self.cells)
        adapted.cells = nu, nv
        adapted.num_faces = adapted._tiles**2
        adapted._slack = _ROUNDING * float(1 + np.abs(center).max() / self.radius)
        return adapted

    def prepare(self, ns: ModuleType) -> LensCells:
        ready = cast("LensCells", super().prepare(ns))
        ready._inverse_focus, ready._inverse_radius = ns.Float(1 / self.focus), ns.Float(1 / self.radius)
        dr.make_opaque(ready._inverse_focus, ready._inverse_radius)
        return ready

    def _project(self, across: Extent, z: Extent, square: Float, face: int, k: int) -> tuple[Float, Float]:
        tile, bounds = (face % self._tiles, face // self._tiles)[k], []
        for end in (2 * tile / self._tiles - 1 - self._slack, 2 * (tile + 1) / self._tiles - 1 + self._slack):
            a = dr.opaque(type(square), end * self.radius)
            bounds.append([v + a * self._inverse_focus for v in project(across.move(-a), z, square)])
        (left, right), (other_left, other_right) = bounds
        return dr.minimum(left, other_left), dr.maximum(right, other_right)

    def find_cell(self, o: Array3f, d: Vector3f) -> UInt32:
        UInt32: Any = dr.uint32_array_t(type(d.x))
        (ox, oy, oz), (dx, dy, dz) = ([dr.dot(axis, v) for axis in self._axes] for v in (o, d))
        slopes = dx / dz, dy / dz
        points = [p - oz * slope for p, slope in zip((ox, oy), slopes)]
        tile_size = 0.5 * self._tiles * self._inverse_radius
        i, j = (UInt32(dr.clip(dr.fma(p, tile_size, 0.5 * self._tiles), 0, self._tiles - 1)) for p in points)
        u, v = (dr.fma(p, self._inverse_focus, slope) for p, slope in zip(points, slopes))
        return self._number(u, v, j * self._tiles + i)


def project(across: Extent, z: Extent, square: Float) -> tuple[Float, Float]:
    """Bounds of the parts of ellipsoids in z > 0 on the plane z = 1, as seen from the origin; infinite where there are
    none, with lower > upper if nothing is seen.

    A plane through the origin, x = u z, touches the ellipsoid of squared extent k^2 where (m_x - u m_z)^2 = k^2
    |L_x - u L_z|^2, with the centre m and the semi-axes L. The discriminant is written without differences of large
    numbers.
    """
    (mx, Lx), (mz, Lz) = across, z
    in_front = mz * mz - square * dr.squared_norm(Lz)
    root = square * (dr.squared_norm(mz * Lx - mx * Lz) - square * dr.squared_norm(dr.cross(Lx, Lz)))
    mean, spread = mx * mz - square * dr.dot(Lx, Lz), dr.sqrt(dr.maximum(root, 0))
    inverse = dr.rcp(dr.select(in_front != 0, in_front, 1e-30))
    tangents = (mean - spread) * inverse, (mean + spread) * inverse
    first, last = dr.minimum(*tangents), dr.maximum(*tangents)
    # An ellipsoid that reaches behind the origin extends to infinity on the side where it crosses the plane z = 0, and
    # on both sides if it contains the origin.
    crosses, side = in_front <= 0, mx * dr.squared_norm(Lz) - mz * dr.dot(Lx, Lz)
    is_outside = root > 0
    left = dr.select(crosses, dr.select(is_outside & (side > 0), last, -dr.inf), first)
    right = dr.select(crosses, dr.select(is_outside & (side < 0), first, dr.inf), last)
    is_behind = ~crosses & (mz < 0)
    return dr.select(is_behind, dr.inf, left), dr.select(is_behind, -dr.inf, right)
