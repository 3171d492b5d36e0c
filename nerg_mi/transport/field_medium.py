"""A radiance field as a medium, and its geometry features."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import drjit as dr
import numpy as np

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceNetwork, mean_features
from nerg_mi.fields.voxels import COLOR_NUMBERS, VoxelColors
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, Ray3f, Vector3f, variant_types

from .geometry import SceneGeometry
from .march_primal import MarchSettings
from .medium import ColorShader, LocalRay, Medium, Occupancy, SampleShader, clamp_density

# ---- Features ----
#
# Geometry features of a radiance field along rays: composited like colour, or evaluated at the surface.
#
# The features that the density network passes to the colour network describe a point without labels. Composited by
# volume rendering they are a semantic signal similar to Semantic-NeRF (Zhi et al. 2021, eq. 2-4). The paper's variants
# condition the gaze field on them, or on the features at the surface.


class FeatureShader:
    """Contributes the features of a sample as an ArrayXf (see `medium.SampleShader`).

    ``medium``: a medium with features; ``color_type``: array type of the colour, or None for features alone. Deferred
    shading computes the colour from the composited features; otherwise the colour of the sample precedes its features.
    """

    needs_features = True

    def __init__(self, medium: Medium, color_type: type | None = None):
        self.color_type, self.count = color_type, medium.feature_count
        self._has_own_color = color_type is not None and not medium.is_deferred
        self._ns = namespace(medium.parameters()[0])

    def zero(self) -> Any:
        return self._ns.ArrayXf([self._ns.Float(0)] * (3 * self._has_own_color + self.count))

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Any:
        color = list(medium.color(features, p, w, active)) if self._has_own_color else []
        return self._ns.ArrayXf([*color, *features])

    def resolve_color(self, medium: Medium, sums: Any, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
        array_type = self.color_type
        if array_type is None or self._has_own_color:
            return None if array_type is None else array_type(list(sums)[:3])
        means = mean_features(self.features(sums), opacity)
        ask = lambda active: array_type(medium.color(means, ray.o, ray.w, active))
        if dr.grad_enabled(means, ray.w, *medium.parameters()):
            return dr.select(active, opacity * ask(active), 0)
        # Packets without any absorption skip the network.
        some = active & (opacity > 0)
        return opacity * dr.if_stmt((some,), some, ask, lambda _: dr.zeros(array_type), label="deferred colour")

    def features(self, sums: Any) -> list[Float]:
        """The features in ``sums``, composited but not divided by opacity."""
        return list(sums)[3 * self._has_own_color :]


class VoxelColorShader:
    """Contributes the numbers of the stored colours of a compiled field (see `medium.SampleShader`)."""

    needs_features = False

    def __init__(self, colors: VoxelColors, color_type: type):
        self._colors, self._color_type = colors, color_type
        self._ns = namespace(colors.net.weights[0])

    def zero(self) -> Any:
        return self._ns.ArrayXf([self._ns.Float(0)] * COLOR_NUMBERS)

    def shade(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Any:
        return self._ns.ArrayXf(cast("FieldMedium", medium).color_numbers(p, active))

    def resolve_color(self, medium: Medium, sums: Any, opacity: Float, ray: LocalRay, active: Bool) -> Color:
        return self._color_type(*self._colors.decode(list(sums), opacity, ray.w))


def make_color_shader(medium: Medium, color_type: type, with_features: bool = False) -> SampleShader:
    """A shader for the colour of a medium, as ``color_type``; ``with_features``: a `FeatureShader`."""
    if not with_features and isinstance(medium, FieldMedium) and medium.colors is not None:
        return VoxelColorShader(medium.colors, color_type)
    return FeatureShader(medium, color_type) if with_features or medium.is_deferred else ColorShader(color_type)


def evaluate_features(medium: Medium, p: Point3f, active: Bool) -> list[Float]:
    """Features at scene points ``p``; 0 on inactive lanes."""
    features = medium.density_features(medium.to_local(p), active)[1]
    return [dr.select(active, f, 0) for f in features]


def accumulate_features(geometry: SceneGeometry, ray: Ray3f, active: Bool, settings: MarchSettings) -> list[Float]:
    """Features composited along ``ray`` through ``geometry``, whose medium has features; 0 on inactive lanes.

    Always uses the default ``color_cutoff``, in training and rendering: the parameter only controls the accuracy of
    colour.
    """
    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)
    march: Any = geometry.trace(ray, active, settings, color=FeatureShader(_medium_with_features(geometry))).march
    return [dr.select(active, f, 0) for f in march.color]


def features_for_observer(
    kind: str,
    geometry: SceneGeometry,
    p_od: Point3f,
    p_o: Point3f,
    r_o: Vector3f,
    active: Bool,
    settings: MarchSettings,
) -> list[Float] | None:
    """Features for a gaze field of the semantic ``kind`` (`fields.gaze_product.SEMANTICS`); None for a field without
    them.

    ``p_od``: the surface that the observer at ``p_o`` sees along unit ``r_o``; ``settings``: of the march.
    """
    if kind == "snapshot":
        return evaluate_features(_medium_with_features(geometry), p_od, active)
    if kind == "accumulated":
        return accumulate_features(geometry, variant_types().Ray3f(p_o, r_o), active, settings)
    return None


def _medium_with_features(geometry: SceneGeometry) -> Medium:
    if geometry.medium is None:
        raise ValueError("a scene without a medium has no features")
    return geometry.medium


# ---- Radiance field as a medium ----


class FieldMedium:
    """A radiance field placed in the scene: a `medium.Medium` in the field's own coordinates.

    ``to_world``: field to scene; default: the identity.
    """

    has_color = True
    cells = None
    hits = None

    def __init__(self, field: RadianceNetwork, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        # A field scaled by s is s times longer, so its density per scene unit is s times lower.
        self._per_unit = 1 / self.to_world.scale
        self.color_space = field.color_space

    @property
    def colors(self) -> VoxelColors | None:
        """The stored colours of a compiled field."""
        return None if self.field.voxels is None else self.field.voxels.colors

    @property
    def is_deferred(self) -> bool:
        return self.field.config.deferred and self.colors is None

    @property
    def occupancy(self) -> Occupancy | None:
        """The field's occupancy grid, which changes with its weights; the voxels of a compiled field in a box."""
        if self.field.voxels is not None and not self.field.box.is_contracted:
            return self.field.voxels
        return self.field.occupancy

    @property
    def is_density_separate(self) -> bool:
        return self.field.voxels is not None

    @property
    def feature_count(self) -> int:
        return self.field.config.geometry

    @property
    def length_scale(self) -> float:
        return self.field.box.diagonal * self.to_world.scale

    @property
    def default_step(self) -> float | None:
        """The step length of the training, in scene units."""
        return None if self.field.march_step is None else self.field.march_step * self.to_world.scale

    @property
    def default_dt_gamma(self) -> float:
        return self.field.march_growth

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.to_world.bounds(self.field.box.lower, self.field.box.upper)

    def parameters(self) -> list[Any]:
        return self.field.kernel_parameters()

    def refresh(self, force: bool = False) -> None:
        """No effect: weights are read in each march."""

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
        return clamp_density(self.field.density(p, active) * self._per_unit)

    def density_in_occupied_cells(self, p: Point3f, active: Bool) -> Float:
        """``density`` where the march has not tested the occupancy grid: 0 in its empty cells."""
        if self.occupancy is not None:
            active = active & (self.occupancy.distance_to_occupied(self.to_unit(p), active) == 0)
        return dr.select(active, self.density(p, active), 0)

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        sigma, features = self.field.density_features(p, active)
        return clamp_density(sigma * self._per_unit), features

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        if self.colors is None:
            return self.field.color(features, w)
        return type(w)(*self.colors.decode(self.color_numbers(p, active), type(w.x)(1), w))

    def color_numbers(self, p: Point3f, active: Bool) -> list[Float]:
        """The numbers of the stored colours at local points (`voxels.VoxelGrid.color_numbers`)."""
        assert self.field.voxels is not None
        return self.field.voxels.color_numbers(self.field.box.to_unit(p), active & self.field.box.contains(p))

    def background(self, o: Point3f, d: Vector3f) -> Color | None:
        """Colour of the field's background network; None for a field without one."""
        if self.field.background is None:
            return None
        return self.field.background(self.to_world.point_to_local(o), self.to_world.direction_to_local(d))
