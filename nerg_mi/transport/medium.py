"""The protocol of media and its parts: voxel cells, local rays, discrete hits, and sample shaders."""

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
# A ray in the coordinates of a medium: transformed once, so that samples need no transform.


@dataclass
class LocalRay:
    """A ray in the coordinates of a medium: the point at the scene distance ``t`` is ``o + t d``."""

    # Origin.
    o: Point3f
    # Displacement per scene unit along the ray; of any length.
    d: Vector3f
    # Unit direction.
    w: Vector3f
    # Scene distances at which the ray enters and leaves the bounding box; the ray misses the box if `t_near >= t_far`.
    # `t_near` can be negative.
    t_near: Float
    t_far: Float


# ---- Cells ----
#
# The voxels of a grid volume: the kinks of its interpolant, and an upper bound of its density.


# Fraction of a voxel by which a point on a boundary counts as beyond it.
_NUDGE = 1e-4
# Voxels whose values are read in one batch.
_BLOCK_VOXELS = 1 << 20


class VoxelCells:
    """Axis-aligned cells inside which a grid's interpolant has no kink.

    Parameters
    ----------
    lower, upper : sequence of float
        Corners of the volume in the scene.
    resolution : sequence of int
        Voxels along x, y, z.
    shift : float
        0.5 for trilinear interpolation, whose pieces meet at voxel centres; 0 for nearest neighbour.

    Attributes
    ----------
    min_edge : float
        Shortest edge of a cell in scene units.
    """

    def __init__(self, lower: Sequence[float], upper: Sequence[float], resolution: Sequence[int], shift: float):
        self._lower = list(lower)
        self._scale = [r / (u - l) for r, l, u in zip(resolution, lower, upper)]
        self._shift = shift
        self.min_edge = min(1 / s for s in self._scale)

    def next_boundary(self, ray: LocalRay, t: Float) -> Float:
        """Distance at which ``ray`` leaves the cell just beyond ``t``; rounding can place it in front of ``t``."""
        end = type(t)(dr.inf)
        for o, d, lower, scale in zip(
            (ray.o.x, ray.o.y, ray.o.z), (ray.d.x, ray.d.y, ray.d.z), self._lower, self._scale
        ):
            a, b = (o - lower) * scale - self._shift, d * scale
            c = dr.fma(b, t, a)
            wall = dr.select(b > 0, dr.floor(c + _NUDGE) + 1, dr.ceil(c - _NUDGE) - 1)
            end = dr.minimum(end, dr.select(b != 0, (wall - a) / dr.select(b != 0, b, 1), dr.inf))
        return end


def read_grid_volume(volume: mi.Volume) -> tuple[VoxelCells, np.ndarray] | None:
    """Cells and voxel values (z, y, x) of an axis-aligned Mitsuba ``gridvolume``; None for any other volume.

    Mitsuba does not expose the transform or the interpolation of a volume. Both are inferred by evaluating the volume
    and comparing it with the grid; a volume that does not match is treated as any other volume. Raises ``NergError``
    for non-finite values and for a grid with two channels, which Mitsuba does not evaluate.
    """
    import mitsuba as mi

    if volume.class_name() != "GridVolume":
        return None
    data = np.array(mi.traverse(volume)["data"], np.float32)
    channels = data.size // max(int(np.prod(data.shape[:3])), 1)
    if channels not in (1, 3):
        raise NergError(f'the grid of "density" has {channels} channels; use one with a single channel')
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
        """Whether the volume has the grid's values at ``shift`` of a voxel from each voxel's lower corner."""
        # All voxels are compared: a few of them cannot tell a mostly empty grid from its mirror image. A few layers at
        # a time, since positions take thirty times the memory of values.
        layers = max(1, _BLOCK_VOXELS // (data.shape[1] * data.shape[2]))
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
    # A quarter of a voxel off the centre, nearest-neighbour interpolation still returns the value of the centre.
    nearest = matches(0.25, 1e-6)
    if nearest and not np.allclose(data, data.flat[0]):
        return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.0), data
    return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.5), data


def bound(data: np.ndarray, ns: ModuleType) -> OccupancyGrid | None:
    """Occupancy grid over the volume: voxel maxima, dilated by one voxel. None if no cell is empty.

    The bound holds at every point for both kinds of interpolation.
    """
    from scipy.ndimage import maximum_filter

    # Outside its border a grid is extended by clamping, mirroring or repetition.
    occupied = (maximum_filter(data, 3, mode="nearest") > 0) | (maximum_filter(data, 3, mode="wrap") > 0)
    if occupied.all():
        return None
    return OccupancyGrid(occupied, ns, 0.0)


# ---- Hits ----
#
# Media of discrete elements, each of which absorbs a fraction of the light at one point of the ray: Gaussian splats.
#
# A hit takes the place of a step. Elements are not sampled, so step lengths and quadrature rules do not apply. Opacity,
# all kinds of depth, occlusion and colour are the same sums over other terms.


@dataclass
class LastHit:
    """The last processed hit: its distance in scene units, and its index."""

    t: Float
    index: UInt32


@dataclass
class NextHits:
    """Hits in order of distance, and of index at equal distances. Distances are infinite behind the last hit."""

    # Distance in scene units.
    t: list[Float]
    # Fraction of the light that is absorbed, below 1.
    absorbed: list[Float]
    # Index of the element.
    index: list[UInt32]
    # Number of elements that were tested.
    evals: Float


class Hits(Protocol):
    """The hits of rays with a medium, in groups of ``group_size``."""

    @property
    def group_size(self) -> int:
        """Number of hits in a group."""
        ...

    def find_next(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """The next hits behind ``after`` and in front of the distance ``before``, without derivatives.

        Returns ``group_size`` hits, or all, or as many as reduce the ``transmittance`` that arrives to at most
        ``stop``.
        """
        ...

    def reevaluate(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """``(t, absorbed)`` of the element ``index``, attached to the ray and to the medium's parameters."""
        ...


# ---- Protocol ----
#
# What the marcher needs from a medium: its extent, density and colour.
#
# A trained field and any pair of Mitsuba volumes implement the same protocol, so that analytic cases, grids of other
# tools and neural fields use one code path. A ray is transformed once (`Medium.ray_to_local`); each sample is then ``o
# + t d`` in the medium's own coordinates, with the scene distance ``t``.

MAX_DENSITY = 1e30
"""Infinite densities are replaced by this one, which is opaque over any length."""


class Occupancy(Protocol):
    """An occupancy grid: equal cells of the unit cube that may contain density."""

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along x, y and z."""
        ...

    @property
    def coarse(self) -> Occupancy:
        """The grid that this one refines, whose occupied cells contain those of this one; the grid itself if it refines
        none."""
        ...

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """A lower bound of the chessboard distance in cells from the cell of ``u`` to an occupied one; 0 in an occupied
        cell. Points outside the cube belong to its nearest cell."""
        ...


class Medium(Protocol):
    """Density, colour and features inside a bounding box in the scene.

    There are two frames: the scene frame, in scene units, and the medium's own ("local"), to which `ray_to_local` and
    `to_local` transform. On inactive lanes any finite value may be returned. Values are attached to the positions and
    to the arrays of ``parameters`` if these carry gradients; ``occupancy`` and ``cells`` never do.
    """

    @property
    def has_color(self) -> bool:
        """Whether the medium has a colour."""
        ...

    @property
    def is_deferred(self) -> bool:
        """Whether the colour of a ray is that of its samples' mean features (deferred shading), rather than the mean of
        their colours."""
        ...

    @property
    def color_space(self) -> str:
        """Colour space: ``srgb``, ``linear``, or ``spectrum``, a linear spectrum of the current variant."""
        ...

    @property
    def feature_count(self) -> int:
        """Number of geometry features that ``density_features`` returns; 0 for a medium without features."""
        ...

    @property
    def is_density_separate(self) -> bool:
        """Whether ``density`` takes much less time than ``density_features``. Features are then only evaluated at the
        samples that are shaded."""
        ...

    @property
    def length_scale(self) -> float:
        """Diagonal of the bounding box in scene units."""
        ...

    @property
    def default_step(self) -> float | None:
        """Recommended step length in scene units; None without a recommendation."""
        ...

    @property
    def default_dt_gamma(self) -> float:
        """Recommended minimum step as a fraction of the distance, for a medium whose resolution decreases with
        distance; 0: uniform steps."""
        ...

    @property
    def occupancy(self) -> Occupancy | None:
        """Cells outside which the density is certainly 0; None: nothing can be skipped."""
        ...

    @property
    def cells(self) -> VoxelCells | None:
        """Voxels inside which the density has no kinks, in the local frame; None for a medium that is not a grid."""
        ...

    @property
    def hits(self) -> Hits | None:
        """The discrete hits of a medium without a density, whose ``density`` must not be evaluated; None for a medium
        that is marched in steps."""
        ...

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the axis-aligned bounding box in the scene frame, (3,) each."""
        ...

    def parameters(self) -> list[Any]:
        """Arrays that densities and colours depend on: those that can carry gradients."""
        ...

    def refresh(self, force: bool = False) -> None:
        """Update what is derived from ``parameters`` if these are other arrays than before, or if ``force``. Call it
        after they may have changed."""
        ...

    def ray_to_local(self, o: Point3f, d: Vector3f) -> LocalRay:
        """The scene ray from ``o`` along the unit direction ``d``, in the local frame."""
        ...

    def to_local(self, p: Point3f) -> Point3f:
        """Scene points in the local frame."""
        ...

    def to_unit(self, p: Point3f) -> Array3f:
        """Local points in the coordinates of ``occupancy``, whose cells fill the unit cube."""
        ...

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        """Local displacements in the coordinates of ``occupancy``."""
        ...

    def density(self, p: Point3f, active: Bool) -> Float:
        """Density at local points in 1/scene unit: finite and not negative."""
        ...

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        """``density``, and the ``feature_count`` features at the same points, which ``color`` needs."""
        ...

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour in ``color_space`` at local points ``p`` for the unit local ray direction ``w``. Only valid if
        ``has_color``.

        ``features``: features of the points, or the index of the hit for a medium of discrete hits; for deferred
        shading the mean features along a ray, which can stem from any of its points.
        """
        ...

    def background(self, o: Point3f, d: Vector3f) -> Color | None:
        """Colour in ``color_space`` behind the medium along scene rays; None for a medium without a background."""
        ...


def clamp_density(sigma: Float) -> Float:
    """``sigma`` clamped to a valid density: 0 if negative or NaN, at most ``MAX_DENSITY``."""
    # A negative value of an interpolated or fitted grid would create light; the comparison also removes NaN.
    return dr.select(sigma > 0, dr.minimum(sigma, MAX_DENSITY), 0)


# ---- Sample shaders ----
#
# What samples contribute to the weighted sum along a ray, next to optical depth: usually colour.


class SampleShader(Protocol):
    """The contribution of samples. Sums are arrays that can be added, and scaled by a Float."""

    @property
    def needs_features(self) -> bool:
        """Whether ``shade`` uses the features."""
        ...

    def zero(self) -> Color:
        """An empty sum, one lane wide."""
        ...

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """The contribution of a sample that absorbs all light, attached to whatever carries gradients.

        Parameters
        ----------
        features : list of Float
            Features of the point as ``medium.density_features`` returns them, or the index of a hit (`Hits`).
        p, w : Point3f, Vector3f
            The point and the unit direction of the ray in the medium's coordinates.
        """
        ...

    def resolve_color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
        """Colour times ``opacity`` of rays with the given ``sums``; None if no colour is gathered."""
        ...


class ColorShader:
    """The medium's own colour as an ``array_type`` such as ``Color3f``, in the medium's ``color_space``.

    Not for a medium with deferred shading: see `field_medium.make_color_shader`.
    """

    needs_features = True

    def __init__(self, array_type: type):
        self.array_type = array_type

    def zero(self) -> Color:
        return self.array_type(0)

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        return self.array_type(medium.color(features, p, w, active))

    def resolve_color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color:
        return sums
