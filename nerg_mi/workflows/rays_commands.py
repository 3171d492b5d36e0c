"""``nerg rays import``: Convert tracking files to rays: right-handed, z up, metres, seconds.
``nerg rays guess``: Propose the preset or the column map of unknown files: what is sure, what is a guess, what no file
says.
``nerg rays show``: The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height.
``nerg rays filter``: Keep some rays: conditions first, then fixations, then thinning of those who stand still.
``nerg rays split``: Split into training and test rays that share none: by position, person, time, or several of them at
once.
``nerg rays plot``: The floor plan: where people stood and how densely, or the layout.
``nerg align``: Find how tracking lies in a place: from points, a twin, cameras, or the tracking alone.

What these commands take; their workflows run in `.rays` and `.align`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.ranges import COORDINATES, LENGTHS, RAYS, SECONDS, SEEDS, THREADS, TIMES, ValidatedDataclass, Range

from .base import Parameter, argument, declare, extra, out
from .options import coordinates, cpu_threads, llvm_variant, option

DETECTORS = ("ivt", "idt")
DATASET = ".rays"
"""How the name of a dataset ends where one is written; any other name is that of a file."""
PLANS = ("density", "layout")


# ---- Rays ----


@dataclass(frozen=True, kw_only=True)
class RaysImportOptions(ValidatedDataclass):
    """How tracking files become rays. Raises `NergError` for a salt without pseudonyms, and for what only a dataset
    has."""

    reader: str = option("table", "Name of a registered reader (nerg_mi.rays.readers.registry).")
    settings: Any = option(None, "An object of the reader's Options. Default: as they are by default.")
    environment: str | None = option(None, "Of a dataset: the place of all files.  [default: unknown]")
    day: str | None = option(
        None, "Of a dataset: the day of all rays, as 2026-11-22.  [default: by their times, in UTC, else unknown]"
    )
    workers: int | None = option(
        None, "Of a dataset: processes that import files beside each other.  [default: a core each]", within=THREADS
    )
    skip_bad_lines: bool = option(
        False, "Leave out lines that cannot be read, with an account of them: at most 1 % of a file's."
    )
    pseudonyms: bool = option(False, "Replace the names of persons, also in the names of files, by salted hashes.")
    salt: Path | str | None = option(
        None,
        "--pseudonyms: file of 16 random bytes or more, so that several imports agree.  [default: random, not kept]",
    )
    output: Path | str | None = option(None, "Rays file (.npz or .parquet) or dataset (.rays) to write.")
    align_output: Path | str | None = option(
        None,
        "JSON file to write: the similarity from the rays to the files' own frame, for --align where a place is in "
        "that frame.",
        "--write-align",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.salt is not None and not self.pseudonyms:
            raise NergError("--salt belongs to --pseudonyms; add it, or leave out --salt")
        given = [n for n in ("place_name", "day", "workers") if getattr(self, n) is not None]
        if given and not self.into_dataset:
            raise NergError(
                f"--{given[0].replace('_', '-')} belongs to datasets; let the name of the output end in {DATASET}"
            )
        if self.align_output is not None and self.into_dataset:
            raise NergError(
                "--write-align belongs to files of rays; the sources of a dataset may differ in their frames"
            )

    @property
    def into_dataset(self) -> bool:
        """Whether a dataset is to be written."""
        return self.output is not None and Path(self.output).suffix.lower() == DATASET


@dataclass(frozen=True, kw_only=True)
class FilterOptions(ValidatedDataclass):
    """Which rays to keep: conditions first, then fixations, then fewer of those who stand still.

    Raises `NergError` for an unknown word, or where nothing is said.
    """

    start: float | None = option(None, "Rays from this time on, seconds.", "--from", within=TIMES)
    end: float | None = option(None, "Rays before this time, seconds.", "--to", within=TIMES)
    persons: tuple[str, ...] = option((), "Only this person; repeatable.", "--person")
    without_persons: tuple[str, ...] = option((), "Not this person; repeatable.", "--without-person")
    cohorts: tuple[str, ...] = option((), "Only this cohort; repeatable.", "--cohort")
    box: tuple[float, ...] | None = coordinates("Origins in this box: x0,x1,y0,y1,z0,z1, metres.")
    min_confidence: float | None = option(None, "Only rays of at least this confidence.", within=Range(0, 1))
    with_hit: bool = option(False, "Only rays whose hit point is known.")
    fixations: str | None = option(None, "Only rays of fixations: ivt (by velocity) or idt (by dispersion).")
    velocity_threshold: float = option(100.0, "ivt: degrees a second that end a fixation.", within=Range(0, 10**6))
    dispersion_threshold: float = option(3.0, "idt: degrees within which a fixation stays.", within=Range(0, 180))
    min_fixation: float | None = option(None, "Shortest fixation, seconds.  [default: ivt 0.06, idt 0.1]", within=SECONDS)
    merge_fixations: bool = option(False, "One ray a fixation, its mean.")
    thin: float | None = option(None, "A stop counts as at most this many seconds of rays.", within=SECONDS)
    thin_distance: float = option(0.1, "With --thin, a stop is a stay within this many metres.", within=Range(0, 10**6))
    sample: int | None = option(None, "So many of the rays that are left, each as likely as any other.", within=RAYS)
    seed: int = option(0, "Seed of --sample.", within=SEEDS)
    output: Path | str | None = option(
        None, "Rays file to write (.npz or .parquet), or of a dataset another (.rays).", "-o", "--output"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fixations not in (None, *DETECTORS):
            raise NergError(f'--fixations is "{self.fixations}"; it is ivt or idt')
        if self.merge_fixations and self.fixations is None:
            raise NergError("--one-ray is of fixations; add --fixations ivt or --fixations idt")
        if not self.conditions and not self.follows and self.sample is None:
            raise NergError(
                "say which rays to keep, for instance with --from, --person, --box, --fixations, --thin or --sample "
                "(--help lists all)"
            )

    @property
    def follows(self) -> bool:
        """Whether it is asked for what must see the rays of a person one after the other."""
        return self.fixations is not None or self.thin is not None

    @property
    def conditions(self) -> dict[str, Any]:
        """What was asked for, as `nerg_mi.rays.filters.select_mask` takes it."""
        what = {
            "time": None if self.start is None and self.end is None else (self.start, self.end),
            "persons": list(self.persons) or None,
            "without_persons": list(self.without_persons) or None,
            "cohorts": list(self.cohorts) or None,
            "box": None if self.box is None else list(self.box),
            "min_confidence": self.min_confidence,
            "with_hit": self.with_hit or None,
        }
        return {name: value for name, value in what.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class SplitOptions(ValidatedDataclass):
    """How training and test rays are parted: by position, person or time, or several of them at once.

    Raises `NergError` where nothing is said.
    """

    test_zones: int = option(0, "By position: zones held out; 0: not by position.", within=Range(0, 1000))
    radius: float = option(
        0.25, "By position: R of probes, metres; rays within 2R of a test position are purged.", within=LENGTHS
    )
    zone_radius: float = option(0.2, "By position: radius of a zone, metres.", within=Range(0, 10**6))
    test_positions: int = option(150, "By position: test positions in the zones.", within=Range(1, 10**5))
    min_rays: int = option(64, "By position: rays that a test position has within R.", within=Range(1, 10**6))
    test_participants: float = option(0.0, "By person: share held out, at random; 0: not by person.", within=Range(0, 1))
    persons: tuple[str, ...] = option((), "By person: this one is held out; repeatable.", "--person")
    test_time: float = option(0.0, "By time: share at the end that is held out; 0: not by time.", within=Range(0, 1))
    gap: float = option(5.0, "By time: seconds purged before the end part.", within=SECONDS)
    clock: str = option("all", "By time: all (one clock), or person (each their own).")
    seed: int = option(0, "Seed of zones, positions and people.", within=SEEDS)
    train_output: Path | str | None = option(None, "Rays file to write of the training rays (.npz or .parquet).")
    test_output: Path | str | None = option(None, "The same of the test rays.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.test_zones or self.test_participants or self.persons or self.test_time):
            raise NergError("say how to split: --zones 3, --people 0.5, --person NAME, --time 0.2, or several of them")


@dataclass(frozen=True, kw_only=True)
class PlotOptions(ValidatedDataclass):
    """What a floor plan shows. Raises `NergError` for an unknown word, or test rays beside densities."""

    kind: str = option("density", "density: rays/m² with mean directions; layout: each ray's place, with dimensions.")
    cell_size: float | None = option(
        None, "density: edge of a cell, metres.  [default: a fiftieth of the plan]", within=LENGTHS
    )
    # Or rays in memory.
    test: Path | str | Any | None = option(None, "layout: the test rays of a split, drawn beside.")
    output: Path | str | None = option(None, "Picture to write (.png or .svg).", "-o", "--output")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in PLANS:
            raise NergError(f'--kind is "{self.kind}"; it is density or layout')
        if self.kind == "density" and self.test is not None:
            raise NergError("--test is drawn in the layout; add --kind layout")


def _reader_parameters() -> Mapping[str, Parameter]:
    """The options of all readers that are registered now."""
    from nerg_mi.rays.readers.registry import list_preset_names, collect_shared_options

    parameters = {"preset": extra(None, f"Known recording: {', '.join(list_preset_names())}.", str, "--preset")}
    for o in collect_shared_options():
        parameters[o.name] = extra(False if o.kind is bool else None, o.help, o.kind, o.flag)
    return parameters


_RAYS_FILE = argument("Rays file (.npz or .parquet), or dataset (a folder).")
_OUTPUT = out("Rays file (.npz or .parquet) or dataset (.rays) to write.")

declare(
    "rays import",
    "nerg_mi.workflows.rays:import_files",
    options=RaysImportOptions,
    without=("reader", "settings"),
    further=_reader_parameters,
    files=argument("Tracking files (CSV, CSV.gz, Parquet or skeleton files; for pupil, folders).", list[Path]),
    output=_OUTPUT,
)

declare(
    "rays guess",
    "nerg_mi.workflows.rays:print_guesses",
    more="Nothing is imported: the whole command is printed, one for all files that are alike, for you to check and to "
    "run.",
    files=argument("Unknown tracking files, folders of them, or folders of recordings.", list[Path]),
)

declare(
    "rays show",
    "nerg_mi.workflows.rays:print_cards",
    more="Of a dataset one for each place; of very many rays some figures are of a sample, as it says.",
    rays=_RAYS_FILE,
)

declare("rays filter", "nerg_mi.workflows.rays:filter_rays", options=FilterOptions, rays=_RAYS_FILE, output=_OUTPUT)

declare(
    "rays split",
    "nerg_mi.workflows.rays:split_file",
    more="Of several, training rays are on the training side of each and test rays on the test side of each; the rest "
    "is purged.",
    options=SplitOptions,
    without=("train_output", "test_output"),
    rays=_RAYS_FILE,
    output=out("Rays file; -train and -test are put before its ending."),
)

declare(
    "rays plot",
    "nerg_mi.workflows.rays:plot_rays",
    options=PlotOptions,
    rays=_RAYS_FILE,
    output=out("Picture to write (.png or .svg)."),
)


# ---- Alignment ----


@dataclass(frozen=True, kw_only=True)
class AlignOptions(ValidatedDataclass):
    """What an alignment is found from, and what is known beforehand. Lengths of the tracking are metres."""

    field: Path | None = option(None, "The place: a radiance field, or Gaussian splats.")
    scene: Path | None = option(None, "Or: a Mitsuba scene.")
    surface: Path | None = option(
        None, "Or: a mesh or points on surfaces (.ply, .obj, .glb, .npy, .csv of x,y,z or of Aria)."
    )
    pairs: Path | None = option(
        None, "Evidence: picked points, CSV of x,y,z,place_x,place_y,place_z (three or more), or JSON."
    )
    tracking_surface: Path | None = option(None, "Or: a mesh or points (as --surface) in the tracking's frame.")
    tracking_cameras: Path | None = option(None, "Or: posed photos in the tracking's frame (transforms.json, COLMAP), with ...")
    scene_cameras: Path | None = option(None, "... the same photos' poses in the place's frame.")
    init: Path | None = option(None, "Or: an alignment that is near, which the tracking refines.")
    refine: bool = option(False, "Refine what the evidence gave by the tracking.")
    up: str | None = option(
        None, "Axis of the place that is up (z, -y, ... or x,y,z): only turns about it are left. The tracking's is z."
    )
    floor_height: float = option(0.0, "Height of the floor in the tracking.", within=COORDINATES)
    scene_floor_height: float | None = option(
        None, "Height of the floor in the place, along --up. Default: found.", within=COORDINATES
    )
    scale: float | None = option(
        None, "Units of the place a metre of the tracking, where that is known.", within=LENGTHS
    )
    max_residual: float = option(
        10.0, "Centimetres of the median residual beyond which a fit is refused.", within=Range(0, 10**9)
    )
    force: bool = option(False, "Write a fit that is refused, too.")
    seed: int = option(0, "Seed of the rays by which the place is traced.", within=SEEDS)
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


declare(
    "align",
    "nerg_mi.workflows.align:align",
    "Find how tracking lies in a place: the similarity from the rays' frame to the place's.",
    more="""From picked points, a twin, cameras known in both frames, or from the tracking alone: heads in free space,
gaze that ends on surfaces. A mirrored frame is found and named.""",
    options=AlignOptions,
    rays=argument("Rays file (.npz or .parquet). Not needed with --pairs, --twin or --cameras.", required=False),
    output=out("Alignment to write (.json), which --align takes; beside it a picture."),
)
