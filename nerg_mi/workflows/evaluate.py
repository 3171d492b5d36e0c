"""Evaluation of a gaze field on held-out rays, and cross-validation of its training."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.evaluation import gaze as evaluation
from nerg_mi.evaluation.baselines import (
    CONDITIONAL_KDE,
    NEAREST_RAYS,
    REAIMED_HITS,
    Baseline,
    format_settings,
    make_tuned_baselines,
)
from nerg_mi.evaluation.baselines import PRIOR as PRIOR_BASELINE
from nerg_mi.evaluation.gaze import EPS, SCORES, SPLITS, CachedBaseline, FieldDensity, format_score_table
from nerg_mi.evaluation.gaze_report import (
    draw_comparison,
    explain_missing,
    format_table,
    format_uncertainty,
    write_report,
)
from nerg_mi.evaluation.uncertainty import (
    average_folds,
    correlate_uncertainty,
    measure_calibration,
    score_positions,
    summarise_folds,
)
from nerg_mi.fields.gaze_base import AnyGazeField, tracking_suffix
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_folder, file_sha256, write_text
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import add_notes, write_csv, write_json
from nerg_mi.formats.fields import load_gaze
from nerg_mi.options import exposed_options, shared_options
from nerg_mi.probes.probes import REGION_LEVELS, format_level
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import hash_rays, is_dataset, load_rays
from nerg_mi.rays.rays import TRACKING, Rays
from nerg_mi.tasks.task import FOLDER_SUFFIX, RENDER_LIBRARIES, Part, Plan
from nerg_mi.threads import set_thread_count
from nerg_mi.tracking_kinds import read_tracking
from nerg_mi.train.gaze_data import find_hit_points
from nerg_mi.train.gaze_log_density import ELEVATION_PRIOR
from nerg_mi.train.geometry_files import check_geometry, geometry_kind, load_training_geometry

from .base import select_backend
from .gaze_commands import FoldOptions, GazeEvaluationOptions, GazeOptions
from .parts import PartRunner, PlannedScene
from .train_gaze import train_gaze

# ---- Evaluation ----
#
# Evaluation of a gaze field at held-out positions and of held-out participants, compared with baselines.


_FIELD = "gaze field"  # Name of the method that is compared with the baselines
# Methods that are scored for each participant, those that are drawn, and those whose highest-density regions are
# calibrated; re-aimed hits only with surfaces.
_BY_PERSON = (_FIELD, NEAREST_RAYS, REAIMED_HITS)
_DRAWN = (_FIELD, PRIOR_BASELINE, NEAREST_RAYS, CONDITIONAL_KDE, REAIMED_HITS)
_CALIBRATED = (_FIELD, PRIOR_BASELINE, NEAREST_RAYS)
# Scores in the terminal; the files have all of them.
_PRINTED = tuple(score for score in SCORES if score not in ("SIM", "MAE", "loglik"))


@dataclass(frozen=True, repr=False)
class GazeEvaluation(ResultTables):
    """Scores of a gaze field."""

    TABLES = ("rows", "persons", "by_position", "uncertainty", "calibration")

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
    tracking: str = "unknown"  # What was tracked, of `nerg_mi.rays.rays.TRACKING`


def evaluate_gaze(
    gaze: str | Path,
    rays: Rays | str | Path,
    output: str | Path | None = None,
    options: GazeEvaluationOptions | None = None,
    reporter: Reporter = SILENT,
) -> GazeEvaluation:
    """Score the gaze field in the checkpoint ``gaze`` and compare it with baselines.

    The baselines are a uniform density, the position-independent prior, the nearest rays, a conditional kernel density,
    with surfaces the re-aimed hits, and the other half of the participants (`nerg_mi.evaluation.baselines`).

    Parameters
    ----------
    gaze
        Checkpoint of the gaze field.
    rays
        Rays of its training, or their file.
    output
        Folder for tables and figures; None writes nothing.
    options
        Split, kernels, and numbers of samples.
    reporter
        Receives messages and progress.

    Raises
    ------
    NergError
        If nothing was held out of the training, and for rays or a scene other than those of the training.
    """
    options, gaze = options or GazeEvaluationOptions(), Path(gaze)
    output = None if output is None else Path(output)
    if output is not None:
        check_folder(output)
    ns = select_backend(options.mode, options.threads)
    loaded, metadata = load_gaze(gaze, ns)
    training = metadata["provenance"]
    data = load_training_rays(gaze, training, rays)
    account, seed = training["test"], options.seed
    tracking = read_tracking(training)
    if tracking == "unknown":  # as in checkpoints of earlier versions, but the rays may state it
        tracking = data.tracking
    split = options.split or ("both" if account.get("people") else "pos")
    reporter.progress(0.0, "test")
    train, scored, centres = evaluation.select_held_out_rays(data, account, split, seed)
    test = evaluation.make_test(
        scored, centres, account["radius"], options.kappa, options.directions, options.min_rays, seed=seed
    )
    environment = load_training_geometry(
        gaze, training, loaded.box, field=options.field, scene=options.scene, choice=options.geometry
    )
    option = f"--{environment.kind} {options.field or options.scene or 'FILE'}"
    # A field that was trained with --force is scored, with a warning.
    check_geometry(environment, scored, option, True, reporter)
    reporter.progress(0.02, "baselines")
    baselines = make_tuned_baselines(
        train,
        account["radius"],
        find_hit_points(train, environment),
        participants=split != "pos",
        positions=split != "people",
        prior_kappa=options.prior_kappa,
        seed=seed,
    )
    depth, count = training.get("probes", {}).get("depth", "median"), len(test.centres)
    # Most of the time is spent on evaluating the field.
    report_position = lambda number: reporter.progress(
        0.05 + 0.6 * min(number / count, 1), f"position {number} of {count}"
    )
    # All tables use the same densities.
    members = CachedBaseline(
        FieldDensity(loaded, environment.medium, environment.align, depth, report_position).members
    )
    field_density = lambda positions, directions: members(positions, directions).mean(axis=0)
    methods = {_FIELD: field_density, **{name: CachedBaseline(b.density) for name, b in baselines.items()}}
    prior = methods[PRIOR_BASELINE]
    reporter.progress(0.05, "scores")
    report_share = lambda share: reporter.progress(0.65 + 0.2 * share, "scores") if share > 0 else None
    rows = evaluation.evaluate_gaze(test, methods, prior, options.resamples, seed, report_share)
    half, half_note = evaluation.score_split_half(
        scored, test.centres, account["radius"], options.kappa, prior, options.min_rays, seed, options.resamples
    )
    rows += [half] if half else []
    if half_note:
        reporter.message(f"the split half is not shown: {half_note}")
    reporter.progress(0.86, "participants")
    select = lambda names: {name: methods[name] for name in names if name in methods}
    persons = evaluation.score_participants(test, select(_BY_PERSON), prior, options.min_rays)
    reporter.progress(0.9, "uncertainty")
    places = _positions(test, loaded, environment, members, prior, _groups(account, split, test.centres), seed)
    ranks = correlate_uncertainty(places, options.resamples, seed)
    at = lambda method: method(test.centres, test.query_directions)[:, : test.sample_directions.shape[1]]
    calibrated = {k: (m(test.centres, test.directions), at(m)) for k, m in select(_CALIBRATED).items()}
    stored_regions = training.get("mix", {}).get("regions")
    regions = measure_calibration(
        test, calibrated, options.resamples, seed, {_FIELD: stored_regions} if stored_regions else None
    )
    for table in (rows, persons, places, ranks, regions):
        add_notes(table, explain_missing)
    files = []
    if output is not None:
        summary = {
            "gaze": gaze.name,
            "gaze_sha256": file_sha256(gaze),
            "tracking": tracking,
            "split": split,
            "kappa": options.kappa,
            "positions": len(test.centres),
            "people": len(test.participants),
            "resamples": options.resamples,
            "split_half": half,
            "split_half_note": half_note,
        }
        notes = _notes(gaze.name, split, test, (len(train), len(data)), account["radius"], options, half_note)
        notes += f" Tracking: {TRACKING[tracking]}. {format_settings(baselines)}"
        files = write_report(output, rows, persons, summary, notes, places, ranks, regions)
        if options.pictures:
            reporter.progress(0.95, "pictures")
            files.append(output / "positions.png")
            sources = existing_files(gaze, rays, options.field, options.scene)
            record = make_provenance("nerg eval gaze", sources, seed, options)
            draw_comparison(test, select(_DRAWN), files[-1], options.pictures, provenance=record)
    return GazeEvaluation(
        rows,
        persons,
        split,
        len(test.centres),
        len(test.participants),
        files,
        places,
        ranks,
        regions,
        half_note,
        tracking,
    )


def default_output(gaze: Path) -> Path:
    """Return the folder in which the command writes the evaluation of ``gaze``, and a report looks for it."""
    return gaze.with_suffix(".eval")


def print_evaluation(
    gaze: Path, rays: Path, output: Path | None, options: GazeEvaluationOptions, reporter: Reporter
) -> None:
    """Call `evaluate_gaze`, and print the scores as a table."""
    result = evaluate_gaze(gaze, rays, output or default_output(gaze), options, reporter)
    rows = [{k: row[k] for k in ("method", *_PRINTED, "integral")} for row in result.rows]
    what = tracking_suffix({"tracking": result.tracking})
    title = f"{gaze.name}{what}, {result.split}: {result.positions} positions, {result.people} participants"
    reporter.message(evaluation.format_score_table(rows, title))
    for path in result.files:
        reporter.message(f"wrote {path}")


def _positions(
    test: evaluation.GazeTest,
    loaded: AnyGazeField,
    environment: Environment,
    members_of: Baseline,
    prior: Baseline,
    groups: list[str] | None,
    seed: int,
) -> list[dict[str, Any]]:
    """Return the error and the uncertainty signals of the field ``loaded`` at each position.

    ``members_of`` evaluates the densities (M, P, D) of the ensemble members.
    """
    members = members_of(test.centres, test.directions)
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


def load_training_rays(gaze: Path, training: dict, rays: Rays | str | Path) -> Rays:
    """Return the rays of the training. Raises `NergError` for others, and if none were held out."""
    if training.get("recipe") == ELEVATION_PRIOR:
        raise NergError(f'"{gaze}" is a prior from other scenes, for which no rays of this scene were held out')
    if "test" not in training:
        raise NergError(
            f'"{gaze}" was trained on all positions, so there are no held-out ones; train with '
            f"{parameter('test_zones', 3)}"
        )
    if isinstance(rays, Rays):
        return rays
    trained = training.get("rays_file", {})
    if trained.get("sha256") not in (None, hash_rays(rays)):
        raise NergError(f'"{gaze}" was not trained on "{rays}"; give the unchanged file {trained["file"]}')
    # The same sample of a dataset.
    return load_rays(rays, trained.get("most"), trained.get("seed", 0))


def _notes(
    name: str,
    split: str,
    test: evaluation.GazeTest,
    count: tuple[int, int],
    radius: float,
    options: GazeEvaluationOptions,
    half_note: str,
) -> str:
    """Return the text above the tables; ``count`` holds the number of training rays and of all rays."""
    trained, total = count
    half = (
        f"not shown: {half_note}"
        if half_note
        else ("one half of the participants predicts the other, where both have enough rays; a reference, not a bound")
    )
    return (
        f"# {name}: {split}\n\n{len(test.centres)} positions, {len(test.participants)} participants; {trained:,} of "
        f"{total:,} rays used for training. Reference: rays within {radius:g} m, kappa {options.kappa:g}, "
        f"{options.directions} directions of equal area; KLD in nats with {EPS:g} of the uniform density added; "
        "MAE in 1/sr; densities are smoothed with the kernel of the reference before these; AUC against all "
        "directions, sAUC of the ratio to the position-independent prior, against rays of other positions; bits per "
        "ray above the position-independent prior, at the centres of the positions and at the origin of each ray; "
        f"loglik in nats of 1/sr. Brackets: ± 1.96 standard errors from {options.resamples} resamples of the "
        f"participants. Split half: {half}."
    )


# ---- Cross-validation over folds ----


FIELD, SCORED = "gaze.safetensors", "scores.json"
"""Files of a fold: its gaze field, and the rows of each split."""

_FOLD_RESAMPLES = 100  # Resamples of the participants of a fold, for the intervals of its rows
_LEVELS = tuple(format_level(level) for level in REGION_LEVELS)


@dataclass(frozen=True, repr=False)
class FoldResult(ResultTables):
    """Result of a cross-validation.

    Attributes
    ----------
    rows
        One row per split and method: means over folds (`uncertainty.summarise_folds`).
    each
        One row per fold, split and method, as of `evaluate_gaze`: its intervals are over the fold's participants.
    fields
        Checkpoint of each fold in the store.
    files
        Written files.
    by_position
        One row per fold, split and position.
    uncertainty
        How well a signal ranks the errors of all positions, for each split and for all of them ("anywhere").
    calibration
        One row per split and method: means over folds.
    """

    TABLES = ("rows", "each", "by_position", "uncertainty", "calibration")

    rows: list[dict[str, Any]]
    each: list[dict[str, Any]]
    fields: list[Path]
    files: list[Path]
    by_position: list[dict[str, Any]]
    uncertainty: list[dict[str, Any]]
    calibration: list[dict[str, Any]]


def evaluate_folds(
    rays: Rays | str | Path, output: str | Path, options: FoldOptions | None = None, reporter: Reporter = SILENT
) -> FoldResult:
    """Train and score a gaze field for each fold, and write tables to the folder ``output``.

    The files are folds.md, folds.csv (by fold), positions.csv (by position) and folds.json. Each fold is a part that is
    stored in ``OUTPUT.tasks`` or ``options.store``; it depends on the rays, the scene, its seed and its options. Equal
    folds give bitwise equal scores with one thread, and equal scores up to rounding with more. Raises `NergError` for
    errors that the user can correct.
    """
    options, output = options or FoldOptions(), Path(output)
    splits = tuple(_splits(options.splits))
    geometry_kind(options)
    check_folder(output)
    parts = PartRunner(options, output, reporter, options.threads)
    if options.threads:
        set_thread_count(options.threads)
    reporter.progress(0.0, "reading")
    common = FoldInputs(fold_options(options), splits, *_sources(rays, options))
    seeds = range(options.seed, options.seed + options.folds)
    job = f"nerg eval folds {os.path.abspath(output)}"
    tasks = [Part(seed, f"fold {seed}") for seed in seeds]
    plan = Plan(job, train_and_score, common, tasks, FOLDER_SUFFIX, (*RENDER_LIBRARIES, "scipy"))
    each, fields, by_split = [], [], {split: [] for split in splits}
    positions, regions = [], {split: [] for split in splits}
    for seed, made in zip(seeds, parts.run(plan)):
        results: Any = read_json(made.path / SCORED, "scores of a fold")
        fields.append(made.path / FIELD)
        for split in splits:
            by_split[split].append(results[split]["rows"])
            each += [{"fold": seed, "split": split, **row} for row in results[split]["rows"]]
            # Zones of different folds, and participants of different splits, are different groups.
            group_key = lambda row, seed=seed, split=split: {"group": f"{seed} {split} {row['group']}"}
            positions += [
                {"fold": seed, "split": split, **row, **group_key(row)} for row in results[split]["by_position"]
            ]
            regions[split].append(results[split]["calibration"])
        score = by_split[splits[0]][-1][0]
        reporter.message(f"fold {seed}, {splits[0]}: KLD {score['KLD']:.3f}, CC {score['CC']:.3f}")
    rows = [{"split": split, **row} for split, scores in by_split.items() for row in summarise_folds(scores)]
    populations = {split: [p for p in positions if p["split"] == split] for split in splits}
    if len(splits) > 1:
        populations["anywhere"] = positions
    ranks = [{"split": split, **row} for split, scores in populations.items() for row in correlate_uncertainty(scores)]
    held = [{"split": split, **row} for split, scores in regions.items() for row in average_folds(scores, _LEVELS)]
    for table in (rows, each, positions, ranks, held):
        add_notes(table, explain_missing)
    written = _write(output, rows, each, options, positions, ranks, held)
    for path in written:
        reporter.message(f"wrote {path}")
    reporter.message(f"The folds are stored in {parts.store.folder}; nerg jobs shows their size.")
    return FoldResult(rows, each, fields, written, positions, ranks, held)


def print_folds(rays: Path, output: Path, options: FoldOptions, reporter: Reporter) -> None:
    """Call `evaluate_folds`, and print the means as a table for each split."""
    result = evaluate_folds(rays, output, options, reporter)
    for split in options.splits.split(","):
        rows = [
            {k: row.get(k, math.nan) for k in ("method", *_PRINTED)} for row in result.rows if row["split"] == split
        ]
        reporter.message(format_score_table(rows, f"{split}: means of {options.folds} folds"))


@dataclass(frozen=True)
class FoldInputs:
    """Inputs that all folds share."""

    options: FoldOptions
    splits: tuple[str, ...]
    rays: Rays | Path
    scene: PlannedScene | None


def fold_options(options: FoldOptions) -> FoldOptions:
    """Return ``options`` without those that count folds and select rays: a fold has its own seed, and all rays."""
    plain = FoldOptions()
    return replace(options, folds=plain.folds, seed=plain.seed, splits=plain.splits, max_samples=plain.max_samples)


def train_and_score(common: FoldInputs, seed: int, output: Path) -> None:
    """Train a gaze field without some participants and zones (`FIELD`), score it in each split (`SCORED`).

    The files are written to the folder ``output``.
    """
    o, gaze = common.options, output / FIELD
    if common.scene is not None:
        common.scene.checked_path()
    training = GazeOptions(
        **shared_options(o, GazeOptions),
        **exposed_options(o),
        test_zones=o.test_zones,
        test_positions=o.test_positions,
        test_participants=o.test_participants,
        seed=seed,
    )
    train_gaze(common.rays, gaze, training)
    tables = {}
    for split in common.splits:
        scoring = GazeEvaluationOptions(
            field=o.field,
            scene=o.scene,
            split=split,
            **shared_options(o, GazeEvaluationOptions),
            resamples=_FOLD_RESAMPLES,
            seed=seed,
            mode=o.mode,
        )
        scored = evaluate_gaze(gaze, common.rays, None, scoring)
        tables[split] = {"rows": scored.rows, "positions": scored.positions, "people": scored.people}
        tables[split] |= {"by_position": scored.by_position, "calibration": scored.calibration}
    write_json(output / SCORED, tables, allow_nan=True)


def _splits(text: str) -> list[str]:
    splits = list(dict.fromkeys(text.split(",")))
    unknown = [split for split in splits if split not in SPLITS]
    if unknown:
        raise NergError(f'{parameter("splits")} must be some of {", ".join(SPLITS)}, got "{unknown[0]}"')
    return splits


def _sources(rays: Rays | str | Path, options: FoldOptions) -> tuple[Rays | Path, PlannedScene | None]:
    """Return the rays of all folds, or their file, and the scene."""
    if not isinstance(rays, Rays):
        rays = load_rays(rays, options.max_samples, options.seed) if is_dataset(rays) else Path(rays)
    return rays, None if options.scene is None else PlannedScene.plan(options.scene)


def _write(
    folder: Path,
    rows: list[dict[str, Any]],
    each: list[dict[str, Any]],
    options: FoldOptions,
    positions: list[dict[str, Any]],
    ranks: list[dict[str, Any]],
    regions: list[dict[str, Any]],
) -> list[Path]:
    files = [folder / name for name in ("folds.md", "folds.csv", "positions.csv", "folds.json")]
    text = (
        f"# {options.folds} folds\n\nEach fold holds out {100 * options.test_participants:g} % of the participants "
        f"and {options.test_positions} positions in {options.test_zones} zones. Means over folds; brackets: 95 % "
        f"confidence intervals of Student's t for {options.folds} folds, which share training participants: the "
        "spread over what was held out. The last row of each table is the mean difference over folds. Ranks of "
        "errors by uncertainty use the positions of all folds, with 95 % bootstrap intervals over zones.\n"
    )
    select = lambda table, split: [row for row in table if row["split"] == split]
    for split in dict.fromkeys(row["split"] for row in (*rows, *ranks)):
        text += f"\n# {split}\n\n"
        if selected := select(rows, split):
            text += f"{format_table(selected, ('method', *SCORES, 'integral', 'folds'))}\n"
        text += format_uncertainty(select(ranks, split), select(regions, split))
    write_text(files[0], text)
    write_csv(files[1], each)
    write_csv(files[2], positions)
    tables = {"methods": rows, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {"folds": options.folds, "seed": options.seed, **tables})
    return files
