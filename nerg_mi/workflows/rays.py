"""Workflows of rays: import of tracking files, filtering, splitting and plotting of rays and datasets."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.figures import maps, style
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_new_folder, check_writable, create_folder_atomically
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import normalize_name
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays import events, filters
from nerg_mi.rays.dataset import (
    BYTES_PER_RAY,
    MAX_LOADED_RAYS,
    UNKNOWN,
    Conditions,
    RayDataset,
    is_dataset,
    load_rays,
    write_dataset_manifest,
)
from nerg_mi.rays.dataset_write import DatasetUpdate, ImportRecipe, SourceWriter, update_dataset
from nerg_mi.rays.guess import Proposal, propose_imports
from nerg_mi.rays.pseudonyms import make_file_aliases, pseudonymise, read_salt
from nerg_mi.rays.quality import RaysSummary, format_quality_report, summarise, summarise_dataset
from nerg_mi.rays.rays import SUFFIXES, Rays, merge_rays
from nerg_mi.rays.readers.registry import TABLE, get_reader, parse_options, read_rays

from .rays_commands import DATASET, FilterOptions, PlotOptions, RaysImportOptions, SplitOptions

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# ---- Steps of a filter: conditions, fixations, thinning, a sample ----


@dataclass(frozen=True)
class FilterStep:
    """A completed step, as stored in the metadata of rays."""

    name: str
    kept: int  # words: ok, a key of the metadata
    of: int  # words: ok, a key of the metadata
    settings: dict[str, Any]


class FilterSteps:
    """Applies filter steps to rays one after the other.

    ``in_place`` tells whether the rays are not used elsewhere, so that they may be modified in place. ``strict`` makes
    a step that selects no ray an error.
    """

    def __init__(self, rays: Rays, *, in_place: bool, reporter: Reporter = SILENT, strict: bool = True) -> None:
        self.rays, self.taken = rays, list[FilterStep]()
        self._in_place, self._reporter, self._strict = in_place, reporter, strict

    def select(self, conditions: dict[str, Any]) -> None:
        """Select rays by ``conditions``, see `nerg_mi.rays.filters.select_mask`."""
        self._select_mask(filters.select_mask(self.rays, **conditions), "filter", conditions)

    def follow(self, options: FilterOptions) -> int | None:
        """Select fixations and thin out stationary periods as in ``options``; return the number of fixations."""
        count = None
        if options.fixations is not None:
            count = self._fixations(options)
        if options.thin is not None:
            settings = {"seconds": options.thin, "distance": options.thin_distance}
            has_rays = len(self.rays) > 0
            self._select_mask(
                filters.thin_mask(self.rays, **settings) if has_rays else np.zeros(0, bool), "thin", settings
            )
        return count

    def sample(self, n: int, seed: int) -> None:
        """Select ``n`` rays uniformly at random."""
        numbers = np.random.default_rng(seed).random(len(self.rays))
        self._select_mask(smallest_mask(numbers, n), "sample", {"seed": seed})

    def _fixations(self, options: FilterOptions) -> int:
        by_velocity = options.fixations == "ivt"
        detect = events.detect_fixations_ivt if by_velocity else events.detect_fixations_idt
        threshold = {"velocity": options.velocity_threshold}
        if not by_velocity:
            threshold = {"dispersion": options.dispersion_threshold}
        min_duration = options.min_fixation
        if min_duration is None:
            min_duration = events.MIN_FIXATION_IVT if by_velocity else events.MIN_FIXATION_IDT
        label = np.zeros(0, np.int64)
        if len(self.rays):
            events.warn_unknown_tracking(self.rays.tracking, self._reporter.warn)
            label = detect(self.rays, **threshold, min_duration=min_duration)
        count = len(np.unique(label[label >= 0]))
        self._reporter.message(f"{count:,} fixations ({options.fixations})")
        # The keys of the metadata.
        settings = {"by": options.fixations, **threshold, "least": min_duration}
        if options.merge_fixations:
            self._replace(label, {**settings, "one_ray": True})
        else:
            self._select_mask(label >= 0, "fixations", settings)
        return count

    def _replace(self, label: np.ndarray, settings: dict[str, Any]) -> None:
        """Replace the rays by one ray for each fixation."""
        before = len(self.rays)
        rays = events.average_fixations(self.rays, label)[0] if before else self.rays
        self._reporter.message(f"fixations: mean rays, {len(rays):,} of {before:,} rays")
        self._apply(rays, FilterStep("fixations", len(rays), before, settings))

    def _select_mask(self, mask: np.ndarray, name: str, settings: dict[str, Any]) -> None:
        """Select the rays of a mask (N,), in place if the rays are not used elsewhere."""
        rays, count = self.rays, int(mask.sum())
        if not count and self._strict:
            raise NergError(f"{name} selects none of {len(rays):,} rays; widen its conditions")
        self._reporter.message(f"{name}: {count:,} of {len(rays):,} rays")
        selected = rays.filter_in_place(mask) if self._in_place else rays.select(mask)
        self._apply(selected, FilterStep(name, count, len(rays), settings))

    def _apply(self, rays: Rays, step: FilterStep) -> None:
        self.rays = rays.with_step(step=step.name, kept=step.kept, of=step.of, **step.settings)
        self._in_place = True
        self.taken.append(step)


def smallest_mask(numbers: np.ndarray, n: int) -> np.ndarray:
    """Return a mask of the ``n`` smallest of the ``numbers`` (N,), or of all if there are fewer."""
    mask = np.ones(len(numbers), bool)
    if n < len(numbers):
        mask[np.argpartition(numbers, n)[n:]] = False
    return mask


# ---- Datasets: import, data-quality reports, and filtering ----


FileName = str | os.PathLike
Card = tuple[Rays, RaysSummary, tuple[tuple[str, str], ...]]
_MAX_ERRORS = 20  # files that could not be imported and are listed


def import_dataset(files: Sequence[FileName], options: RaysImportOptions, reporter: Reporter) -> ImportResult:
    """Import ``files`` into the dataset ``options.output``, except those that are there unchanged.

    Returns the data-quality report of their environment. Raises `NergError` if some files could not be imported, after
    all others were.
    """
    folder, place = Path(options.output or ""), normalize_name(options.environment or UNKNOWN)
    key = None
    if options.pseudonyms:
        key = secrets.token_bytes(32) if options.salt is None else read_salt(options.salt)
    recipe = ImportRecipe(
        reader=get_reader(options.reader),
        settings=options.settings,
        skip_bad_lines=options.skip_bad_lines,
        place=place,
        day=options.day,
        key=key,
        is_salt_stored=options.salt is not None,
    )
    done: list[str] = []

    def tell(name: str) -> None:
        done.append(name)
        reporter.progress(min(len(done) / len(files), 1.0), f"imported {name}")

    update = update_dataset(folder, [Path(f) for f in files], recipe, options.workers or os.cpu_count() or 1, tell)
    _report_update(update, reporter)
    if update.errors:
        count_note = (
            f" ({len(update.errors)} of {len(files)} files could not be imported; the others were)"
            if len(files) > 1
            else ""
        )
        for error in update.errors[1:_MAX_ERRORS]:
            reporter.message(sanitize(error, 2000))
        raise NergError(update.errors[0] + count_note)
    aliases = {} if key is None else make_file_aliases([Path(file).name for file in files], key)
    return ImportResult(*summarise_dataset(RayDataset.open(folder).select_place(place)), aliases)


def _report_update(update: DatasetUpdate, reporter: Reporter) -> None:
    """Report what was imported, in one line."""
    parts = [
        f"imported {update.num_imported:,} sources, {update.num_rays:,} rays"
        if update.num_imported
        else "nothing to import"
    ]
    parts += [
        f"{count:,} {what}"
        for count, what in ((update.num_unchanged, "unchanged"), (update.num_duplicates, "given twice"))
        if count
    ]
    parts += [f"{update.num_replaced:,} replaced"] if update.num_replaced else []
    reporter.message("; ".join(parts))
    for path in update.empty[:_MAX_ERRORS]:
        reporter.message(sanitize(f"{path}: none of its rows gives a ray; the report lists why", 2000))


def make_dataset_reports(path: FileName) -> Iterator[tuple[str, Card]]:
    """Yield a title and the data-quality report for each environment of a dataset."""
    dataset = RayDataset.open(path)
    for place in dataset.places:
        title = str(path) if len(dataset.places) == 1 else f"{path}: {place}"
        yield title, summarise_dataset(dataset.select_place(place))


def filter_dataset(path: FileName, options: FilterOptions, reporter: Reporter) -> tuple[Rays | None, int | None]:
    """Filter a dataset block by block, and write the result to a file or another dataset; count fixations.

    Fixations and stationary periods end at the end of a part, that is of a day or a source. The returned rays are None
    if they were written to a dataset. Raises `NergError` if no rays are selected, or more than a file can hold.
    """
    dataset, output = RayDataset.open(path), options.output
    steps = _Totals(len(dataset))
    if options.fixations is not None:
        events.warn_unknown_tracking(dataset.metadata.get("tracking", "unknown"), reporter.warn)
    if output is not None and Path(output).suffix.lower() == DATASET:
        if options.sample is not None:
            raise NergError(
                f"{parameter('sample')} needs a file as output; use an output name that ends in .npz or .parquet"
            )
        check_new_folder(output)
        with create_folder_atomically(output) as folder:
            _write_filtered(dataset, options, steps, folder)
            steps.tell(options, reporter)
        return None, steps.fixations
    if output is not None:
        check_writable(output, *SUFFIXES)
    dataset.require_single_place()
    if options.sample is not None and not options.conditions and not options.follows:
        rays = dataset.sample(options.sample, options.seed)
        reporter.message(f"sample: {len(rays):,} of {len(dataset):,} rays")
    else:
        blocks = (
            _draw_sample(dataset, options, steps)
            if options.sample is not None
            else _load_selected(dataset, options, steps)
        )
        steps.tell(options, reporter)
        rays = merge_rays(blocks, dataset.metadata)
        for step in steps.steps:
            rays = rays.with_step(step=step.name, kept=step.kept, of=step.of, **step.settings)
    if output is not None:
        rays.save(output)
    return rays, steps.fixations


class _Totals:
    """Sums of the steps over all blocks."""

    def __init__(self, count: int) -> None:
        self._count, self._steps, self.fixations = count, list[FilterStep](), None

    def filtered(self, dataset: RayDataset, options: FilterOptions) -> Iterator[Rays]:
        """Yield the selected rays of each part of ``dataset``."""
        conditions = Conditions(**options.conditions)
        selected = FilterStep("filter", 0, self._count, options.conditions)
        for block in dataset.scan(conditions, whole_parts=options.follows):
            steps = FilterSteps(block, in_place=True, strict=False)
            count = steps.follow(options)
            if count is not None:
                self.fixations = (self.fixations or 0) + count
            first = [replace(selected, kept=len(block), of=0)] if options.conditions else []
            self.add([*first, *steps.taken])
            if len(steps.rays):
                yield steps.rays

    def add(self, taken: list[FilterStep]) -> None:
        """Add the steps of one block."""
        before = self._steps or [replace(step, kept=0, of=0) for step in taken]
        self._steps = [replace(a, kept=a.kept + b.kept, of=a.of + b.of) for a, b in zip(before, taken)]

    def add_last(self, step: FilterStep) -> None:
        """Add a step that was applied to all blocks together."""
        self._steps.append(step)

    @property
    def steps(self) -> list[FilterStep]:
        """The steps over all blocks; conditions count all rays, many of which were not read."""
        return [replace(step, of=self._count) if step.name == "filter" else step for step in self._steps]

    def tell(self, options: FilterOptions, reporter: Reporter) -> None:
        """Report what was selected. Raises `NergError` if nothing was."""
        if not self._steps or not self._steps[-1].kept:
            raise NergError(f"none of {self._count:,} rays are selected; widen the conditions")
        if self.fixations is not None:
            reporter.message(f"{self.fixations:,} fixations ({options.fixations})")
        for step in self.steps:
            reporter.message(f"{step.name}: {step.kept:,} of {step.of:,} rays")


def _load_selected(dataset: RayDataset, options: FilterOptions, steps: _Totals) -> list[Rays]:
    blocks, count = [], 0
    for block in steps.filtered(dataset, options):
        blocks.append(block)
        count += len(block)
        if count > MAX_LOADED_RAYS:
            raise NergError(
                f"more than {MAX_LOADED_RAYS:,} rays are selected, {MAX_LOADED_RAYS * BYTES_PER_RAY / 1e9:.2g} GB: "
                f"narrow the conditions, add {parameter('sample')}, or write a dataset "
                f"({parameter('output', 'NAME' + DATASET)})"
            )
    return blocks


def _draw_sample(dataset: RayDataset, options: FilterOptions, steps: _Totals) -> list[Rays]:
    """Return a uniform random sample of the selected rays: those with the smallest random numbers."""
    n, rng = options.sample or 0, np.random.default_rng(options.seed)
    held, lots, count = list[Rays](), list[np.ndarray](), 0
    limit = 1.0
    for block in steps.filtered(dataset, options):
        lot = rng.random(len(block))
        count += len(block)
        held.append(block.select(lot < limit))
        lots.append(lot[lot < limit])
        if sum(map(len, lots)) > 2 * n:
            held, lots = _select_smallest(held, lots, n)
            limit = max(float(lot.max()) for lot in lots if len(lot))
    held, _ = _select_smallest(held, lots, n)
    steps.add_last(FilterStep("sample", min(n, count), count, {"seed": options.seed}))
    return held


def _select_smallest(held: list[Rays], lots: list[np.ndarray], n: int) -> tuple[list[Rays], list[np.ndarray]]:
    """Return the ``n`` rays with the smallest numbers, in their blocks."""
    mask = smallest_mask(np.concatenate(lots) if lots else np.zeros(0), n)
    masks = np.split(mask, np.cumsum([len(lot) for lot in lots])[:-1]) if lots else []
    return [rays.select(m) for rays, m in zip(held, masks)], [lot[m] for lot, m in zip(lots, masks)]


def _write_filtered(dataset: RayDataset, options: FilterOptions, steps: _Totals, folder: Path) -> None:
    """Write the selected rays of each source to a new dataset; metadata last, as it holds the sums of all steps."""
    write_dataset_manifest(folder, replace(dataset.manifest, closed=True))
    writers = {source.id: SourceWriter(folder, source.id, dataset.manifest.buckets) for source in dataset.sources}
    for source, part in dataset.parts:
        for block in steps.filtered(replace(dataset, parts=((source, part),)), options):
            writers[source.id].add(block, part.place, part.day)
    for source in dataset.sources:
        done = [{"step": s.name, "kept": s.kept, "of": s.of, **s.settings} for s in steps.steps]
        metadata = {**source.metadata, "steps": [*source.metadata.get("steps", []), *done]}
        source_fields = {name: getattr(source, name) for name in ("file", "where", "stamp", "recipe", "generation")}
        writers[source.id].finish(metadata, **source_fields)


# ---- Rays: import, data-quality report, filter, split and plot ----


@dataclass(frozen=True, eq=False)
class ImportResult:
    """Imported rays, whose metadata list what was dropped, and their summary.

    For a dataset of more than a million rays, ``rays`` is a sample, as its metadata state; the summary covers all rays.
    """

    rays: Rays
    summary: RaysSummary
    # Further lines of the report of a dataset: names and texts.
    lines: tuple[tuple[str, str], ...] = ()
    # Names of files by their aliases, with pseudonyms; they are not written to any file.
    aliases: dict[str, str] = field(default_factory=dict)


def import_rays(
    files: FileName | Sequence[FileName], options: RaysImportOptions | None = None, reporter: Reporter = SILENT
) -> ImportResult:
    """Read tracking files (or folders, depending on the reader) as rays: right-handed, z up, metres, seconds.

    Raises `NergError` for files that the reader rejects, for an output that is not writable, before anything is read,
    and for an alignment to files in a left-handed frame.
    """
    options = options or RaysImportOptions()
    files = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    if options.into_dataset:
        return import_dataset(files, options, reporter)
    _check_outputs(options.output)
    if options.align_output is not None:
        check_writable(options.align_output, ".json")
    salt = None if options.salt is None else read_salt(options.salt)
    begun: list[str] = []

    def progress(name: str) -> None:
        reporter.progress(min(len(begun) / len(files), 1.0), f"reading {name}")
        begun.append(name)

    rays = read_rays(options.reader, files, options.settings, skip_bad_lines=options.skip_bad_lines, on_source=progress)
    aliases: dict[str, str] = {}
    if options.pseudonyms:
        key = secrets.token_bytes(32) if salt is None else salt
        aliases = make_file_aliases([source["file"] for source in rays.metadata["sources"]], key)
        rays = pseudonymise(rays, key, is_salt_stored=salt is not None)
    align = None if options.align_output is None else _transform_to_files(rays)
    _save(rays, options.output)
    if options.align_output is not None:
        write_json(options.align_output, align)
    return ImportResult(rays, summarise(rays), aliases=aliases)


def _transform_to_files(rays: Rays) -> list[list[float]]:
    """Return the similarity (4 rows) from the rays to the frame of the input files, for --align."""
    back = np.linalg.inv(np.array(rays.metadata["transform"], np.float64))
    if np.linalg.det(back[:3, :3]) < 0:
        raise NergError(
            "the frame of the files is left-handed and that of rays right-handed, so no similarity connects them; "
            f"leave out {parameter('align_output')}, and align the rays with the scene"
        )
    return (back + 0.0).tolist()


def import_files(
    files: list[Path], preset: str | None, options: RaysImportOptions, reporter: Reporter, **settings: Any
) -> None:
    """Call `import_rays` with a preset or a column map, and print the data-quality report."""
    settings = {name: value for name, value in settings.items() if value is not None and value is not False}
    if (preset is None) == ("columns" not in settings):
        raise NergError(
            f"the format of the files is not given: add {parameter('preset', 'NAME')} or "
            f"{parameter('columns', 'COLUMNS')}; nerg rays guess proposes one"
        )
    reader = preset or TABLE
    options = replace(options, reader=reader, settings=parse_options(reader, settings))
    result = import_rays(files, options, reporter)
    report = format_quality_report(result.rays, result.summary, str(options.output), result.lines)
    reporter.message(report)
    unwrapped = "".join(report.split())
    for alias, file in result.aliases.items():
        if alias in unwrapped:
            reporter.message(f"{alias} is {sanitize(file, 200)} (only shown here)")
    for path in (options.output, options.align_output):
        _report_written(path, reporter)


def guess_imports(files: Sequence[FileName], reporter: Reporter = SILENT) -> list[Proposal]:
    """Return the likely formats of unknown tracking files or folders, with import commands.

    There is one proposal for all files of a format. Nothing is imported or written. Raises `NergError` for files that
    are not tables, or damaged.
    """
    reporter.progress(0.0, f"reading {Path(files[0]).name}")
    return propose_imports([Path(file) for file in files])


def print_guesses(files: list[Path], reporter: Reporter) -> None:
    """Print the proposals of `guess_imports`; column names are printed without control characters."""
    proposals = guess_imports(files, reporter)
    for k, proposal in enumerate(proposals):
        if len(proposals) > 1 or proposal.paths[0] not in files:
            count_note = f" and {len(proposal.paths) - 1} more" if len(proposal.paths) > 1 else ""
            reporter.message("\n" * (k > 0) + sanitize(f"{proposal.paths[0]}{count_note}", 2000))
        for name, sentences in (
            ("sure", proposal.certain),
            ("guess", proposal.assumptions),
            ("open", proposal.questions),
        ):
            for sentence in sentences:
                reporter.message(f"{name:6} {sanitize(sentence, 2000)}")
        reporter.message("")
        reporter.message(sanitize(proposal.command or "no command can be proposed", 100_000))


def make_quality_report(path: FileName, reporter: Reporter = SILENT) -> list[tuple[str, ImportResult]]:
    """Return titles and data-quality reports of a rays file, or of each environment of a dataset."""
    reporter.progress(0.0, f"reading {Path(path).name}")
    if not is_dataset(path):
        rays = Rays.load(path)
        return [(str(path), ImportResult(rays, summarise(rays)))]
    return [(title, ImportResult(*card)) for title, card in make_dataset_reports(path)]


def print_cards(rays: Path, reporter: Reporter) -> None:
    """Print the data-quality reports as tables."""
    for title, card in make_quality_report(rays, reporter):
        reporter.message(format_quality_report(card.rays, card.summary, title, card.lines))


@dataclass(frozen=True, eq=False)
class FilterResult:
    """The selected rays, and the number of fixations if they were detected."""

    # None if they were written to another dataset.
    rays: Rays | None
    fixations: int | None


def filter_rays(rays: Rays | FileName, options: FilterOptions, reporter: Reporter = SILENT) -> FilterResult:
    """Select rays; each step is recorded in their metadata. ``rays`` are rays or their file.

    Raises `NergError` if a step selects no ray, and for options that `nerg_mi.rays.filters` rejects.
    """
    reporter.progress(0.0, "reading rays")
    if not isinstance(rays, Rays) and is_dataset(rays):
        result = FilterResult(*filter_dataset(rays, options, reporter))
        _report_written(options.output, reporter)
        return result
    _check_outputs(options.output)
    steps = FilterSteps(_load(rays), in_place=not isinstance(rays, Rays), reporter=reporter)
    if options.conditions:
        steps.select(options.conditions)
    count = steps.follow(options)
    if options.sample is not None:
        steps.sample(options.sample, options.seed)
    _save(steps.rays, options.output)
    _report_written(options.output, reporter)
    return FilterResult(steps.rays, count)


@dataclass(frozen=True, eq=False)
class SplitResult:
    """Disjoint training and test rays, and the number of rays that are in neither."""

    train: Rays
    test: Rays
    purged: int


def split_rays(rays: Rays | FileName, options: SplitOptions, reporter: Reporter = SILENT) -> SplitResult:
    """Split rays into training rays, on the training side of each criterion, and test rays, on the test side of each.

    ``rays`` are rays or their file. Raises `NergError` for options that `nerg_mi.rays.filters` rejects.
    """
    _check_outputs(options.train_output, options.test_output)
    reporter.progress(0.0, "reading rays")
    data, seed = _load(rays), options.seed
    reporter.progress(0.01, "splitting")
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    criteria: dict[str, Any] = {}
    if options.test_zones:
        where = {"zones": options.test_zones, "zone_radius": options.zone_radius, "min_rays": options.min_rays}
        held = filters.split_by_position(data, options.radius, test_probes=options.test_positions, seed=seed, **where)
        parts.append(held.masks)
        criteria["position"] = {
            "radius": options.radius,
            "zones": options.test_zones,
            "zone_radius": options.zone_radius,
            "test_centres": held.test_centres.tolist(),
        }
    if options.test_participants or options.persons:
        sides = filters.split_by_person(
            data, test_fraction=options.test_participants or 0.5, test_persons=list(options.persons) or None, seed=seed
        )
        parts.append(sides)
        criteria["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[sides[1]]))}
    if options.test_time:
        parts.append(filters.split_by_time(data, test_fraction=options.test_time, gap=options.gap, clock=options.clock))
        criteria["time"] = {"share": options.test_time, "gap": options.gap, "of": options.clock}
    train, test = filters.combine_splits(*parts)
    purged = int((~(train | test)).sum())
    reporter.message(f"{train.sum():,} training rays, {test.sum():,} test rays, {purged:,} purged of {len(data):,}")
    side = lambda name, mask: data.select(mask).with_step(
        step="split", side=name, seed=seed, kept=int(mask.sum()), of=len(data), by=criteria
    )
    result = SplitResult(side("train", train), side("test", test), purged)
    _save(result.train, options.train_output)
    _save(result.test, options.test_output)
    return result


def split_file(rays: Path, output: Path, options: SplitOptions, reporter: Reporter) -> None:
    """Split a rays file into two files in the same folder."""
    train, test = (output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test"))
    split_rays(rays, replace(options, train_output=train, test_output=test), reporter)
    _report_written(train, reporter)
    _report_written(test, reporter)


def plot_rays(
    rays: Rays | FileName, options: PlotOptions | None = None, reporter: Reporter = SILENT, axes: Axes | None = None
) -> Axes:
    """Draw the floor plan of rays, or of their file, in ``axes`` or in a new figure, and return its axes."""
    options = options or PlotOptions()
    reporter.progress(0.0, "drawing rays")
    if options.output is not None:
        check_writable(options.output, *style.FORMATS)
    if options.kind == "density":
        drawn = maps.floor_plan(_load(rays), options.cell_size, axes=axes)
    else:
        test = None if options.test is None else _load(options.test)
        where = {} if test is None else filters.read_position_split(test)
        drawn = maps.layout_figure(_load(rays), test, where.get("test_centres"), where.get("radius"), axes=axes)
    if options.output is not None:
        record = make_provenance("nerg rays plot", existing_files(rays, options.test), None, options)
        style.save(drawn, options.output, record)
        _report_written(options.output, reporter)
    return drawn


def _load(rays: Rays | FileName) -> Rays:
    return rays if isinstance(rays, Rays) else load_rays(rays)


def _check_outputs(*outputs: FileName | None) -> None:
    """Raise `NergError` for outputs that are not writable, before minutes of reading."""
    for path in outputs:
        if path is not None:
            check_writable(path, *SUFFIXES)


def _save(rays: Rays, output: FileName | None) -> None:
    if output is not None:
        rays.save(Path(output))


def _report_written(output: FileName | None, reporter: Reporter) -> None:
    if output is not None:
        reporter.message(f"wrote {output}")
