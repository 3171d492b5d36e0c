"""A trained radiance field as a medium that is marched."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.radiance import RadianceField
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, Vector3f

from .local_ray import LocalRay
from .protocol import Occupancy, bounded


class FieldMedium:
    """A radiance field placed in the scene: a ``protocol.Medium`` in the field's own coordinates.

    ``to_world``: field to scene; the identity by default.
    """

    has_color = True
    cells = None
    hits = None

    def __init__(self, field: RadianceField, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        # A field scaled by s is s times longer, so its density per scene unit is s times lower.
        self._per_unit = 1 / self.to_world.scale
        self.color_space = field.color_space

    @property
    def deferred(self) -> bool:
        return self.field.config.deferred

    @property
    def occupancy(self) -> Occupancy | None:
        """The field's own, which changes with its weights."""
        return self.field.occupancy

    @property
    def feature_count(self) -> int:
        return self.field.config.geometry

    @property
    def length_scale(self) -> float:
        return self.field.box.diagonal * self.to_world.scale

    @property
    def step(self) -> float | None:
        """The step that the field was trained with, in scene units."""
        return None if self.field.march_step is None else self.field.march_step * self.to_world.scale

    @property
    def growth(self) -> float:
        return self.field.march_growth

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.field.box.lower, self.field.box.upper)

    def parameters(self) -> list[Any]:
        return self.field.kernel_parameters()

    def refresh(self, anyway: bool = False) -> None:
        """Nothing to do: weights are read whenever the field is marched."""

    def local(self, o: Point3f, d: Vector3f) -> LocalRay:
        o_l, d_l = self.to_world.point_to_local(o), self.to_world.vector_to_local(d)
        near, far = intersect_box(o_l, d_l, self.field.box.lower, self.field.box.upper)
        return LocalRay(o_l, d_l, self.to_world.direction_to_local(d), near, far)

    def to_local(self, p: Point3f) -> Point3f:
        return self.to_world.point_to_local(p)

    def to_unit(self, p: Point3f) -> Array3f:
        return self.field.box.to_cube(p)

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        return v / self.field.box.cube_side

    def density(self, p: Point3f, active: Bool) -> Float:
        return bounded(self.field.density(p, active) * self._per_unit)

    def occupied_density(self, p: Point3f, active: Bool) -> Float:
        """``density`` where no march has looked up the occupancy grid before: 0 in its empty cells."""
        if self.occupancy is not None:
            active = active & (self.occupancy.empty_cells(self.to_unit(p), active) == 0)
        return dr.select(active, self.density(p, active), 0)

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        sigma, features = self.field.density_features(p, active)
        return bounded(sigma * self._per_unit), features

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        return self.field.color(features, w)

    def background(self, o: Point3f, d: Vector3f) -> Color | None:
        """Of the field's background network; None for a field without one."""
        if self.field.background is None:
            return None
        return self.field.background(self.to_world.point_to_local(o), self.to_world.direction_to_local(d))
