"""Settings of attention statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerg_mi.errors import NergError, parameter
from nerg_mi.ranges import COORDINATES, SECONDS, Range, ValidatedDataclass, range_field, setting


@dataclass(frozen=True, kw_only=True)
class VisitRules(ValidatedDataclass):
    """Durations that define sessions and visits, in seconds."""

    GROUP: ClassVar = "Analysis"

    min_visit: float = setting(0.1, "Shortest visit to an AOI in seconds.", SECONDS)
    merge_gap: float = range_field(0.15, SECONDS)
    """Longest interruption of a visit: samples on an AOI form one visit unless the gaze is elsewhere for longer."""
    max_gap: float = range_field(1.0, SECONDS)
    """Longest gap between samples. A sample lasts until the next one; across a longer gap it lasts for the median
    sampling interval."""
    session_gap: float = range_field(60.0, SECONDS)
    """Pause after which the samples of a participant belong to a new session."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.session_gap >= self.max_gap > 0:
            raise NergError(
                f"{parameter('session_gap')} ({self.session_gap:g} s) must not be below {parameter('max_gap')} "
                f"({self.max_gap:g} s), which must be positive"
            )


@dataclass(frozen=True, kw_only=True)
class AoiSampling(ValidatedDataclass):
    """How rays are assigned to areas, and how visibility and the gaze field are sampled."""

    GROUP: ClassVar = "Analysis"

    tolerance: float = setting(
        0.0,
        "Angular tolerance in degrees: a gaze sample counts if it passes this close to an unoccluded part of the AOI.",
        Range(0, 20),
    )
    margin: float = range_field(0.03, Range(0, 10**6))
    """Depth tolerance in metres: a surface this far in front of an AOI, or behind a box, still belongs to it."""
    aoi_samples: int = range_field(48, Range(1, 4096))
    """Number of sample points on each AOI that visibility is tested for."""
    cell_size: float = range_field(0.1, Range(0.001, 10**6))
    """Edge length in metres of the grid cells from whose centres the visibility of AOIs is traced."""
    directions: int = range_field(8192, Range(64, 1 << 20))
    """Number of directions around each viewpoint in which the gaze field is evaluated."""
    glance_duration: float = range_field(0.3, Range(0.001, 10**6))
    """Glance duration in seconds, used to predict the hit ratio; glances are assumed independent."""


@dataclass(frozen=True, kw_only=True)
class ObserverGrid(ValidatedDataclass):
    """Positions on the floor at which a gaze field is evaluated without recordings."""

    GROUP: ClassVar = "Analysis"

    eye_height: float = setting(
        1.6, "Eye height above the floor of observers on a grid, in metres.", Range(0.01, 10**6)
    )
    floor_height: float = range_field(0.0, COORDINATES)
    """Height of the floor along the up axis, in scene units."""
    grid_step: float = range_field(0.25, Range(0.01, 10**6))
    """Distance between neighbouring positions, in metres."""


@dataclass(frozen=True, kw_only=True)
class TrackerError(ValidatedDataclass):
    """Error of the eye tracker in degrees. Without one, measures are those of the recorded directions."""

    GROUP: ClassVar = "Analysis"

    accuracy: float = setting(
        0.0,
        "Accuracy of the eye tracker in degrees: the mean angle of its offset, which is constant in a session. The "
        "table tracker then has measures corrected for it, and the table resolution what is too small for it.",
        Range(0, 20),
    )
    precision: float = setting(
        0.0,
        "Precision of the eye tracker in degrees: the root mean square angle of the noise of a sample.",
        Range(0, 20),
    )
    draws: int = range_field(10, Range(2, 1000))
    """Number of random errors that the correction averages over."""
