"""The unit of length, by how far the eyes are apart."""

from __future__ import annotations

import numpy as np

from nerg_mi.rays.readers.frames import UNITS

from .figures import Figures, name_some
from .protocol import check

USUAL = 0.063
"""Metres between the eyes of adults, on average; 95 % of them lie between 0.055 and 0.071 (Dodgson 2004)."""

_BOUNDS = (0.050, 0.078), (0.055, 0.072)  # metres, of one, and of the median of several
_SEVERAL = 5
_LIKE = 1.25  # factor up to which a unit fits


@check(
    "eyes nearer to each other or farther apart than people's, where both are recorded (`--units`, or the scale of the "
    "recorder's scene)"
)
def check_eyes(figures: Figures) -> list[str]:
    rays = figures.rays
    there = {rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))}
    found = {name: d for name, d in rays.metadata.get("eye_distance", {}).items() if name in there}
    odd = {name: d for name, d in found.items() if not _BOUNDS[0][0] <= d <= _BOUNDS[0][1]}
    if not odd and len(found) >= _SEVERAL and not _BOUNDS[1][0] <= np.median([*found.values()]) <= _BOUNDS[1][1]:
        odd = found
    if not odd:
        return []
    distance = float(np.median([*odd.values()]))
    whose = "" if len(odd) == len(found) else f" of {name_some(list(odd))}"
    declared = rays.metadata.get("source_frame", {}).get("units", "m")
    size = UNITS.get(declared, 1.0) * USUAL / max(distance, 1e-12)
    fits = [u for u, metres in UNITS.items() if u != declared and metres / _LIKE <= size <= metres * _LIKE]
    if fits:
        remedy = f"is the unit {fits[0]}? (--units {fits[0]})"
    else:
        remedy = f"a unit of the file's lengths is about {size:.2g} m: scale its positions by that"
    return [f"the eyes{whose} are {1e3 * distance:.3g} mm apart, where people have {1e3 * USUAL:.0f}; {remedy}"]
