"""Robustness of conclusions: AOI statistics repeated with other choices of filters, areas, alignment and weighting."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.style import changed_arguments, existing_files, make_provenance
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import Alignment, AnySimilarity, open_similarity
from nerg_mi.formats.boxes import Region
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import SEEDS, Range, check_ranges
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import RENDER_LIBRARIES, FileGroup, Part, Plan
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.events import detect_fixations_ivt, warn_unknown_tracking
from nerg_mi.tracking.rays import TRACKING, Rays

from .areas import AnyAreas, Areas
from .measured import AoiContext, Counting, count_block, iter_blocks
from .placed import PlacedAreas, open_placed_areas, place_areas
from .robustness_output import Conclusion, RobustnessResult, conclusion_rows
from .settings import AoiSampling, Choices, TrackerError, VisitRules
from .statistics import open_counting, open_inputs
from .statistics_parts import PlannedAreas, read_sums, save_objects, write_sums
from .tables import MEASURES_BY_NAME, Pair, Participants, Row
from .visits import ALL, Cell, VisitSums, merge_sums

# ---- Choices ----

MEASURES = ("share", "hit_ratio", "visits")
"""Measures whose differences are conclusions. Their denominators do not depend on where the gaze is."""

MAX_PAIRED = 5
"""Largest number of areas, or of values of a dimension, that are all compared with each other; of more areas,
neighbours in the order of the reference are, and of more values, the first ones."""

MAX_SHRINKAGE = 0.45  # of the extent of a box, at each of its sides


def draw_choices(choices: Choices, rng: np.random.Generator) -> Row:
    """Draw the choices of one analysis, by name; those that depend on another choice are None if it excludes them."""
    choice: Row = {}
    for field in fields(choices):
        value = getattr(choices, field.name)
        if field.name in ("rotation", "shift"):
            names = [field.name] if field.name == "rotation" else ["shift_x", "shift_y", "shift_z"]
            choice |= {name: float(rng.uniform(-1, 1)) * (value or 0.0) for name in names}
        elif isinstance(value[0], str):
            choice[field.name] = value[int(rng.integers(len(value)))]
        else:
            choice[field.name] = float(rng.uniform(*value))
    if choice["samples"] == "all":
        choice |= {"velocity": None, "min_fixation": None}
    return choice


# ---- Analyses ----


@dataclass(frozen=True, eq=False)
class Analyses:
    """Counts visits with other choices: ``placed`` areas, ``rays``, and how they are counted by default."""

    placed: PlacedAreas
    rays: Rays
    counting: Counting

    @cached_property
    def center(self) -> np.ndarray:
        """Mean position (3,) in the scene."""
        return self.placed.environment.points_to_field(self.rays.origin.mean(axis=0))

    @property
    def has_hits(self) -> bool:
        """Whether rays end at their hit points, because surfaces are unknown."""
        hit = self.rays.hit
        return self.placed.environment.medium is None and hit is not None and bool(np.isfinite(hit).any())

    def get_reference(self) -> Row:
        """Return the choices of the reference, by name."""
        rules, sampling = self.counting.rules, self.placed.sampling
        reference: Row = {name: getattr(rules, name) for name in ("min_visit", "merge_gap", "max_gap")}
        reference |= {"tolerance": sampling.tolerance, "margin": sampling.margin, "growth": 0.0}
        reference |= dict.fromkeys(("rotation", "shift_x", "shift_y", "shift_z"), 0.0)
        reference |= {"weighting": "participants", "samples": "all", "velocity": None, "min_fixation": None}
        return reference | {"tracker": "corrected" if self.counting.has_error else "ignored"}

    def count(self, choice: Mapping[str, Any]) -> VisitSums:
        """Sum the visits with these choices."""
        rays = self.rays
        if choice["samples"] == "fixations":
            rays = rays.select(detect_fixations_ivt(rays, choice["velocity"], choice["min_fixation"]) >= 0)
        rules = replace(self.counting.rules, **{k: choice[k] for k in ("min_visit", "merge_gap", "max_gap")})
        counting = replace(self.counting, rules=rules)
        if choice["tracker"] == "ignored":
            counting = replace(counting, error=TrackerError(), validation=None)
        context = AoiContext(self._place(choice), counting, self.has_hits, tuple(sorted(self.rays.cohorts)))
        return merge_sums(count_block(block, context) for block in iter_blocks(rays, rules))

    def _place(self, choice: Mapping[str, Any]) -> PlacedAreas:
        placed = self.placed
        shift = placed.scale * np.array([choice[f"shift_{axis}"] for axis in "xyz"])
        cos, sin = np.cos(np.radians(choice["rotation"])), np.sin(np.radians(choice["rotation"]))
        motion = np.eye(4)
        motion[:2, :2] = [[cos, -sin], [sin, cos]]
        motion[:3, 3] = self.center - motion[:3, :3] @ self.center + shift
        align = Similarity(motion @ placed.environment.align.matrix)
        growth = choice["growth"] * placed.scale
        areas = tuple(_grow(a, growth) if isinstance(a, Region) else a for a in placed.areas.areas)
        sampling = replace(placed.sampling, tolerance=choice["tolerance"], margin=choice["margin"])
        environment = replace(placed.environment, align=align)
        return place_areas(environment, None, replace(placed.areas, areas=areas), placed.meshes, sampling)


def _grow(box: Region, growth: float) -> Region:
    """Move the sides of a box outwards, or inwards by at most `MAX_SHRINKAGE`."""
    lower, upper = box.corners
    step = np.maximum(growth, -MAX_SHRINKAGE * (upper - lower))
    return replace(box, lower=tuple((lower - step).tolist()), upper=tuple((upper + step).tolist()))


@dataclass(frozen=True)
class PlannedAnalyses:
    """Common arguments of all parts: the ``areas``, the file of ``rays``, and how they are counted by default."""

    areas: PlannedAreas
    rays: Path
    counting: Counting

    def open(self) -> Analyses:
        """Load the files."""
        return Analyses(self.areas.open(), Rays.load(self.rays), self.counting)


def count_analysis(common: PlannedAnalyses, choice: Mapping[str, Any], output: Path) -> None:
    """Write the sums (.npz) of one analysis."""
    analyses: Analyses = prepare_once(common, common.open)
    write_sums(output, [analyses.count(choice)])


# ---- Conclusions ----


@dataclass(frozen=True)
class Evaluation:
    """Evaluates conclusions from the sums of an analysis; ``is_single`` (A,) are the areas that are no groups."""

    is_single: np.ndarray
    draws: int
    resamples: int
    seed: int

    def rank(self, sums: VisitSums, choice: Row) -> dict[str, np.ndarray]:
        """Return the ranks (A,) of the areas from 1, the largest value, by measure; equal values share the mean of
        their ranks, and groups have the rank infinity."""
        ranks = {}
        for measure in MEASURES:
            x, y = self._pair(sums, choice, measure, ALL)
            value = np.where(self.is_single, x.sum(axis=0) / np.maximum(y.sum(axis=0), 1e-300), -np.inf)
            is_equal = np.isclose(value, value[:, None], rtol=1e-9, atol=0)
            rank = 0.5 + ((value > value[:, None]) & ~is_equal).sum(axis=1) + 0.5 * is_equal.sum(axis=1)
            ranks[measure] = np.where(self.is_single, rank, np.inf)
        return ranks

    def evaluate(
        self, sums: VisitSums, choice: Row, ranks: Mapping[str, np.ndarray]
    ) -> dict[Conclusion, tuple[float, float, float]]:
        """Return differences, or ranks, with the limits of their intervals (NaN without one); ``ranks`` are those of
        the reference."""
        names, values = sums.areas, {}
        own_ranks = self.rank(sums, choice)
        for measure, reference in ranks.items():
            order = np.argsort(reference, kind="stable")[: self.is_single.sum()]
            pairs = list(combinations(order, 2) if len(order) <= MAX_PAIRED else zip(order[:-1], order[1:]))
            if pairs:
                x, y = self._pair(sums, choice, measure, ALL)
                a, b = np.array(pairs).T
                keys = [Conclusion("areas", measure, names[i], names[j]) for i, j in pairs]
                values |= dict(zip(keys, self._subtract(measure, (x[:, a], y[:, a]), (x[:, b], y[:, b]))))
            for place, k in enumerate(order[:3], 1):
                values[Conclusion("rank", measure, names[k], place)] = (own_ranks[measure][k], np.nan, np.nan)
            for first, second in _pair_cells(sums.cells):
                people = sorted({person for cell, person in sums.rows if cell in (first, second)})
                one, other = (self._pair(sums, choice, measure, cell, people) for cell in (first, second))
                keys = [Conclusion("cells", measure, first, second, name) for name in names]
                values |= dict(zip(keys, self._subtract(measure, one, other)))
        return values

    def _subtract(self, measure: str, first: Pair, second: Pair) -> Iterator[tuple[float, float, float]]:
        d = MEASURES_BY_NAME[measure].estimate_differences(second, first, self.resamples, self.seed)
        return zip(d.value.tolist(), d.low.tolist(), d.high.tolist())

    def _pair(
        self, sums: VisitSums, choice: Row, measure: str, cell: Cell, people: Sequence[str] | None = None
    ) -> Pair:
        """Return numerators and denominators (P, A) over the participants of a cell, or over ``people``."""
        is_corrected = choice["tracker"] == "corrected"
        x, y = [], np.empty(0)
        for draw in range(2 * self.draws + 1 if is_corrected else 1):
            p = Participants.from_sums(sums.select_draw(draw), cell, False)
            p = p if people is None else p.align_to(people)
            if measure == "share" and choice["weighting"] == "time":
                pair: Pair | None = p.dwell_time, p.ones * p.time[:, None]
            else:
                pair = MEASURES_BY_NAME[measure].numerator_denominator(p)
            assert pair is not None
            x.append(pair[0])
            y = pair[1]
        if not is_corrected:
            return x[0], y
        # To no error, as in `nerg_mi.aoi.tracker_error`; denominators are those of the samples without an added error.
        once, twice = np.mean(x[1 : self.draws + 1], axis=0), np.mean(x[self.draws + 1 :], axis=0)
        return 3 * x[0] - 3 * once + twice, y


def _pair_cells(cells: Sequence[Cell]) -> list[tuple[Cell, Cell]]:
    """Return pairs of cells of the same dimension."""
    recorded = [cell for cell in cells if cell.draw == 0 and cell != ALL]
    pairs: list[tuple[Cell, Cell]] = []
    for dimension in dict.fromkeys(cell.dimension for cell in recorded):
        pairs += combinations([cell for cell in recorded if cell.dimension == dimension][:MAX_PAIRED], 2)
    return pairs


# ---- The function ----


@check_ranges
def robustness(
    inputs: Sequence[FilePath | Any] | FilePath | Any,
    aois: FilePath | AnyAreas | None = None,
    *,
    choices: Choices = Choices(),
    analyses: Annotated[int, Range(10, 100_000)] = 100,
    align: FilePath | AnySimilarity | None = None,
    cohorts: FilePath | None = None,
    validation: FilePath | None = None,
    windows: Mapping[str, Sequence[float]] | None = None,
    zones: FilePath | AnyAreas | None = None,
    resamples: Annotated[int, Range(199, 100_000)] = 199,
    seed: Annotated[int, SEEDS] = 0,
    rules: VisitRules = VisitRules(),
    error: TrackerError = TrackerError(),
    sampling: AoiSampling = AoiSampling(),
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> RobustnessResult:
    """Test whether conclusions of AOI statistics survive other reasonable choices.

    Repeats the analysis of recordings with choices drawn at random: durations that define visits, sizes of areas,
    tolerances, alignment, samples or fixations, weights of participants, and correction of the tracker's error. Reports
    in how many analyses each conclusion holds, and which choice decides most.

    Parameters
    ----------
    inputs : object, path or sequence of these
        Rays or a dataset, and optionally an environment, in any order.
    aois : Areas, path or mapping
        JSON file of areas of interest (AOIs), as for ``nerg stats``.
    choices : Choices
        Ranges of the choices (`nerg_mi.aoi.settings.Choices`).
    analyses : int
        Number of analyses with choices drawn at random.
    align : path or similarity, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it. Its
        uncertainty is a choice.
    cohorts : path, optional
        CSV file with columns person,cohort; cohorts are compared. Default: the cohorts in the rays.
    validation : path, optional
        CSV file with columns person,accuracy,precision in degrees: the errors of the eye tracker by participant, which
        replace accuracy and precision.
    windows : mapping, optional
        Start and end of a time window by its name, NAME=FROM,TO in seconds of the rays' clock; windows are compared;
        repeatable.
    zones : Areas, path or mapping, optional
        JSON file of boxes on the floor; observers in different boxes are compared.
    resamples : int
        Number of bootstrap resamples of the participants for confidence intervals.
    seed : int
        Seed of the choices, and of the bootstrap resamples, which are the same in each analysis.
    rules : VisitRules
        Durations that define a visit in the reference (`nerg_mi.aoi.settings.VisitRules`).
    error : TrackerError
        Error of the eye tracker (`nerg_mi.aoi.settings.TrackerError`).
    sampling : AoiSampling
        How rays are assigned to AOIs in the reference (`nerg_mi.aoi.settings.AoiSampling`).
    parallel : Parallel
        Where parts, one per analysis, run (`nerg_mi.tasks.settings.Parallel`). The tables are the same.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RobustnessResult
        Tables as lists of dicts, with ``verdict``, and methods ``to_dataframe`` and ``save`` (a folder of tables and a
        figure).

    Raises
    ------
    NergError
        An argument or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg, numpy as np
    >>> eye, toward = [[0.0, 0.0, 1.6]] * 60, np.tile([[1, 0.2, 0], [1, 0.2, 0], [1, -0.2, 0]], (20, 1))
    >>> times, names = np.tile(np.arange(15) / 10, 4), np.repeat(["a", "b", "c", "d"], 15)
    >>> rays = nerg.Rays.from_arrays(eye, toward, times=times, participants=names, tracking="eye")
    >>> areas = {"left": [[2, 0, 0], [3, 1, 2]], "right": [[2, -1, 0], [3, 0, 2]]}
    >>> row = nerg.robustness(rays, areas, analyses=20).conclusions[0]
    >>> row["conclusion"], row["measure"], row["holds"]
    ('left > right', 'share', 1.0)
    """
    changed = changed_arguments(robustness, locals() | {"choices": Choices()})
    changed |= {} if choices == Choices() else {"choices": asdict(choices)}
    if aois is None:
        raise NergError(f"no AOIs are given; add {parameter('aois', 'FILE')}")
    mode = str(activate_mitsuba().variant())
    chosen, align = open_inputs(inputs, align)
    if chosen.rays is None or chosen.gaze is not None:
        raise NergError("choices are varied in the analysis of recordings: give rays and no gaze field")
    areas = Areas.open(aois, "aois")
    counting, counting_files = open_counting(Counting(rules, error=error), windows, zones, cohorts, validation)
    files = [*existing_files(*chosen, *areas.files, align), *counting_files]
    matrix = None if align is None else open_similarity(align, "rays to scene").matrix.tolist()
    if align is not None and not isinstance(align, (str, os.PathLike)):
        changed["align"] = matrix
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        base = Analyses(
            open_placed_areas(chosen.environment, None, areas, align, sampling), open_rays(chosen.rays), counting
        )
        for note in base.placed.warnings:
            reporter.message(note)
        choices = _adapt_choices(choices, base, align, reporter)
        drawn = [draw_choices(choices, np.random.default_rng((seed, k))) for k in range(analyses)]
        table = [base.get_reference(), *drawn]
        if parallel.in_parts:
            planned = PlannedAreas(None, None, areas, matrix, sampling, mode)
            all_sums = _count_in_parts(base, planned, chosen.environment, table, PartRunner(parallel, None, reporter))
        else:
            all_sums = _count_in_process(base, table, reporter)
        single = np.isin(np.arange(len(base.placed.areas.names)), AoiContext(base.placed, counting).transition_areas)
        evaluation, ranks, estimates = Evaluation(single, error.draws, resamples, seed), {}, []
        for choice, sums in zip(table, all_sums):
            ranks = ranks or evaluation.rank(sums, choice)
            estimates.append(evaluation.evaluate(sums, choice, ranks))
        result = conclusion_rows(estimates, drawn)
        provenance = make_provenance("nerg robustness", files, seed, changed | {"mode": mode})
        result = replace(result, provenance=provenance)
        for line in result.verdict.splitlines():
            reporter.message(line)
    return result


def _adapt_choices(choices: Choices, base: Analyses, align: Any, reporter: Reporter) -> Choices:
    """Return the choices that the inputs allow: those of alignment, tracker, boxes and fixations."""
    turn, shift = _read_uncertainty(align)
    choices = replace(
        choices,
        rotation=turn if choices.rotation is None else choices.rotation,
        shift=shift if choices.shift is None else choices.shift,
    )
    if not base.counting.has_error:
        choices = replace(choices, tracker=("ignored",))
    if not base.placed.areas.boxes:
        choices = replace(choices, growth=(0.0, 0.0))
    if "fixations" not in choices.samples:
        return choices
    rays, reason = base.rays, ""
    if rays.tracking in ("head", "mixed"):
        reason = f"the rays are {TRACKING[rays.tracking]}"
    else:
        warn_unknown_tracking(rays.tracking, reporter.warn)
        label = detect_fixations_ivt(rays, choices.velocity[0], max(choices.min_fixation))
        missing = len(rays.participants) - len(np.unique(rays.person[label >= 0]))
        if missing:
            reason = f"{missing:,} participants have no fixation below {choices.velocity[0]:g} degrees per second"
    if not reason:
        return choices
    if "all" not in choices.samples:
        raise NergError(f"fixations cannot be selected, because {reason}; add all to the samples of the choices")
    reporter.message(f"all samples count in each analysis, because {reason}")
    return replace(choices, samples=("all",))


def _read_uncertainty(align: Any) -> tuple[float, float]:
    """Return twice the standard deviations of an alignment in degrees and metres, or the ends of its interval; zeros
    if they are unknown."""
    if isinstance(align, (str, os.PathLike)):
        align = Alignment.load(to_path(align))
    uncertainty = align.uncertainty or {} if isinstance(align, Alignment) else {}
    if "turn_degrees" in uncertainty:
        return float(np.abs(uncertainty["turn_degrees"]).max()), uncertainty["shift_cm"] / 100
    return 2.0 * uncertainty.get("degrees", 0.0), 2.0 * uncertainty.get("cm", 0.0) / 100


def _count_in_process(base: Analyses, table: Sequence[Row], reporter: Reporter) -> Iterator[VisitSums]:
    """Yield the sums of each analysis, computed in this process."""
    with Interruption() as stop:
        for k, choice in enumerate(table):
            stop.check()
            yield base.count(choice)
            reporter.progress((k + 1) / len(table), f"{k} of {len(table) - 1} analyses")


def _count_in_parts(
    base: Analyses, planned: PlannedAreas, environment: Any, table: Sequence[Row], runner: PartRunner
) -> Iterator[VisitSums]:
    """Yield the sums of each analysis, computed in parts."""
    with runner.store.make_scratch_folder() as folder:
        file, _ = save_objects(environment, None, folder)
        areas = planned.areas
        if isinstance(areas, Areas) and areas.path is not None:
            areas = FileGroup(areas.path, areas.files)
        planned = replace(planned, environment=None if file is None else PlannedFiles.plan(file), areas=areas)
        base.rays.save(folder / "rays.npz")
        common = PlannedAnalyses(planned, folder / "rays.npz", base.counting)
        parts = [Part(choice, f"analysis {k}" if k else "the reference") for k, choice in enumerate(table)]
        job = f"nerg robustness {runner.store.folder.absolute()}"
        plan = Plan(job, count_analysis, common, parts, ".npz", (*RENDER_LIBRARIES, "scipy"))
        for output in runner.run(plan):
            yield read_sums(output.path)[0]
