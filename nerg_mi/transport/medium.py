"""The protocol of media, and what they share: cells of occupancy, local rays, hits, and painting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, UInt32, Vector3f

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Local ray ----
#
# Rays as a medium sees them: handed over once, so that no sample has to be transformed.


@dataclass
class LocalRay:
    """A ray in a medium's coordinates: the point at scene distance ``t`` is ``o + t d``."""

    # Origin.
    o: Point3f
    # Displacement that one scene unit along the ray makes: of any length.
    d: Vector3f
    # Unit direction.
    w: Vector3f
    # Scene distances at which the ray enters and leaves the medium's box; it misses where `t_near >= t_far`. `t_near`
    # may be negative.
    t_near: Float
    t_far: Float


# ---- Cells ----
#
# The voxels of a grid volume: where its interpolant has kinks, and what bounds it.


# Share of a voxel by which a point on a boundary counts as beyond it; far below what a sample can tell.
_NUDGE = 1e-4
# Voxels whose values are asked for at a time.
_ASKED = 1 << 20


class VoxelCells:
    """Axis-aligned cells between which a grid's interpolant has no kink.

    ``lower``, ``upper``: corners of the volume in the scene; ``resolution``: voxels along x, y, z; ``shift``: 0.5 for
    trilinear interpolation, whose pieces meet at voxel centres, 0 for nearest neighbours. ``edge``: of the smallest
    cell, in scene units.
    """

    def __init__(self, lower: Sequence[float], upper: Sequence[float], resolution: Sequence[int], shift: float):
        self._lower = list(lower)
        self._scale = [r / (u - l) for r, l, u in zip(resolution, lower, upper)]
        self._shift = shift
        self.edge = min(1 / s for s in self._scale)

    def next_boundary(self, ray: LocalRay, t: Float) -> Float:
        """Distance at which ``ray`` leaves the cell that it is in just beyond ``t``; rounding may put it before
        ``t``."""
        end = type(t)(dr.inf)
        for o, d, lower, scale in zip(
            (ray.o.x, ray.o.y, ray.o.z), (ray.d.x, ray.d.y, ray.d.z), self._lower, self._scale
        ):
            a, b = (o - lower) * scale - self._shift, d * scale
            c = dr.fma(b, t, a)
            wall = dr.select(b > 0, dr.floor(c + _NUDGE) + 1, dr.ceil(c - _NUDGE) - 1)
            end = dr.minimum(end, dr.select(b != 0, (wall - a) / dr.select(b != 0, b, 1), dr.inf))
        return end


def describe(volume: mi.Volume) -> tuple[VoxelCells, np.ndarray] | None:
    """Cells and voxel values (z, y, x) of an axis-aligned Mitsuba ``gridvolume``; None for any other volume.

    Mitsuba does not tell a volume's transform or interpolation, so both are found by asking for values and
    comparing them with the grid's: what does not match is treated as any other volume. Raises ``NergError`` for a
    grid with values that are not finite or with two channels, of which Mitsuba evaluates none.
    """
    import mitsuba as mi

    if volume.class_name() != "GridVolume":
        return None
    data = np.array(mi.traverse(volume)["data"], np.float32)
    channels = data.size // max(int(np.prod(data.shape[:3])), 1)
    if channels not in (1, 3):
        raise NergError(f'the grid of "density" has {channels} channels; give one with a single channel')
    data = data.reshape(data.shape[:3] + (-1,))[..., 0]
    if not np.all(np.isfinite(data)):
        bad = np.argwhere(~np.isfinite(data))
        raise NergError(
            f'the grid of "density" holds {len(bad)} values that are not finite, the first in voxel '
            f"(z, y, x) = {tuple(bad[0].tolist())}; replace them"
        )
    box = volume.bbox()
    lower, upper = np.array(box.min, float), np.array(box.max, float)
    resolution = data.shape[::-1]
    size = (upper - lower) / resolution
    scale = max(float(np.abs(data).max()), 1e-30)

    def matches(shift: float, tolerance: float) -> bool:
        """Whether the volume has the grid's values at ``shift`` of a voxel from every voxel's lower corner."""
        # Every voxel is asked for: few of them tell a grid that is mostly empty from its mirror image. Some layers at a
        # time: positions take thirty times the memory of values.
        layers = max(1, _ASKED // (data.shape[1] * data.shape[2]))
        for first in range(0, data.shape[0], layers):
            part = data[first : first + layers]
            z, y, x = np.indices(part.shape, np.float32).reshape(3, -1)
            cell = np.stack([x, y, z + first]) + shift
            it = dr.zeros(mi.Interaction3f)
            it.p = mi.Point3f((lower[:, None] + cell * size[:, None]).astype(np.float32))
            if not np.allclose(np.array(volume.eval_1(it)), part.ravel(), atol=tolerance * scale):
                return False
        return True

    if not matches(0.5, 1e-3):
        return None
    # A quarter voxel off the centre, nearest neighbours still return the centre's value.
    nearest = matches(0.25, 1e-6)
    if nearest and not np.allclose(data, data.flat[0]):
        return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.0), data
    return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.5), data


def bound(data: np.ndarray, ns: ModuleType) -> OccupancyGrid | None:
    """Cells of a cubic grid over the volume that may hold density: voxel maxima dilated by one voxel.

    The bound holds for every point that either interpolation can reach. None when nothing could be skipped.
    """
    from scipy.ndimage import maximum_filter

    # Beyond its border a grid goes on with its border's voxels, mirrored ones or those of the far side.
    reach = (maximum_filter(data, 3, mode="nearest") > 0) | (maximum_filter(data, 3, mode="wrap") > 0)
    if reach.all():
        return None
    return OccupancyGrid(reach, ns, 0.0)


# ---- Hits ----
#
# Media of things that are met one by one, each of which absorbs its share of light at one point of the ray.
#
# Gaussian splats are such: what a step is to a density, a hit is to them. They are not sampled, so that nothing of a
# march applies but where it ends; all else (opacity, every kind of depth, occlusion, colour) is the same sum over other
# terms.


@dataclass
class LastHit:
    """Up to where hits are known: the distance, in scene units, and the index of the last one there."""

    t: Float
    index: UInt32


@dataclass
class NextHits:
    """Hits in their order: by distance, and by index where that is the same. Distances are infinite where there are no
    more."""

    # Distance in scene units.
    t: list[Float]
    # Share of the light that is absorbed there, less than 1.
    absorbed: list[Float]
    # Which thing it is.
    index: list[UInt32]
    # Things that were looked at.
    evals: Float


class Hits(Protocol):
    """What rays meet of a medium, in groups of ``at_once``."""

    @property
    def group_size(self) -> int:
        """How many are returned at once."""
        ...

    def find_next(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """The next hits behind ``after`` and nearer than the distance ``before``; ``at_once`` of them, or all, or as
        many as let no more than ``stop`` of the light through, of which ``transmittance`` arrives. Without
        derivatives."""
        ...

    def reevaluate(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """``(t, absorbed)`` of the thing ``index``, attached to the ray and to the medium's parameters."""
        ...


# ---- Protocol ----
#
# What the marcher asks of a medium: its extent, its density and its colour.
#
# A trained field and any pair of Mitsuba volumes answer the same questions, so that analytic cases, grids from other
# tools and neural fields run through one code path. Rays are handed over once (``local``), then every sample is
# ``o + t d`` in the medium's own coordinates while ``t`` stays the distance in the scene.

MAX_DENSITY = 1e30
"""Infinite densities count as this one, which is opaque over any length."""


class Occupancy(Protocol):
    """Where there may be density: equal cells of the unit cube."""

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along x, y and z."""
        ...

    @property
    def coarse(self) -> Occupancy:
        """The grid that this one refines, which holds all that it holds; itself where it refines none."""
        ...

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """How far the cell of ``u`` is from an occupied one, in cells by the chessboard's measure, or less; 0 in an
        occupied one. Points outside of the cube belong to its nearest cell."""
        ...


class Medium(Protocol):
    """Density, colour and features in a box, placed in the scene.

    Two frames: the scene's, in scene units, and the medium's own ("local"), to which ``local`` and ``to_local`` lead.
    On lanes that are not ``active`` anything finite may be returned. What is evaluated is attached to the positions,
    and to the arrays of ``parameters``, wherever these carry derivatives; ``occupancy`` and ``cells`` never carry any.
    """

    @property
    def has_color(self) -> bool:
        """Whether there is a colour to be asked for."""
        ...

    @property
    def is_deferred(self) -> bool:
        """Whether a ray's colour is that of its samples' mean features, rather than the mean of their colours."""
        ...

    @property
    def color_space(self) -> str:
        """What colours are: ``srgb``, ``linear``, or ``spectrum``, a linear spectrum of the variant in use."""
        ...

    @property
    def feature_count(self) -> int:
        """Geometry features of a point, as ``density_features`` returns them; 0 for a medium that has none."""
        ...

    @property
    def length_scale(self) -> float:
        """Diagonal of the box, in scene units."""
        ...

    @property
    def default_step(self) -> float | None:
        """Length of a step that suits the medium, in scene units; None where it knows none."""
        ...

    @property
    def default_dt_gamma(self) -> float:
        """Share of its distance that a step is at least, which suits a medium that gets coarser with distance; 0 where
        steps are best of one length."""
        ...

    @property
    def occupancy(self) -> Occupancy | None:
        """Cells outside of which there certainly is no density; None: nothing may be skipped."""
        ...

    @property
    def cells(self) -> VoxelCells | None:
        """Voxels between which the density has no kinks, in the local frame; None for a medium that is no grid."""
        ...

    @property
    def hits(self) -> Hits | None:
        """What rays meet instead of a density, of a medium that has none: its densities may not be asked for. None for
        one that is marched in steps."""
        ...

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the axis-aligned box around the medium, (3,) each, in the scene's frame."""
        ...

    def parameters(self) -> list[Any]:
        """Arrays that densities and colours depend on: those by which derivatives may be asked for."""
        ...

    def refresh(self, anyway: bool = False) -> None:
        """Renew what is derived from ``parameters`` where these are other arrays than before, or ``anyway``; to be
        called after they may have changed."""
        ...

    def ray_to_local(self, o: Point3f, d: Vector3f) -> LocalRay:
        """The ray of the scene from ``o`` along unit ``d``."""
        ...

    def to_local(self, p: Point3f) -> Point3f:
        """Points of the scene in the local frame."""
        ...

    def to_unit(self, p: Point3f) -> Array3f:
        """Local points in the coordinates of ``occupancy``, whose cells fill the unit cube."""
        ...

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        """Local displacements in the coordinates of ``occupancy``."""
        ...

    def density(self, p: Point3f, active: Bool) -> Float:
        """Density at local points, in 1 / scene unit: finite and not negative."""
        ...

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        """``density``, and the ``feature_count`` features of the same points, which ``color`` needs."""
        ...

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour in ``color_space`` at local points ``p`` in the unit local direction ``w`` of the ray. Only to be
        called where ``has_color``. ``features``: of the points, or the index of the hit alone in a medium of hits; in
        a ``deferred`` one the mean along a ray, which may have been gathered anywhere on it."""
        ...

    def background(self, o: Point3f, d: Vector3f) -> Color | None:
        """Colour in ``color_space`` behind the medium along rays of the scene; None for a medium that knows none."""
        ...


def bounded(sigma: Float) -> Float:
    """``sigma`` as a density: 0 where it is negative or NaN, at most ``MAX_DENSITY``."""
    # A negative value of an interpolated or fitted grid would create light; comparing also drops NaN.
    return dr.select(sigma > 0, dr.minimum(sigma, MAX_DENSITY), 0)


# ---- Painting ----
#
# What samples contribute to the sum that a march gathers along a ray beside its optical depth: colour, as a rule.


class Painter(Protocol):
    """What samples contribute. Sums are arrays that can be added, and scaled by a Float."""

    def zero(self) -> Color:
        """A sum of nothing, of one lane."""
        ...

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """The contribution of a sample that absorbs all light, attached to whatever carries derivatives.

        ``features``: of the same point, as ``medium.density_features`` returned them, or the index of a hit (`hits`);
        ``p``, ``w``: the point and the
        unit direction of the ray in the medium's coordinates.
        """
        ...

    def resolve_color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
        """Colour, times ``opacity``, of rays that gathered ``sums``; None where no colour is gathered."""
        ...


class ColorPainter:
    """The medium's own colour, as an ``array_type`` such as ``Color3f``; in the medium's ``color_space``. Not for a
    medium that is ``deferred``: see ``field_medium.make_color_shader``."""

    def __init__(self, array_type: type):
        self.array_type = array_type

    def zero(self) -> Color:
        return self.array_type(0)

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        return self.array_type(medium.color(features, p, w, active))

    def resolve_color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color:
        return sums
