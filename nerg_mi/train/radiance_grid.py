"""Occupancy grid during radiance training, and its extraction at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, cascades_from_contracted, cell_corner, dilate
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Array3f
from nerg_mi.photos.cameras import PosedCamera, find_view_tangents

from .radiance_data import FreeSpace

# ---- Density grid during training, and the occupancy that is stored ----
#
# A cubic grid over the unit cube of the field, x varying fastest, as in instant-ngp: each cell stores a decaying
# maximum of the optical depth of one step.

_DECAY = 0.6
# One part of the cells is updated at a time; strides cycle through all parts.
NUM_PARTS = 8
GRID_STATE = ("value", "bits", "seen", "always")  # Arrays of the grid in the run state


class MarchGrid:
    """Decaying maxima of σ times ``step``, and the cells in which samples are taken.

    Parameters
    ----------
    ns : module
        Dr.Jit backend.
    box : AnyBox
        Bounds of the field. In a contracted box the cells have equal size in encoded positions.
    resolution : int
        Cells along an edge.
    step : float
        Length in scene units that converts density to optical depth.
    cameras : list of PosedCamera
        Training cameras.
    min_views : int
        Cells seen by fewer cameras are empty.
    threshold : float
        Optical depth of a step above which a cell is occupied. It is lowered to half of the mean while the field is
        thin.
    free_space : FreeSpace, optional
        Empty space near the cameras.
    growth : float
        In a contracted box, a step is at least ``growth`` times the distance from the centre, so that steps and cells
        grow alike.
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
        free_space: FreeSpace | None = None,
        growth: float = 0.0,
    ):
        self.ns, self.box, self.resolution, self.step, self.threshold = ns, box, resolution, step, threshold
        self.growth = growth if box.is_contracted else 0.0
        self.cameras, self.min_views = cameras, min_views
        cells = resolution**3
        self.index = dr.arange(ns.UInt32, cells)
        if free_space is None:
            free_space = FreeSpace.within(len(cameras), 0)
        self._restrict_to(self._find_seen_cells(free_space))
        if self.seen_count == 0:
            raise NergError(
                f"no cell of the scene box {box.lower} to {box.upper} is seen by {min_views} cameras; pass a box "
                f"around the photographed scene with {parameter('aabb')}"
            )
        self.always = dr.full(ns.Bool, False, cells)
        self.turn = 0

    def _get_corner(self, index):
        """Return the lower corner of cells in the unit cube."""
        return cell_corner(index, self.resolution, self.ns) / self.resolution

    def _sample_point(self, index, rng: np.random.Generator, stratum=0, parts: int = 1):
        """Return a random world point in each cell, in part ``stratum`` of ``parts`` per axis."""
        jitter = self.ns.Array3f(
            *[self.ns.Float(copy_aligned(rng.random(dr.width(index), np.float32))) for _ in range(3)]
        )
        return self._to_world(self._get_corner(index) + (stratum + jitter) / (parts * self.resolution))

    def _to_world(self, u):
        return self.box.from_unit(u)

    def step_length_at(self, p):
        """Return the approximate length of a training step at ``p`` (Array3f, world), assuming that rays start near the
        centre.
        """
        if not self.growth:
            return self.step
        return dr.maximum(self.growth * dr.norm(p - self.ns.Array3f(*self.box.center)), self.step)

    def cell_size_at(self, p):
        """Return the edge of the cell that holds ``p`` (Array3f, world), in scene units, across the line to the
        centre."""
        inner = 2 if self.box.is_contracted else 1
        return self.box.distance_scale(p) * (inner * self.box.side / self.resolution)

    def _find_seen_cells(self, free_space: FreeSpace):
        """Return the cells whose centre is in the box and in at least `min_views` pictures, and not in free space.

        Occlusion is ignored, and the frusta are widened by 10 %, or narrowed by 5 % for free space.
        """
        Float, UInt32 = self.ns.Float, self.ns.UInt32
        p = self._to_world(self._get_corner(self.index) + 0.5 / self.resolution)
        cell = 0 if self.box.is_contracted else self.box.side / self.resolution
        half = ((np.subtract(self.box.upper, self.box.lower) + cell) / 2).tolist()
        inside = dr.all(dr.abs(p - self.ns.Array3f(*self.box.center)) < self.ns.Array3f(*half))
        count = dr.zeros(UInt32, self.resolution**3)
        dr.eval(p, inside)
        for camera, near, clear in zip(self.cameras, free_space.near.tolist(), free_space.clear.tolist()):
            rows = [Float(v) for v in camera.to_world[:3, :3].T.ravel()]
            origin = [Float(v) for v in camera.center]
            edge = [Float(v) for v in find_view_tangents(camera.intrinsics)]
            # Literal poses would compile one kernel per camera.
            dr.make_opaque(rows, origin, edge)
            d = [p[k] - origin[k] for k in range(3)]
            x, y, z = (rows[3 * k] * d[0] + rows[3 * k + 1] * d[1] + rows[3 * k + 2] * d[2] for k in range(3))

            def is_in_view(scale, x=x, y=y, z=z, edge=edge):
                left, right, up, down = (e * scale for e in edge)
                return (z < 0) & (x > left * z) & (x < -right * z) & (-y > up * z) & (-y < -down * z)

            count += dr.select(is_in_view(1.1), UInt32(1), 0)
            squared_distance = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            inside &= squared_distance > dr.opaque(Float, near * near)
            if clear > near:
                inside &= ~is_in_view(0.95) | (squared_distance > dr.opaque(Float, clear * clear))
            dr.eval(count, inside)
        return inside & (count >= min(self.min_views, len(self.cameras)))

    def set_free_space(self, free_space: FreeSpace) -> None:
        """Replace the empty space near the cameras.

        Samples are taken in cells that were empty before once an update finds density there.
        """
        self.seen = self._find_seen_cells(free_space)
        self._count_seen()

    def carve(self, points) -> None:
        """Restrict samples to the cells that hold or touch a surface point; ``points`` yields Array3f (world).

        Use this if every pixel has exact depth, so that all visible surfaces are known. Cells that hold a point are
        always sampled, because a cell that is switched off would never be trained again.
        """
        surface_cells = self._find_cells_with(points)
        self.always = self.seen & self.ns.Bool(surface_cells.ravel())
        self._restrict_to(self.seen & self.ns.Bool(dilate(surface_cells).ravel()))

    def _find_cells_with(self, points) -> np.ndarray:
        """Return the cells (R, R, R) that hold one of the points (Array3f, world) of an iterable."""
        r = self.resolution
        cells = dr.zeros(self.ns.UInt8, r**3)
        for p in points:
            self.mark_cells(cells, p)
        return cells.numpy().reshape(r, r, r) > 0

    def mark_cells(self, cells, p) -> None:
        """Set ``cells`` (UInt8 per cell) where they hold one of the points ``p`` (Array3f, world)."""
        if dr.width(p) > 0:
            dr.scatter(cells, self.ns.UInt8(1), self._find_cell(p))
            dr.eval(cells)

    def _restrict_to(self, cells) -> None:
        """Restrict samples to the mask ``cells``. All of them count as occupied until they are evaluated."""
        self.seen = cells
        self._count_seen()
        self.value = dr.zeros(self.ns.Float, self.resolution**3)
        self.bits = dr.select(cells, self.ns.UInt8(1), 0)
        dr.eval(self.value, self.bits)

    def _count_seen(self) -> None:
        dr.eval(self.seen)
        count: Any = dr.count(self.seen)
        self.seen_count = int(count[0])

    def is_occupied(self, p, active):
        """Return the mask of points ``p`` (Array3f, world) in occupied cells."""
        return self.is_within(self.bits, p, active)

    def is_within(self, bits, p, active):
        """Return the mask of points ``p`` (Array3f, world) in cells set in ``bits`` (UInt8 per cell)."""
        return active & (dr.gather(self.ns.UInt8, bits, self._find_cell(p), active) > 0)

    def _find_cell(self, p):
        """Return the index (UInt32) of the cell that holds ``p`` (Array3f, world)."""
        r = self.resolution
        u: Array3f = self.box.to_unit(p)
        c = [self.ns.UInt32(dr.clip(x * r, 0, r - 1)) for x in (u.x, u.y, u.z)]
        return c[0] + r * (c[1] + r * c[2])

    def update(self, density, rng: np.random.Generator, everywhere: bool = False) -> None:
        """Evaluate the density at one random point in an eighth of the cells, or in all of them.

        ``density`` maps world points (Array3f, mask) to σ without gradient.
        """
        index = self.select_cells(self.turn, 1 if everywhere else NUM_PARTS)
        self.turn += not everywhere
        if dr.width(index) > 0:
            # Clamp the optical depth: larger values carry no information and would dominate the mean.
            p = self._sample_point(index, rng)
            value = dr.minimum(density(p, True) * self.step_length_at(p), 10)
            if not everywhere:
                value = dr.maximum(dr.gather(self.ns.Float, self.value, index) * _DECAY, value)
            dr.scatter(self.value, value, index, mode=dr.ReduceMode.Permute)
            dr.eval(self.value)
        mean = dr.sum(self.value) / self.seen_count
        bound = dr.minimum(self.threshold, 0.5 * mean)
        self.bits = dr.select((self.seen & (self.value > bound)) | self.always, self.ns.UInt8(1), 0)
        dr.eval(self.bits)
        self.unsampled: Any = dr.compress(self.seen & (self.bits == 0))

    def restore(self, value, bits, seen, always, turn: int, unsampled=None) -> None:
        """Restore a stored state (arrays of the attributes of these names).

        States of earlier versions have no ``unsampled``, which differs between a change of free space and the next
        update.
        """
        ns = self.ns
        self.value, self.bits, self.seen, self.always = ns.Float(value), ns.UInt8(bits), ns.Bool(seen), ns.Bool(always)
        self.seen_count, self.turn = int(seen.sum()), turn
        self.unsampled = dr.compress(self.seen & (self.bits == 0)) if unsampled is None else ns.UInt32(unsampled)

    def empty_points(self, count: int, rng: np.random.Generator):
        """Return random points (Array3f, world) in visible cells that are not sampled; None if there are none."""
        if dr.width(self.unsampled) == 0:
            return None
        pick = self.ns.UInt32(copy_aligned(rng.integers(0, dr.width(self.unsampled), count, np.uint32), np.uint32))
        return self._sample_point(dr.gather(self.ns.UInt32, self.unsampled, pick), rng)

    @property
    def occupied_fraction(self) -> float:
        """Fraction of all cells in which samples are taken."""
        return float(dr.sum(self.ns.Float(self.bits))[0]) / self.resolution**3

    def extract_occupancy(
        self,
        density,
        rng: np.random.Generator,
        contributing_points,
        probes: int = 3,
        on_progress: Callable[[float], None] = lambda part: None,
    ) -> OccupancyGrid | CascadeGrid:
        """Extract the occupancy for rendering: cells that may hold density and contribute to training rays.

        Parameters
        ----------
        density : callable
            Maps world points and a mask to σ.
        rng : numpy.random.Generator
            Random numbers of the probes.
        contributing_points : callable
            ``contributing_points(density, occupied)`` yields the points of samples with more than a thousandth of the
            light of a training ray.
        probes : int
            The density is evaluated at ``probes``**3 jittered points per cell.
        on_progress : callable
            Called with the completed part of these.

        Notes
        -----
        A cell with a point above the threshold is occupied, and so are its neighbours, so that a bump between the
        probes of a face is not cut. The threshold, in 1/unit, is the density that absorbs ``self.threshold`` in one
        training step. Of these cells, only those that contribute or touch such a cell remain. All others are empty by
        definition, because no picture constrains them.
        """
        dense_cells = dr.zeros(self.ns.UInt8, self.resolution**3)
        for k in range(probes**3):
            index = dr.compress(self.seen & (dense_cells == 0))
            if dr.width(index) == 0:
                break
            self.mark_dense_cells(
                dense_cells, index, density, rng, (k % probes, k // probes % probes, k // probes**2), probes
            )
            on_progress((k + 1) / probes**3)
        return self.select_contributing(self.dilate_cells(dense_cells), density, contributing_points)

    def select_contributing(self, dense: np.ndarray, density, contributing_points) -> OccupancyGrid | CascadeGrid:
        """Return the occupancy of the cells ``dense`` (R, R, R) that contribute to training rays, or touch such a cell.

        The other parameters are those of `extract_occupancy`.
        """
        bits = self.ns.UInt8(dense.ravel())
        contributing = self._find_cells_with(
            contributing_points(density, lambda p, active: self.is_within(bits, p, active))
        )
        bits = dense & dilate(contributing)
        if self.box.outer_scale is not None:
            return cascades_from_contracted(bits, self.box.outer_scale, self.ns, self.density_threshold)
        return OccupancyGrid(bits, self.ns, self.density_threshold)

    @property
    def density_threshold(self) -> float:
        """Density, in 1/unit, that absorbs ``threshold`` in one training step; in a contracted box, near its centre."""
        return self.threshold / self.step

    def mark_dense_cells(self, cells, index, density, rng: np.random.Generator, stratum: tuple, parts: int) -> None:
        """Set ``cells`` (UInt8 per cell) for the cells ``index`` that are denser than ``density_threshold`` at a random
        point of their ``stratum`` (three numbers) of ``parts`` per axis.
        """
        corner = self.ns.Array3f(*stratum)
        dr.make_opaque(corner)
        p = self._sample_point(index, rng, corner, parts)
        limit = self.threshold / self.step_length_at(p) if self.growth else self.density_threshold
        hit: Any = dr.compress(density(p, True) > limit)
        if dr.width(hit) > 0:
            dr.scatter(cells, self.ns.UInt8(1), dr.gather(self.ns.UInt32, index, hit))
            dr.eval(cells)

    def dilate_cells(self, cells) -> np.ndarray:
        """Return ``cells`` (UInt8 per cell) and their neighbours (R, R, R), restricted to cells that may be sampled."""
        shape = (self.resolution,) * 3
        return dilate(cells.numpy().reshape(shape) > 0) & self.seen.numpy().reshape(shape)

    def keep_sampled(self, cells: np.ndarray) -> None:
        """Always sample ``cells`` (R, R, R) from now on."""
        self.always = self.always | self.ns.Bool(cells.ravel())
        dr.eval(self.always)

    def select_cells(self, turn: int, parts: int = NUM_PARTS):
        """Return every ``parts``-th cell (UInt32) that may be sampled, starting from cell ``turn`` modulo ``parts``."""
        index = dr.arange(self.ns.UInt32, self.resolution**3 // parts) * parts + dr.opaque(self.ns.UInt32, turn % parts)
        seen: Any = dr.compress(dr.gather(self.ns.Bool, self.seen, index))
        return dr.gather(self.ns.UInt32, index, seen)


# ---- Occupancy extraction during training ----
#
# From some step on, every cell that rendering will visit is sampled. These cells are found one piece per step.
#
# Cells that were not sampled have stopped training, and hash collisions fill them with artefacts that appear once a
# picture is rendered with the extracted occupancy (`MarchGrid.extract_occupancy`). The last part of a run must clear
# them. Extracting the occupancy at once would take as long as hundreds of steps.


# Each cell is evaluated in alternate corners of its 2 x 2 x 2 parts: each half along each axis has two of them.
_STRATA = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
_RAY_GROUPS = 32  # Groups of training rays that decide which cells contribute


class OccupancyExtraction:
    """Incremental approximation of `MarchGrid.extract_occupancy` with fewer points per cell and fewer rays.

    Attributes
    ----------
    pieces_done : int
        Number of completed pieces.
    dense_cells : UInt8
        Cells with density.
    contributing_cells : UInt8
        Cells that absorb some light.
    """

    PROBE_PIECES = len(_STRATA) * NUM_PARTS
    NUM_PIECES = PROBE_PIECES + _RAY_GROUPS

    def __init__(self, grid: MarchGrid):
        self.grid, self.pieces_done = grid, 0
        self.dilated_dense: Any = None
        self.dense_cells, self.contributing_cells = (dr.zeros(grid.ns.UInt8, grid.resolution**3) for _ in range(2))
        dr.eval(self.dense_cells, self.contributing_cells)

    @property
    def is_done(self) -> bool:
        return self.pieces_done >= self.NUM_PIECES

    def restore(
        self,
        pieces_done: int,
        dense_cells: np.ndarray,
        contributing_cells: np.ndarray,
        dilated_dense: np.ndarray | None = None,
    ) -> None:
        """Restore a stored state."""
        UInt8 = self.grid.ns.UInt8
        self.pieces_done, self.dense_cells, self.contributing_cells, self.dilated_dense = (
            pieces_done,
            UInt8(dense_cells),
            UInt8(contributing_cells),
            None if dilated_dense is None else UInt8(dilated_dense),
        )

    def advance(self, density, contributing_points, seed: int) -> None:
        """Process the next piece; after the last one the grid is updated.

        Parameters
        ----------
        density : callable
            As for `MarchGrid.extract_occupancy`.
        contributing_points : callable
            ``contributing_points(density, occupied, rng)`` returns points (Array3f, world) of visible samples on some
            training rays, or None.
        seed : int
            Seed of the points and rays.
        """
        if self.is_done:
            return
        grid, rng = self.grid, np.random.default_rng((seed, self.pieces_done))
        if self.pieces_done < self.PROBE_PIECES:
            part = grid.select_cells(self.pieces_done)
            open_: Any = dr.compress(dr.gather(grid.ns.UInt8, self.dense_cells, part) == 0)
            if dr.width(open_) > 0:
                index = dr.gather(grid.ns.UInt32, part, open_)
                grid.mark_dense_cells(self.dense_cells, index, density, rng, _STRATA[self.pieces_done // NUM_PARTS], 2)
        else:
            if self.dilated_dense is None:
                self.dilated_dense = grid.ns.UInt8(grid.dilate_cells(self.dense_cells).ravel())
            p = contributing_points(density, lambda p, active: grid.is_within(self.dilated_dense, p, active), rng)
            if p is not None:
                grid.mark_cells(self.contributing_cells, p)
        self.pieces_done += 1
        if self.is_done:
            grid.keep_sampled(grid.dilate_cells(self.contributing_cells) & grid.dilate_cells(self.dense_cells))
