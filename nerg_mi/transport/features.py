"""Geometry features of a radiance field along rays: accumulated like colour, or taken at the surface.

What the density network hands to the colour network describes the place at a point without a label. Accumulated by
volume rendering it is a semantic signal in the manner of Semantic-NeRF (Zhi et al. 2021, eq. 2-4); the paper's variants
give either it or the snapshot at the surface to the gaze field.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import mean_features
from nerg_mi.maths.types import Bool, Color, Float, Point3f, Ray3f, Vector3f

from .march.settings import MarchSettings
from .media.local_ray import LocalRay
from .media.painting import ColorPainter, Painter
from .media.protocol import Medium
from .place import Place


class FeaturePainter:
    """Contributes a sample's features as an ArrayXf (see ``media.painting.Painter``).

    ``medium``: one that has features; ``color_type``: array type of a ray's colour, or None for features alone. A
    deferred medium makes that colour of the features; of another one a sample's own colour stands before them."""

    def __init__(self, medium: Medium, color_type: type | None = None):
        self.color_type, self.count = color_type, medium.feature_count
        self._own = color_type is not None and not medium.deferred
        self._ns = namespace(medium.parameters()[0])

    def zero(self) -> Any:
        return self._ns.ArrayXf([self._ns.Float(0)] * (3 * self._own + self.count))

    def paint(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Any:
        color = list(medium.color(features, p, w, active)) if self._own else []
        return self._ns.ArrayXf([*color, *features])

    def color(self, medium: Medium, sums: Any, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
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


def color_painter(medium: Medium, color_type: type, features: bool = False) -> Painter:
    """What gathers the colour of a medium that has one, as ``color_type``; with ``features``, a `FeaturePainter`."""
    return FeaturePainter(medium, color_type) if features or medium.deferred else ColorPainter(color_type)


def snapshot(medium: Medium, p: Point3f, active: Bool) -> list[Float]:
    """Features at scene points ``p``; 0 where not ``active``."""
    features = medium.density_features(medium.to_local(p), active)[1]
    return [dr.select(active, f, 0) for f in features]


def accumulated(place: Place, ray: Ray3f, active: Bool, settings: MarchSettings) -> list[Float]:
    """Features accumulated along ``ray`` through ``place``, whose medium has some; 0 where not ``active``.

    What gathers them is always the default's, in training as in every picture: ``color_cutoff`` chooses how exact
    colours are."""
    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)
    march: Any = place.trace(ray, active, settings, color=FeaturePainter(_featured(place))).march
    return [dr.select(active, f, 0) for f in march.color]


def observed_features(
    kind: str, place: Place, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool, settings: MarchSettings
) -> list[Float] | None:
    """Features of what an observer sees at ``p_od`` along unit ``r_o`` from ``p_o``, for a gaze field that wants such
    of ``kind`` (``fields.gaze_product.SEMANTICS``); None for one that wants none. ``settings``: of the march."""
    import mitsuba as mi

    if kind == "snapshot":
        return snapshot(_featured(place), p_od, active)
    if kind == "accumulated":
        return accumulated(place, mi.Ray3f(p_o, r_o), active, settings)
    return None


def _featured(place: Place) -> Medium:
    if place.medium is None:
        raise ValueError("a place without a medium has no features")
    return place.medium
