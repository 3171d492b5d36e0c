"""Settings of `nerg_mi.surfaces.bake.bake`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerg_mi.errors import NergError, parameter
from nerg_mi.ranges import LOG_DECADES, POSITIVE_VALUES, Range, ValidatedDataclass, range_field, setting

WEIGHTINGS = ("time", "person", "equal")
"""Kinds of weights of rays."""


@dataclass(frozen=True, kw_only=True)
class BakeSampling(ValidatedDataclass):
    """How the gaze is sampled."""

    GROUP: ClassVar = "Analysis"

    num_observers: int = setting(
        64, "Number of weighted observers that represent the recorded positions of --rays.", Range(1, 100_000)
    )
    ray_weights: str = setting(
        "time",
        "Weights of the rays: time (duration of each ray), person (duration, with equal totals for all participants) "
        "or equal (the same for each ray).",
    )
    cone: float | None = setting(
        None,
        "Standard deviation in degrees of the gaze cone, for tracker error and the fovea.  [default: 1.5 for rays, 0 "
        "for a field]",
        Range(0, 30),
    )
    max_angle: float = setting(
        2.0,
        "Maximum angle in degrees under which an observer sees a surface element; smaller is more accurate.",
        Range(0.2, 30),
    )
    resolution: int = setting(
        256, "Number of grid cells along the longest edge of a radiance field, for extracting its mesh.", Range(8, 2048)
    )
    cone_samples: int = range_field(16, Range(1, 1024))
    """Number of sample rays in the gaze cone of a recorded ray."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ray_weights not in WEIGHTINGS:
            raise NergError(f'{parameter("ray_weights")} must be {", ".join(WEIGHTINGS)}, got "{self.ray_weights}"')


@dataclass(frozen=True, kw_only=True)
class BakeColors(ValidatedDataclass):
    """Colours of the output files."""

    GROUP: ClassVar = "Output"

    texture_size: int | None = setting(
        None,
        "Width and height in pixels of a texture in .glb files.  [default: vertex colours, no texture]",
        Range(64, 8192),
    )
    vmax: float | None = setting(
        None, "Upper end of the colour scale, in the unit of --unit.  [default: the 99.5th percentile]", POSITIVE_VALUES
    )
    cmap: str = setting("inferno", "Colour map: inferno, magma, plasma, viridis or cividis.")
    log_decades: float = setting(
        0.0, "Number of decades that the colour scale spans if it is logarithmic; 0: linear.", LOG_DECADES
    )
