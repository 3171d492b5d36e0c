"""A trained radiance field as a medium that is marched."""

from __future__ import annotations

import drjit as dr

from nerg_mi.field.radiance import RadianceField
from nerg_mi.maths.ray_box import intersect_box
from nerg_mi.maths.similarity import Similarity

from .protocol import LocalRay, bounded


class FieldMedium:
    """A radiance field placed in the scene."""

    def __init__(self, field: RadianceField, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        # A field scaled by s is s times longer, so its density per scene unit is s times lower.
        self._per_unit = 1 / self.to_world.scale
        self.occupancy = field.occupancy
        self.color_space = field.color_space
        self.has_color = True
        self.cells = None

    @property
    def length_scale(self) -> float:
        """Diagonal of the medium in scene units."""
        return self.field.box.diagonal * self.to_world.scale

    @property
    def step(self) -> float | None:
        """Step length in scene units that suits the medium, if it knows one."""
        return None if self.field.march_step is None else self.field.march_step * self.to_world.scale

    def bounds(self):
        return self.to_world.bounds(self.field.box.lower, self.field.box.upper)

    def parameters(self) -> list:
        """Arrays that densities and colours depend on, for derivatives."""
        return self.field.kernel_parameters()

    def local(self, o, d) -> LocalRay:
        o_l, d_l = self.to_world.point_to_local(o), self.to_world.vector_to_local(d)
        near, far = intersect_box(o_l, d_l, self.field.box.lower, self.field.box.upper)
        return LocalRay(o_l, d_l, self.to_world.direction_to_local(d), near, far)

    @property
    def feature_count(self) -> int:
        """Geometry features of a point, which ``density_features`` returns."""
        return self.field.config.geometry

    def to_local(self, p):
        """Scene points in the field's coordinates."""
        return self.to_world.point_to_local(p)

    def to_unit(self, p):
        """Occupancy-grid coordinates (unit cube) of local points."""
        return self.field.box.to_unit(p)

    def vector_to_unit(self, v):
        return v / self.field.box.side

    def density(self, p, active):
        return bounded(self.field.density(p, active) * self._per_unit)

    def occupied_density(self, p, active):
        """Density where no march has looked up the occupancy grid before: 0 in its empty cells."""
        if self.occupancy is not None:
            active = active & (self.occupancy.empty_cells(self.to_unit(p), active) == 0)
        return dr.select(active, self.density(p, active), 0)

    def density_features(self, p, active):
        """Density, and what ``color`` needs of the same point."""
        sigma, features = self.field.density_features(p, active)
        return bounded(sigma * self._per_unit), features

    def color(self, features, p, w, active):
        """Colour in ``color_space`` (Array3f)."""
        return self.field.color(features, w)

    def background(self, o, d):
        """Colour behind the field of scene rays, in ``color_space``; None for a field without a background network."""
        if self.field.background is None:
            return None
        return self.field.background(self.to_world.point_to_local(o), self.to_world.direction_to_local(d))
