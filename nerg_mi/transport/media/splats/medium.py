"""Gaussian splats as a medium.

They enter where a march sums what absorbs light, and not as shapes: a shape ends a ray, while a Gaussian lets light
through, and a depth or a surface is what comes of many. A march's steps would not do either. A Gaussian may be a
millimetre thick in a hall of fifty metres, and its optical depth by the convention of splats is no integral of a
density: it absorbs all its share at its peak. So a hit takes the place of a step (`media.hits`), and what a march
returns means what it always does.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, Vector3f
from nerg_mi.transport.media.local_ray import LocalRay

from .arrays import SplatArrays
from .nearest import SplatHits


class SplatMedium:
    """Gaussian splats placed in the scene: a ``protocol.Medium`` in their own coordinates.

    ``to_world``: splats to scene; the identity by default. ``color_space``: ``srgb``, as photos train them, or
    ``linear``.
    """

    has_color = True
    deferred = False
    feature_count = 0
    growth = 0.0
    occupancy = None
    cells = None

    def __init__(self, arrays: SplatArrays, to_world: Similarity | None = None, color_space: str = "srgb"):
        self.arrays, self.to_world, self.color_space = arrays, to_world or Similarity(), color_space
        self.hits = SplatHits(arrays)

    @property
    def length_scale(self) -> float:
        return float(np.linalg.norm(self.arrays.upper - self.arrays.lower)) * self.to_world.scale

    @property
    def step(self) -> float | None:
        """The median thickness of a Gaussian: how far apart two ideas of a surface usually are."""
        return self.arrays.thickness * self.to_world.scale

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.arrays.lower.tolist(), self.arrays.upper.tolist())

    def parameters(self) -> list[Any]:
        return [self.arrays.shapes, self.arrays.colors]

    def refresh(self, anyway: bool = False) -> None:
        """Nothing: whoever sets parameters of the splats packs them."""

    def local(self, o: Point3f, d: Vector3f) -> LocalRay:
        along = self.to_world.vector_to_local(d)
        w = self.to_world.direction_to_local(d)
        p = self.to_world.point_to_local(o)
        near, far = intersect_box(p, along, self.arrays.corners[:3], self.arrays.corners[3:])
        return LocalRay(p, along, w, near, far)

    def to_local(self, p: Point3f) -> Point3f:
        return self.to_world.point_to_local(p)

    def to_unit(self, p: Point3f) -> Array3f:
        return (p - type(p)(*self.arrays.lower.tolist())) * self._inverse_size(p)

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        return v * self._inverse_size(v)

    def _inverse_size(self, v: Array3f) -> Array3f:
        return type(v)(*(1 / (self.arrays.upper - self.arrays.lower)).tolist())

    def density(self, p: Point3f, active: Bool) -> Float:
        raise ValueError("Gaussian splats have no density at a point: they are met along rays")

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        raise ValueError("Gaussian splats have no density at a point: they are met along rays")

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour of the Gaussian whose index is the only one of ``features``."""
        return self.arrays.color(features[0], w, active)

    def background(self, o: Point3f, d: Vector3f) -> None:
        """None: what is behind splats is the scene's."""
        return None
