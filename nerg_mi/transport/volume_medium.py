"""Mitsuba volumes as a medium."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.maths.geometry import intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, Vector3f

from .jit import Fingerprint, is_recording
from .medium import LocalRay, VoxelCells, bound, clamp_density, read_grid_volume

if TYPE_CHECKING:
    import mitsuba as mi


class VolumeMedium:
    """A Mitsuba volume as density (1/scene unit), and optionally a second one as colour: a `medium.Medium` in scene
    coordinates.

    There is vacuum outside the density volume's ``bbox()``. Empty voxels of an axis-aligned ``gridvolume`` are skipped;
    any other volume is marched without skipping. Colours are spectra of the current variant. Raises ``NergError`` for a
    density without a finite extent, and for a grid with non-finite values.
    """

    UNRECORDED = ("_read",)

    color_space = "spectrum"
    feature_count = 0
    is_density_separate = False
    hits = None

    def __init__(self, density: mi.Volume, color: mi.Volume | None = None):
        import mitsuba as mi

        # Types of the current variant: it can change later.
        self._interaction, self._ns = mi.Interaction3f, namespace(mi.Float)
        self._density: Any = density
        self._color: Any = color
        self.has_color, self.is_deferred = color is not None, False
        box = density.bbox()
        self._lower, self._upper = np.array(box.min, float), np.array(box.max, float)
        if not np.all(np.isfinite(self._lower) & np.isfinite(self._upper)) or np.any(self._upper <= self._lower):
            raise NergError(
                f'the volume "density" has no finite extent (its bounding box is {self._lower} to {self._upper}); '
                "give it a to_world that places it in the scene"
            )
        self.cells: VoxelCells | None = None
        self.default_step: float | None = None
        self.bound: OccupancyGrid | None = None
        self._read: Fingerprint | None = None
        self.refresh()

    def refresh(self, force: bool = False) -> None:
        """Read the voxels of the grid again if they are other arrays than before, or if ``force``."""
        if is_recording():
            # The bound would belong to the voxels of the recording, not to those of a replay.
            self.bound = self._read = None
            return
        import mitsuba as mi

        arrays = Fingerprint(v for v in dict(mi.traverse(self._density)).values() if dr.is_array_v(v))
        if arrays == self._read and not force:
            return
        described = read_grid_volume(self._density)
        self.cells, self.bound, self.default_step = None, None, None
        if described is not None:
            self.cells, data = described
            # A step longer than a voxel could pass over a thin sheet.
            self.default_step = min(self.length_scale / 1024, 0.5 * self.cells.min_edge)
            self.bound = bound(data, self._ns)
        # Last, so that a rejected grid is checked again.
        self._read = arrays

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """Cells that may contain density; None while gradients of the density are tracked, which empty voxels have,
        too."""
        if self.bound is None or any(dr.grad_enabled(v) for v in self.parameters()):
            return None
        return self.bound

    @property
    def default_dt_gamma(self) -> float:
        return 0.0

    @property
    def length_scale(self) -> float:
        return float(np.linalg.norm(self._upper - self._lower))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self._lower, self._upper

    def parameters(self) -> list[Any]:
        import mitsuba as mi

        values = []
        for volume in (self._density, self._color):
            if volume is not None:
                values += [v for v in dict(mi.traverse(volume)).values() if dr.is_array_v(v) and dr.is_float_v(v)]
        return values

    def ray_to_local(self, o: Point3f, d: Vector3f) -> LocalRay:
        near, far = intersect_box(o, d, self._lower.tolist(), self._upper.tolist())
        return LocalRay(o, d, d, near, far)

    def to_local(self, p: Point3f) -> Point3f:
        return p

    def to_unit(self, p: Point3f) -> Array3f:
        return (p - type(p)(*self._lower.tolist())) * self._inverse_size(p)

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        return v * self._inverse_size(v)

    def _inverse_size(self, v):
        return type(v)(*(1 / (self._upper - self._lower)).tolist())

    def _at(self, p):
        it = dr.zeros(self._interaction)
        it.p = p
        return it

    def density(self, p: Point3f, active: Bool) -> Float:
        return clamp_density(self._density.eval_1(self._at(p), active))

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        return self.density(p, active), []

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        if self._color is None:
            raise ValueError("this medium has no colour")
        return self._color.eval(self._at(p), active)

    def background(self, o: Point3f, d: Vector3f) -> None:
        """None: the scene provides the background."""
        return None


class FrozenBound:
    """Exposes the occupancy bound of a `VolumeMedium` to dr.freeze as an attribute of the integrator. (The medium
    itself cannot be a PyTree: custom operations would try to construct another one.)"""

    DRJIT_STRUCT: ClassVar[dict[str, None]] = {"bound": None}

    def __init__(self, medium: VolumeMedium):
        self.medium = medium

    @property
    def bound(self) -> OccupancyGrid | None:
        return self.medium.bound

    @bound.setter
    def bound(self, value: OccupancyGrid | None) -> None:
        self.medium.bound = value
