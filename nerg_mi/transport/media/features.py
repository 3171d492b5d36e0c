"""Geometry features of a radiance field along rays: accumulated like colour, or taken at the surface.

What the density network hands to the colour network describes the place at a point without a label. Accumulated by
volume rendering it is a semantic signal in the manner of Semantic-NeRF (Zhi et al. 2021, eq. 2-4); the paper's variants
give either it or the snapshot at the surface to the gaze field.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr

from nerg_mi.field.backend import namespace
from nerg_mi.transport.march.primal import MarchSettings
from nerg_mi.transport.place import Place


class Featured:
    """A field medium whose samples carry their features behind their colour (``painted``), or alone.

    Marches like the medium itself; a march's ``color`` is then an ArrayXf of ``blank``'s length.
    """

    def __init__(self, medium, painted: bool):
        self._medium, self._painted = medium, painted

    def __getattr__(self, name):
        return getattr(self._medium, name)

    @property
    def count(self) -> int:
        """Features of a point."""
        return self._medium.feature_count

    def blank(self, value):
        """A sample's colour and features that are all ``value``; one that is given as an array stays as it is."""
        ns = namespace(self.parameters()[0])
        if isinstance(value, ns.ArrayXf):
            return value
        return ns.ArrayXf([ns.Float(value)] * (3 * self._painted + self.count))

    def color(self, features, p, w, active):
        painted = list(self._medium.color(features, p, w, active)) if self._painted else []
        return namespace(self.parameters()[0]).ArrayXf([*painted, *features])


def snapshot(medium, p, active) -> list:
    """Features (Floats) at scene points ``p``; 0 where not ``active``."""
    features = medium.density_features(medium.to_local(p), active)[1]
    return [dr.select(active, f, 0) for f in features]


def what_gaze_wants(kind: str, place, p_od, p_o, r_o, active, settings) -> list | None:
    """Features (Floats) of what an observer sees at ``p_od`` along unit ``r_o`` from ``p_o``, for a gaze field that
    wants such of ``kind`` (``field.gaze.product.SEMANTICS``); None for one that wants none. ``settings``: of the
    march."""
    import mitsuba as mi

    if kind == "snapshot":
        return snapshot(place.medium, p_od, active)
    if kind == "accumulated":
        return accumulated(place, mi.Ray3f(p_o, r_o), active, settings)
    return None


def accumulated(place, ray, active, settings) -> list:
    """Features (Floats) accumulated along a Mitsuba ``ray`` through ``place`` (``place.Place`` with a field).

    What gathers them is always the default's, in training as in every picture: ``color_cutoff`` chooses how exact
    colours are."""
    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)
    featured = Featured(place.medium, False)
    march = Place(featured, place.scene).trace(ray, active, settings, color=featured.blank).march
    return [dr.select(active, f, 0) for f in march.color]
