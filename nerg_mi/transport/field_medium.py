"""A radiance field as a medium, and its features where a ray ends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceField, mean_features
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, Ray3f, Vector3f, variant_types

from .geometry import SceneGeometry
from .march_primal import MarchSettings
from .medium import ColorPainter, LocalRay, Medium, Occupancy, Painter, bounded

# ---- Features ----
#
# Geometry features of a radiance field along rays: accumulated like colour, or taken at the surface.
#
# What the density network hands to the colour network describes the place at a point without a label. Accumulated by
# volume rendering it is a semantic signal in the manner of Semantic-NeRF (Zhi et al. 2021, eq. 2-4); the paper's
# variants give either it or the snapshot at the surface to the gaze field.


class FeaturePainter:
    """Contributes a sample's features as an ArrayXf (see ``medium.Painter``).

    ``medium``: one that has features; ``color_type``: array type of a ray's colour, or None for features alone. A
    deferred medium makes that colour of the features; of another one a sample's own colour stands before them."""

    def __init__(self, medium: Medium, color_type: type | None = None):
        self.color_type, self.count = color_type, medium.feature_count
        self._own = color_type is not None and not medium.is_deferred
        self._ns = namespace(medium.parameters()[0])

    def zero(self) -> Any:
        return self._ns.ArrayXf([self._ns.Float(0)] * (3 * self._own + self.count))

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Any:
        color = list(medium.color(features, p, w, active)) if self._own else []
        return self._ns.ArrayXf([*color, *features])

    def resolve_color(self, medium: Medium, sums: Any, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
        array_type = self.color_type
        if array_type is None or self._own:
            return None if array_type is None else array_type(list(sums)[:3])
        means = mean_features(self.features(sums), opacity)
        ask = lambda active: array_type(medium.color(means, ray.o, ray.w, active))
        if dr.grad_enabled(means, ray.w, *medium.parameters()):
            return dr.select(active, opacity * ask(active), 0)
        # Where no ray of a packet meets anything, the network is passed over.
        some = active & (opacity > 0)
        return opacity * dr.if_stmt((some,), some, ask, lambda _: dr.zeros(array_type), label="deferred colour")

    def features(self, sums: Any) -> list[Float]:
        """The features in ``sums``, composited but not divided by opacity."""
        return list(sums)[3 * self._own :]


def make_color_shader(medium: Medium, color_type: type, features: bool = False) -> Painter:
    """What gathers the colour of a medium that has one, as ``color_type``; with ``features``, a `FeaturePainter`."""
    return FeaturePainter(medium, color_type) if features or medium.is_deferred else ColorPainter(color_type)


def evaluate_features(medium: Medium, p: Point3f, active: Bool) -> list[Float]:
    """Features at scene points ``p``; 0 where not ``active``."""
    features = medium.density_features(medium.to_local(p), active)[1]
    return [dr.select(active, f, 0) for f in features]


def accumulate_features(place: SceneGeometry, ray: Ray3f, active: Bool, settings: MarchSettings) -> list[Float]:
    """Features accumulated along ``ray`` through ``place``, whose medium has some; 0 where not ``active``.

    What gathers them is always the default's, in training as in every picture: ``color_cutoff`` chooses how exact
    colours are."""
    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)
    march: Any = place.trace(ray, active, settings, color=FeaturePainter(_featured(place))).march
    return [dr.select(active, f, 0) for f in march.color]


def observed_features(
    kind: str, place: SceneGeometry, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool, settings: MarchSettings
) -> list[Float] | None:
    """Features of what an observer sees at ``p_od`` along unit ``r_o`` from ``p_o``, for a gaze field that wants such
    of ``kind`` (``fields.gaze_product.SEMANTICS``); None for one that wants none. ``settings``: of the march."""
    if kind == "snapshot":
        return evaluate_features(_featured(place), p_od, active)
    if kind == "accumulated":
        return accumulate_features(place, variant_types().Ray3f(p_o, r_o), active, settings)
    return None


def _featured(place: SceneGeometry) -> Medium:
    if place.medium is None:
        raise ValueError("a place without a medium has no features")
    return place.medium


# ---- A trained radiance field as a medium that is marched ----


class FieldMedium:
    """A radiance field placed in the scene: a ``medium.Medium`` in the field's own coordinates.

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
    def is_deferred(self) -> bool:
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
    def default_step(self) -> float | None:
        """The step that the field was trained with, in scene units."""
        return None if self.field.march_step is None else self.field.march_step * self.to_world.scale

    @property
    def default_dt_gamma(self) -> float:
        return self.field.march_growth

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.field.box.lower, self.field.box.upper)

    def parameters(self) -> list[Any]:
        return self.field.kernel_parameters()

    def refresh(self, anyway: bool = False) -> None:
        """Nothing to do: weights are read whenever the field is marched."""

    def ray_to_local(self, o: Point3f, d: Vector3f) -> LocalRay:
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
            active = active & (self.occupancy.distance_to_occupied(self.to_unit(p), active) == 0)
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
