"""What the marcher asks of a place: its extent, its density and its colour.

A trained field and any pair of Mitsuba volumes answer the same questions, so that
analytic cases, grids from other tools and neural fields run through one code path.
Rays are handed over once (``local``), then every sample is ``o + t d`` in the
medium's own coordinates while ``t`` stays the distance in the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

MAX_DENSITY = 1e30
"""Infinite densities count as this one, which is opaque over any length."""


@dataclass
class LocalRay:
    """A ray in a medium's coordinates: point ``o + t d`` at scene distance ``t``; ``w`` is the unit direction."""

    o: object
    d: object
    w: object
    t_near: object
    t_far: object


def bounded(sigma):
    # A negative value of an interpolated or fitted grid would create light; comparing also drops NaN.
    return dr.select(sigma > 0, dr.minimum(sigma, MAX_DENSITY), 0)
