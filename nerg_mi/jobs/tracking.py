"""``nerg rays import``: Convert tracking files to rays: right-handed, z up, metres, seconds.
``nerg rays guess``: Propose the preset or the column map of unknown files: what is sure, what is a guess, what no file
says.
``nerg rays show``: The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height.
``nerg rays filter``: Keep some rays: conditions first, then fixations, then thinning of those who stand still.
``nerg rays split``: Split into training and test rays that share none: by position, person, time, or several of them at
once.
``nerg rays plot``: The floor plan: where people stood and how densely, or the layout.

Rays of attention from tracking files, and what is done to them: imported, summed up, filtered, split, drawn.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures import maps, style
from nerg_mi.figures.style import files_among, provenance
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.safe_read import plain
from nerg_mi.files.tables import write_json
from nerg_mi.ranges import LENGTHS, Checked
from nerg_mi.rays import filters
from nerg_mi.rays.dataset import is_dataset
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.guess import Proposal, propose_imports
from nerg_mi.rays.pseudonyms import pseudonymise, read_salt
from nerg_mi.rays.quality import RaysSummary, card_table, summarise
from nerg_mi.rays.rays import SUFFIXES, Rays
from nerg_mi.rays.readers.registry import TABLE, parse_options, preset_names, read_rays, shared_options

from .commands import Parameter, argument, command, extra, out
from .datasets import FileName, dataset_cards, filter_dataset, import_dataset
from .filtering import FilterSteps
from .options import option
from .options.rays import FilterOptions, ImportOptions, SplitOptions
from .reporter import SILENT, Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("density", "layout")

_RAYS_FILE = argument("Rays file (.npz or .parquet), or dataset (a folder).")
_OUTPUT = out("Rays file (.npz or .parquet) or dataset (.rays) to write.")


@dataclass(frozen=True, eq=False)
class ImportResult:
    """Rays, whose metadata hold the account of what was dropped, and their figures.

    Of a dataset of more than a million they are a sample, as its metadata say, and the figures are of all of them.
    """

    rays: Rays
    summary: RaysSummary
    # Further lines of the card, of a dataset: names and texts.
    lines: tuple[tuple[str, str], ...] = ()


def import_rays(
    files: FileName | Sequence[FileName], options: ImportOptions | None = None, reporter: Reporter = SILENT
) -> ImportResult:
    """Tracking files (or folders, by the reader) as rays: right-handed, z up, metres, seconds.

    Raises `NergError` for what the reader refuses, or an output that cannot be written, before anything is read; for an
    alignment with files whose frame is the other hand's.
    """
    options = options or ImportOptions()
    files = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    if options.into_dataset:
        return ImportResult(*import_dataset(files, options, reporter))
    _check_outputs(options.output)
    if options.align_output is not None:
        check_writable(options.align_output, ".json")
    salt = None if options.salt is None else read_salt(options.salt)
    begun: list[str] = []

    def progress(name: str) -> None:
        reporter.progress(min(len(begun) / len(files), 1.0), f"reading {name}")
        begun.append(name)

    rays = read_rays(options.reader, files, options.settings, skip_bad_lines=options.skip_bad_lines, on_source=progress)
    if options.pseudonyms:
        rays = pseudonymise(rays, salt)
    align = None if options.align_output is None else _to_files(rays)
    _save(rays, options.output)
    if options.align_output is not None:
        write_json(options.align_output, align)
    return ImportResult(rays, summarise(rays))


def _to_files(rays: Rays) -> list[list[float]]:
    """The similarity (4 rows) from rays to the frame of the files that they were made of, for --align."""
    back = np.linalg.inv(np.array(rays.metadata["transform"], np.float64))
    if np.linalg.det(back[:3, :3]) < 0:
        raise NergError(
            "the files' frame is left-handed and that of rays right-handed, so that no similarity leads from one to "
            "the other; leave out --write-align, and align the rays with the place"
        )
    return (back + 0.0).tolist()


def _reader_parameters() -> dict[str, Parameter]:
    """The options of all readers that are registered now."""
    parameters = {"preset": extra(None, f"Known recording: {', '.join(preset_names())}.", str, "--preset")}
    for o in shared_options():
        parameters[o.name] = extra(False if o.kind is bool else None, o.help, o.kind, o.flag)
    return parameters


@command(
    "rays import",
    options=ImportOptions,
    without=("reader", "settings"),
    further=_reader_parameters,
    files=argument("Tracking files (CSV, CSV.gz, Parquet or skeleton files; for pupil, folders).", list[Path]),
    output=_OUTPUT,
)
def import_files(
    files: list[Path], preset: str | None, options: ImportOptions, reporter: Reporter, **settings: Any
) -> None:
    """`import_rays` by a preset, or by a column map, with the sanity card."""
    settings = {name: value for name, value in settings.items() if value is not None and value is not False}
    if (preset is None) == ("columns" not in settings):
        raise NergError("say what the files are: either --preset NAME or --map COLUMNS")
    reader = preset or TABLE
    options = replace(options, reader=reader, settings=parse_options(reader, settings))
    result = import_rays(files, options, reporter)
    reporter.message(card_table(result.rays, result.summary, str(options.output), result.lines))
    for path in (options.output, options.align_output):
        _tell(path, reporter)


def guess_imports(files: Sequence[FileName], reporter: Reporter = SILENT) -> list[Proposal]:
    """What unknown tracking files, or folders of them, are likely to be, and the commands to import them by: one for
    all that are alike. Nothing is applied or written.

    Raises `NergError` for a file that is no table, or is damaged.
    """
    reporter.progress(0.0, f"reading {Path(files[0]).name}")
    return propose_imports([Path(file) for file in files])


@command(
    "rays guess",
    more="Nothing is imported: the whole command is printed, one for all files that are alike, for you to check and to "
    "run.",
    files=argument("Unknown tracking files, folders of them, or folders of recordings.", list[Path]),
)
def print_guesses(files: list[Path], reporter: Reporter) -> None:
    """`guess_imports` in words. Names of columns are printed without control characters of a terminal."""
    proposals = guess_imports(files, reporter)
    for k, proposal in enumerate(proposals):
        if len(proposals) > 1:
            more = f" and {len(proposal.paths) - 1} more" if len(proposal.paths) > 1 else ""
            reporter.message("\n" * (k > 0) + plain(f"{proposal.paths[0]}{more}", 2000))
        for name, sentences in (("sure", proposal.sure), ("guess", proposal.guessed), ("open", proposal.open)):
            for sentence in sentences:
                reporter.message(f"{name:6} {plain(sentence, 2000)}")
        reporter.message("")
        reporter.message(plain(proposal.command or "nothing can be proposed", 100_000))


def card_of(path: FileName, reporter: Reporter = SILENT) -> list[tuple[str, ImportResult]]:
    """Titles, figures and lines of the sanity cards of a file of rays, or of each place of a dataset."""
    reporter.progress(0.0, f"reading {Path(path).name}")
    if not is_dataset(path):
        rays = Rays.load(path)
        return [(str(path), ImportResult(rays, summarise(rays)))]
    return [(title, ImportResult(*card)) for title, card in dataset_cards(path)]


@command(
    "rays show",
    more="Of a dataset one for each place; of very many rays some figures are of a sample, as it says.",
    rays=_RAYS_FILE,
)
def print_cards(rays: Path, reporter: Reporter) -> None:
    """`card_of` as tables."""
    for title, card in card_of(rays, reporter):
        reporter.message(card_table(card.rays, card.summary, title, card.lines))


@dataclass(frozen=True, eq=False)
class FilterResult:
    """The rays that were kept, and how many fixations there were, if they were asked for."""

    # None: they were written to another dataset.
    rays: Rays | None
    fixations: int | None


@command("rays filter", options=FilterOptions, rays=_RAYS_FILE, output=_OUTPUT)
def filter_rays(rays: Rays | FileName, options: FilterOptions, reporter: Reporter = SILENT) -> FilterResult:
    """Some of the rays; each step is noted in their metadata. ``rays``: those, or a file of them.

    Raises `NergError` where a step leaves no ray, and for what `nerg_mi.rays.filters` and `.fixations` refuse.
    """
    reporter.progress(0.0, "reading rays")
    if not isinstance(rays, Rays) and is_dataset(rays):
        result = FilterResult(*filter_dataset(rays, options, reporter))
        _tell(options.output, reporter)
        return result
    _check_outputs(options.output)
    steps = FilterSteps(_load(rays), own=not isinstance(rays, Rays), reporter=reporter)
    if options.conditions:
        steps.select(options.conditions)
    count = steps.follow(options)
    if options.sample is not None:
        steps.sample(options.sample, options.seed)
    _save(steps.rays, options.output)
    _tell(options.output, reporter)
    return FilterResult(steps.rays, count)


@dataclass(frozen=True, eq=False)
class SplitResult:
    """Training and test rays that share none, and how many are used on neither side."""

    train: Rays
    test: Rays
    purged: int


def split_rays(rays: Rays | FileName, options: SplitOptions, reporter: Reporter = SILENT) -> SplitResult:
    """Training rays, which are on the training side of each split, and test rays, on the test side of each.

    ``rays``: those, or a file of them. Raises `NergError` for what `nerg_mi.rays.filters` refuses.
    """
    _check_outputs(options.train_output, options.test_output)
    reporter.progress(0.0, "reading rays")
    data, seed = _load(rays), options.seed
    reporter.progress(0.01, "splitting")
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    about: dict[str, Any] = {}
    if options.zones:
        where = {name: getattr(options, name) for name in ("zones", "zone_radius", "min_rays")}
        held = filters.split_by_position(data, options.radius, test_probes=options.positions, seed=seed, **where)
        parts.append(held.sides)
        about["position"] = {
            "radius": options.radius,
            "zones": options.zones,
            "zone_radius": options.zone_radius,
            "test_centres": held.test_centres.tolist(),
        }
    if options.people or options.persons:
        sides = filters.split_by_person(
            data, test_share=options.people or 0.5, test_persons=list(options.persons) or None, seed=seed
        )
        parts.append(sides)
        about["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[sides[1]]))}
    if options.time:
        parts.append(filters.split_by_time(data, test_share=options.time, gap=options.gap, of=options.clock))
        about["time"] = {"share": options.time, "gap": options.gap, "of": options.clock}
    train, test = filters.combine(*parts)
    purged = int((~(train | test)).sum())
    reporter.message(f"{train.sum():,} training rays, {test.sum():,} test rays, {purged:,} purged of {len(data):,}")
    side = lambda name, mask: data.select(mask).with_step(
        step="split", side=name, seed=seed, kept=int(mask.sum()), of=len(data), by=about
    )
    result = SplitResult(side("train", train), side("test", test), purged)
    _save(result.train, options.train_output)
    _save(result.test, options.test_output)
    return result


@command(
    "rays split",
    more="Of several, training rays are on the training side of each and test rays on the test side of each; the rest "
    "is purged.",
    options=SplitOptions,
    without=("train_output", "test_output"),
    rays=_RAYS_FILE,
    output=out("Rays file; -train and -test are put before its ending."),
)
def split_file(rays: Path, output: Path, options: SplitOptions, reporter: Reporter) -> None:
    """`split_rays` of a file, to two files beside each other."""
    train, test = (output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test"))
    split_rays(rays, replace(options, train_output=train, test_output=test), reporter)
    _tell(train, reporter)
    _tell(test, reporter)


@dataclass(frozen=True, kw_only=True)
class PlotOptions(Checked):
    """What a floor plan shows. Raises `NergError` for an unknown word, or test rays beside densities."""

    kind: str = option("density", "density: rays/m² with mean directions; layout: each ray's place, with dimensions.")
    cell: float | None = option(
        None, "density: edge of a cell, metres.  [default: a fiftieth of the plan]", within=LENGTHS
    )
    test: Rays | Path | str | None = option(None, "layout: the test rays of a split, drawn beside.")
    output: Path | str | None = option(None, "Picture to write (.png or .svg).", "-o", "--output")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in KINDS:
            raise NergError(f'--kind is "{self.kind}"; it is density or layout')
        if self.kind == "density" and self.test is not None:
            raise NergError("--test is drawn in the layout; add --kind layout")


@command("rays plot", options=PlotOptions, rays=_RAYS_FILE, output=out("Picture to write (.png or .svg)."))
def plot_rays(rays: Rays | FileName, options: PlotOptions = PlotOptions(), reporter: Reporter = SILENT) -> Figure:
    """The floor plan of rays, or of a file of them, as a figure of matplotlib."""
    reporter.progress(0.0, "drawing rays")
    if options.output is not None:
        check_writable(options.output, *style.FORMATS)
    if options.kind == "density":
        figure = maps.floor_plan(_load(rays), options.cell)
    else:
        test = None if options.test is None else _load(options.test)
        where = {} if test is None else filters.position_of_split(test)
        figure = maps.layout_figure(_load(rays), test, where.get("test_centres"), where.get("radius"))
    if options.output is not None:
        about = provenance("nerg rays plot", files_among(rays, options.test), None, options)
        style.save(figure, options.output, about)
        _tell(options.output, reporter)
    return figure


def _load(rays: Rays | FileName) -> Rays:
    return rays if isinstance(rays, Rays) else load_rays(rays)


def _check_outputs(*outputs: FileName | None) -> None:
    """Raise `NergError` where rays cannot be written: before minutes of reading."""
    for path in outputs:
        if path is not None:
            check_writable(path, *SUFFIXES)


def _save(rays: Rays, output: FileName | None) -> None:
    if output is not None:
        rays.save(Path(output))


def _tell(output: FileName | None, reporter: Reporter) -> None:
    if output is not None:
        reporter.message(f"wrote {output}")
