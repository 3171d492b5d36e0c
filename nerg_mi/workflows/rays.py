"""Tracking files to rays: importing, filtering, splitting and plotting sets and datasets of them."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.figures import maps, style
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_new_folder, check_writable, create_folder_atomically
from nerg_mi.files.tables import write_json
from nerg_mi.rays import filters
from nerg_mi.rays.dataset import MAX_LOADED_RAYS, BYTES_PER_RAY, UNKNOWN, Conditions, RayDataset, is_dataset, load_rays, write_dataset_manifest
from nerg_mi.rays.dataset_write import ImportRecipe, SourceWriter, DatasetUpdate, update_dataset
from nerg_mi.rays.guess import Proposal, propose_imports
from nerg_mi.rays.pseudonyms import pseudonymise, read_salt
from nerg_mi.rays.quality import RaysSummary, format_quality_report, summarise, summarise_dataset
from nerg_mi.rays.rays import SUFFIXES, Rays, merge_rays
from nerg_mi.rays.readers.registry import TABLE, parse_options, read_rays, get_reader

from .base import SILENT, Reporter
from .rays_commands import DATASET, FilterOptions, PlotOptions, RaysImportOptions, SplitOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---- What a filter does to rays, step by step: conditions, fixations, thinning, a sample ----


@dataclass(frozen=True)
class FilterStep:
    """A step that was taken: what the metadata of rays keep of it."""

    name: str
    kept: int
    of: int
    about: dict[str, Any]


class FilterSteps:
    """Rays to which one thing after the other is done.

    ``own``: whether nobody else holds the rays, which then lose them. ``strict``: whether a step that leaves none is an
    error; without it what is left of nothing is nothing.
    """

    def __init__(self, rays: Rays, *, own: bool, reporter: Reporter = SILENT, strict: bool = True) -> None:
        self.rays, self.taken = rays, list[FilterStep]()
        self._own, self._reporter, self._strict = own, reporter, strict

    def select(self, conditions: dict[str, Any]) -> None:
        """Keep what meets ``conditions``, those of `nerg_mi.rays.filters.select_mask`."""
        self._keep(filters.select_mask(self.rays, **conditions), "filter", conditions)

    def follow(self, options: FilterOptions) -> int | None:
        """Keep fixations, and fewer of those who stand still, as ``options`` say; how many fixations there are."""
        count = None
        if options.fixations is not None:
            count = self._fixations(options)
        if options.thin is not None:
            about = {"seconds": options.thin, "distance": options.thin_distance}
            there = len(self.rays) > 0
            self._keep(filters.thin_mask(self.rays, **about) if there else np.zeros(0, bool), "thin", about)
        return count

    def sample(self, n: int, seed: int) -> None:
        """Keep ``n`` rays, each as likely as any other."""
        lot = np.random.default_rng(seed).random(len(self.rays))
        self._keep(smallest_mask(lot, n), "sample", {"seed": seed})

    def _fixations(self, options: FilterOptions) -> int:
        by_velocity = options.fixations == "ivt"
        limit = {"velocity": options.velocity_threshold} if by_velocity else {"dispersion": options.dispersion_threshold}
        limit |= {} if options.min_fixation is None else {"least": options.min_fixation}
        label = np.zeros(0, np.int64)
        if len(self.rays):
            label = (filters.detect_fixations_ivt if by_velocity else filters.detect_fixations_idt)(self.rays, **limit)
        count = len(np.unique(label[label >= 0]))
        self._reporter.message(f"{count:,} fixations ({options.fixations})")
        about = {"by": options.fixations, **limit}
        if options.merge_fixations:
            self._replace(label, {**about, "one_ray": True})
        else:
            self._keep(label >= 0, "fixations", about)
        return count

    def _replace(self, label: np.ndarray, about: dict[str, Any]) -> None:
        """Go on with a ray for each fixation."""
        before = len(self.rays)
        rays = filters.average_fixations(self.rays, label)[0] if before else self.rays
        self._reporter.message(f"fixations: one ray each, {len(rays):,} of {before:,} rays")
        self._take(rays, FilterStep("fixations", len(rays), before, about))

    def _keep(self, mask: np.ndarray, name: str, about: dict[str, Any]) -> None:
        """Keep the rays of a mask (N,); in their own memory, if nobody else holds them."""
        rays, count = self.rays, int(mask.sum())
        if not count and self._strict:
            raise NergError(f"{name} leaves none of {len(rays):,} rays; widen its conditions")
        self._reporter.message(f"{name}: {count:,} of {len(rays):,} rays")
        kept = rays.filter_in_place(mask) if self._own else rays.select(mask)
        self._take(kept, FilterStep(name, count, len(rays), about))

    def _take(self, rays: Rays, step: FilterStep) -> None:
        self.rays = rays.with_step(step=step.name, kept=step.kept, of=step.of, **step.about)
        self._own = True
        self.taken.append(step)


def smallest_mask(lot: np.ndarray, n: int) -> np.ndarray:
    """The ``n`` least of the numbers ``lot`` (N,), as a mask; all, where there are no more."""
    mask = np.ones(len(lot), bool)
    if n < len(lot):
        mask[np.argpartition(lot, n)[n:]] = False
    return mask


# ---- Datasets of rays: tracking files imported into one, its sanity cards, and some of its rays ----


FileName = str | os.PathLike
Card = tuple[Rays, RaysSummary, tuple[tuple[str, str], ...]]


def import_dataset(files: Sequence[FileName], options: RaysImportOptions, reporter: Reporter) -> Card:
    """Import ``files`` into the dataset ``options.output``, each unless it is there unchanged; the card of their place.

    Raises `NergError` where some could not be imported, after the others were.
    """
    folder, place = Path(options.output or ""), options.environment or UNKNOWN
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

    found = update_dataset(folder, [Path(f) for f in files], recipe, options.workers or os.cpu_count() or 1, tell)
    _tell(found, reporter)
    if found.errors:
        more = f" ({len(found.errors)} of {len(files)} could not be imported; the others are)" if len(files) > 1 else ""
        raise NergError(found.errors[0] + more)
    return summarise_dataset(RayDataset.open(folder).select_place(place))


def _tell(found: DatasetUpdate, reporter: Reporter) -> None:
    """What an import came to, in a line."""
    parts = [f"imported {found.num_imported:,} sources, {found.num_rays:,} rays" if found.num_imported else "nothing to import"]
    parts += [
        f"{count:,} {what}" for count, what in ((found.num_unchanged, "unchanged"), (found.num_duplicates, "given twice")) if count
    ]
    parts += [f"{found.num_replaced:,} replaced"] if found.num_replaced else []
    reporter.message("; ".join(parts))


def make_dataset_reports(path: FileName) -> Iterator[tuple[str, Card]]:
    """Of each place of a dataset what to call it, and its card."""
    dataset = RayDataset.open(path)
    for place in dataset.places:
        title = str(path) if len(dataset.places) == 1 else f"{path}: {place}"
        yield title, summarise_dataset(dataset.select_place(place))


def filter_dataset(path: FileName, options: FilterOptions, reporter: Reporter) -> tuple[Rays | None, int | None]:
    """Some rays of a dataset, block by block, written to a file or another dataset; and how many fixations there are.

    Fixations and stays end where a part does, with a day or a source. The rays are None where they were written to a
    dataset. Raises `NergError` where none are left, and for more rays than a file is made of.
    """
    dataset, output = RayDataset.open(path), options.output
    steps = _Totals(len(dataset))
    if output is not None and Path(output).suffix.lower() == DATASET:
        if options.sample is not None:
            raise NergError("a --sample is written to a file; let the name of the output end in .npz or .parquet")
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
        found = _sampled(dataset, options, steps) if options.sample is not None else _all(dataset, options, steps)
        steps.tell(options, reporter)
        rays = merge_rays(found, dataset.metadata)
        for step in steps.steps:
            rays = rays.with_step(step=step.name, kept=step.kept, of=step.of, **step.about)
    if output is not None:
        rays.save(output)
    return rays, steps.fixations


class _Totals:
    """The steps of all blocks together."""

    def __init__(self, count: int) -> None:
        self._count, self._steps, self.fixations = count, list[FilterStep](), None

    def filtered(self, dataset: RayDataset, options: FilterOptions) -> Iterator[Rays]:
        """What is left of each part of ``dataset``."""
        conditions = Conditions(**options.conditions)
        selected = FilterStep("filter", 0, self._count, options.conditions)
        for block in dataset.scan(conditions, whole_parts=options.follows):
            steps = FilterSteps(block, own=True, strict=False)
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
        """Add a step that was taken by all blocks together."""
        self._steps.append(step)

    @property
    def steps(self) -> list[FilterStep]:
        """Those of all blocks; what met conditions is of all rays, of which many were not read."""
        return [replace(step, of=self._count) if step.name == "filter" else step for step in self._steps]

    def tell(self, options: FilterOptions, reporter: Reporter) -> None:
        """Say what was kept. Raises `NergError` where nothing was."""
        if not self._steps or not self._steps[-1].kept:
            raise NergError(f"nothing is left of {self._count:,} rays; widen the conditions")
        if self.fixations is not None:
            reporter.message(f"{self.fixations:,} fixations ({options.fixations})")
        for step in self.steps:
            reporter.message(f"{step.name}: {step.kept:,} of {step.of:,} rays")


def _all(dataset: RayDataset, options: FilterOptions, steps: _Totals) -> list[Rays]:
    found, count = [], 0
    for block in steps.filtered(dataset, options):
        found.append(block)
        count += len(block)
        if count > MAX_LOADED_RAYS:
            raise NergError(
                f"more than {MAX_LOADED_RAYS:,} rays are left, {MAX_LOADED_RAYS * BYTES_PER_RAY / 1e9:.2g} GB: narrow the conditions, add "
                f"--sample, or write another dataset (-o NAME{DATASET})"
            )
    return found


def _sampled(dataset: RayDataset, options: FilterOptions, steps: _Totals) -> list[Rays]:
    """As many rays as are asked for, each as likely as any other: those of the least of random numbers."""
    n, rng = options.sample or 0, np.random.default_rng(options.seed)
    held, lots, count = list[Rays](), list[np.ndarray](), 0
    limit = 1.0
    for block in steps.filtered(dataset, options):
        lot = rng.random(len(block))
        count += len(block)
        held.append(block.select(lot < limit))
        lots.append(lot[lot < limit])
        if sum(map(len, lots)) > 2 * n:
            held, lots = _least(held, lots, n)
            limit = max(float(lot.max()) for lot in lots if len(lot))
    held, _ = _least(held, lots, n)
    steps.add_last(FilterStep("sample", min(n, count), count, {"seed": options.seed}))
    return held


def _least(held: list[Rays], lots: list[np.ndarray], n: int) -> tuple[list[Rays], list[np.ndarray]]:
    """The ``n`` rays with the least numbers, in their blocks."""
    mask = smallest_mask(np.concatenate(lots) if lots else np.zeros(0), n)
    masks = np.split(mask, np.cumsum([len(lot) for lot in lots])[:-1]) if lots else []
    return [rays.select(m) for rays, m in zip(held, masks)], [lot[m] for lot, m in zip(lots, masks)]


def _write_filtered(dataset: RayDataset, options: FilterOptions, steps: _Totals, folder: Path) -> None:
    """Write what is left of each source to a new dataset; its accounts last, since they tell the steps of all."""
    write_dataset_manifest(folder, replace(dataset.manifest, closed=True))
    writers = {source.id: SourceWriter(folder, source.id, dataset.manifest.buckets) for source in dataset.sources}
    for source, part in dataset.parts:
        for block in steps.filtered(replace(dataset, parts=((source, part),)), options):
            writers[source.id].add(block, part.place, part.day)
    for source in dataset.sources:
        done = [{"step": s.name, "kept": s.kept, "of": s.of, **s.about} for s in steps.steps]
        metadata = {**source.metadata, "steps": [*source.metadata.get("steps", []), *done]}
        kept = {name: getattr(source, name) for name in ("file", "where", "stamp", "recipe", "generation")}
        writers[source.id].finish(metadata, **kept)


# ---- Rays of attention from tracking files, and what is done to them: imported, summed up, filtered, split, drawn ----


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
    files: FileName | Sequence[FileName], options: RaysImportOptions | None = None, reporter: Reporter = SILENT
) -> ImportResult:
    """Tracking files (or folders, by the reader) as rays: right-handed, z up, metres, seconds.

    Raises `NergError` for what the reader refuses, or an output that cannot be written, before anything is read; for an
    alignment with files whose frame is the other hand's.
    """
    options = options or RaysImportOptions()
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


def import_files(
    files: list[Path], preset: str | None, options: RaysImportOptions, reporter: Reporter, **settings: Any
) -> None:
    """`import_rays` by a preset, or by a column map, with the sanity card."""
    settings = {name: value for name, value in settings.items() if value is not None and value is not False}
    if (preset is None) == ("columns" not in settings):
        raise NergError("say what the files are: either --preset NAME or --map COLUMNS")
    reader = preset or TABLE
    options = replace(options, reader=reader, settings=parse_options(reader, settings))
    result = import_rays(files, options, reporter)
    reporter.message(format_quality_report(result.rays, result.summary, str(options.output), result.lines))
    for path in (options.output, options.align_output):
        _tell_tracking(path, reporter)


def guess_imports(files: Sequence[FileName], reporter: Reporter = SILENT) -> list[Proposal]:
    """What unknown tracking files, or folders of them, are likely to be, and the commands to import them by: one for
    all that are alike. Nothing is applied or written.

    Raises `NergError` for a file that is no table, or is damaged.
    """
    reporter.progress(0.0, f"reading {Path(files[0]).name}")
    return propose_imports([Path(file) for file in files])


def print_guesses(files: list[Path], reporter: Reporter) -> None:
    """`guess_imports` in words. Names of columns are printed without control characters of a terminal."""
    proposals = guess_imports(files, reporter)
    for k, proposal in enumerate(proposals):
        if len(proposals) > 1:
            more = f" and {len(proposal.paths) - 1} more" if len(proposal.paths) > 1 else ""
            reporter.message("\n" * (k > 0) + sanitize(f"{proposal.paths[0]}{more}", 2000))
        for name, sentences in (("sure", proposal.certain), ("guess", proposal.assumptions), ("open", proposal.questions)):
            for sentence in sentences:
                reporter.message(f"{name:6} {sanitize(sentence, 2000)}")
        reporter.message("")
        reporter.message(sanitize(proposal.command or "nothing can be proposed", 100_000))


def make_quality_report(path: FileName, reporter: Reporter = SILENT) -> list[tuple[str, ImportResult]]:
    """Titles, figures and lines of the sanity cards of a file of rays, or of each place of a dataset."""
    reporter.progress(0.0, f"reading {Path(path).name}")
    if not is_dataset(path):
        rays = Rays.load(path)
        return [(str(path), ImportResult(rays, summarise(rays)))]
    return [(title, ImportResult(*card)) for title, card in make_dataset_reports(path)]


def print_cards(rays: Path, reporter: Reporter) -> None:
    """`card_of` as tables."""
    for title, card in make_quality_report(rays, reporter):
        reporter.message(format_quality_report(card.rays, card.summary, title, card.lines))


@dataclass(frozen=True, eq=False)
class FilterResult:
    """The rays that were kept, and how many fixations there were, if they were asked for."""

    # None: they were written to another dataset.
    rays: Rays | None
    fixations: int | None


def filter_rays(rays: Rays | FileName, options: FilterOptions, reporter: Reporter = SILENT) -> FilterResult:
    """Some of the rays; each step is noted in their metadata. ``rays``: those, or a file of them.

    Raises `NergError` where a step leaves no ray, and for what `nerg_mi.rays.filters` and `.fixations` refuse.
    """
    reporter.progress(0.0, "reading rays")
    if not isinstance(rays, Rays) and is_dataset(rays):
        result = FilterResult(*filter_dataset(rays, options, reporter))
        _tell_tracking(options.output, reporter)
        return result
    _check_outputs(options.output)
    steps = FilterSteps(_load(rays), own=not isinstance(rays, Rays), reporter=reporter)
    if options.conditions:
        steps.select(options.conditions)
    count = steps.follow(options)
    if options.sample is not None:
        steps.sample(options.sample, options.seed)
    _save(steps.rays, options.output)
    _tell_tracking(options.output, reporter)
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
    if options.test_zones:
        where = {name: getattr(options, name) for name in ("zones", "zone_radius", "min_rays")}
        held = filters.split_by_position(data, options.radius, test_probes=options.test_positions, seed=seed, **where)
        parts.append(held.masks)
        about["position"] = {
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
        about["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[sides[1]]))}
    if options.test_time:
        parts.append(filters.split_by_time(data, test_fraction=options.test_time, gap=options.gap, clock=options.clock))
        about["time"] = {"share": options.test_time, "gap": options.gap, "of": options.clock}
    train, test = filters.combine_splits(*parts)
    purged = int((~(train | test)).sum())
    reporter.message(f"{train.sum():,} training rays, {test.sum():,} test rays, {purged:,} purged of {len(data):,}")
    side = lambda name, mask: data.select(mask).with_step(
        step="split", side=name, seed=seed, kept=int(mask.sum()), of=len(data), by=about
    )
    result = SplitResult(side("train", train), side("test", test), purged)
    _save(result.train, options.train_output)
    _save(result.test, options.test_output)
    return result


def split_file(rays: Path, output: Path, options: SplitOptions, reporter: Reporter) -> None:
    """`split_rays` of a file, to two files beside each other."""
    train, test = (output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test"))
    split_rays(rays, replace(options, train_output=train, test_output=test), reporter)
    _tell_tracking(train, reporter)
    _tell_tracking(test, reporter)


def plot_rays(rays: Rays | FileName, options: PlotOptions | None = None, reporter: Reporter = SILENT) -> Figure:
    """The floor plan of rays, or of a file of them, as a figure of matplotlib."""
    options = options or PlotOptions()
    reporter.progress(0.0, "drawing rays")
    if options.output is not None:
        check_writable(options.output, *style.FORMATS)
    if options.kind == "density":
        figure = maps.floor_plan(_load(rays), options.cell_size)
    else:
        test = None if options.test is None else _load(options.test)
        where = {} if test is None else filters.read_position_split(test)
        figure = maps.layout_figure(_load(rays), test, where.get("test_centres"), where.get("radius"))
    if options.output is not None:
        about = make_provenance("nerg rays plot", existing_files(rays, options.test), None, options)
        style.save(figure, options.output, about)
        _tell_tracking(options.output, reporter)
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


def _tell_tracking(output: FileName | None, reporter: Reporter) -> None:
    if output is not None:
        reporter.message(f"wrote {output}")
