"""The occupancy grid while a radiance field is trained, and how it settles at the end."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, cell_corner, cascades_from_contracted, dilate
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Array3f
from nerg_mi.photos.cameras import PosedCamera, find_view_tangents

# ---- Where density may be while a field trains, and the bound that is stored when it is done ----
#
# A cubic grid over the field's unit cube, x varying fastest, as instant-ngp keeps it: each cell
# remembers a decaying maximum of the optical depth that one step finds in it.

_DECAY = 0.6
# A share of the cells is refreshed at a time; the strides walk over all of them.
_PARTS = 8
GRID_STATE = ("value", "bits", "seen", "always")  # Arrays of the grid that the state of a run keeps


class DensityGrid:
    """Decaying maxima of σ times ``step``, and the cells in which samples are taken.

    ``step``: length, in scene units, that turns density into optical depth; ``threshold``: optical
    depth a step from which on a cell counts, lowered to half of the mean while the field is thin. Of a contracted box
    the cells are equal where positions are encoded, and a step is at least ``growth`` times the distance from its
    centre: cells and steps grow alike outwards.
    """

    def __init__(
        self,
        ns,
        box: AnyBox,
        resolution: int,
        step: float,
        cameras: list[PosedCamera],
        min_views: int,
        threshold: float = 0.01,
        near: float = 0.0,
        growth: float = 0.0,
    ):
        self.ns, self.box, self.resolution, self.step, self.threshold = ns, box, resolution, step, threshold
        self.growth = growth if box.is_contracted else 0.0
        cells = resolution**3
        self.index = dr.arange(ns.UInt32, cells)
        self._allow(self._seen(cameras, min_views, near))
        if self.seen_count == 0:
            raise NergError(
                f"not one cell of the scene box {box.lower} to {box.upper} is seen by {min_views} cameras; "
                "give a box that holds what the pictures show with --aabb"
            )
        self.always = dr.full(ns.Bool, False, cells)
        self.turn = 0

    def _corner(self, index):
        """Lower corner of cells in the unit cube."""
        return cell_corner(index, self.resolution, self.ns) / self.resolution

    def _point(self, index, rng: np.random.Generator, stratum=0, parts: int = 1):
        """A random world point in each cell, in part ``stratum`` of ``parts`` an axis."""
        jitter = self.ns.Array3f(*[self.ns.Float(copy_aligned(rng.random(dr.width(index), np.float32))) for _ in range(3)])
        return self._to_world(self._corner(index) + (stratum + jitter) / (parts * self.resolution))

    def _to_world(self, u):
        return self.box.from_unit(u)

    def step_length_at(self, p):
        """Length of a training step at ``p`` (Array3f, world), about: rays start anywhere near the centre."""
        if not self.growth:
            return self.step
        return dr.maximum(self.growth * dr.norm(p - self.ns.Array3f(*self.box.center)), self.step)

    def cell_size_at(self, p):
        """Edge of the cell that holds ``p`` (Array3f, world), in the field's units; across the line to the centre."""
        inner = 2 if self.box.is_contracted else 1
        return self.box.distance_scale(p) * (inner * self.box.side / self.resolution)

    def _seen(self, cameras: list[PosedCamera], min_views: int, near: float):
        """Cells whose centre lies within the box and in at least ``min_views`` pictures.

        Occlusion is not considered, and pictures are taken to be 10 % wider than their borders' rays.
        """
        Float, UInt32 = self.ns.Float, self.ns.UInt32
        p = self._to_world(self._corner(self.index) + 0.5 / self.resolution)
        cell = 0 if self.box.is_contracted else self.box.side / self.resolution
        half = ((np.subtract(self.box.upper, self.box.lower) + cell) / 2).tolist()
        inside = dr.all(dr.abs(p - self.ns.Array3f(*self.box.center)) < self.ns.Array3f(*half))
        count = dr.zeros(UInt32, self.resolution**3)
        dr.eval(p, inside)
        for camera in cameras:
            rows = [Float(v) for v in camera.to_world[:3, :3].T.ravel()]
            origin = [Float(v) for v in camera.center]
            edge = [Float(v) for v in find_view_tangents(camera.intrinsics)]
            # As literals the pose would compile one kernel a camera.
            dr.make_opaque(rows, origin, edge)
            d = [p[k] - origin[k] for k in range(3)]
            x, y, z = (rows[3 * k] * d[0] + rows[3 * k + 1] * d[1] + rows[3 * k + 2] * d[2] for k in range(3))
            left, right, up, down = (e * 1.1 for e in edge)
            sees = (z < 0) & (x > left * z) & (x < -right * z) & (-y > up * z) & (-y < -down * z)
            count += dr.select(sees, UInt32(1), 0)
            inside &= d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > near * near
            dr.eval(count, inside)
        return inside & (count >= min(min_views, len(cameras)))

    def carve(self, points) -> None:
        """Keep only the cells that hold or touch one of the surface points: ``points`` yields Array3f (world).

        For depth that is exact and known at every pixel: all that a camera can see lies on those points. The
        cells that hold one stay on whatever is found in them: once off, nothing would be learnt there again.
        """
        found = self._holding(points)
        self.always = self.seen & self.ns.Bool(found.ravel())
        self._allow(self.seen & self.ns.Bool(dilate(found).ravel()))

    def _holding(self, points) -> np.ndarray:
        """Cells (R, R, R) that hold one of the points (Array3f, world) of an iterable."""
        r = self.resolution
        found = dr.zeros(self.ns.UInt8, r**3)
        for p in points:
            self.mark_cells(found, p)
        return found.numpy().reshape(r, r, r) > 0

    def mark_cells(self, cells, p) -> None:
        """Set ``found`` (UInt8 a cell) where it holds one of the points ``p`` (Array3f, world)."""
        if dr.width(p) > 0:
            dr.scatter(cells, self.ns.UInt8(1), self._cell(p))
            dr.eval(cells)

    def _allow(self, cells) -> None:
        """Restrict samples to ``cells`` (mask), all of which count as occupied until they are looked at."""
        self.seen = cells
        count: Any = dr.count(cells)
        self.seen_count = int(count[0])
        self.value = dr.zeros(self.ns.Float, self.resolution**3)
        self.bits = dr.select(cells, self.ns.UInt8(1), 0)
        dr.eval(self.seen, self.value, self.bits)

    def is_occupied(self, p, active):
        """Mask of the points ``p`` (Array3f, world) in cells that may hold density."""
        return self.is_within(self.bits, p, active)

    def is_within(self, bits, p, active):
        """Mask of the points ``p`` (Array3f, world) in cells of ``bits`` (UInt8 a cell)."""
        return active & (dr.gather(self.ns.UInt8, bits, self._cell(p), active) > 0)

    def _cell(self, p):
        """Index (UInt32) of the cell that holds ``p`` (Array3f, world)."""
        r = self.resolution
        u: Array3f = self.box.to_unit(p)
        c = [self.ns.UInt32(dr.clip(x * r, 0, r - 1)) for x in (u.x, u.y, u.z)]
        return c[0] + r * (c[1] + r * c[2])

    def update(self, density, rng: np.random.Generator, everywhere: bool = False) -> None:
        """Look at one random point in an eighth of the cells, or in all of them.

        ``density``: σ at world points (Array3f, mask), without gradient.
        """
        index = self.select_cells(self.turn, 1 if everywhere else _PARTS)
        self.turn += not everywhere
        if dr.width(index) > 0:
            # Beyond some optical depth more says nothing, and would drown the mean.
            p = self._point(index, rng)
            value = dr.minimum(density(p, True) * self.step_length_at(p), 10)
            if not everywhere:
                value = dr.maximum(dr.gather(self.ns.Float, self.value, index) * _DECAY, value)
            dr.scatter(self.value, value, index, mode=dr.ReduceMode.Permute)
            dr.eval(self.value)
        mean = dr.sum(self.value) / self.seen_count
        bound = dr.minimum(self.threshold, 0.5 * mean)
        self.bits = dr.select((self.seen & (self.value > bound)) | self.always, self.ns.UInt8(1), 0)
        dr.eval(self.bits)
        self.unsampled = dr.compress(self.seen & (self.bits == 0))

    def restore(self, value, bits, seen, always, turn: int) -> None:
        """Go on from a stored state (arrays of the attributes of these names)."""
        ns = self.ns
        self.value, self.bits, self.seen, self.always = ns.Float(value), ns.UInt8(bits), ns.Bool(seen), ns.Bool(always)
        self.seen_count, self.turn = int(seen.sum()), turn
        self.unsampled = dr.compress(self.seen & (self.bits == 0))

    def empty_points(self, count: int, rng: np.random.Generator):
        """Random points (Array3f, world) in cells that cameras see and that are not sampled; None without any."""
        if dr.width(self.unsampled) == 0:
            return None
        pick = self.ns.UInt32(copy_aligned(rng.integers(0, dr.width(self.unsampled), count, np.uint32), np.uint32))
        return self._point(dr.gather(self.ns.UInt32, self.unsampled, pick), rng)

    @property
    def occupied_fraction(self) -> float:
        """Share of all cells that samples are taken in."""
        return float(dr.sum(self.ns.Float(self.bits))[0]) / self.resolution**3

    def extract_occupancy(self, density, rng: np.random.Generator, contributing_points, probes: int = 3) -> OccupancyGrid | CascadeGrid:
        """A grid for rendering, of cells that may hold density and that matter to the training rays.

        ``probes``**3 jittered points a cell are looked at; a cell with one above the threshold stays on, and so do all
        that touch it, so that a bump between the probes of a face is not cut. The threshold, in 1/unit, is the density
        that absorbs ``self.threshold`` in one training step. Of these cells those stay that take more than a
        thousandth of some training ray's light, or touch one that does: ``lit(density, occupied)`` yields
        the points of such samples. All others are empty by definition: no picture says what is in them.
        """
        found = dr.zeros(self.ns.UInt8, self.resolution**3)
        for k in range(probes**3):
            index = dr.compress(self.seen & (found == 0))
            if dr.width(index) == 0:
                break
            self.mark_dense_cells(found, index, density, rng, (k % probes, k // probes % probes, k // probes**2), probes)
        dense = self.dilate_cells(found)
        bits = self.ns.UInt8(dense.ravel())
        shown = self._holding(contributing_points(density, lambda p, active: self.is_within(bits, p, active)))
        bits = dense & dilate(shown)
        if self.box.outer_scale is not None:
            return cascades_from_contracted(bits, self.box.outer_scale, self.ns, self.density_threshold)
        return OccupancyGrid(bits, self.ns, self.density_threshold)

    @property
    def density_threshold(self) -> float:
        """Density, in 1/unit, that absorbs ``threshold`` in one training step; of a contracted box, near its centre."""
        return self.threshold / self.step

    def mark_dense_cells(self, cells, index, density, rng: np.random.Generator, stratum: tuple, parts: int) -> None:
        """Set ``found`` (UInt8 a cell) for those of the cells ``index`` that are denser than ``limit`` at a random
        point of their ``stratum`` (three numbers) of ``parts`` an axis."""
        corner = self.ns.Array3f(*stratum)
        dr.make_opaque(corner)
        p = self._point(index, rng, corner, parts)
        limit = self.threshold / self.step_length_at(p) if self.growth else self.density_threshold
        hit: Any = dr.compress(density(p, True) > limit)
        if dr.width(hit) > 0:
            dr.scatter(cells, self.ns.UInt8(1), dr.gather(self.ns.UInt32, index, hit))
            dr.eval(cells)

    def dilate_cells(self, cells) -> np.ndarray:
        """Cells (R, R, R) of ``found`` (UInt8 a cell) and all that touch one of them, as far as they may be sampled."""
        shape = (self.resolution,) * 3
        return dilate(cells.numpy().reshape(shape) > 0) & self.seen.numpy().reshape(shape)

    def keep_sampled(self, cells: np.ndarray) -> None:
        """From now on sample ``cells`` (R, R, R) whatever is found in them."""
        self.always = self.always | self.ns.Bool(cells.ravel())
        dr.eval(self.always)

    def select_cells(self, turn: int, parts: int = _PARTS):
        """Every ``parts``-th cell (UInt32) that may be sampled, from cell ``turn`` modulo ``parts`` on."""
        index = dr.arange(self.ns.UInt32, self.resolution**3 // parts) * parts + dr.opaque(self.ns.UInt32, turn % parts)
        seen: Any = dr.compress(dr.gather(self.ns.Bool, self.seen, index))
        return dr.gather(self.ns.UInt32, index, seen)


# ---- Settling ----
#
# From some point of a training on, every cell that rendering will visit is sampled; found a piece a step.
#
# Cells that were left out stopped learning, and what hashing made of them shows once a picture is rendered under the
# bound of what the field has become (`DensityGrid.bound`): the last part of a run must clear it. Finding them at once
# would take as long as hundreds of steps.


# Every cell is looked at in alternate corners of its 2 x 2 x 2 parts: each half along each axis has two of them.
_STRATA = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
_LOOKS = 32  # Groups of training rays that decide which cells matter


class OccupancyExtraction:
    """Which cells the `DensityGrid.bound` of this moment would hold, nearly: by fewer points a cell and fewer rays.

    ``at``: pieces done; ``found``: cells (UInt8 each) with density; ``shown``: cells that absorb some light.
    """

    PROBE_PIECES = len(_STRATA) * _PARTS
    NUM_PIECES = PROBE_PIECES + _LOOKS

    def __init__(self, grid: DensityGrid):
        self.grid, self.pieces_done = grid, 0
        self.dense_cells, self.contributing_cells = (dr.zeros(grid.ns.UInt8, grid.resolution**3) for _ in range(2))
        self.dilated_dense = None
        dr.eval(self.dense_cells, self.contributing_cells)

    @property
    def is_done(self) -> bool:
        return self.pieces_done >= self.NUM_PIECES

    def restore(self, pieces_done: int, dense_cells: np.ndarray, contributing_cells: np.ndarray) -> None:
        """Go on from a stored state."""
        UInt8 = self.grid.ns.UInt8
        self.pieces_done, self.dense_cells, self.contributing_cells, self.dilated_dense = pieces_done, UInt8(dense_cells), UInt8(contributing_cells), None

    def advance(self, density, contributing_points, seed: int) -> None:
        """The next piece; with the last one the grid is told.

        ``density``: of the field, as `DensityGrid.bound` has it; ``lit(density, occupied, rng)``: points (Array3f,
        world) of samples that some training rays see, or None; ``seed``: of the points and rays.
        """
        if self.is_done:
            return
        grid, rng = self.grid, np.random.default_rng((seed, self.pieces_done))
        if self.pieces_done < self.PROBE_PIECES:
            part = grid.select_cells(self.pieces_done)
            open_: Any = dr.compress(dr.gather(grid.ns.UInt8, self.dense_cells, part) == 0)
            if dr.width(open_) > 0:
                index = dr.gather(grid.ns.UInt32, part, open_)
                grid.mark_dense_cells(self.dense_cells, index, density, rng, _STRATA[self.pieces_done // _PARTS], 2)
        else:
            if self.dilated_dense is None:
                self.dilated_dense = grid.ns.UInt8(grid.dilate_cells(self.dense_cells).ravel())
            p = contributing_points(density, lambda p, active: grid.is_within(self.dilated_dense, p, active), rng)
            if p is not None:
                grid.mark_cells(self.contributing_cells, p)
        self.pieces_done += 1
        if self.is_done:
            grid.keep_sampled(grid.dilate_cells(self.contributing_cells) & grid.dilate_cells(self.dense_cells))
