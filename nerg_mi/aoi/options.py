"""Options of attention statistics, without heavy imports, so that the command line lists them quickly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import COORDINATES, SECONDS, SEEDS, THREADS, TIMES, Range, ValidatedDataclass
from nerg_mi.workflows.options import PartOptions, option, parse_numbers, parse_point

if TYPE_CHECKING:
    from nerg_mi.statistics.visits import VisitRules


@dataclass(frozen=True, kw_only=True)
class AoiOptions(ValidatedDataclass):
    """Areas of interest and how they are traced. Positions are in scene coordinates."""

    aois: Path | None = option(
        None, "JSON file of AOIs (boxes, meshes, shapes, groups), or a folder of Aria Digital Twin."
    )
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the frame of the rays to the scene.  [default: the gaze field's]"
    )
    margin: float = option(
        0.03,
        "Tolerance in metres: a surface this close to an AOI, in front of it or behind a box, counts as the AOI.",
        within=Range(0, 10**6),
    )
    aoi_samples: int = option(48, "Sample points per AOI, for visibility.", within=Range(1, 4096))
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )


@dataclass(frozen=True, kw_only=True)
class CountOptions(AoiOptions):
    """Options of the measurement; durations are in seconds."""

    tolerance: float = option(
        0.0,
        "Angular tolerance in degrees: a sample counts if it passes this close to an unoccluded part of the AOI.",
        within=Range(0, 20),
    )
    max_gap: float = option(
        1.0, "Longest time in seconds between two samples that the first one represents.", within=SECONDS
    )
    session_gap: float = option(
        60.0, "Pause in seconds after which a new session of a participant starts.", within=SECONDS
    )
    merge_gap: float = option(0.15, "Longest interruption of a visit in seconds.", within=SECONDS)
    min_visit: float = option(0.1, "Shortest visit in seconds.", within=SECONDS)
    aoi_visibility: bool = option(
        False, "Also compute visibility: visible share, share of visible time, AOIs that are visible but not visited."
    )
    fov: float = option(
        120.0,
        "Field of view in degrees, centred on the head direction or, if unknown, on the gaze direction.",
        within=Range(1, 360),
    )
    cell_size: float = option(
        0.1, "Edge length in metres of the cells from whose centres visibility is traced.", within=Range(0.001, 10**6)
    )
    windows: tuple[str, ...] = option(
        (), "Time window NAME=FROM,TO in seconds on the clock of the rays. Repeatable.", "--window"
    )
    zones: Path | None = option(None, "JSON file of boxes that define zones of the floor.")
    cohorts: Path | None = option(None, "CSV file with the columns person,cohort.  [default: the cohorts in the rays]")

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.windows:
            parse_window(text)

    def visit_rules(self) -> VisitRules:
        """Return the definition of visits. Raises `NergError` for contradictory durations."""
        from nerg_mi.statistics.visits import VisitRules

        return VisitRules(self.max_gap, self.session_gap, self.merge_gap, self.min_visit)


@dataclass(frozen=True, kw_only=True)
class PredictionOptions(AoiOptions):
    """Options of the prediction."""

    directions: int = option(8192, "Initial number of directions around each viewpoint.", within=Range(64, 1 << 20))


@dataclass(frozen=True, kw_only=True)
class StatisticsOptions(CountOptions, PredictionOptions, PartOptions):
    """Options of `nerg stats`."""

    viewpoints: int = option(256, "Approximate number of viewpoints for predictions.", within=Range(1, 100_000))
    glance_duration: float = option(
        0.3,
        "Glance duration in seconds, used to predict the hit ratio; glances are assumed independent.",
        within=Range(0.001, 10**6),
    )
    what_if: Path | None = option(None, "JSON file of changes to shapes and observers whose effects are predicted.")
    visibility: bool = option(False, "Compute isovists on a grid, without recordings.")
    observers: tuple[str, ...] = option(
        (),
        "Position x,y,z of an observer if there are no rays.  [default: the scene's observer, or a grid on the floor]",
        "--observer",
    )
    eye_height: float = option(
        1.6, "Eye height in metres above the floor, for observers on a grid.", within=Range(0.01, 10**6)
    )
    floor_height: float = option(0.0, "Height of the floor in scene units.", within=COORDINATES)
    grid_step: float = option(0.25, "Spacing of the grid in metres.", within=Range(0.01, 10**6))
    min_participants: int = option(1, "Suppress values that rest on fewer participants.", within=Range(1, 10**6))
    show_names: bool = option(False, "Write the names of participants instead of pseudonyms.")
    salt: Path | None = option(
        None, "Secret file that pseudonyms are derived from.  [default: a random secret, which is not stored]"
    )
    resamples: int = option(1999, "Number of bootstrap draws for confidence intervals.", within=Range(199, 100_000))
    seed: int = option(0, "Seed of the bootstrap draws.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.observers:
            parse_point(text, "--observer")


def parse_window(text: str) -> tuple[str, float, float]:
    """Parse NAME=FROM,TO to a name, a start and an end. Raises `NergError` for other texts."""
    name, sign, rest = text.partition("=")
    ends = parse_numbers(rest, "--window") if sign else ()
    if not name.strip() or len(ends) != 2 or not TIMES.low <= ends[0] < ends[1] <= TIMES.high:
        raise NergError(f'--window needs NAME=FROM,TO in seconds, such as morning=0,3600; got "{sanitize(text, 60)}"')
    return name.strip(), ends[0], ends[1]
