"""Geometry features of a radiance field along rays: accumulated like colour, or taken at the surface.

What the density network hands to the colour network describes the place at a point without a label. Accumulated by
volume rendering it is a semantic signal in the manner of Semantic-NeRF (Zhi et al. 2021, eq. 2-4); the paper's variants
give either it or the snapshot at the surface to the gaze field.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from nerg_mi.field.backend import namespace
from nerg_mi.maths.types import Bool, Float, Point3f, Ray3f, Vector3f

from .march.settings import MarchSettings
from .media.protocol import Medium
from .place import Place


class FeaturePainter:
    """Contributes a sample's features, behind its colour where it is ``colored``, as an ArrayXf (see
    ``media.painting.Painter``). ``medium``: one that has features."""

    def __init__(self, medium: Medium, colored: bool):
        self.colored, self.count = colored, medium.feature_count
        self._ns = namespace(medium.parameters()[0])

    def zero(self) -> Any:
        return self._ns.ArrayXf([self._ns.Float(0)] * (3 * self.colored + self.count))

    def paint(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Any:
        color = list(medium.color(features, p, w, active)) if self.colored else []
        return self._ns.ArrayXf([*color, *features])


def snapshot(medium: Medium, p: Point3f, active: Bool) -> list[Float]:
    """Features at scene points ``p``; 0 where not ``active``."""
    features = medium.density_features(medium.to_local(p), active)[1]
    return [dr.select(active, f, 0) for f in features]


def accumulated(place: Place, ray: Ray3f, active: Bool, settings: MarchSettings) -> list[Float]:
    """Features accumulated along ``ray`` through ``place``, whose medium has some; 0 where not ``active``.

    What gathers them is always the default's, in training as in every picture: ``color_cutoff`` chooses how exact
    colours are."""
    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)
    march: Any = place.trace(ray, active, settings, color=FeaturePainter(_featured(place), False)).march
    return [dr.select(active, f, 0) for f in march.color]


def observed_features(
    kind: str, place: Place, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool, settings: MarchSettings
) -> list[Float] | None:
    """Features of what an observer sees at ``p_od`` along unit ``r_o`` from ``p_o``, for a gaze field that wants such
    of ``kind`` (``field.gaze.product.SEMANTICS``); None for one that wants none. ``settings``: of the march."""
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
