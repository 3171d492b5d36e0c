"""Options that say where people looked around."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import Checked

from . import option


@dataclass(frozen=True, kw_only=True)
class PlaceOptions(Checked):
    """Exactly one of them is given."""

    field: Path | None = option(None, "Radiance field, or Gaussian splats, in which people looked around.")
    scene: Path | None = option(None, "Or: a Mitsuba scene, or a mesh (.ply, .obj, .glb), whose shapes they looked at.")
    geometry: str | None = option(
        None, 'Or: "hits" makes a place from the rays\' own hit points, "none" does without any.'
    )
