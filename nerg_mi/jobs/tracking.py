"""Rays of attention from tracking files, and what is done to them: imported, summed up, filtered, split, drawn."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.tables import write_json
from nerg_mi.rays import filters, fixations, splits
from nerg_mi.rays.guess.proposal import Proposal, propose_import
from nerg_mi.rays.io import SUFFIXES
from nerg_mi.rays.pseudonyms import pseudonymise, read_salt
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.registry import TABLE, read_rays
from nerg_mi.rays.summary import RaysSummary, summarise
from nerg_mi.view import figures, ray_figures

from .options.rays import FilterOptions, SplitOptions
from .reporter import SILENT, Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FileName = str | os.PathLike
KINDS = ("density", "layout")


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """How tracking files become rays. Raises `NergError` for a salt without pseudonyms."""

    reader: str = TABLE  # name of a registered reader (`nerg_mi.rays.readers.registry`)
    settings: Any = None  # an object of the reader's Options; None: as they are by default
    skip_bad_lines: bool = False  # leave out lines that cannot be read, at most 1 % of a file's
    pseudonyms: bool = False  # replace the names of persons by salted hashes
    salt: FileName | None = None  # of the hashes: a file of 16 bytes or more; None: random, not kept
    output: FileName | None = None  # rays file to write, .npz or .parquet; None: none
    align_output: FileName | None = None  # JSON file to write: the similarity from rays to the files' frame; None: none

    def __post_init__(self) -> None:
        if self.salt is not None and not self.pseudonyms:
            raise NergError("--salt belongs to --pseudonyms; add it, or leave out --salt")


@dataclass(frozen=True, eq=False)
class ImportResult:
    """Rays, whose metadata hold the account of what was dropped, and their figures."""

    rays: Rays
    summary: RaysSummary


def import_rays(
    files: FileName | Sequence[FileName], options: ImportOptions = ImportOptions(), reporter: Reporter = SILENT
) -> ImportResult:
    """Tracking files (or folders, by the reader) as rays: right-handed, z up, metres, seconds.

    Raises `NergError` for what the reader refuses, or an output that cannot be written, before anything is read; for an
    alignment with files whose frame is the other hand's.
    """
    files = [files] if isinstance(files, (str, os.PathLike)) else list(files)
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


def guess_import(file: FileName, reporter: Reporter = SILENT) -> Proposal:
    """What an unknown tracking file is likely to be, and the command to import it by; nothing is applied or written.

    Raises `NergError` for a file that is no table, or is damaged.
    """
    reporter.message(f"looking at {file}")
    return propose_import(Path(file))


@dataclass(frozen=True, eq=False)
class FilterResult:
    """The rays that were kept, and how many fixations there were, if they were asked for."""

    rays: Rays
    fixations: int | None


def filter_rays(rays: Rays | FileName, options: FilterOptions, reporter: Reporter = SILENT) -> FilterResult:
    """Some of the rays; each step is noted in their metadata. ``rays``: those, or a file of them.

    Raises `NergError` where a step leaves no ray, and for what `nerg_mi.rays.filters` and `.fixations` refuse.
    """
    _check_outputs(options.output)
    steps = _Steps(rays, reporter)
    if options.conditions:
        steps.keep(filters.select_mask(steps.rays, **options.conditions), "filter", options.conditions)
    count = None
    if options.fixations is not None:
        by_velocity = options.fixations == "ivt"
        limit = {"velocity": options.velocity} if by_velocity else {"dispersion": options.dispersion}
        limit |= {} if options.least is None else {"least": options.least}
        label = (fixations.ivt if by_velocity else fixations.idt)(steps.rays, **limit)
        count = len(np.unique(label[label >= 0]))
        reporter.message(f"{count:,} fixations ({options.fixations})")
        what = {"by": options.fixations, **limit}
        if options.one_ray:
            steps.replace(fixations.fixation_rays(steps.rays, label)[0], "fixations", {**what, "one_ray": True})
        else:
            steps.keep(label >= 0, "fixations", what)
    if options.thin is not None:
        what = {"seconds": options.thin, "distance": options.thin_distance}
        steps.keep(filters.thin_mask(steps.rays, **what), "thin", what)
    _save(steps.rays, options.output)
    return FilterResult(steps.rays, count)


class _Steps:
    """Rays to which one thing after the other is done."""

    def __init__(self, rays: Rays | FileName, reporter: Reporter) -> None:
        self.rays, self.reporter = _load(rays), reporter
        # Rays that somebody else holds stay as they are.
        self.own = self.rays is not rays

    def keep(self, mask: np.ndarray, step: str, what: dict[str, Any]) -> None:
        """Keep the rays of a mask (N,); in their own memory, if nobody else holds them."""
        rays, count = self.rays, int(mask.sum())
        if not count:
            raise NergError(f"{step} leaves none of {len(rays):,} rays; widen its conditions")
        self.reporter.message(f"{step}: {count:,} of {len(rays):,} rays")
        kept = rays.keep_in_place(mask) if self.own else rays.select(mask)
        self.rays, self.own = kept.with_step(step=step, kept=count, of=len(rays), **what), True

    def replace(self, rays: Rays, step: str, what: dict[str, Any]) -> None:
        """Go on with other rays that were made of these."""
        before = len(self.rays)
        self.reporter.message(f"{step}: one ray each, {len(rays):,} of {before:,} rays")
        self.rays, self.own = rays.with_step(step=step, kept=len(rays), of=before, **what), True


@dataclass(frozen=True, eq=False)
class SplitResult:
    """Training and test rays that share none, and how many are used on neither side."""

    train: Rays
    test: Rays
    purged: int


def split_rays(rays: Rays | FileName, options: SplitOptions, reporter: Reporter = SILENT) -> SplitResult:
    """Training rays, which are on the training side of each split, and test rays, on the test side of each.

    ``rays``: those, or a file of them. Raises `NergError` for what `nerg_mi.rays.splits` refuses.
    """
    _check_outputs(options.train_output, options.test_output)
    data, seed = _load(rays), options.seed
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    about: dict[str, Any] = {}
    if options.zones:
        where = {name: getattr(options, name) for name in ("zones", "zone_radius", "min_rays")}
        held = splits.split_by_position(data, options.radius, test_probes=options.positions, seed=seed, **where)
        parts.append(held.sides)
        about["position"] = {
            "radius": options.radius,
            "zones": options.zones,
            "zone_radius": options.zone_radius,
            "test_centres": held.test_centres.tolist(),
        }
    if options.people or options.persons:
        sides = splits.split_by_person(
            data, test_share=options.people or 0.5, test_persons=list(options.persons) or None, seed=seed
        )
        parts.append(sides)
        about["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[sides[1]]))}
    if options.time:
        parts.append(splits.split_by_time(data, test_share=options.time, gap=options.gap, of=options.clock))
        about["time"] = {"share": options.time, "gap": options.gap, "of": options.clock}
    train, test = splits.combine(*parts)
    purged = int((~(train | test)).sum())
    reporter.message(f"{train.sum():,} training rays, {test.sum():,} test rays, {purged:,} purged of {len(data):,}")
    side = lambda name, mask: data.select(mask).with_step(
        step="split", side=name, seed=seed, kept=int(mask.sum()), of=len(data), by=about
    )
    result = SplitResult(side("train", train), side("test", test), purged)
    _save(result.train, options.train_output)
    _save(result.test, options.test_output)
    return result


@dataclass(frozen=True, kw_only=True)
class PlotOptions:
    """What a floor plan shows. Raises `NergError` for an unknown word, or test rays beside densities."""

    kind: str = "density"  # "density": rays/m² with mean directions; "layout": each ray's place, with dimensions
    cell: float | None = None  # density: edge of a cell, metres; None: a fiftieth of the plan
    test: Rays | FileName | None = None  # layout: test rays of a split, drawn beside
    output: FileName | None = None  # picture to write, .png; None: none

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise NergError(f'--kind is "{self.kind}"; it is density or layout')
        if self.kind == "density" and self.test is not None:
            raise NergError("--test is drawn in the layout; add --kind layout")


def plot_rays(rays: Rays | FileName, options: PlotOptions = PlotOptions()) -> Figure:
    """The floor plan of rays, or of a file of them, as a figure of matplotlib."""
    if options.output is not None:
        check_writable(options.output, ".png")
    if options.kind == "density":
        figure = ray_figures.floor_plan(_load(rays), options.cell)
    else:
        test = None if options.test is None else _load(options.test)
        where = {} if test is None else splits.position_of_split(test)
        figure = ray_figures.layout_figure(_load(rays), test, where.get("test_centres"), where.get("radius"))
    if options.output is not None:
        figures.save(figure, options.output)
    return figure


def _load(rays: Rays | FileName) -> Rays:
    return rays if isinstance(rays, Rays) else Rays.load(rays)


def _check_outputs(*outputs: FileName | None) -> None:
    """Raise `NergError` where rays cannot be written: before minutes of reading."""
    for path in outputs:
        if path is not None:
            check_writable(path, *SUFFIXES)


def _save(rays: Rays, output: FileName | None) -> None:
    if output is not None:
        rays.save(Path(output))
