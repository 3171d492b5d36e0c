"""Datasets of rays: tracking files imported into one, its sanity cards, and some of its rays."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_new_folder, check_writable, replacing_folder
from nerg_mi.rays.dataset import MOST, RAY_BYTES, UNKNOWN, Conditions, RayDataset, merge_rays, write_head
from nerg_mi.rays.dataset_open import summarise_dataset
from nerg_mi.rays.dataset_write import Recipe, SourceWriter, Update, update_dataset
from nerg_mi.rays.pseudonyms import read_salt
from nerg_mi.rays.quality import RaysSummary
from nerg_mi.rays.rays import SUFFIXES, Rays
from nerg_mi.rays.readers.registry import reader_named

from .filtering import FilterSteps, Step, least_mask
from .options.rays import DATASET, FilterOptions, ImportOptions
from .reporter import Reporter

FileName = str | os.PathLike
Card = tuple[Rays, RaysSummary, tuple[tuple[str, str], ...]]


def import_dataset(files: Sequence[FileName], options: ImportOptions, reporter: Reporter) -> Card:
    """Import ``files`` into the dataset ``options.output``, each unless it is there unchanged; the card of their place.

    Raises `NergError` where some could not be imported, after the others were.
    """
    folder, place = Path(options.output or ""), options.place_name or UNKNOWN
    key = None
    if options.pseudonyms:
        key = secrets.token_bytes(32) if options.salt is None else read_salt(options.salt)
    recipe = Recipe(
        reader=reader_named(options.reader),
        settings=options.settings,
        skip_bad_lines=options.skip_bad_lines,
        place=place,
        day=options.day,
        key=key,
        kept_salt=options.salt is not None,
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
    return summarise_dataset(RayDataset.open(folder).of_place(place))


def _tell(found: Update, reporter: Reporter) -> None:
    """What an import came to, in a line."""
    parts = [f"imported {found.imported:,} sources, {found.rays:,} rays" if found.imported else "nothing to import"]
    parts += [
        f"{count:,} {what}" for count, what in ((found.unchanged, "unchanged"), (found.alike, "given twice")) if count
    ]
    parts += [f"{found.replaced:,} replaced"] if found.replaced else []
    reporter.message("; ".join(parts))


def dataset_cards(path: FileName) -> Iterator[tuple[str, Card]]:
    """Of each place of a dataset what to call it, and its card."""
    dataset = RayDataset.open(path)
    for place in dataset.places:
        title = str(path) if len(dataset.places) == 1 else f"{path}: {place}"
        yield title, summarise_dataset(dataset.of_place(place))


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
        with replacing_folder(output) as folder:
            _write_filtered(dataset, options, steps, folder)
            steps.tell(options, reporter)
        return None, steps.fixations
    if output is not None:
        check_writable(output, *SUFFIXES)
    dataset.one_place()
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
        self._count, self._steps, self.fixations = count, list[Step](), None

    def filtered(self, dataset: RayDataset, options: FilterOptions) -> Iterator[Rays]:
        """What is left of each part of ``dataset``."""
        conditions = Conditions(**options.conditions)
        selected = Step("filter", 0, self._count, options.conditions)
        for block in dataset.scan(conditions, whole=options.follows):
            steps = FilterSteps(block, own=True, strict=False)
            count = steps.follow(options)
            if count is not None:
                self.fixations = (self.fixations or 0) + count
            first = [replace(selected, kept=len(block), of=0)] if options.conditions else []
            self.add([*first, *steps.taken])
            if len(steps.rays):
                yield steps.rays

    def add(self, taken: list[Step]) -> None:
        """Add the steps of one block."""
        before = self._steps or [replace(step, kept=0, of=0) for step in taken]
        self._steps = [replace(a, kept=a.kept + b.kept, of=a.of + b.of) for a, b in zip(before, taken)]

    def add_last(self, step: Step) -> None:
        """Add a step that was taken by all blocks together."""
        self._steps.append(step)

    @property
    def steps(self) -> list[Step]:
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
        if count > MOST:
            raise NergError(
                f"more than {MOST:,} rays are left, {MOST * RAY_BYTES / 1e9:.2g} GB: narrow the conditions, add "
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
    steps.add_last(Step("sample", min(n, count), count, {"seed": options.seed}))
    return held


def _least(held: list[Rays], lots: list[np.ndarray], n: int) -> tuple[list[Rays], list[np.ndarray]]:
    """The ``n`` rays with the least numbers, in their blocks."""
    mask = least_mask(np.concatenate(lots) if lots else np.zeros(0), n)
    masks = np.split(mask, np.cumsum([len(lot) for lot in lots])[:-1]) if lots else []
    return [rays.select(m) for rays, m in zip(held, masks)], [lot[m] for lot, m in zip(lots, masks)]


def _write_filtered(dataset: RayDataset, options: FilterOptions, steps: _Totals, folder: Path) -> None:
    """Write what is left of each source to a new dataset; its accounts last, since they tell the steps of all."""
    write_head(folder, replace(dataset.head, closed=True))
    writers = {source.id: SourceWriter(folder, source.id, dataset.head.buckets) for source in dataset.sources}
    for source, part in dataset.parts:
        for block in steps.filtered(replace(dataset, parts=((source, part),)), options):
            writers[source.id].add(block, part.place, part.day)
    for source in dataset.sources:
        done = [{"step": s.name, "kept": s.kept, "of": s.of, **s.about} for s in steps.steps]
        metadata = {**source.metadata, "steps": [*source.metadata.get("steps", []), *done]}
        kept = {name: getattr(source, name) for name in ("file", "where", "stamp", "recipe", "generation")}
        writers[source.id].finish(metadata, **kept)
