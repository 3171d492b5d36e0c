"""Robustness of conclusions: AOI statistics, of recordings or predicted by gaze fields, repeated with other choices."""

from __future__ import annotations

import copy
import os
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.environment.gaze import GazeField, find_environment_record
from nerg_mi.environment.inputs import find_role
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.figures.style import changed_arguments, existing_files, make_provenance
from nerg_mi.files.atomic import make_folder
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import Alignment, AnySimilarity, open_similarity
from nerg_mi.formats.boxes import Region
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import SILENT, Progress, Reporter, SilentReporter, open_reporter
from nerg_mi.ranges import SEEDS, Range, check_ranges
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import Part
from nerg_mi.tracking.dataset import open_rays, open_recordings
from nerg_mi.tracking.event_settings import EventRules, read_fixations
from nerg_mi.tracking.events import describe_slow_sampling, label_fixations, warn_unknown_tracking
from nerg_mi.tracking.rays import TRACKING, Rays
from nerg_mi.transport.observer_gaze import GazeFieldInstance

from .areas import AnyAreas, Areas
from .measured import AoiContext, Counting, count_block, iter_blocks
from .placed import PlacedAreas, open_placed_areas, place_areas
from .predicted import PredictedAttention, Viewpoints, aggregate_by_participant, predict_attention
from .robustness_output import Conclusion, RobustnessResult, conclusion_rows
from .settings import AoiSampling, Choices, ObserverGrid, TrackerError, VisitRules
from .statistics import (
    AttentionAnalysis,
    list_inputs,
    open_counting,
    open_inputs,
    report_values_without_comparison,
    warn_unused_fixation_part,
)
from .statistics_parts import (
    ObserverPoses,
    PartitionedStatistics,
    PlannedAreas,
    read_prediction,
    read_sums,
    save_objects,
    write_prediction,
    write_sums,
)
from .tables import MEASURED, MEASURES_BY_NAME, PREDICTED, MinParticipantsFilter, Pair, Participants, Row
from .tracker_error import describe_tracker_fixations
from .visits import ALL, Cell, VisitSums, merge_sums

# ---- Choices ----

MEASURES = ("share", "hit_ratio", "visits")
"""Measures whose differences are conclusions. Their denominators do not depend on where the gaze is."""

MAX_PAIRED = 5
"""Largest number of areas, of groups, or of values of a dimension that are all compared with each other; of more areas,
neighbours in the order of the reference are, and of more groups or values, the first ones."""

MAX_SHRINKAGE = 0.45  # of the extent of a box, at each of its sides


NUM_WEIGHTS = 5
"""Number of weights of the prior that are drawn from. Each compiles kernels of its own."""

People = Mapping[Cell, Sequence[Participants]]
"""Participants by cell: as recorded or predicted, and then with each random error of the tracker."""


def draw_choices(choices: Choices, names: Container[str], num_fields: int, rng: np.random.Generator) -> Row:
    """Draw the choices of one analysis that are in ``names``, and one of ``num_fields`` fields; those that depend on
    another choice are None if it excludes them."""
    choice: Row = {}
    for name in (f.name for f in fields(choices)):
        value = getattr(choices, name)
        if name in ("rotation", "shift"):
            axes = [name] if name == "rotation" else ["shift_x", "shift_y", "shift_z"]
            choice |= {axis: float(rng.uniform(-1, 1)) * (value or 0.0) for axis in axes}
        elif name not in names:
            continue
        elif name == "prior_weight":
            choice[name] = None if value is None else float(rng.choice(np.linspace(value[0], value[1], NUM_WEIGHTS)))
        elif isinstance(value[0], str):
            choice[name] = value[int(rng.integers(len(value)))]
        else:
            choice[name] = float(rng.uniform(*value))
    if choice.get("samples") == "all":
        choice |= {"velocity": None, "min_fixation": None}
    return choice | ({"field": int(rng.integers(num_fields)) + 1} if num_fields else {})


def _make_rules(choice: Mapping[str, Any]) -> EventRules:
    return EventRules(velocity_threshold=choice["velocity"], min_fixation=choice["min_fixation"])


def find_motion(choice: Mapping[str, Any], center: np.ndarray, scale: float) -> np.ndarray:
    """Return the motion (4, 4) of the tracking in the scene: a rotation about ``center`` and a shift."""
    cos, sin = np.cos(np.radians(choice["rotation"])), np.sin(np.radians(choice["rotation"]))
    motion = np.eye(4)
    motion[:2, :2] = [[cos, -sin], [sin, cos]]
    shift = scale * np.array([choice[f"shift_{axis}"] for axis in "xyz"])
    motion[:3, 3] = center - motion[:3, :3] @ center + shift
    return motion


def change_areas(placed: PlacedAreas, choice: Mapping[str, Any]) -> tuple[Areas, AoiSampling]:
    """Return the areas and tolerances of a choice."""
    growth = choice["growth"] * placed.scale
    areas = tuple(_grow(a, growth) if isinstance(a, Region) else a for a in placed.areas.areas)
    tolerance = choice.get("tolerance", placed.sampling.tolerance)
    sampling = replace(placed.sampling, tolerance=tolerance, margin=choice["margin"])
    return replace(placed.areas, areas=areas), sampling


def _grow(box: Region, growth: float) -> Region:
    """Move the sides of a box outwards, or inwards by at most `MAX_SHRINKAGE`."""
    lower, upper = box.corners
    step = np.maximum(growth, -MAX_SHRINKAGE * (upper - lower))
    return replace(box, lower=tuple((lower - step).tolist()), upper=tuple((upper + step).tolist()))


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

    def compute(self, choice: Mapping[str, Any], reporter: Reporter = SILENT) -> VisitSums:
        """Sum the visits with these choices. ``reporter`` is told the progress after each block, and may stop it."""
        rays = self.rays
        if choice["samples"] == "fixations":
            rays = rays.select(label_fixations(rays, _make_rules(choice))[0] >= 0)
        rules = replace(self.counting.rules, **{k: choice[k] for k in ("min_visit", "merge_gap", "max_gap")})
        counting = replace(self.counting, rules=rules)
        if choice["tracker"] == "ignored":
            counting = replace(counting, error=TrackerError(), validation=None)
        context = AoiContext(self._place(choice), counting, self.has_hits, tuple(sorted(self.rays.cohorts)))

        def count_blocks() -> Iterator[VisitSums]:
            done = 0
            for block in iter_blocks(rays, rules):
                yield count_block(block, context)
                reporter.progress((done := done + len(block)) / len(rays))

        return merge_sums(count_blocks())

    def _place(self, choice: Mapping[str, Any]) -> PlacedAreas:
        placed, (areas, sampling) = self.placed, change_areas(self.placed, choice)
        align = Similarity(find_motion(choice, self.center, placed.scale) @ placed.environment.align.matrix)
        return place_areas(replace(placed.environment, align=align), None, areas, placed.meshes, sampling)

    def find_people(self, sums: VisitSums, choice: Mapping[str, Any]) -> People:
        """Return the participants of an analysis."""
        draws = [sums.select_draw(draw) for draw in range(1 + max(cell.draw for cell in sums.cells))]
        return {cell: [Participants.from_sums(of_draw, cell, False) for of_draw in draws] for cell in draws[0].cells}


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predicts attention with other choices: of ``viewpoints`` in the ``placed`` areas, recorded or not, by one of the
    ``networks`` (`list_networks`). ``sigma`` is the error of the eye tracker in radians, as for `predict_attention`,
    and ``times`` are the recorded seconds of each participant by cell."""

    placed: PlacedAreas
    networks: Sequence[GazeNetwork]
    viewpoints: Viewpoints
    is_recorded: bool
    sigma: float = 0.0
    times: Mapping[Cell, dict[str, float]] = field(default_factory=dict)

    def get_reference(self) -> Row:
        """Return the choices of the reference, by name."""
        sampling = self.placed.sampling
        reference: Row = {"margin": sampling.margin, "growth": 0.0, "glance_duration": sampling.glance_duration}
        reference |= dict.fromkeys(("rotation", "shift_x", "shift_y", "shift_z"), 0.0)
        reference |= {"weighting": "participants", "prior_weight": None, "field": 0}
        return reference | {"tracker": "corrected" if self.sigma > 0 else "ignored"}

    def compute(self, choice: Mapping[str, Any], reporter: Reporter = SILENT) -> PredictedAttention:
        """Predict the attention with these choices. The field is moved with the tracking that it was trained on.
        ``reporter`` is told the progress after each viewpoint, and may stop it."""
        placed, viewpoints, network = self.placed, self.viewpoints, self.networks[choice["field"]]
        assert placed.sampler is not None
        if choice["prior_weight"] not in (None, network.config.mix):
            network = copy.copy(network.members[0])
            network.set_prior(choice["prior_weight"])
        motion = find_motion(choice, viewpoints.positions.mean(axis=0), placed.scale)
        moved = GazeFieldInstance(network, Similarity(motion @ placed.sampler.gaze.to_world.matrix))
        areas, sampling = change_areas(placed, choice)
        sampler = replace(placed.sampler, gaze=moved)
        placed = place_areas(placed.environment, sampler, areas, placed.meshes, sampling)
        if self.is_recorded:
            viewpoints = replace(viewpoints, positions=transform_points(motion, viewpoints.positions))
        sigma = self.sigma if choice["tracker"] == "corrected" else 0.0
        # Nothing here depends on the field of view.
        return predict_attention(placed, viewpoints, 360.0, reporter, sigma=sigma)

    def find_people(self, predicted: PredictedAttention, choice: Mapping[str, Any]) -> People:
        """Return the participants of an analysis."""
        duration, people = choice["glance_duration"], dict[Cell, list[Participants]]()
        levels = [predicted.share, *([] if predicted.disturbed is None else predicted.disturbed)]
        for cell, times in self.times.items():
            for share in levels:
                level = replace(predicted, share=share)
                of_cell = aggregate_by_participant(level, self.viewpoints, cell, times, duration)
                if of_cell is not None:
                    people.setdefault(cell, []).append(of_cell)
        return people


def list_networks(gaze_fields: Sequence[GazeField]) -> list[GazeNetwork]:
    """Return the network of the first field, which is that of the reference, and each member of all fields alone."""
    networks = [gaze_fields[0].network]
    for network in (gaze_field.network for gaze_field in gaze_fields):
        for member in network.members:
            alone = copy.copy(member)
            # Those of an ensemble belong to it as a whole.
            alone.hits, alone.support, alone.basis = network.hits, network.support, network.basis
            networks.append(alone)
    return networks


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
    write_sums(output, [analyses.compute(choice)])


@dataclass(frozen=True)
class PlannedPredictions:
    """Common arguments of all parts: the ``areas``, the files of ``gaze_fields``, and what `Predictions` has."""

    areas: PlannedAreas
    gaze_fields: tuple[Path, ...]
    poses: ObserverPoses
    is_recorded: bool
    sigma: float

    def open(self) -> Predictions:
        """Load the files."""
        placed = self.areas.open()
        networks = list_networks([GazeField.load(file) for file in self.gaze_fields])
        return Predictions(placed, networks, self.poses.to_viewpoints(), self.is_recorded, self.sigma)


def predict_analysis(common: PlannedPredictions, choice: Mapping[str, Any], output: Path) -> None:
    """Write the predicted attention (.npz) of one analysis."""
    predictions: Predictions = prepare_once(common, common.open)
    write_prediction(output, predictions.compute(choice))


# ---- Conclusions ----


@dataclass(frozen=True)
class Evaluation:
    """Evaluates conclusions from the participants of an analysis; ``areas`` (A,) are names, and ``members`` (A,) the
    indices of their elementary areas; ``is_single`` (A,) are those that are no groups."""

    areas: Sequence[str]
    members: Sequence[Sequence[int]]
    is_single: np.ndarray
    resamples: int
    seed: int

    def rank(self, people: People, choice: Row) -> dict[str, np.ndarray]:
        """Return the ranks (A,) of the areas from 1, the largest value, by measure that the analysis has; equal values
        share the mean of their ranks, and groups have the rank infinity."""
        ranks = {}
        for measure in MEASURES:
            if MEASURES_BY_NAME[measure].numerator_denominator(people[ALL][0]) is None:  # as visits of a prediction
                continue
            x, y = self._pair(people[ALL], choice, measure)
            value = np.where(self.is_single, x.sum(axis=0) / np.maximum(y.sum(axis=0), 1e-300), -np.inf)
            is_equal = np.isclose(value, value[:, None], rtol=1e-9, atol=0)
            rank = 0.5 + ((value > value[:, None]) & ~is_equal).sum(axis=1) + 0.5 * is_equal.sum(axis=1)
            ranks[measure] = np.where(self.is_single, rank, np.inf)
        return ranks

    def evaluate(
        self, people: People, choice: Row, ranks: Mapping[str, np.ndarray]
    ) -> dict[Conclusion, tuple[float, float, float]]:
        """Return differences, or ranks, with the limits of their intervals (NaN without one); ``ranks`` are those of
        the reference."""
        values: dict[Conclusion, tuple[float, float, float]] = {}
        own_ranks = self.rank(people, choice)
        for measure, reference in ranks.items():
            order = np.argsort(reference, kind="stable")[: self.is_single.sum()]
            pairs = list(combinations(order, 2) if len(order) <= MAX_PAIRED else zip(order[:-1], order[1:]))
            pairs += self._pair_groups(order)
            if pairs:
                x, y = self._pair(people[ALL], choice, measure)
                a, b = np.array(pairs).T
                keys = [Conclusion("areas", measure, self.areas[i], self.areas[j]) for i, j in pairs]
                values |= dict(zip(keys, self._subtract(measure, (x[:, a], y[:, a]), (x[:, b], y[:, b]))))
            for place, k in enumerate(order[:3], 1):
                rank = float(own_ranks[measure][k])
                values[Conclusion("rank", measure, self.areas[k], place)] = (rank, np.nan, np.nan)
            for first, second in _pair_cells(people):
                names = sorted({*people[first][0].names, *people[second][0].names})
                one, other = (
                    self._pair([p.align_to(names) for p in people[cell]], choice, measure) for cell in (first, second)
                )
                keys = [Conclusion("cells", measure, first, second, area) for area in self.areas]
                values |= dict(zip(keys, self._subtract(measure, one, other)))
        return values

    def _pair_groups(self, order: np.ndarray) -> list[tuple[int, int]]:
        """Return pairs of a group and another one, or an area of no group, that have no area in common; ``order`` are
        the indices of the areas that are no groups."""
        groups = np.flatnonzero(~self.is_single).tolist()
        grouped = {k for group in groups for k in self.members[group]}
        units = [*groups, *(k for k in order.tolist() if grouped.isdisjoint(self.members[k]))][:MAX_PAIRED]
        return [
            (i, j)
            for i, j in combinations(units, 2)
            if not self.is_single[i] and set(self.members[i]).isdisjoint(self.members[j])
        ]

    def _subtract(self, measure: str, first: Pair, second: Pair) -> Iterator[tuple[float, float, float]]:
        d = MEASURES_BY_NAME[measure].estimate_differences(second, first, self.resamples, self.seed)
        return zip(d.value.tolist(), d.low.tolist(), d.high.tolist())

    def _pair(self, draws: Sequence[Participants], choice: Row, measure: str) -> Pair:
        """Return numerators and denominators (P, A) over participants."""
        pairs = []
        for p in draws:
            if measure == "share" and choice["weighting"] == "time":
                pair: Pair | None = p.dwell_time, p.ones * p.time[:, None]
            else:
                pair = MEASURES_BY_NAME[measure].numerator_denominator(p)
            assert pair is not None
            pairs.append(pair)
        if len(pairs) == 1:
            return pairs[0]
        # To no error, as in `nerg_mi.aoi.tracker_error`; denominators are those of the samples without an added error.
        half = len(pairs) // 2
        once, twice = (np.mean([x for x, _ in part], axis=0) for part in (pairs[1 : half + 1], pairs[half + 1 :]))
        return 3 * pairs[0][0] - 3 * once + twice, pairs[0][1]


def _pair_cells(cells: Iterable[Cell]) -> list[tuple[Cell, Cell]]:
    """Return pairs of cells of the same dimension."""
    recorded = [cell for cell in cells if cell != ALL]
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
    viewpoints: Annotated[int, Range(1, 100_000)] = 64,
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
    tolerances, alignment, samples or fixations, weights of participants, and correction of the tracker's error. With
    gaze fields, repeats that of their predictions: seeds, weight of the prior, and the choices that apply. Reports in
    how many analyses each conclusion holds, and which choice decides most.

    Parameters
    ----------
    inputs : object, path or sequence of these
        Rays or a dataset, an environment, and gaze fields of several seeds, in any order. With gaze fields, predictions
        are tested, for the recorded positions.
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
        Table of the errors of the eye tracker by participant in degrees, as for nerg stats; they replace accuracy and
        precision.
    windows : mapping, optional
        Start and end of a time window by its name, NAME=FROM,TO in seconds of the rays' clock; windows are compared;
        repeatable.
    zones : Areas, path or mapping, optional
        JSON file of boxes on the floor; observers in different boxes are compared.
    viewpoints : int
        Approximate number of viewpoints of predictions, as for ``nerg stats``.
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
    items = list_inputs(inputs)
    gaze_inputs = [item for item in items if find_role(item) == "gaze"]
    chosen, align = open_inputs([item for item in items if not any(item is other for other in gaze_inputs[1:])], align)
    if chosen.rays is None and not gaze_inputs:
        raise NergError("there is nothing to analyse: give rays, or gaze fields")
    areas = Areas.open(aois, "aois")
    counting, counting_files = open_counting(Counting(rules, error=error), windows, zones, cohorts, validation)
    files = [*existing_files(*chosen, *gaze_inputs[1:], *areas.files, align), *counting_files]
    matrix = None if align is None else open_similarity(align, "rays to scene").matrix.tolist()
    if align is not None and not isinstance(align, (str, os.PathLike)):
        changed["align"] = matrix
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        placed = open_placed_areas(chosen.environment, chosen.gaze, areas, align, sampling)
        if gaze_inputs:
            gaze_fields = _open_gaze_fields([chosen.gaze, *gaze_inputs[1:]])
            plain = replace(counting, error=TrackerError(), validation=None)
            observed = None if chosen.rays is None else open_recordings(chosen.rays)
            measured = AttentionAnalysis(
                placed, observed, plain, None, MinParticipantsFilter(), resamples, seed, reporter
            ).measure(viewpoints, None, ObserverGrid())
            is_recorded, networks = observed is not None, list_networks(gaze_fields)
            sigma = counting.disturbance.sigma if counting.has_error else 0.0
            base: Analyses | Predictions = Predictions(
                placed, networks, measured.viewpoints, is_recorded, sigma, measured.times
            )
            warn_unused_fixation_part(counting, None, reporter)
        else:
            assert chosen.rays is not None
            gaze_fields, base = [], Analyses(placed, open_rays(chosen.rays), counting)
            counting.disturbance.check_participants(base.rays.persons, reporter)
            warn_unused_fixation_part(counting, base.rays, reporter)
        for note in placed.warnings:
            reporter.message(note)
        choices = _adapt_choices(choices, base, align, reporter)
        changed |= _describe_fixations(base, choices) | describe_tracker_fixations(error)
        reference, num_fields = base.get_reference(), len(base.networks) - 1 if isinstance(base, Predictions) else 0
        rngs = (np.random.default_rng((seed, k)) for k in range(analyses))
        drawn = [draw_choices(choices, reference.keys(), num_fields, rng) for rng in rngs]
        table = [reference, *drawn]
        reporter.progress(0.0, "analyses")
        if parallel.in_parts:
            runner = PartRunner(parallel, None, reporter)
            results = _compute_in_parts(base, chosen.environment, gaze_fields, areas, matrix, table, runner)
        else:
            results = _compute_in_process(base, table, reporter)
        names = placed.areas.names
        single = np.isin(np.arange(len(names)), AoiContext(placed, counting).transition_areas)
        evaluation = Evaluation(names, placed.members, single, resamples, seed)
        ranks, estimates = dict[str, np.ndarray](), []
        # Strict, so that the results end before the conclusions are counted.
        for choice, result in zip(table, results, strict=True):
            people = base.find_people(result, choice)
            if not estimates:
                ranks = evaluation.rank(people, choice)
                report_values_without_comparison(people, MAX_PAIRED, reporter)
            estimates.append(evaluation.evaluate(people, choice, ranks))
        result = conclusion_rows(estimates, drawn, PREDICTED if gaze_inputs else MEASURED)
        provenance = make_provenance("nerg robustness", files, seed, changed | {"mode": mode})
        result = replace(result, provenance=provenance)
        for line in result.verdict.splitlines():
            reporter.message(line)
    return result


def _open_gaze_fields(inputs: Sequence[Any]) -> list[GazeField]:
    """Open gaze fields. Raises `NergError` if the training of one had another environment than that of the first."""
    gaze_fields = [GazeField.open(item) for item in inputs]
    checksums = [(find_environment_record(f.provenance) or {}).get("sha256") for f in gaze_fields]
    for gaze_field, checksum in zip(gaze_fields, checksums):
        if checksum != checksums[0]:
            raise NergError(
                f"{gaze_field.label} was trained in another environment than {gaze_fields[0].label}; give fields that "
                "differ in their seeds or settings"
            )
    return gaze_fields


def _adapt_choices(choices: Choices, base: Analyses | Predictions, align: Any, reporter: Reporter) -> Choices:
    """Return the choices that the inputs allow: those of alignment, boxes, and recordings or gaze fields."""
    turn, shift = _read_uncertainty(align)
    choices = replace(
        choices,
        rotation=turn if choices.rotation is None else choices.rotation,
        shift=shift if choices.shift is None else choices.shift,
    )
    if not base.placed.areas.boxes:
        choices = replace(choices, growth=(0.0, 0.0))
    if isinstance(base, Predictions):
        return _adapt_to_fields(choices, base, reporter)
    return _adapt_to_rays(choices, base, reporter)


def _adapt_to_fields(choices: Choices, base: Predictions, reporter: Reporter) -> Choices:
    configs = [network.config for network in base.networks[1:]]
    if len(configs) == 1:
        reporter.message(
            "seeds are not varied, because there is one gaze field: give several, or train an ensemble "
            "(nerg train gaze --ensemble 5)"
        )
    if not base.is_recorded:
        choices = replace(choices, weighting=("participants",))
    if not base.sigma > 0:
        choices = replace(choices, tracker=("ignored",))
    if not all(config.prior for config in configs):
        if choices.prior_weight is not None:
            raise NergError("a gaze field has no prior, whose weight could be varied; leave out prior_weight")
        return choices
    if choices.prior_weight is None:
        weights = [config.mix for config in configs]
        ends = (
            odds * weight / (1 - weight + odds * weight) for odds, weight in ((0.5, min(weights)), (2, max(weights)))
        )
        choices = replace(choices, prior_weight=tuple(ends))
    return choices


def _adapt_to_rays(choices: Choices, base: Analyses, reporter: Reporter) -> Choices:
    if not base.counting.has_error:
        choices = replace(choices, tracker=("ignored",))
    if "fixations" not in choices.samples:
        return choices
    rays, reason = base.rays, ""
    if rays.tracking in ("head", "mixed"):
        reason = f"the rays are {TRACKING[rays.tracking]}"
    else:
        warn_unknown_tracking(rays.tracking, reporter.warn)
        strictest = _make_rules({"velocity": choices.velocity[0], "min_fixation": choices.min_fixation[1]})
        label, _ = label_fixations(rays, strictest)
        without = rays.select(~np.isin(rays.person, rays.person[label >= 0]))
        if len(without):
            remedy = f"{parameter('fixations', 'ivt')} and a larger {parameter('max_step')} of nerg rays filter"
            slow = describe_slow_sampling(without, strictest)
            how = (
                f" ({slow}; select them before, with {remedy})"
                if slow
                else f" below {choices.velocity[0]:g} degrees per second"
            )
            reason = f"{len(np.unique(without.person)):,} participants have no fixation{how}"
    if not reason:
        return choices
    if "all" not in choices.samples:
        raise NergError(f"fixations cannot be selected, because {reason}; add all to the samples of the choices")
    reporter.message(f"all samples count in each analysis, because {reason}")
    return replace(choices, samples=("all",))


def _describe_fixations(base: Analyses | Predictions, choices: Choices) -> dict[str, Any]:
    """Return the definitions of the fixations that the rays were reduced to, and of those that are drawn."""
    if isinstance(base, Predictions):
        return {}
    drawn = EventRules().describe() | {"velocity": choices.velocity, "min_fixation": choices.min_fixation}
    return read_fixations(base.rays.metadata) | ({"drawn_fixations": drawn} if "fixations" in choices.samples else {})


def _read_uncertainty(align: Any) -> tuple[float, float]:
    """Return twice the standard deviations of an alignment in degrees and metres, or the ends of its interval; zeros
    if they are unknown."""
    if isinstance(align, (str, os.PathLike)):
        align = Alignment.load(to_path(align))
    uncertainty = align.uncertainty or {} if isinstance(align, Alignment) else {}
    if "turn_degrees" in uncertainty:
        return float(np.abs(uncertainty["turn_degrees"]).max()), uncertainty["shift_cm"] / 100
    return 2.0 * uncertainty.get("degrees", 0.0), 2.0 * uncertainty.get("cm", 0.0) / 100


def _compute_in_process(base: Analyses | Predictions, table: Sequence[Row], reporter: Reporter) -> Iterator[Any]:
    """Yield the result of each analysis, computed in this process."""
    with Interruption() as stop:
        for k, choice in enumerate(table):
            yield base.compute(choice, _OneAnalysis(stop, reporter, k, len(table)))
            stop.check()


@dataclass(frozen=True)
class _OneAnalysis(SilentReporter):
    """Reports the progress of one of ``count`` analyses, and stops it after Ctrl-C."""

    stop: Interruption
    reporter: Reporter
    number: int
    count: int

    def progress(self, fraction: float, text: str = "") -> None:
        self.stop.check()
        done = f"{self.number} of {self.count - 1} analyses"
        self.reporter.progress((self.number + fraction) / self.count, done)


def _compute_in_parts(
    base: Analyses | Predictions,
    environment: Any,
    gaze_fields: Sequence[GazeField],
    areas: Areas,
    align: Any,
    table: Sequence[Row],
    runner: PartRunner,
) -> Iterator[Any]:
    """Yield the result of each analysis, computed in parts."""
    with runner.store.make_scratch_folder() as folder:
        file, _ = save_objects(environment, None, folder)
        files = tuple(
            gaze_field.path or gaze_field.save(make_folder(folder / str(k)) / "gaze.safetensors")
            for k, gaze_field in enumerate(gaze_fields)
        )
        job, sampling = f"nerg robustness {runner.store.folder.absolute()}", base.placed.sampling
        planner = PartitionedStatistics(runner, job, file, files[0] if files else None, areas, align, sampling)
        parts = [Part(choice, f"analysis {k}" if k else "the reference") for k, choice in enumerate(table)]
        if isinstance(base, Predictions):
            poses = ObserverPoses(base.viewpoints.positions, base.viewpoints.facing)
            planned = planner.plan_areas("margin", "aoi_samples", "directions")
            common: Any = PlannedPredictions(planned, files, poses, base.is_recorded, base.sigma)
            for output in runner.run(planner.make_plan(job, predict_analysis, common, parts)):
                yield read_prediction(output.path)
        else:
            base.rays.save(folder / "rays.npz")
            planned = planner.plan_areas("tolerance", "margin", "aoi_samples", "cell_size")
            common = PlannedAnalyses(planned, folder / "rays.npz", base.counting)
            for output in runner.run(planner.make_plan(job, count_analysis, common, parts)):
                yield read_sums(output.path)[0]
