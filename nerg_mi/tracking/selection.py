"""Selection of rays by conditions, fixations, thinning and samples, in memory or block by block of a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.atomic import check_new_folder, check_writable, create_folder_atomically
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import COORDINATES, RAYS, SECONDS, SEEDS, TIMES, Range, check_ranges

from . import events, filters
from .dataset import (
    BYTES_PER_RAY,
    DATASET,
    MAX_LOADED_RAYS,
    Conditions,
    RayDataset,
    open_recordings,
    write_dataset_manifest,
)
from .dataset_write import SourceWriter
from .event_settings import EventRules
from .rays import SUFFIXES, Rays, merge_rays


@check_ranges
def filter_rays(
    rays: Rays | RayDataset | FilePath,
    *,
    start: Annotated[float, TIMES] | None = None,
    end: Annotated[float, TIMES] | None = None,
    persons: Sequence[str] = (),
    without_persons: Sequence[str] = (),
    cohorts: Sequence[str] = (),
    box: Annotated[Sequence[float], COORDINATES] | None = None,
    min_confidence: Annotated[float, Range(0, 1)] | None = None,
    with_hit: bool = False,
    fixations: Literal["ivt", "idt"] | None = None,
    dispersion_threshold: Annotated[float, Range(0, 180)] = 3.0,
    merge_fixations: bool = False,
    thin: Annotated[float, SECONDS] | None = None,
    thin_distance: Annotated[float, Range(0, 10**6)] = 0.1,
    sample: Annotated[int, RAYS] | None = None,
    seed: Annotated[int, SEEDS] = 0,
    output: FilePath | None = None,
    rules: EventRules = EventRules(),
    progress: Progress = None,
) -> Rays | RayDataset:
    """Select rays by conditions, detect fixations, and thin out stationary periods.

    Parameters
    ----------
    rays : Rays, RayDataset or path
        Rays file (.npz or .parquet) or dataset (.rays).
    start : float, optional
        Time of the first selected ray, in seconds of the rays' clock. Default: no limit.
    end : float, optional
        Time before which selected rays lie, in seconds of the rays' clock. Default: no limit.
    persons : sequence of str
        Participants whose rays are selected. Default: all.
    without_persons : sequence of str
        Participants whose rays are left out.
    cohorts : sequence of str
        Cohorts whose rays are selected. Default: all.
    box : sequence of float, optional
        Axis-aligned box that selected ray origins lie in: x0,x1,y0,y1,z0,z1 in metres. Default: no limit.
    min_confidence : float, optional
        Minimum confidence of selected rays. Default: no limit.
    with_hit : bool
        Select only rays with a hit point.
    fixations : str, optional
        Select only rays of fixations, detected by ivt (velocities, as in nerg rays events) or idt (dispersion).
    dispersion_threshold : float
        Angular dispersion in degrees within which a fixation stays (idt).
    merge_fixations : bool
        Replace the rays of each fixation by their mean ray.
    thin : float, optional
        Maximum time in seconds that a stationary period contributes; its rays are thinned out evenly. Default: no
        thinning.
    thin_distance : float
        Distance in metres within which a participant counts as stationary for ``thin``.
    sample : int, optional
        Number of rays in a uniform random sample of the selected rays. Default: all.
    seed : int
        Seed of ``sample``.
    output : path, optional
        Rays file to write (.npz or .parquet); for a dataset, another dataset (.rays).
    rules : EventRules
        Limits between the kinds of events (`nerg_mi.tracking.event_settings.EventRules`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Rays or RayDataset
        The selected rays, whose metadata record the steps; the dataset, if they were written to one. Fixations and
        stationary periods of a dataset end at the end of a part, that is of a day or a source.

    Raises
    ------
    NergError
        An argument is invalid, no ray is selected, or more than a file can hold.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> nerg.filter_rays(rays, persons=["Ada"], sample=100)
    <Rays: 100 of 1 participant, t 0.2 to 199.8 s>
    """
    conditions = {
        "time": None if start is None and end is None else (start, end),
        "persons": list(persons) or None,
        "without_persons": list(without_persons) or None,
        "cohorts": list(cohorts) or None,
        "box": None if box is None else list(box),
        "min_confidence": min_confidence,
        "with_hit": with_hit or None,
    }
    selection = _Selection(
        {name: value for name, value in conditions.items() if value is not None},
        fixations,
        rules,
        dispersion_threshold if fixations == "idt" else None,
        merge_fixations,
        thin,
        thin_distance,
        sample,
        seed,
    )
    output = None if output is None else to_path(output)
    new_dataset = output if output is not None and output.suffix.lower() == DATASET else None
    if output is not None and new_dataset is None:
        check_writable(output, *SUFFIXES)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading rays")
        data = open_recordings(rays)
        if isinstance(data, Rays):
            if new_dataset is not None:
                check_writable(new_dataset, *SUFFIXES)
            result = _filter_rays(data, selection, reporter, in_place=not isinstance(rays, Rays))
        elif new_dataset is not None:
            result = _filter_to_dataset(data, selection, new_dataset, reporter)
        else:
            result = _filter_dataset(data, selection, reporter)
        if output is not None:
            if isinstance(result, Rays):
                result.save(output)
            reporter.message(f"wrote {output}")
    return result


@dataclass(frozen=True)
class _Selection:
    """What `filter_rays` selects. Raises `NergError` for arguments that select nothing or miss others."""

    conditions: dict[str, Any]  # keywords of `Conditions`
    fixations: str | None
    rules: EventRules
    dispersion: float | None
    merge_fixations: bool
    thin: float | None
    thin_distance: float
    sample: int | None
    seed: int

    def __post_init__(self) -> None:
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


# ---- Steps ----


@dataclass(frozen=True)
class _Step:
    """A completed step, as stored in the metadata of rays."""

    name: str
    kept: int  # words: ok, a key of the metadata
    of: int  # words: ok, a key of the metadata
    settings: dict[str, Any]

    @property
    def entry(self) -> dict[str, Any]:
        return {"step": self.name, "kept": self.kept, "of": self.of, **self.settings}


class _Steps:
    """Applies steps to rays one after the other. ``reason`` tells why there are no fixations.

    ``in_place`` tells whether the rays are not used elsewhere, so that they may be modified in place. ``reporter`` None
    is for one of several blocks: nothing is reported, and a step may select no ray.
    """

    def __init__(self, rays: Rays, in_place: bool, reporter: Reporter | None) -> None:
        self.rays, self.taken, self.fixations, self.reason = rays, list[_Step](), 0, ""
        self._in_place, self._reporter = in_place, reporter

    def follow(self, selection: _Selection) -> None:
        """Select fixations and thin out stationary periods."""
        if selection.fixations is not None:
            self._select_fixations(selection)
        if selection.thin is not None:
            settings = {"seconds": selection.thin, "distance": selection.thin_distance}
            mask = filters.thin_mask(self.rays, **settings) if len(self.rays) else np.zeros(0, bool)
            self.select_mask(mask, "thin", settings)

    def _select_fixations(self, selection: _Selection) -> None:
        rules, dispersion, label = selection.rules, selection.dispersion, np.zeros(0, np.int64)
        if len(self.rays):
            label = events.label_fixations(self.rays, rules, dispersion)[0]
        self.fixations = len(np.unique(label[label >= 0]))
        if not self.fixations:
            self.reason = events.explain_missing_fixations(self.rays, rules, dispersion)
            if self._reporter is not None:
                raise NergError(self.reason)
        if self._reporter is not None:
            self._reporter.message(f"{self.fixations:,} fixations ({selection.fixations})")
        settings = {"by": selection.fixations, **rules.describe(dispersion)}
        if not selection.merge_fixations:
            self.select_mask(label >= 0, "fixations", settings)
            return
        before = len(self.rays)
        merged = events.average_fixations(self.rays, label)[0] if self.fixations else self.rays.select(label >= 0)
        self._apply(merged, "fixations", before, {**settings, "one_ray": True})

    def select_mask(self, mask: np.ndarray, name: str, settings: dict[str, Any]) -> None:
        """Select the rays of a mask (N,), in place if the rays are not used elsewhere."""
        count = len(self.rays)
        if not mask.any() and self._reporter is not None:
            conditions = sanitize(", ".join(f"{key} {value}" for key, value in settings.items()), 120)
            raise NergError(f"{name} selects none of {count:,} rays ({conditions}); widen its conditions")
        self._apply(
            self.rays.filter_in_place(mask) if self._in_place else self.rays.select(mask), name, count, settings
        )

    def _apply(self, rays: Rays, name: str, before: int, settings: dict[str, Any]) -> None:
        step = _Step(name, len(rays), before, settings)
        if self._reporter is not None:
            self._reporter.message(f"{name}: {step.kept:,} of {before:,} rays")
        self.rays, self._in_place = rays.with_step(**step.entry), True
        self.taken.append(step)


def smallest_mask(numbers: np.ndarray, n: int) -> np.ndarray:
    """Return a mask of the ``n`` smallest of the ``numbers`` (N,), or of all if there are fewer."""
    mask = np.ones(len(numbers), bool)
    if n < len(numbers):
        mask[np.argpartition(numbers, n)[n:]] = False
    return mask


def _filter_rays(rays: Rays, selection: _Selection, reporter: Reporter, in_place: bool) -> Rays:
    steps = _Steps(rays, in_place, reporter)
    if selection.conditions:
        steps.select_mask(filters.select_mask(rays, **selection.conditions), "filter", selection.conditions)
    if selection.fixations is not None and len(steps.rays):
        events.warn_unknown_tracking(steps.rays.tracking, reporter.warn)
    steps.follow(selection)
    if selection.sample is not None:
        numbers = np.random.default_rng(selection.seed).random(len(steps.rays))
        steps.select_mask(smallest_mask(numbers, selection.sample), "sample", {"seed": selection.seed})
    return steps.rays


# ---- Datasets, block by block ----


class _Totals:
    """Sums of the steps over all blocks of a dataset."""

    def __init__(self, dataset: RayDataset, selection: _Selection, reporter: Reporter) -> None:
        self._count, self._selection, self._reporter = len(dataset), selection, reporter
        self._steps, self._fixations, self._reason = list[_Step](), 0, ""
        if selection.fixations is not None:
            events.warn_unknown_tracking(dataset.metadata.get("tracking", "unknown"), reporter.warn)

    def filter_blocks(self, dataset: RayDataset) -> Iterator[Rays]:
        """Yield the selected rays of each part of ``dataset``."""
        conditions = self._selection.conditions
        for block in dataset.scan(Conditions(**conditions), whole_parts=self._selection.follows):
            steps = _Steps(block, True, None)
            steps.follow(self._selection)
            self._fixations += steps.fixations
            self._reason = self._reason or steps.reason
            first = [_Step("filter", len(block), 0, conditions)] if conditions else []
            taken = [*first, *steps.taken]
            before = self._steps or [replace(step, kept=0, of=0) for step in taken]
            self._steps = [replace(a, kept=a.kept + b.kept, of=a.of + b.of) for a, b in zip(before, taken)]
            if len(steps.rays):
                yield steps.rays

    def add_sample(self, count: int, total: int) -> None:
        """Add the sample that was drawn of all blocks together."""
        self._steps.append(_Step("sample", count, total, {"seed": self._selection.seed}))

    def report(self) -> list[dict[str, Any]]:
        """Report and return the steps over all blocks. Raises `NergError` if nothing was selected."""
        if self._reason and not self._fixations:
            raise NergError(self._reason)
        if not self._steps or not self._steps[-1].kept:
            raise NergError(f"none of {self._count:,} rays are selected; widen the conditions")
        # Conditions count all rays, many of which were not read.
        steps = [replace(step, of=self._count) if step.name == "filter" else step for step in self._steps]
        if self._selection.fixations is not None:
            self._reporter.message(f"{self._fixations:,} fixations ({self._selection.fixations})")
        for step in steps:
            self._reporter.message(f"{step.name}: {step.kept:,} of {step.of:,} rays")
        return [step.entry for step in steps]


def _filter_dataset(dataset: RayDataset, selection: _Selection, reporter: Reporter) -> Rays:
    """Return the selected rays of a dataset."""
    dataset.require_single_place()
    n = selection.sample
    if n is not None and not selection.conditions and not selection.follows:
        rays = dataset.sample(n, selection.seed)
        reporter.message(f"sample: {len(rays):,} of {len(dataset):,} rays")
        return rays
    totals = _Totals(dataset, selection, reporter)
    selected = totals.filter_blocks(dataset)
    blocks = _collect(selected) if n is None else _draw_sample(selected, n, selection.seed, totals)
    steps = totals.report()
    rays = merge_rays(blocks, dataset.metadata)
    for step in steps:
        rays = rays.with_step(**step)
    return rays


def _collect(selected: Iterator[Rays]) -> list[Rays]:
    blocks, count = [], 0
    for block in selected:
        blocks.append(block)
        count += len(block)
        if count > MAX_LOADED_RAYS:
            raise NergError(
                f"more than {MAX_LOADED_RAYS:,} rays are selected, {MAX_LOADED_RAYS * BYTES_PER_RAY / 1e9:.2g} GB: "
                f"narrow the conditions, add {parameter('sample')}, or write a dataset "
                f"({parameter('output', 'NAME' + DATASET)})"
            )
    return blocks


def _draw_sample(selected: Iterator[Rays], n: int, seed: int, totals: _Totals) -> list[Rays]:
    """Return a uniform random sample of the selected rays: those with the smallest random numbers."""
    rng = np.random.default_rng(seed)
    held, lots, count = list[Rays](), list[np.ndarray](), 0
    limit = 1.0
    for block in selected:
        lot = rng.random(len(block))
        count += len(block)
        held.append(block.select(lot < limit))
        lots.append(lot[lot < limit])
        if sum(map(len, lots)) > 2 * n:
            held, lots = _select_smallest(held, lots, n)
            limit = max(float(lot.max()) for lot in lots if len(lot))
    held, _ = _select_smallest(held, lots, n)
    totals.add_sample(min(n, count), count)
    return held


def _select_smallest(held: list[Rays], lots: list[np.ndarray], n: int) -> tuple[list[Rays], list[np.ndarray]]:
    """Return the ``n`` rays with the smallest numbers, in their blocks."""
    mask = smallest_mask(np.concatenate(lots) if lots else np.zeros(0), n)
    masks = np.split(mask, np.cumsum([len(lot) for lot in lots])[:-1]) if lots else []
    return [rays.select(m) for rays, m in zip(held, masks)], [lot[m] for lot, m in zip(lots, masks)]


def _filter_to_dataset(dataset: RayDataset, selection: _Selection, output: Path, reporter: Reporter) -> RayDataset:
    """Write the selected rays of each source to a new dataset; metadata last, as it holds the sums of all steps."""
    if selection.sample is not None:
        raise NergError(
            f"{parameter('sample')} needs a file as output; use an output name that ends in .npz or .parquet"
        )
    check_new_folder(output)
    totals = _Totals(dataset, selection, reporter)
    with create_folder_atomically(output) as folder:
        write_dataset_manifest(folder, replace(dataset.manifest, closed=True))
        writers = {source.id: SourceWriter(folder, source.id, dataset.manifest.buckets) for source in dataset.sources}
        for source, part in dataset.parts:
            for block in totals.filter_blocks(replace(dataset, parts=((source, part),))):
                writers[source.id].add(block, part.place, part.day)
        steps = totals.report()
        for source in dataset.sources:
            metadata = {**source.metadata, "steps": [*source.metadata.get("steps", []), *steps]}
            names = ("file", "where", "stamp", "recipe", "generation")
            writers[source.id].finish(metadata, **{name: getattr(source, name) for name in names})
    return RayDataset.open(output)
