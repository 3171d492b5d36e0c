"""Whose gaze a bake is asked for, and in which unit."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.jobs.options.bake import BakeOptions
from nerg_mi.rays.rays import Rays

UNITS = {"share": "share of gaze per square metre [1/m²]", "seconds": "gaze per square metre [s/m²]"}
SOURCES = ("field", "rays")
CONE = 1.5
"""Degrees of a tracked ray's: the error of good trackers, and the radius of the fovea."""


def source_of(options: BakeOptions, rays: Rays | None, with_gaze: bool = False) -> str:
    """Whose gaze it is, of `SOURCES`; ``rays`` are those in memory, and ``with_gaze`` says whether the surface may have
    a gaze field of its own. Raises `NergError` for options that contradict each other."""
    people = rays is not None or options.rays is not None
    source = options.source or ("field" if options.gaze is not None or (with_gaze and not people) else "rays")
    if source not in SOURCES:
        raise NergError(f'--from is {" or ".join(SOURCES)}, got "{source}"')
    if options.unit not in UNITS:
        raise NergError(f'--unit is {" or ".join(UNITS)}, got "{options.unit}"')
    if source == "rays" and not people:
        raise NergError("whose gaze is it? give a gaze field by --gaze, or rays by --rays")
    if source == "rays" and (options.observer is not None or options.path is not None):
        raise NergError("--observer and --path look with a gaze field; give --gaze, or leave them out")
    if source == "field" and (options.unit == "seconds" or options.halves):
        raise NergError("--unit seconds and --halves are of rays, whose time is known; add --from rays")
    return source


def cone_of(options: BakeOptions, source: str) -> float:
    """Standard deviation in radian of the cone of a look."""
    return float(np.radians(CONE if options.cone is None and source == "rays" else options.cone or 0.0))
