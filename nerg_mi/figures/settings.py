"""Settings of figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerg_mi.ranges import LOG_DECADES, ValidatedDataclass, setting

SMOOTHING = 1.0
"""Default smoothing of figures in degrees: about the fovea, and the error of eye trackers."""


@dataclass(frozen=True, kw_only=True)
class Style(ValidatedDataclass):
    """Appearance of values on an image. ``title``: that of the figure; None: the quantity."""

    GROUP: ClassVar[str] = "View"

    cmap: str | None = setting(
        None,
        "Colour map: inferno, magma, plasma, viridis or cividis; others for signed values and classes.  [default: "
        "depends on the quantity]",
    )
    log_decades: float = setting(
        0.0, "Number of decades that the colour scale spans if it is logarithmic; 0: linear.", LOG_DECADES
    )
    hatching: bool = setting(
        True, "Hatch areas whose value is unknown: no surface or, for gaze, far from all recorded positions."
    )
    title: str | None = None
