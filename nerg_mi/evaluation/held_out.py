"""Evaluation of a gaze field at held-out positions and of held-out participants, compared with baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.scene import AnyEnvironment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import tracking_suffix
from nerg_mi.figures.style import changed_arguments, existing_files, make_provenance
from nerg_mi.files.atomic import check_folder, file_sha256, make_folder
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.tables import add_notes
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import DIRECTIONS, KAPPAS, SEEDS, Range, check_ranges
from nerg_mi.tracking.dataset import hash_rays, open_rays
from nerg_mi.tracking.event_settings import read_fixations
from nerg_mi.tracking.filters import purge, split_by_person
from nerg_mi.tracking.rays import TRACKING, Rays
from nerg_mi.tracking_kinds import read_tracking
from nerg_mi.train.gaze import check_environment
from nerg_mi.train.gaze_data import find_hit_points
from nerg_mi.train.prior import ELEVATION_PRIOR, select_prior_kappa

from . import gaze as evaluation
from .baselines import (
    NEAREST_RAYS,
    REAIMED_HITS,
    STACK,
    Baseline,
    CachedBaseline,
    TunedBaseline,
    format_settings,
    make_tuned_baselines,
)
from .baselines import PRIOR as PRIOR_BASELINE
from .gaze import EPS, SCORES, SPLIT_HALF, FieldDensity
from .gaze_report import compute_verdict, draw_comparison, explain_missing, write_report
from .position_scores import choose_tunings, format_verdicts, iter_region_levels, score_kinds
from .uncertainty import correlate_uncertainty, measure_calibration, measure_coverage, score_positions

_FIELD = "gaze field"  # Name of the method that is compared with the baselines
# Methods that are scored for each participant, those that are drawn, and those whose highest-density regions are
# calibrated; re-aimed hits only with surfaces.
_BY_PERSON = (_FIELD, NEAREST_RAYS, REAIMED_HITS)
_DRAWN = (_FIELD, PRIOR_BASELINE, NEAREST_RAYS, REAIMED_HITS, STACK)
_CALIBRATED = (_FIELD, PRIOR_BASELINE, NEAREST_RAYS)
# Scores in the terminal; the files have all of them.
PRINTED = tuple(score for score in SCORES if score not in ("SIM", "MAE", "loglik"))


@dataclass(frozen=True, repr=False)
class GazeEvaluation(ResultTables):
    """Scores of a gaze field."""

    TABLES = ("rows", "persons", "by_position", "uncertainty", "calibration", "verdicts")

    # One row per method, the gaze field first; scores of `gaze.SCORES`, confidence limits with ".low" and ".high".
    rows: list[dict]
    # One row per method and participant.
    persons: list[dict]
    # What was held out: "both", "pos" or "people".
    split: str
    # Number of test positions and of participants in the test.
    positions: int
    people: int
    # Written tables and figures.
    files: list[Path]
    # One row per position: error and uncertainty (`score_positions`).
    by_position: list[dict[str, Any]] = field(default_factory=list)
    # One row per uncertainty signal and error: how well it ranks errors (`correlate_uncertainty`).
    uncertainty: list[dict[str, Any]] = field(default_factory=list)
    # One row per method: coverage of its highest-density regions (`measure_calibration`).
    calibration: list[dict[str, Any]] = field(default_factory=list)
    split_half_note: str = ""  # Why there is no row of the split half
    kappa: float = 20.0  # Concentration of the kernels of reference densities
    tracking: str = "unknown"  # What was tracked, of `nerg_mi.tracking.rays.TRACKING`
    gaze: str = ""  # Name of the field, and the checksum of its file, if it has one
    gaze_sha256: str | None = None
    resamples: int = 0  # Resamples of the participants for confidence intervals
    introduction: str = ""  # What the scores are, in Markdown
    # Writes the figure of reference and predicted densities; None without one.
    draw: Callable[[Path], None] | None = field(default=None, compare=False)
    # Bits of the field and of baselines where training participants stood, and where none did (`score_kinds`).
    verdicts: list[dict[str, Any]] = field(default_factory=list)
    # Definition of the fixations that the rays were reduced to (`read_fixations`).
    fixations: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Whether the field is useful, and its lead over the best baseline where people stood and elsewhere, in short
        sentences, one a line."""
        verdict = compute_verdict(self.rows, self.split, self.people, self.positions)
        return "\n".join([verdict.sentence, *format_verdicts(self.verdicts)])

    def save(self, folder: FilePath) -> list[Path]:
        """Write tables and figures to ``folder``, and return their paths.

        These are gaze.md, gaze.csv (by method), persons.csv (by participant), gaze.json, positions.csv (by position)
        and, unless it was evaluated with ``pictures=0``, positions.png. Raises `NergError` if they cannot be written.
        """
        folder = make_folder(to_path(folder))
        summary = {
            "gaze": self.gaze,
            **({} if self.gaze_sha256 is None else {"gaze_sha256": self.gaze_sha256}),
            "tracking": self.tracking,
            **self.fixations,
            "split": self.split,
            "kappa": self.kappa,
            "positions": self.positions,
            "people": self.people,
            "resamples": self.resamples,
            "split_half": next((row for row in self.rows if row["method"] == SPLIT_HALF), None),
            "split_half_note": self.split_half_note,
        }
        tables = self.by_position, self.uncertainty, self.calibration
        files = write_report(folder, self.rows, self.persons, summary, self.introduction, *tables, self.verdicts)
        if self.draw is not None:
            self.draw(folder / "positions.png")
            files.append(folder / "positions.png")
        return files


@check_ranges
def evaluate_gaze(
    gaze: GazeField | FilePath,
    rays: Rays | FilePath,
    environment: AnyEnvironment | FilePath = None,
    *,
    split: Literal["both", "pos", "people"] | None = None,
    kappa: Annotated[float, KAPPAS] = 20.0,
    prior_kappa: Annotated[float, KAPPAS] | None = None,
    directions: Annotated[int, DIRECTIONS] = 2048,
    min_rays: Annotated[int, Range(1, 10**6)] = 64,
    resamples: Annotated[int, Range(0, 10**5)] = 200,
    pictures: Annotated[int, Range(0, 10000)] = 4,
    seed: Annotated[int, SEEDS] = 0,
    output: FilePath | None = None,
    progress: Progress = None,
) -> GazeEvaluation:
    """Score a gaze field on held-out data and compare it with baselines: uniform, position-independent, nearest rays,
    conditional kernel density, re-aimed hits, a stack of kernels, and the other half of the participants.

    The held-out data chose nothing of the field. The baselines are tuned on folds of the training rays, with zones of
    positions left out and without, and the better of the two is scored, which favours the baselines. An alignment that
    nerg align fitted to hit points or traces of gaze used the rays of all participants, and the defaults of the recipe
    were chosen in other trainings, some of them in public recordings.

    Parameters
    ----------
    gaze : GazeField or path
        Gaze field that was trained with ``test_zones`` (.safetensors).
    rays : Rays or path
        Rays file or dataset that it was trained on.
    environment : object or path, optional
        What it was trained in; hits or none, as in the training, select what is stored. Default: the file of the same
        name, next to the gaze field.
    split : str, optional
        Held-out data to score on: both (new participants at new positions), pos (new positions) or people (new
        participants). Default: both if participants were held out, else pos.
    kappa : float or str
        Concentration (unitless), or standard deviation such as 13deg, of the von Mises-Fisher kernels that turn test
        rays into reference densities.
    prior_kappa : float or str, optional
        Concentration (unitless), or standard deviation such as 10deg, of the kernels of the position-independent prior,
        against which information gain is measured in bits. Default: chosen by leaving out participants.
    directions : int
        Number of directions on the sphere at which densities are compared.
    min_rays : int
        Minimum number of rays around a test position.
    resamples : int
        Number of bootstrap resamples of the participants for confidence intervals; 0 computes none.
    pictures : int
        Number of test positions in the figure that compares reference and predicted densities; 0 draws no figure.
    seed : int
        Seed of the random numbers for sampled rays, bootstrap resamples and split halves.
    output : path, optional
        Folder for tables and figures.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    GazeEvaluation
        Scores of the field and the baselines.

    Raises
    ------
    NergError
        Nothing was held out of the training, or the rays or the environment are not those of the training.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "validation_zones": 0}
    >>> gaze = nerg.train_gaze(rays, "none", **held_out, steps=2, probes=8, directions=64)
    >>> scores = nerg.evaluate_gaze(gaze, rays, directions=64, resamples=2, min_rays=8)
    >>> scores.rows[0]["method"], scores.split
    ('gaze field', 'pos')
    """
    arguments = dict(locals())
    folder = None if output is None else to_path(output)
    if folder is not None:
        check_folder(folder)
    with open_reporter(progress) as reporter:
        loaded = GazeField.open(gaze)
        training = loaded.provenance
        data = open_training_rays(loaded, rays)
        account = training["test"]
        tracking = read_tracking(training)
        if tracking == "unknown":  # as in checkpoints of earlier versions, but the rays may state it
            tracking = data.tracking
        split = split or ("both" if account.get("people") else "pos")
        reporter.progress(0.0, "test")
        train, scored, centres = evaluation.select_held_out_rays(data, account, split, seed)
        test = evaluation.make_test(scored, centres, account["radius"], kappa, directions, min_rays, seed=seed)
        opened = loaded.open_environment(environment)
        # A field that was trained with ``force`` is scored, with a warning.
        check_environment(opened, scored, True, reporter)
        reporter.progress(0.02, "baselines")
        hits = find_hit_points(train, opened)
        # All baselines that are tuned here have the same prior.
        prior_kappa = prior_kappa or select_prior_kappa(train, "person", seed)
        tunings = _tune_baselines(train, account["radius"], hits, prior_kappa, split, seed)
        baselines = choose_tunings(tunings, test.own_origins, test.own_directions, test.own_participants)
        depth, count = training.get("probes", {}).get("depth", "median"), len(test.centres)
        # Much of the time is spent on evaluating the field.
        report_position = lambda number: reporter.progress(
            0.05 + 0.35 * min(number / count, 1), f"position {number} of {count}"
        )
        # All tables use the same densities.
        members = CachedBaseline(
            FieldDensity(loaded.network, opened.medium, opened.align, depth, report_position).members
        )
        field_density = lambda positions, directions: members(positions, directions).mean(axis=0)
        methods = {_FIELD: field_density, **{name: b.density for name, b in baselines.items()}}
        prior = methods[PRIOR_BASELINE]
        reporter.progress(0.05, "scores")
        report_share = lambda share: reporter.progress(0.4 + 0.45 * share, "scores") if share > 0 else None
        rows = evaluation.score_methods(test, methods, prior, resamples, seed, report_share)
        half, half_note = evaluation.score_split_half(
            scored, test.centres, account["radius"], kappa, prior, min_rays, seed, resamples
        )
        rows += [half] if half else []
        if half_note:
            reporter.message(f"the split half is not shown: {half_note}")
        reporter.progress(0.85, "recorded and new positions")
        density = FieldDensity(loaded.network, opened.medium, opened.align, depth)
        held_out = _select_all_held_out(data, account)
        verdicts = score_kinds(train, held_out, density, tunings, seed)
        reporter.progress(0.88, "participants")
        select = lambda names: {name: methods[name] for name in names if name in methods}
        persons = evaluation.score_participants(test, select(_BY_PERSON), prior, min_rays)
        reporter.progress(0.9, "uncertainty")
        places = _positions(test, loaded, opened, members, prior, _groups(account, split, test.centres), seed)
        ranks = correlate_uncertainty(places, resamples, seed)
        at = lambda method: method(test.centres, test.query_directions)[:, : test.sample_directions.shape[1]]
        calibrated = {k: (m(test.centres, test.directions), at(m)) for k, m in select(_CALIBRATED).items()}
        stored = training.get("mix", {}).get("regions")
        regions = measure_calibration(test, calibrated, resamples, seed, {_FIELD: stored} if stored else None)
        for kind, levels, of_kind in iter_region_levels(train, held_out, density.evaluate_rays, seed):
            people, person = np.unique(of_kind.person, return_inverse=True)
            regions += measure_coverage(f"{_FIELD}, {kind}", levels, person, len(people), resamples, seed, stored)
        for table in (rows, persons, places, ranks, regions, verdicts):
            add_notes(table, explain_missing)
        numbers = len(train), len(data), account["radius"], kappa, directions, resamples
        notes = _notes(loaded.name, split, test, *numbers, half_note)

        def draw(path: Path) -> None:
            sources = existing_files(loaded.path, rays, opened.path)
            settings = changed_arguments(evaluate_gaze, arguments) | read_fixations(data.metadata)
            record = make_provenance("nerg eval gaze", sources, seed, settings)
            draw_comparison(test, select(_DRAWN), path, pictures, provenance=record)

        result = GazeEvaluation(
            rows,
            persons,
            split,
            len(test.centres),
            len(test.participants),
            [],
            places,
            ranks,
            regions,
            half_note,
            kappa,
            tracking,
            loaded.name,
            None if loaded.path is None else file_sha256(loaded.path),
            resamples,
            f"{notes} Tracking: {TRACKING[tracking]}. {format_settings(baselines)}",
            draw if pictures else None,
            verdicts,
            read_fixations(data.metadata),
        )
        if folder is not None:
            reporter.progress(0.95, "pictures")
            result.files.extend(result.save(folder))
        _report(loaded, result, reporter)
    return result


def _select_all_held_out(rays: Rays, account: dict) -> Rays:
    """Select all rays of the held-out participants, or, if none were held out, rays of the training participants at the
    held-out positions."""
    if account.get("people"):
        return rays.select(split_by_person(rays, test_persons=account["people"])[1])
    return rays.select(~purge(rays, np.array(account["centres"]), account["radius"]))


def _tune_baselines(
    train: Rays, radius: float, hits: np.ndarray | None, prior_kappa: float, split: str, seed: int
) -> list[dict[str, TunedBaseline]]:
    """Tune the baselines in folds that hold out what the ``split`` does, and in others: without zones of positions, or
    with them if the split has none."""
    of_split = {"participants": split != "pos", "positions": split != "people"}
    others = {"participants": True, "positions": split == "people"}
    tune = partial(make_tuned_baselines, train, radius, hits, prior_kappa=prior_kappa, seed=seed)
    # All tables use the same densities.
    return [
        {name: replace(tuned, density=CachedBaseline(tuned.density)) for name, tuned in tune(**kind).items()}
        for kind in (of_split, others)
    ]


def _report(gaze: GazeField, result: GazeEvaluation, reporter: Reporter) -> None:
    """Report the scores as a table, and the written files."""
    rows = [{k: row[k] for k in ("method", *PRINTED, "integral")} for row in result.rows]
    what = tracking_suffix({"tracking": result.tracking})
    title = f"{gaze.name}{what}, {result.split}: {result.positions} positions, {result.people} participants"
    reporter.message(evaluation.format_score_table(rows, title))
    for line in format_verdicts(result.verdicts):
        reporter.message(line)
    for path in result.files:
        reporter.message(f"wrote {path}")


def _positions(
    test: evaluation.GazeTest,
    gaze: GazeField,
    environment: Environment,
    members_of: Baseline,
    prior: Baseline,
    groups: list[str] | None,
    seed: int,
) -> list[dict[str, Any]]:
    """Return the error and the uncertainty signals of the field ``loaded`` at each position.

    ``members_of`` evaluates the densities (M, P, D) of the ensemble members.
    """
    loaded, members = gaze.network, members_of(test.centres, test.directions)
    support = spread = None
    if loaded.support is not None:
        points = environment.points_to_field(test.centres)
        support = np.array([np.ravel(loaded.support.evaluate(loaded.ns.Array3f(*map(float, p))))[0] for p in points])
    if len(members) > 1:
        spread = 4 * np.pi * members.std(axis=0, ddof=1).mean(axis=1)
    of_prior = np.asarray(prior(test.centres, test.directions))
    maps = members.mean(axis=0)
    return score_positions(test, maps, of_prior, support=support, spread=spread, groups=groups, seed=seed)


def _groups(account: dict, split: str, centres: np.ndarray) -> list[str] | None:
    """Return the zone of each of the held-out ``centres`` (P, 3).

    None if positions are not from zones, or if an older checkpoint does not store the zones.
    """
    if split == "people" or "zone" not in account:
        return None
    all_centres = np.array(account["centres"])
    return [str(account["zone"][int(np.argmin(((all_centres - c) ** 2).sum(axis=1)))]) for c in centres]


def open_training_rays(gaze: GazeField, rays: Rays | FilePath) -> Rays:
    """Return the rays of the training. Raises `NergError` for others, and if none were held out."""
    training = gaze.provenance
    if training.get("recipe") == ELEVATION_PRIOR:
        raise NergError(f"{gaze.label} is a prior from other scenes, for which no rays of this scene were held out")
    if "test" not in training:
        raise NergError(
            f"{gaze.label} was trained on all positions, so there are no held-out ones; train with "
            f"{parameter('test_zones', 3)}"
        )
    trained = training.get("rays_file", {})
    if not isinstance(rays, Rays) and trained.get("sha256") not in (None, hash_rays(rays)):
        raise NergError(f'{gaze.label} was not trained on "{rays}"; give the unchanged file {trained["file"]}')
    # The same sample of a dataset.
    return open_rays(rays, trained.get("most"), trained.get("seed", 0))


def _notes(
    name: str,
    split: str,
    test: evaluation.GazeTest,
    trained: int,
    total: int,
    radius: float,
    kappa: float,
    directions: int,
    resamples: int,
    half_note: str,
) -> str:
    """Return the text above the tables; ``trained`` and ``total`` are the numbers of training rays and of all rays."""
    half = (
        f"not shown: {half_note}"
        if half_note
        else ("one half of the participants predicts the other, where both have enough rays; a reference, not a bound")
    )
    return (
        f"# {name}: {split}\n\n{len(test.centres)} positions, {len(test.participants)} participants; {trained:,} of "
        f"{total:,} rays used for training. Reference: rays within {radius:g} m, kappa {kappa:g}, "
        f"{directions} directions of equal area; KLD in nats with {EPS:g} of the uniform density added; "
        "MAE in 1/sr; densities are smoothed with the kernel of the reference before these; AUC against all "
        "directions, sAUC of the ratio to the position-independent prior, against rays of other positions; bits per "
        "ray above the position-independent prior, at the centres of the positions and at the origin of each ray; "
        f"loglik in nats of 1/sr. Brackets: ± 1.96 standard errors from {resamples} resamples of the "
        f"participants. Split half: {half}."
    )
