"""``nerg rays import``: Convert tracking files to rays: right-handed, z up, metres, seconds.
``nerg rays guess``: Propose the preset or the column map for unknown tracking files.
``nerg rays show``: Print a data-quality report: rays, participants, duration, rate, dropped rows, extent, eye height.
``nerg rays filter``: Select rays by conditions, detect fixations, and thin out stationary periods.
``nerg rays split``: Split rays into disjoint training and test sets by position, participant or time.
``nerg rays events``: Detect fixations, saccades, pursuits and pauses, and measure data quality, per recording.
``nerg rays export``: Write rays in a format of other programs: a BIDS dataset with gaze, events and visits.
``nerg rays plot``: Plot a floor plan of recorded positions, as densities or as the layout of a split.

Options of these commands. The workflows are in `.rays`, `.rays_events` and `.rays_export`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, parameter
from nerg_mi.options import (
    ALIGN_HELP,
    ANALYSIS,
    DETAILS_OF_EVENTS,
    INPUT,
    OUTPUT,
    PERFORMANCE,
    TEST,
    EventOptions,
    best_variant,
    coordinates,
    option,
)
from nerg_mi.ranges import LENGTHS, RAYS, SECONDS, SEEDS, THREADS, TIMES, Range, ValidatedDataclass

from .base import HelpView, Parameter, argument, declare, extra, out

DETECTORS = ("ivt", "idt")
DATASET = ".rays"
"""Suffix by which a written dataset is recognised; any other name is that of a file."""
PLANS = ("density", "layout")


# ---- Rays ----


@dataclass(frozen=True, kw_only=True)
class RaysImportOptions(ValidatedDataclass):
    """How tracking files become rays.

    Raises `NergError` for a salt without pseudonyms, and for options of datasets if the output is a file.
    """

    reader: str = option("table", "Name of a registered reader (nerg_mi.rays.readers.registry).", group=INPUT)
    settings: Any = option(None, "Instance of the reader's Options.  [default: its defaults]", group=INPUT)
    environment: str | None = option(
        None,
        "Name of the environment in which all files were recorded (datasets only).  [default: unknown]",
        group=INPUT,
    )
    day: str | None = option(
        None,
        "Day of all recordings, as 2026-11-22 (datasets only).  [default: from their times in UTC, else unknown]",
        group=INPUT,
    )
    workers: int | None = option(
        None,
        "Number of processes that import files in parallel (datasets only).  [default: one per core]",
        within=THREADS,
        group=PERFORMANCE,
    )
    skip_bad_lines: bool = option(
        False, "Skip and report lines that cannot be read, up to 1 % of the lines of a file.", group=INPUT
    )
    pseudonyms: bool = option(
        False, "Replace the names of participants, also within file names, by salted hashes.", group=OUTPUT
    )
    salt: Path | str | None = option(
        None,
        "File of at least 16 random bytes for --pseudonyms, so that several imports agree.  [default: random, not "
        "stored]",
        group=OUTPUT,
    )
    output: Path | str | None = option(None, "Rays file (.npz or .parquet) or dataset (.rays) to write.", group=OUTPUT)
    align_output: Path | str | None = option(
        None,
        "JSON file to write: the similarity from the rays to the frame of the input files, for --align with a scene in "
        "that frame.",
        group=OUTPUT,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.salt is not None and not self.pseudonyms:
            raise NergError(
                f"{parameter('salt')} needs {parameter('pseudonyms', True)}; add it, or leave out {parameter('salt')}"
            )
        of_datasets = {
            parameter("environment"): self.environment,
            parameter("day"): self.day,
            parameter("workers"): self.workers,
        }
        explicit = [flag for flag, value in of_datasets.items() if value is not None]
        if explicit and not self.into_dataset:
            raise NergError(f"{explicit[0]} applies to datasets only; use an output name that ends in {DATASET}")
        if self.align_output is not None and self.into_dataset:
            raise NergError(
                f"{parameter('align_output')} does not apply to datasets, whose sources may differ in their "
                "frames; write a rays file"
            )

    @property
    def into_dataset(self) -> bool:
        """Whether the output is a dataset."""
        return self.output is not None and Path(self.output).suffix.lower() == DATASET


@dataclass(frozen=True, kw_only=True)
class FilterOptions(ValidatedDataclass):
    """Which rays are selected: by conditions, then by fixations, then by thinning.

    Raises `NergError` for an unknown detector, or if no option selects anything.
    """

    start: float | None = option(
        None,
        "Time of the first selected ray, in seconds of the rays' clock.  [default: no limit]",
        within=TIMES,
        group=INPUT,
    )
    end: float | None = option(
        None,
        "Time before which selected rays lie, in seconds of the rays' clock.  [default: no limit]",
        within=TIMES,
        group=INPUT,
    )
    persons: tuple[str, ...] = option(
        (), "Participant whose rays are selected; repeatable.  [default: all]", "--person", group=INPUT
    )
    without_persons: tuple[str, ...] = option(
        (), "Participant whose rays are left out; repeatable.", "--without-person", group=INPUT
    )
    cohorts: tuple[str, ...] = option(
        (), "Cohort whose rays are selected; repeatable.  [default: all]", "--cohort", group=INPUT
    )
    box: tuple[float, ...] | None = coordinates(
        "Axis-aligned box that selected ray origins lie in: x0,x1,y0,y1,z0,z1 in metres.  [default: no limit]",
        group=INPUT,
    )
    min_confidence: float | None = option(
        None, "Minimum confidence of selected rays.  [default: no limit]", within=Range(0, 1), group=INPUT
    )
    with_hit: bool = option(False, "Select only rays with a hit point.", group=INPUT)
    fixations: str | None = option(
        None,
        "Select only rays of fixations, detected by ivt (velocity threshold) or idt (dispersion threshold).",
        group=ANALYSIS,
    )
    velocity_threshold: float = option(
        100.0,
        "Angular velocity in degrees per second above which a fixation ends (ivt).",
        within=Range(0, 10**6),
        group=ANALYSIS,
    )
    dispersion_threshold: float = option(
        3.0, "Angular dispersion in degrees within which a fixation stays (idt).", within=Range(0, 180), group=ANALYSIS
    )
    min_fixation: float | None = option(
        None,
        "Minimum duration of a fixation in seconds.  [default: 0.06 for ivt, 0.1 for idt]",
        within=SECONDS,
        group=ANALYSIS,
    )
    merge_fixations: bool = option(False, "Replace the rays of each fixation by their mean ray.", group=ANALYSIS)
    thin: float | None = option(
        None,
        "Maximum time in seconds that a stationary period contributes; its rays are thinned out evenly.  [default: no "
        "thinning]",
        within=SECONDS,
        group=ANALYSIS,
    )
    thin_distance: float = option(
        0.1,
        "Distance in metres within which a participant counts as stationary for --thin.",
        within=Range(0, 10**6),
        group=ANALYSIS,
    )
    sample: int | None = option(
        None,
        "Number of rays in a uniform random sample of the selected rays.  [default: all]",
        within=RAYS,
        group=ANALYSIS,
    )
    seed: int = option(0, "Seed of --sample.", within=SEEDS, group=ANALYSIS)
    output: Path | str | None = option(
        None,
        "Rays file to write (.npz or .parquet); for a dataset, another dataset (.rays).",
        "-o",
        "--output",
        group=OUTPUT,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fixations not in (None, *DETECTORS):
            raise NergError(f'{parameter("fixations")} must be ivt or idt, got "{self.fixations}"')
        if self.merge_fixations and self.fixations is None:
            raise NergError(
                f"{parameter('merge_fixations', True)} needs a detector; add {parameter('fixations', 'ivt')} or "
                f"{parameter('fixations', 'idt')}"
            )
        if not self.conditions and not self.follows and self.sample is None:
            raise NergError(
                f"no selection is given; add for instance {parameter('start')}, {parameter('persons')}, "
                f"{parameter('box')}, {parameter('fixations')}, {parameter('thin')} or {parameter('sample')}"
            )

    @property
    def follows(self) -> bool:
        """Whether a step needs the consecutive rays of a participant."""
        return self.fixations is not None or self.thin is not None

    @property
    def conditions(self) -> dict[str, Any]:
        """The conditions that are set, as keywords of `nerg_mi.rays.filters.Conditions`."""
        values = {
            "time": None if self.start is None and self.end is None else (self.start, self.end),
            "persons": list(self.persons) or None,
            "without_persons": list(self.without_persons) or None,
            "cohorts": list(self.cohorts) or None,
            "box": None if self.box is None else list(self.box),
            "min_confidence": self.min_confidence,
            "with_hit": self.with_hit or None,
        }
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class SplitOptions(ValidatedDataclass):
    """How training and test rays are separated. Raises `NergError` if no criterion is given."""

    test_zones: int = option(
        0, "Number of zones whose positions are held out; 0: no split by position.", within=Range(0, 1000), group=TEST
    )
    radius: float = option(
        0.25,
        "Radius R of probes in metres; training rays within 2 R of a test position are purged.",
        within=LENGTHS,
        group=TEST,
    )
    zone_radius: float = option(0.2, "Radius of a zone in metres.", within=Range(0, 10**6), group=TEST)
    test_positions: int = option(
        150, "Maximum number of test positions, in all held-out zones together.", within=Range(1, 10**5), group=TEST
    )
    min_rays: int = option(
        64, "Minimum number of rays within R of a test position.", within=Range(1, 10**6), group=TEST
    )
    test_participants: float = option(
        0.0,
        "Fraction of the participants that are held out, at random; 0: no split by participant.",
        within=Range(0, 1),
        group=TEST,
    )
    persons: tuple[str, ...] = option((), "Person that is held out; repeatable.", "--person", group=TEST)
    test_time: float = option(
        0.0,
        "Fraction of the recording time that is held out, at its end; 0: no split by time.",
        within=Range(0, 1),
        group=TEST,
    )
    gap: float = option(
        5.0, "Time in seconds before the held-out end whose rays are purged.", within=SECONDS, group=TEST
    )
    clock: str = option(
        "all", "Clock of --test-time: all (one for all participants), or person (one for each).", group=TEST
    )
    seed: int = option(0, "Seed of zones, positions and participants.", within=SEEDS, group=TEST)
    train_output: Path | str | None = option(
        None, "Rays file to write the training rays to (.npz or .parquet).", group=OUTPUT
    )
    test_output: Path | str | None = option(
        None, "Rays file to write the test rays to (.npz or .parquet).", group=OUTPUT
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.test_zones or self.test_participants or self.persons or self.test_time):
            raise NergError(
                f"no criterion is given for the split; add {parameter('test_zones', 3)}, "
                f"{parameter('test_participants', 0.5)}, {parameter('persons', 'NAME')} or "
                f"{parameter('test_time', 0.2)}, or several of them"
            )


@dataclass(frozen=True, kw_only=True)
class PlotOptions(ValidatedDataclass):
    """What a floor plan shows. Raises `NergError` for an unknown kind, or test rays with densities."""

    kind: str = option(
        "density",
        "What is plotted: density (rays per square metre, with mean directions) or layout (ray origins, with "
        "dimensions).",
        group=ANALYSIS,
    )
    cell_size: float | None = option(
        None,
        "Edge length of a grid cell of the density in metres.  [default: a fiftieth of the plan]",
        within=LENGTHS,
        group=ANALYSIS,
    )
    # Or rays in memory.
    test: Path | str | Any | None = option(
        None, "Rays file of the test rays of a split, drawn in the same layout.", group=INPUT
    )
    output: Path | str | None = option(None, "Image to write (.png or .svg).", "-o", "--output", group=OUTPUT)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in PLANS:
            raise NergError(f'{parameter("kind")} must be density or layout, got "{self.kind}"')
        if self.kind == "density" and self.test is not None:
            raise NergError(f"{parameter('test')} applies to layouts only; add {parameter('kind', 'layout')}")


@dataclass(frozen=True, kw_only=True)
class RaysEventsOptions(EventOptions):
    """What is measured and written next to the events."""

    targets: Path | None = option(
        None,
        "CSV file of points that participants looked at, for the accuracy: columns start,end (seconds), x,y,z (metres, "
        "in the frame of the rays) and optionally person.  [default: no accuracy]",
        group=INPUT,
    )
    quality: Path | None = option(
        None, "CSV file to write: data quality of each recording.  [default: none]", group=OUTPUT
    )


@dataclass(frozen=True, kw_only=True)
class RaysExportOptions(EventOptions):
    """What is written next to the rays. Raises `NergError` for a scene without AOIs."""

    task: str = option("gaze", "Label of the task in the file names: letters and digits.", group=OUTPUT)
    title: str = option("Gaze in the world", "Name of the dataset.", group=OUTPUT)
    events: bool = option(
        True, "Write fixations, saccades and other events of gaze.", "--events/--no-events", group=OUTPUT
    )
    aois: Path | None = option(
        None,
        "JSON file of areas of interest (AOIs), whose visits are among the events.  [default: no visits]",
        group=INPUT,
    )
    scene: Path | None = option(
        None,
        "Scene (.xml) whose surfaces rays end on, for the visits.  [default: rays end at their hit points]",
        group=INPUT,
    )
    align: Path | None = option(None, ALIGN_HELP, group=INPUT)
    mode: str | None = best_variant()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.aois is None and (self.scene is not None or self.align is not None):
            raise NergError(
                f"{parameter('scene')} and {parameter('align')} are for the visits of AOIs; add "
                f"{parameter('aois')}, or leave them out"
            )


def _reader_parameters() -> Mapping[str, Parameter]:
    """Return the options of all registered readers."""
    from nerg_mi.rays.readers.registry import collect_shared_options, list_preset_names

    presets = ", ".join(list_preset_names())
    parameters = {
        "preset": extra(
            None, f"Format of the files: {presets}.  [default: a table, see --map]", str, "--preset", group=INPUT
        )
    }
    for o in collect_shared_options():
        parameters[o.name] = extra(False if o.kind is bool else None, o.help, o.kind, o.flag, group=INPUT)
    return parameters


def _view_import(arguments: Sequence[str]) -> HelpView:
    """Show the options of the preset among the ``arguments``, or those of all formats and the presets."""
    from nerg_mi.rays.readers.base import list_options
    from nerg_mi.rays.readers.registry import (
        TABLE,
        collect_shared_options,
        get_reader,
        list_preset_names,
        summarise_files,
    )

    values = [f"{a}={b}" if a == "--preset" else a for a, b in zip(arguments, [*arguments[1:], ""])]
    preset = next((value.partition("=")[2] for value in values if value.startswith("--preset=")), None)
    if preset is None and any(value.partition("=")[0] == "--map" for value in values):
        preset = TABLE
    names = {o.name for o in collect_shared_options()}
    if preset is None:
        return HelpView(
            "Options of a format: nerg rays import --preset NAME --help; of tables: nerg rays import --map COLUMNS "
            "--help.",
            frozenset(names - {"columns"}),
            {"preset": "Format of the files, see below.  [default: a table, see --map]"},
            {"Presets": [(name, summarise_files(get_reader(name))) for name in list_preset_names()]},
        )
    reader = get_reader(preset)
    options = {o.name: o for o in list_options(reader.Options)}
    text = f"The preset {reader.name} reads {reader.files}. Frame: {reader.frame_description}."
    helps = {o.name: o.help + (f"  [default: {o.default_text}]" if o.default_text else "") for o in options.values()}
    return HelpView(text.replace("`", ""), frozenset(names - set(options)), {"preset": "Format of the files.", **helps})


_RAYS_FILE = argument("Rays file (.npz or .parquet) or dataset (.rays).")
_OUTPUT = out("Rays file (.npz or .parquet) or dataset (.rays) to write.")

declare(
    "rays import",
    "nerg_mi.workflows.rays:import_files",
    options=RaysImportOptions,
    without=("reader", "settings"),
    further=_reader_parameters,
    view=_view_import,
    files=argument("Tracking files (CSV, CSV.gz, Parquet, skeleton files); for pupil, folders.", list[Path]),
    output=_OUTPUT,
)

declare(
    "rays guess",
    "nerg_mi.workflows.rays:print_guesses",
    "Propose the preset or the column map for unknown tracking files; say what is certain, what is a guess, and "
    "what no file states.",
    more="Nothing is imported. The complete import command is printed, once for all files of the same format, to be "
    "checked and run.",
    files=argument("Tracking files of unknown format, or folders of them.", list[Path]),
)

declare(
    "rays show",
    "nerg_mi.workflows.rays:print_cards",
    more="A dataset gets one report for each environment. For very large data some numbers are estimated from a "
    "sample; the report says which.",
    rays=_RAYS_FILE,
)

declare("rays filter", "nerg_mi.workflows.rays:filter_rays", options=FilterOptions, rays=_RAYS_FILE, output=_OUTPUT)

declare(
    "rays split",
    "nerg_mi.workflows.rays:split_file",
    more="With several criteria, training rays are on the training side of each and test rays on the test side of "
    "each; all other rays are purged.",
    options=SplitOptions,
    without=("train_output", "test_output", "zone_radius"),
    rays=_RAYS_FILE,
    output=out("Rays file; -train and -test are inserted before its suffix."),
)

declare(
    "rays events",
    "nerg_mi.workflows.rays_events:write_events",
    options=RaysEventsOptions,
    rays=_RAYS_FILE,
    output=out("CSV file to write: one event per row."),
)

declare(
    "rays export",
    "nerg_mi.workflows.rays_export:export_rays",
    options=RaysExportOptions,
    without=DETAILS_OF_EVENTS,
    rays=_RAYS_FILE,
    output=out("Folder of the BIDS dataset to write; it must not exist or be empty."),
)

declare(
    "rays plot",
    "nerg_mi.workflows.rays:plot_rays",
    options=PlotOptions,
    rays=_RAYS_FILE,
    output=out("Image to write (.png or .svg)."),
)
