"""Options of statistics of attention, apart from what follows them: the command line lists them at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import COORDINATES, SECONDS, SEEDS, THREADS, TIMES, ValidatedDataclass, Range
from nerg_mi.workflows.options import PartOptions, option, parse_numbers, parse_point

if TYPE_CHECKING:
    from nerg_mi.statistics.visits import VisitRules


@dataclass(frozen=True, kw_only=True)
class AoiOptions(ValidatedDataclass):
    """The things that people look at, and how finely they are traced. Positions are in the coordinates of the place."""

    aois: Path | None = option(
        None, "JSON file of areas of interest: boxes, meshes, shapes, groups; or a folder of Aria Digital Twin."
    )
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    margin: float = option(
        0.03,
        "Metres by which surfaces may lie in front of a thing, or behind a box, and yet be its own.",
        within=Range(0, 10**6),
    )
    aoi_samples: int = option(48, "Points of a thing that are looked for.", within=Range(1, 4096))
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )


@dataclass(frozen=True, kw_only=True)
class CountOptions(AoiOptions):
    """On what sums of rays depend besides. Times are in seconds."""

    tolerance: float = option(
        0.0, "Degrees by which a ray may miss what of a thing is in nobody's way.", within=Range(0, 20)
    )
    max_gap: float = option(1.0, "A ray stands for the time to the next, unless that is longer than this.", within=SECONDS)
    session_gap: float = option(60.0, "A longer pause of a person begins another sitting.", within=SECONDS)
    merge_gap: float = option(
        0.15, "Rays on a thing are one look if nothing else lasts longer between them.", within=SECONDS
    )
    min_visit: float = option(0.1, "A look lasts so long at least.", within=SECONDS)
    aoi_visibility: bool = option(False, "Also count what could be seen: visible share, looked at given visible, unseen.")
    fov: float = option(
        120.0, "Degrees that a view is wide, about where the head, or else the ray, points.", within=Range(1, 360)
    )
    cell_size: float = option(
        0.1, "What could be seen is traced from middles of cells of this edge, in metres.", within=Range(0.001, 10**6)
    )
    windows: tuple[str, ...] = option((), "A window of time on the rays' clock: NAME=FROM,TO.", "--window")
    zones: Path | None = option(None, "JSON file of boxes on whose floor areas people stand.")
    cohorts: Path | None = option(None, "CSV file of person,cohort.  [default: the cohorts in the rays]")

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.windows:
            parse_window(text)

    def visit_rules(self) -> VisitRules:
        """What a look is. Raises `NergError` for times that contradict each other."""
        from nerg_mi.statistics.visits import VisitRules

        return VisitRules(self.max_gap, self.session_gap, self.merge_gap, self.min_visit)


@dataclass(frozen=True, kw_only=True)
class PredictionOptions(AoiOptions):
    """On what depends besides how a field answers."""

    directions: int = option(8192, "Directions around each.", within=Range(64, 1 << 20))


@dataclass(frozen=True, kw_only=True)
class StatisticsOptions(CountOptions, PredictionOptions, PartOptions):
    """What is counted, and how."""

    viewpoints: int = option(256, "Places from which the field is asked, about.", within=Range(1, 100_000))
    glance_duration: float = option(
        0.3, "Seconds of a glance: the field's reach takes glances for independent.", within=Range(0.001, 10**6)
    )
    what_if: Path | None = option(None, "JSON file of changes to shapes and observers, which the field foretells.")
    visibility: bool = option(False, "Isovists on a grid: what can be seen from where, without any tracking.")
    observers: tuple[str, ...] = option(
        (),
        "Position of somebody, x,y,z, where there are no rays.  [default: the scene's, or all of the floor]",
        "--observer",
    )
    eye_height: float = option(1.6, "Height of eyes above the floor, of people on a grid.", within=Range(0.01, 10**6))
    floor_height: float = option(0.0, "Height of the floor.", within=COORDINATES)
    grid_step: float = option(0.25, "Metres between the places of a grid.", within=Range(0.01, 10**6))
    min_participants: int = option(1, "Blank numbers that rest on fewer people.", within=Range(1, 10**6))
    show_names: bool = option(False, "Write the names of people. Without it they have pseudonyms.")
    salt: Path | None = option(None, "Secret file from which pseudonyms are made.  [default: a random one, not kept]")
    resamples: int = option(1999, "Draws of people for intervals.", within=Range(199, 100_000))
    seed: int = option(0, "Seed of the draws.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.observers:
            parse_point(text, "--observer")


def parse_window(text: str) -> tuple[str, float, float]:
    """Name, start and end of NAME=FROM,TO. Raises `NergError` for other texts."""
    name, sign, rest = text.partition("=")
    ends = parse_numbers(rest, "--window") if sign else ()
    if not name.strip() or len(ends) != 2 or not TIMES.low <= ends[0] < ends[1] <= TIMES.high:
        raise NergError(f'--window is NAME=FROM,TO in seconds, as in morning=0,3600; got "{sanitize(text, 60)}"')
    return name.strip(), ends[0], ends[1]
