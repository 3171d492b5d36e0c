"""Settings of attention statistics."""

from __future__ import annotations

from dataclasses import dataclass, fields
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
    fixation_part: float = setting(
        0.0,
        "Part of the variance of the tracker's offset that changes from fixation to fixation. The rest is constant in "
        "a session.",
        Range(0, 1),
    )
    draws: int = range_field(10, Range(2, 1000))
    """Number of random errors that the correction averages over."""


@dataclass(frozen=True, kw_only=True)
class Choices(ValidatedDataclass):
    """Ranges from which the choices of an analysis are drawn evenly. Equal ends: the choice is not varied."""

    min_visit: tuple[float, float] = range_field((0.05, 0.2), SECONDS)
    """Shortest visit in seconds."""
    merge_gap: tuple[float, float] = range_field((0.075, 0.3), SECONDS)
    """Longest interruption of a visit in seconds."""
    max_gap: tuple[float, float] = range_field((0.5, 2.0), SECONDS)
    """Longest gap between samples in seconds."""
    tolerance: tuple[float, float] = range_field((0.0, 1.0), Range(0, 20))
    """Angular tolerance in degrees."""
    margin: tuple[float, float] = range_field((0.01, 0.1), Range(0, 10**6))
    """Depth tolerance in metres."""
    growth: tuple[float, float] = range_field((-0.03, 0.03), Range(-(10**6), 10**6))
    """Metres by which each side of a box moves outwards."""
    rotation: float | None = range_field(None, Range(0, 180))
    """Largest rotation about the vertical axis through the mean position, in degrees. None: twice the standard
    deviation in the alignment file, or none without one."""
    shift: float | None = range_field(None, Range(0, 10**6))
    """Largest shift along each axis in metres. None: as for ``rotation``."""
    weighting: tuple[str, ...] = ("participants", "time")
    """Weights of participants in shares: the same for each, or the recorded time."""
    samples: tuple[str, ...] = ("all", "fixations")
    """Samples that count: all, or those of fixations (as in nerg rays events). The time between fixations then belongs
    to the earlier one, up to ``max_gap``."""
    velocity: tuple[float, float] = range_field((20.0, 100.0), Range(0.1, 10**6))
    """Velocity in degrees per second above which a fixation ends."""
    min_fixation: tuple[float, float] = range_field((0.06, 0.15), SECONDS)
    """Shortest fixation in seconds."""
    tracker: tuple[str, ...] = ("corrected", "ignored")
    """Error of the eye tracker, if one is given."""
    glance_duration: tuple[float, float] = range_field((0.2, 0.4), Range(0.001, 10**6))
    """Duration of a glance in seconds, for predicted hit ratios."""
    prior_weight: tuple[float, float] | None = range_field(None, Range(0, 1))
    """Weight of the position-independent prior of gaze fields, of which five values are drawn. None: from half to twice
    the odds of the fields' own weights."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, tuple) and isinstance(field.default[0], str):
                if not value or not set(value) <= set(field.default):
                    raise NergError(f"{field.name} must be some of {', '.join(field.default)}, got {value!r}")
            elif isinstance(value, tuple) and not (len(value) == 2 and value[0] <= value[1]):
                raise NergError(f"{field.name} must be a lower and an upper end, got {value!r}")
