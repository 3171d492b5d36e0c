"""Options of attention statistics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.options import (
    ALIGN_HELP,
    ANALYSIS,
    INPUT,
    OUTPUT,
    PartOptions,
    best_variant,
    cpu_threads,
    option,
    parse_numbers,
    parse_point,
    random_seed,
)
from nerg_mi.ranges import COORDINATES, SECONDS, TIMES, Range, ValidatedDataclass

if TYPE_CHECKING:
    from nerg_mi.measures.visits import VisitRules


@dataclass(frozen=True, kw_only=True)
class AoiOptions(ValidatedDataclass):
    """The areas of interest (AOIs), and how visibility between observers and AOIs is traced."""

    aois: Path | None = option(
        None,
        "JSON file of areas of interest (AOIs): boxes, meshes, shapes of the scene, and groups of them; or a folder of "
        "Aria Digital Twin.",
        group=INPUT,
    )
    align: Path | None = option(None, ALIGN_HELP, group=INPUT)
    margin: float = option(
        0.03,
        "Depth tolerance in metres: a surface this far in front of an AOI, or behind a box, still belongs to it.",
        within=Range(0, 10**6),
        group=ANALYSIS,
    )
    aoi_samples: int = option(
        48, "Number of sample points on each AOI that visibility is tested for.", within=Range(1, 4096), group=ANALYSIS
    )
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class CountOptions(AoiOptions):
    """How gaze samples are turned into visits. Times are in seconds."""

    tolerance: float = option(
        0.0,
        "Angular tolerance in degrees: a gaze sample counts if it passes this close to an unoccluded part of the AOI.",
        within=Range(0, 20),
        group=ANALYSIS,
    )
    max_gap: float = option(
        1.0,
        "Longest gap between gaze samples in seconds. A sample lasts until the next one; across a longer gap it lasts "
        "for the median sampling interval.",
        within=SECONDS,
        group=ANALYSIS,
    )
    session_gap: float = option(
        60.0,
        "Pause in seconds after which the samples of a participant belong to a new session.",
        within=SECONDS,
        group=ANALYSIS,
    )
    merge_gap: float = option(
        0.15,
        "Longest interruption of a visit in seconds: samples on an AOI form one visit unless the gaze is elsewhere for "
        "longer.",
        within=SECONDS,
        group=ANALYSIS,
    )
    min_visit: float = option(0.1, "Shortest visit to an AOI in seconds.", within=SECONDS, group=ANALYSIS)
    aoi_visibility: bool = option(
        False,
        "Also report the visibility of AOIs: visible share of each AOI, attention while it is visible, and visible but "
        "unseen AOIs.",
        group=ANALYSIS,
    )
    fov: float = option(
        120.0,
        "Width of the field of view in degrees, centred on the head direction, or on the gaze if there is none.",
        within=Range(1, 360),
        group=ANALYSIS,
    )
    cell_size: float = option(
        0.1,
        "Edge length in metres of the grid cells from whose centres the visibility of AOIs is traced.",
        within=Range(0.001, 10**6),
        group=ANALYSIS,
    )
    windows: tuple[str, ...] = option(
        (),
        "Time window NAME=FROM,TO in seconds of the rays' clock, reported separately; repeatable.",
        "--window",
        group=ANALYSIS,
    )
    zones: Path | None = option(
        None,
        "JSON file of boxes on the floor; attention is reported separately for observers in each box.",
        group=INPUT,
    )
    cohorts: Path | None = option(
        None,
        "CSV file with columns person,cohort; attention is reported separately for each cohort.  "
        "[default: the cohorts in the rays]",
        group=INPUT,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.windows:
            parse_window(text)

    def visit_rules(self) -> VisitRules:
        """Return the rules that define a visit. Raises `NergError` for contradictory times."""
        from nerg_mi.measures.visits import VisitRules

        return VisitRules(self.max_gap, self.session_gap, self.merge_gap, self.min_visit)


@dataclass(frozen=True, kw_only=True)
class PredictionOptions(AoiOptions):
    """How a gaze field is evaluated from a viewpoint."""

    directions: int = option(
        8192,
        "Number of directions around each viewpoint in which the gaze field is evaluated.",
        within=Range(64, 1 << 20),
        group=ANALYSIS,
    )


@dataclass(frozen=True, kw_only=True)
class StatisticsOptions(CountOptions, PredictionOptions, PartOptions):
    """Options of ``nerg stats``."""

    viewpoints: int = option(
        256,
        "Approximate number of viewpoints from which the gaze field is evaluated: recorded positions, or positions on "
        "the floor if there are no recordings. Each participant gets at least one. If there are more participants than "
        "this number, the prediction uses that many of them.",
        within=Range(1, 100_000),
        group=ANALYSIS,
    )
    glance_duration: float = option(
        0.3,
        "Glance duration in seconds, used to predict the hit ratio; glances are assumed independent.",
        within=Range(0.001, 10**6),
        group=ANALYSIS,
    )
    what_if: Path | None = option(
        None, "JSON file of changes to shapes and observers; the gaze field predicts their effect.", group=INPUT
    )
    observers: tuple[str, ...] = option(
        (),
        "Position x,y,z of an observer, where there are no rays; repeatable.  "
        "[default: the observer of the scene, or a grid on the floor]",
        "--observer",
        group=INPUT,
    )
    eye_height: float = option(
        1.6, "Eye height above the floor of observers on a grid, in metres.", within=Range(0.01, 10**6), group=ANALYSIS
    )
    floor_height: float = option(
        0.0, "Height of the floor along the up axis, in scene units.", within=COORDINATES, group=ANALYSIS
    )
    grid_step: float = option(
        0.25, "Distance between neighbouring positions of a grid, in metres.", within=Range(0.01, 10**6), group=ANALYSIS
    )
    min_participants: int = option(
        1,
        "Smallest number of participants that a reported number may rest on; other numbers are left blank.",
        within=Range(1, 10**6),
        group=OUTPUT,
    )
    show_names: bool = option(
        False, "Write the names of participants into the tables. Without it, they get pseudonyms.", group=OUTPUT
    )
    salt: Path | None = option(
        None,
        "Secret file from which pseudonyms are derived, so that several runs agree.  [default: random, not stored]",
        group=OUTPUT,
    )
    resamples: int = option(
        1999,
        "Number of bootstrap resamples of the participants for confidence intervals.",
        within=Range(199, 100_000),
        group=ANALYSIS,
    )
    power: float | None = option(
        None,
        "Relative difference between two cells, such as 0.3 for 30 %. The table `power` then reports how often the "
        "test of differences detects it, by number of participants.  [default: no table]",
        within=Range(0.01, 100),
        group=ANALYSIS,
    )
    seed: int = random_seed("viewpoints and bootstrap resamples")
    threads: int | None = cpu_threads()

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.observers:
            parse_point(text, parameter("observers"))


def parse_window(text: str) -> tuple[str, float, float]:
    """Parse NAME=FROM,TO into a name, a start and an end. Raises `NergError` for any other text."""
    name, sign, rest = text.partition("=")
    ends = parse_numbers(rest, parameter("windows")) if sign else ()
    if not name.strip() or len(ends) != 2 or not TIMES.low <= ends[0] < ends[1] <= TIMES.high:
        raise NergError(
            f'{parameter("windows")} must be NAME=FROM,TO in seconds, as in morning=0,3600, got "{sanitize(text, 60)}"'
        )
    return name.strip(), ends[0], ends[1]
