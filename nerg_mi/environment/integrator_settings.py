"""Parameters of the integrator ``nerg`` as keywords of `make_scene`."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError

from .arrays import join_names


class IntegratorSettings(TypedDict, total=False):
    """Parameters of the integrator ``nerg``; its page documents meanings, defaults and units.

    Objects (``density`` to ``integrator``) are dicts for ``mi.load_dict`` or objects of Mitsuba.
    """

    density: object
    color: object
    kde: object
    integrator: object  # nested; further children can have any name
    headlight: float  # 0 to 1
    occlusion: bool
    falloff: float  # scene units
    tolerance: float  # scene units
    visibility: str  # "depth", "transmittance" or "map"
    map_height: int
    directions: int
    integral_tolerance: float
    depth: str  # a kind of depth
    surface_opacity: float  # 0 to 1
    radiance: bool
    background: ArrayLike  # linear radiance, a number or RGB
    ceiling: float  # scene units
    up: ArrayLike  # (3,)
    aovs: str  # separated by commas
    step: float  # scene units; 0: that of the field
    quadrature: str
    coarse: float
    dt_gamma: float
    stop: float
    color_cutoff: float
    refined: bool
    jitter: bool


def check_settings(settings: Mapping[str, object]) -> None:
    """Raise `NergError` for a parameter that the integrator ``nerg`` does not have; its children can have any name."""
    allowed = IntegratorSettings.__annotations__
    for name, value in settings.items():
        if isinstance(value, (str, bool, int, float, np.number)) and name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1)
            remedy = f'did you mean "{near[0]}"?' if near else f"available: {join_names(list(allowed))}"
            raise NergError(f'make_scene has no setting "{name}"; {remedy}')
