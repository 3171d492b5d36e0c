"""Fit and evaluation of the density of a participant's next look."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.scene import AnyEnvironment
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_folder, file_sha256, make_folder, write_text
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.tables import add_notes, write_csv, write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import SEEDS, Range, check_number, check_ranges
from nerg_mi.tracking.filters import split_by_person
from nerg_mi.tracking.probes import compute_participant_weights
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.prior import select_prior_kappa
from nerg_mi.transport.extrapolation import warn_extrapolation
from nerg_mi.transport.geometry import SURFACE_OPACITY, trace_depth
from nerg_mi.transport.observer_gaze import GazeFieldInstance

from .baselines import UNIFORM_DENSITY, Baseline, make_prior_baseline
from .gaze import EPS, FieldDensity, format_score_table
from .gaze_report import explain_missing, format_table
from .held_out import open_training_rays
from .next_look import (
    GRID_DIRECTIONS,
    HEAD_METHODS,
    METHODS,
    LookSample,
    NextLook,
    PastLooks,
    RayDistance,
    evaluate_on_grid,
    find_heads,
    find_past_looks,
    measure_gaze_in_head,
    score_next_look,
)

_ELAPSED = (0.2, 1.0, 2.0, 5.0)  # seconds
_NOWHERE = np.zeros((1, 3))  # the position of a density that does not depend on it
_MIN_LOOKS = 16  # per elapsed time
_COLUMNS = ("elapsed", "method", "looks", "bits", "gap")


@dataclass(frozen=True, repr=False)
class NextLookEvaluation(ResultTables):
    """A fitted model of the next look, and its scores."""

    TABLES = ("rows",)

    model: NextLook
    # One row for each elapsed time and method (`evaluation.next_look.score_next_look`).
    rows: list[dict[str, Any]]
    # Number of participants that the weights were fitted to, and of held-out participants.
    fitted: int
    scored: int
    # Concentration of the kernels of the position-independent prior.
    prior_kappa: float
    # Written tables and weights.
    files: list[Path]
    gaze: str  # Name of the field, and the checksum of its file, if it has one
    gaze_sha256: str | None

    def save(self, folder: FilePath) -> list[Path]:
        """Write next.md, next.csv (the scores) and next.json, which has the model, too, to ``folder``, and return their
        paths. Raises `NergError` if they cannot be written."""
        folder, model = make_folder(to_path(folder)), self.model
        files = [folder / name for name in ("next.md", "next.csv", "next.json")]
        weights = [
            {"component": str(component), **{f"{t:g} s": float(w) for t, w in zip(model.knots, row)}}
            for component, row in zip(model.components, model.weights.T)
            if row.max() >= 0.01
        ]
        title = "the next look" if model.gaze_in_head is None else "gaze given the direction of the head"
        notes = (
            f"# {self.gaze}: {title}\n\nWeights fitted to {self.fitted} participants, scores of {self.scored} "
            "others, at held-out positions; each zone of these is scored with weights from the other zones. Elapsed "
            "times in seconds; bits per look above the position-independent prior with kappa "
            f"{self.prior_kappa:g}; gap: bits of the first method above the method. Brackets: ± 1.96 standard errors "
            "from resampled participants.\n\n"
        )
        table = format_table([{**row, "elapsed": f"{row['elapsed']:g} s"} for row in self.rows], _COLUMNS)
        columns = tuple(weights[0])
        write_text(files[0], f"{notes}{table}\n## Weights of at least 1 %\n\n{format_table(weights, columns)}")
        write_csv(files[1], self.rows)
        summary: dict[str, Any] = {"gaze": self.gaze, "fitted": self.fitted, "scored": self.scored}
        if self.gaze_sha256 is not None:
            summary["gaze_sha256"] = self.gaze_sha256
        write_json(files[2], summary | {"prior_kappa": self.prior_kappa, "rows": self.rows, "model": model.to_json()})
        return files


@check_ranges
def next_look(
    gaze: GazeField | FilePath,
    rays: Rays | FilePath,
    environment: AnyEnvironment | FilePath = None,
    *,
    elapsed: Sequence[float] | None = None,
    earlier: Annotated[int, Range(0, 10_000)] = 120,
    head: bool = False,
    max_looks: Annotated[int, Range(16, 10**6)] = 500,
    resamples: Annotated[int, Range(0, 10**5)] = 200,
    seed: Annotated[int, SEEDS] = 0,
    output: FilePath | None = None,
    progress: Progress = None,
) -> NextLookEvaluation:
    """Predict where a participant looks next from the last looks, the elapsed time and a gaze field; score held-out
    participants at held-out positions.

    The weights of the prediction are fitted to training participants at held-out positions, where the field was not
    trained: its weight would be too high elsewhere. Scores in a zone use weights that were fitted in the other zones,
    the model uses all. The looks that precede are those of the same recording, anywhere. Looks without a recorded hit
    point end at the first surface of the environment, if there is one.

    Parameters
    ----------
    gaze : GazeField or path
        Gaze field that was trained with ``test_zones`` and ``test_participants`` (.safetensors).
    rays : Rays or path
        Rays file or dataset that it was trained on.
    environment : object or path, optional
        What it was trained in; hits or none, as in the training, select what is stored. Default: the file of the same
        name, next to the gaze field.
    elapsed : sequence of float, optional
        Comma-separated times in seconds between the last look and the next one, increasing. Default: 0.2,1,2,5.
    earlier : int
        Number of looks before the last one that a participant may return to, half a second apart.
    head : bool
        Predict gaze from the direction of the head at the same time, in place of earlier looks.
    max_looks : int
        Maximum number of looks that determine the weights, and of looks that are scored.
    resamples : int
        Number of bootstrap resamples of the participants for confidence intervals; 0 computes none.
    seed : int
        Seed of the random numbers for selected looks and bootstrap resamples.
    output : path, optional
        Folder for tables and weights.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    NextLookEvaluation
        Scores (``rows``), and the ``model`` (`nerg_mi.evaluation.next_look.NextLook`), whose method ``sample``
        simulates the looks of a participant along a trajectory.

    Raises
    ------
    NergError
        No positions or no participants were held out, there are too few looks or no heads, or the rays or the
        environment are not those of the training.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "test_participants": 0.5, "validation_zones": 0}
    >>> gaze = nerg.train_gaze(rays, "none", **held_out, steps=2, probes=8, directions=64, min_rays=8)
    >>> result = nerg.next_look(gaze, rays, elapsed=(1.0, 4.0), earlier=5, max_looks=32)
    >>> result.rows[0]["method"], result.model.knots.tolist()
    ('next look', [1.0, 4.0])
    >>> walk = [(1.0 + 0.5 * t, 2.0, 1.6) for t in range(4)]
    >>> result.model.sample(range(4), walk, gaze.density).shape
    (4, 3)
    """
    if head and elapsed is not None:
        raise NergError(
            f"{parameter('head', True)} predicts gaze at the same time, so that {parameter('elapsed')} does not "
            "apply; leave out one"
        )
    knots = (1.0,) if head else _ELAPSED if elapsed is None else tuple(elapsed)
    for time in knots:
        check_number(time, Range(1e-3, 1e4), parameter("elapsed"))
    if not knots or not (np.diff(knots) > 0).all():
        raise NergError(f"{parameter('elapsed')} needs increasing times in seconds, as 0.2,1,5, got {list(knots)}")
    folder = None if output is None else to_path(output)
    if folder is not None:
        check_folder(folder)
    with open_reporter(progress) as reporter:
        loaded = GazeField.open(gaze)
        data = open_training_rays(loaded, rays)
        if not loaded.provenance["test"].get("people"):
            raise NergError(
                f"{loaded.label} held out no participants to score; train with {parameter('test_participants', 0.5)}"
            )
        opened = loaded.open_environment(environment)
        result = _evaluate(loaded, data, opened, knots, earlier, head, max_looks, resamples, seed, reporter)
        if folder is not None:
            result = replace(result, files=result.save(folder))
        rows = [
            {"elapsed": f"{row['elapsed']:g} s", **{k: row.get(k, math.nan) for k in _COLUMNS[1:]}}
            for row in result.rows
        ]
        reporter.message(format_score_table(rows, f"{loaded.name}: {result.scored} held-out participants"))
        for path in result.files:
            reporter.message(f"wrote {path}")
    return result


def _evaluate(
    gaze: GazeField,
    data: Rays,
    environment: Environment,
    knots: tuple[float, ...],
    earlier: int,
    head: bool,
    max_looks: int,
    resamples: int,
    seed: int,
    reporter: Reporter,
) -> NextLookEvaluation:
    """Fit and score the next look for elapsed times ``knots``; parameters as of `next_look`."""
    from scipy.spatial import KDTree

    loaded, training = gaze.network, gaze.provenance
    holdout = training["test"]
    field = FieldDensity(
        loaded, environment.medium, environment.align, training.get("probes", {}).get("depth", "median")
    )
    is_held_out = split_by_person(data, test_persons=holdout["people"])[1]
    distance_to_centre, centre = KDTree(holdout["centres"]).query(data.origin)
    # The training of the field has no rays of anybody in the larger range.
    is_near = distance_to_centre <= holdout["purged_within"]
    train = data.select(~is_held_out & ~is_near)
    gaze_in_head = measure_gaze_in_head(train) if head else None
    is_usable = find_heads(data) if head else np.ones(len(data), bool)
    zone = np.array(holdout.get("zone", np.zeros(len(holdout["centres"]))), int)[centre]
    rng = np.random.default_rng(seed)
    rows = [
        np.sort(rng.permutation(np.flatnonzero(mask & is_usable))[:max_looks])
        for mask in (~is_held_out & is_near, is_held_out & (distance_to_centre <= holdout["radius"]))
    ]
    if min(map(len, rows)) < _MIN_LOOKS:
        raise NergError(
            f"only {len(rows[0])} looks of training participants and {len(rows[1])} of others are near held-out "
            f"positions; train with more {parameter('test_zones')} or a larger {parameter('radius')}"
        )
    if len(np.unique(zone[rows[0]])) < 2:
        reporter.warn(
            "the weights are fitted in the only zone of held-out positions and scored there; for scores in new "
            f"zones, train with {parameter('test_zones', 3)}"
        )
    eyes = environment.points_to_field(data.origin[np.concatenate(rows)])
    warn_extrapolation(reporter.warn, environment.scene_geometry, GazeFieldInstance(loaded), eyes)
    reporter.progress(0.0, "prior")
    kappa = select_prior_kappa(train, "person", seed)
    prior = make_prior_baseline(train, kappa=kappa, weights=compute_participant_weights(train))
    distance = make_ray_distance(environment)

    def find_past(selected: np.ndarray, elapsed: float) -> tuple[PastLooks, np.ndarray]:
        if gaze_in_head is None:
            return find_past_looks(data, selected, elapsed, earlier=earlier, distance=distance)
        return PastLooks.from_heads(data.origin[selected], np.asarray(data.head)[selected], gaze_in_head), selected

    samples = []
    for number, selected in enumerate(rows):
        reporter.progress(0.1 + 0.4 * number, "looks")
        samples.append(_sample_looks(data, selected, zone[selected], field, prior, find_past, knots))
    reporter.progress(0.9, "scores")
    fit, scored = samples
    methods = HEAD_METHODS if head else METHODS
    model, table = score_next_look(fit, scored, knots, resamples, seed, methods)
    if head:
        model, table = replace(model, gaze_in_head=gaze_in_head), [{**row, "elapsed": 0.0} for row in table]
    add_notes(table, explain_missing)
    people = [len(np.unique(sample.person)) for sample in samples]
    sha256 = None if gaze.path is None else file_sha256(gaze.path)
    return NextLookEvaluation(model, table, people[0], people[1], kappa, [], gaze.name, sha256)


def _sample_looks(
    rays: Rays,
    rows: np.ndarray,
    zone: np.ndarray,
    field: FieldDensity,
    prior: Baseline,
    find_past: Callable[[np.ndarray, float], tuple[PastLooks, np.ndarray]],
    knots: Sequence[float],
) -> LookSample:
    """Collect the rays ``rows`` (N,) in ``zone`` (N,) for each elapsed time of ``knots``, with what precedes them and
    the densities of the field and the prior."""
    pasts, parts, numbers = [], [], []
    for number, elapsed in enumerate(knots):
        past, matched = find_past(rows, elapsed)
        if len(matched) < _MIN_LOOKS:
            raise NergError(
                f"only {len(matched)} of {len(rows)} looks have another one {elapsed:g} s before; change "
                f"{parameter('elapsed')}"
            )
        pasts.append(past)
        parts.append(matched)
        numbers.append(np.full(len(matched), number))
    density = field.evaluate_rays(rays.origin[rows], rays.direction[rows])
    on_grid = evaluate_on_grid(field.evaluate_rays, rays.origin[rows])
    prior_density = prior(_NOWHERE, rays.direction[rows])[0] + EPS * UNIFORM_DENSITY
    prior_on_grid = prior(_NOWHERE, fibonacci_directions(GRID_DIRECTIONS))
    at = np.searchsorted(rows, np.concatenate(parts))
    return LookSample(
        PastLooks.concatenate(pasts),
        rays.direction[rows[at]],
        rays.person[rows[at]],
        np.concatenate(numbers),
        zone[at],
        (density[at], on_grid[at]),
        (prior_density[at], np.broadcast_to(prior_on_grid, (len(at), GRID_DIRECTIONS))),
    )


def make_ray_distance(environment: Environment) -> RayDistance | None:
    """Return the distance in metres to the first surface of a geometry along rays; None without geometry."""
    medium = environment.medium
    if medium is None:
        return None

    def measure(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        points, vectors = environment.points_to_field(origins), environment.directions_to_field(directions)
        depth, opacity = trace_depth(medium, points, vectors)
        return np.where(opacity >= SURFACE_OPACITY, depth / environment.align.scale, np.inf)

    return measure
