"""Scoring a gaze field on held-out rays, and trainings and scores over folds."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import gaze as evaluation
from nerg_mi.evaluation.gaze import (
    EPS,
    SCORES,
    SPLITS,
    Baseline,
    CachedBaseline,
    FieldDensity,
    format_score_table,
    make_standard_baselines,
)
from nerg_mi.evaluation.gaze_report import format_table, draw_comparison, format_uncertainty, write_report
from nerg_mi.evaluation.uncertainty import measure_calibration, summarise_folds, average_folds, score_positions, correlate_uncertainty
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_folder, file_sha256, write_text
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.formats.fields import load_gaze
from nerg_mi.probes.probes import REGION_LEVELS, format_level
from nerg_mi.rays.dataset import is_dataset, load_rays, hash_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.task import FOLDER_SUFFIX, RENDER_LIBRARIES, Part, Plan
from nerg_mi.threads import set_thread_count
from nerg_mi.train.geometry import TrainingGeometry

from .base import SILENT, Reporter, select_backend
from .gaze_commands import FoldOptions, GazeEvaluationOptions, GazeOptions
from .geometry import check_geometry, geometry_kind, load_training_geometry
from .options import exposed_options, shared_options
from .parts import PartRunner, PlannedScene
from .train_gaze import PRIOR, train_gaze

# ---- Evaluation ----
#
# The evaluation of a gaze field, at positions and of people that it was not trained on, beside what needs no field.


# Methods whose scores are told for each person, and those that are drawn.
_BY_PERSON = ("gaze field", "4,096 nearest rays")
_DRAWN = ("gaze field", "position-blind", "16 nearest probes", "4,096 nearest rays")
# Those whose regions are looked at, by what they are called.
_BLIND = "position-blind"
_CALIBRATED = ("gaze field", _BLIND, "4,096 nearest rays")


@dataclass(frozen=True)
class GazeEvaluation:
    """What a gaze field scored."""

    # A row a method, the gaze field's first; scores by `gaze.SCORES`, intervals with ".low" and ".high".
    rows: list[dict]
    # A row a method and person.
    persons: list[dict]
    # "both", "pos" or "people": what was new to the field.
    split: str
    # Test positions, and people in the test.
    positions: int
    people: int
    # Tables and pictures that were written.
    files: list[Path]
    # A row a position: its error, and how sure the field is there (`uncertainty.position_rows`).
    by_position: list[dict[str, Any]] = field(default_factory=list)
    # A row a signal and error: how well it ranks them (`uncertainty.rank_rows`).
    uncertainty: list[dict[str, Any]] = field(default_factory=list)
    # A row a method: what its regions hold (`uncertainty.calibration_rows`).
    calibration: list[dict[str, Any]] = field(default_factory=list)


def evaluate_gaze(
    gaze: str | Path,
    rays: Rays | str | Path,
    output: str | Path | None = None,
    options: GazeEvaluationOptions | None = None,
    reporter: Reporter = SILENT,
) -> GazeEvaluation:
    """Score the gaze field in the checkpoint ``gaze`` beside uniform, position-blind, nearest probes, nearest rays and
    the other half of the people.

    ``rays``: those that it was trained on, or their file; ``output``: folder for tables and pictures, None: none are
    written. Raises `NergError` where nothing was held out of the training, and for other rays or another place than
    those of the training.
    """
    options, gaze = options or GazeEvaluationOptions(), Path(gaze)
    output = None if output is None else Path(output)
    if output is not None:
        check_folder(output)
    ns = select_backend(options.mode, options.threads)
    loaded, metadata = load_gaze(gaze, ns)
    about = metadata["provenance"]
    data = _rays_of_training(gaze, about, rays)
    account, seed = about["test"], options.seed
    split = options.split or ("both" if account.get("people") else "pos")
    reporter.progress(0.0, "test")
    train, scored, centres = evaluation.select_held_out_rays(data, account, split, seed)
    test = evaluation.make_test(
        scored, centres, account["radius"], options.kappa, options.directions, options.min_rays, seed=seed
    )
    place = load_training_geometry(gaze, about, loaded.box, options, ns)
    option = f"--{place.kind} {options.field or options.scene or 'FILE'}"
    # What was trained by force is scored, and told.
    check_geometry(place, scored, option, True, reporter)
    blind, others = make_standard_baselines(train, account["radius"], options.kappa, options.prior_kappa, seed)
    depth, count = about.get("probes", {}).get("depth", "median"), len(test.centres)
    # Most of the time goes to the densities of the field.
    known = lambda number: reporter.progress(0.05 + 0.6 * min(number / count, 1), f"position {number} of {count}")
    # Each table asks for the same densities.
    members = CachedBaseline(FieldDensity(loaded, place.medium, place.align, depth, known).members)
    field_density = lambda positions, directions: members(positions, directions).mean(axis=0)
    kept = CachedBaseline(blind)
    methods = {"gaze field": field_density} | {k: kept if m is blind else CachedBaseline(m) for k, m in others.items()}
    reporter.progress(0.05, "scores")
    told = lambda share: reporter.progress(0.65 + 0.2 * share, "scores") if share > 0 else None
    rows = evaluation.evaluate_gaze(test, methods, kept, options.resamples, seed, told)
    half = evaluation.score_split_half(scored, test.centres, account["radius"], options.kappa, blind, options.min_rays, seed)
    rows += [half] if half else []
    reporter.progress(0.86, "each person")
    persons = evaluation.score_participants(test, {k: methods[k] for k in _BY_PERSON}, kept, options.min_rays)
    reporter.progress(0.9, "uncertainty")
    places = _positions(test, loaded, place, members, methods[_BLIND], _groups(account, split, test.centres), seed)
    ranks = correlate_uncertainty(places, options.resamples, seed)
    at = lambda method: method(test.centres, test.query_directions)[:, : test.sample_directions.shape[1]]
    asked = {k: (methods[k](test.centres, test.directions), at(methods[k])) for k in _CALIBRATED}
    found = about.get("mix", {}).get("regions")
    regions = measure_calibration(test, asked, options.resamples, seed, {"gaze field": found} if found else None)
    files = []
    if output is not None:
        summary = {
            "gaze": gaze.name,
            "gaze_sha256": file_sha256(gaze),
            "split": split,
            "kappa": options.kappa,
            "positions": len(test.centres),
            "people": len(test.participants),
            "resamples": options.resamples,
        }
        notes = _notes(gaze.name, split, test, (len(train), len(data)), account["radius"], options)
        files = write_report(output, rows, persons, summary, notes, places, ranks, regions)
        if options.pictures:
            reporter.progress(0.95, "pictures")
            files.append(output / "positions.png")
            sources = existing_files(gaze, rays, options.field, options.scene)
            made = make_provenance("nerg eval gaze", sources, seed, options)
            draw_comparison(test, {k: methods[k] for k in _DRAWN}, files[-1], options.pictures, provenance=made)
    return GazeEvaluation(rows, persons, split, len(test.centres), len(test.participants), files, places, ranks, regions)


def print_evaluation(
    gaze: Path, rays: Path, output: Path | None, options: GazeEvaluationOptions, reporter: Reporter
) -> None:
    """`evaluate_gaze`, with its scores as a table and its files named."""
    result = evaluate_gaze(gaze, rays, output or gaze.with_suffix(".eval"), options, reporter)
    rows = [{k: row[k] for k in ("method", *evaluation.SCORES, "integral")} for row in result.rows]
    title = f"{gaze.name}, {result.split}: {result.positions} positions, {result.people} persons"
    reporter.message(evaluation.format_score_table(rows, title))
    for path in result.files:
        reporter.message(f"wrote {path}")


def _positions(
    test: evaluation.GazeTest,
    loaded: AnyGazeField,
    place: TrainingGeometry,
    members_of: Baseline,
    blind: Baseline,
    groups: list[str] | None,
    seed: int,
) -> list[dict[str, Any]]:
    """The error at each position, and what tells how sure the field ``loaded`` is there. ``members_of``: densities
    (M, P, D) of its members."""
    members = members_of(test.centres, test.directions)
    support = spread = None
    if loaded.support is not None:
        points = place.points_to_field(test.centres)
        support = np.array([np.ravel(loaded.support.evaluate(loaded.ns.Array3f(*map(float, p))))[0] for p in points])
    if len(members) > 1:
        spread = 4 * np.pi * members.std(axis=0, ddof=1).mean(axis=1)
    of_blind = np.asarray(blind(test.centres, test.directions))
    maps = members.mean(axis=0)
    return score_positions(test, maps, of_blind, support=support, spread=spread, groups=groups, seed=seed)


def _groups(account: dict, split: str, centres: np.ndarray) -> list[str] | None:
    """The zone of each of the ``centres`` (P, 3) that a test held out; None where they lie anywhere, and where a
    checkpoint of before does not say."""
    if split == "people" or "zone" not in account:
        return None
    whole = np.array(account["centres"])
    return [str(account["zone"][int(np.argmin(((whole - c) ** 2).sum(axis=1)))]) for c in centres]


def _rays_of_training(gaze: Path, about: dict, rays: Rays | str | Path) -> Rays:
    """The rays that the field was trained on. Raises `NergError` for others, and where none were held out of it."""
    if about.get("recipe") == PRIOR:
        raise NergError(f'"{gaze}" was learnt in other places, so that none of its rays are of this one to be held out')
    if "test" not in about:
        raise NergError(
            f'"{gaze}" was trained on all positions, so that none is left to score; train it with --test-zones 3'
        )
    if isinstance(rays, Rays):
        return rays
    trained = about.get("rays_file", {})
    if trained.get("sha256") not in (None, hash_rays(rays)):
        raise NergError(
            f'"{gaze}" was trained on other rays than "{rays}"; give the file {trained["file"]}, as it was then'
        )
    # Of a dataset the same sample.
    return load_rays(rays, trained.get("most"), trained.get("seed", 0))


def _notes(
    name: str,
    split: str,
    test: evaluation.GazeTest,
    count: tuple[int, int],
    radius: float,
    options: GazeEvaluationOptions,
) -> str:
    """What the tables say, for whoever reads them later; ``count``: of the rays that were trained on, and of all."""
    trained, whole = count
    return (
        f"# {name}: {split}\n\n{len(test.centres)} positions, {len(test.participants)} persons; {trained:,} of {whole:,} "
        f"rays trained on. Truth: rays within {radius:g} m, kappa {options.kappa:g}, {options.directions} directions "
        f"of equal area; KLD in nats with {EPS:g} of the uniform density added; MAE in 1/sr; AUC against all "
        "directions, sAUC against rays of other positions; bits a ray beyond the position-blind density of kappa "
        f"{options.prior_kappa:g}; loglik in nats of 1/sr. Brackets: 1.96 standard errors either way, from "
        f"{options.resamples} resamples of the persons. Split half: half of the people predict the other half, where "
        "both have enough rays; a reference, no bound."
    )


# ---- Gaze fields over folds: trained and scored again and again, each time without other people and other zones ----


FIELD, SCORED = "gaze.safetensors", "scores.json"
"""What the output of a fold holds: its field, and the rows of each split."""

_LEVELS = tuple(format_level(level) for level in REGION_LEVELS)


@dataclass(frozen=True)
class FoldResult:
    """``rows``: a row a split and method, means over folds (`uncertainty.mean_rows`); ``each``: a row a fold,
    split and method; ``fields``: the checkpoint of each fold, where the store keeps it; ``files`` written;
    ``by_position``: a row a fold, split and position; ``uncertainty``: how well a signal ranks the errors of all folds'
    positions, in each split and in all of them ("anywhere"); ``calibration``: a row a split and method, means over
    folds."""

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
    """Train and score a gaze field for each fold on ``rays``, or their file or dataset, and write one table into the
    folder ``output``: folds.md, folds.csv (fold by fold), positions.csv (position by position), folds.json.

    A fold is a part that is kept, in ``OUTPUT.tasks`` or in ``options.store``: it depends on the rays, the place, its
    seed and its options. Equal ones give equal scores to the bit with one thread, and to rounding with more. Raises
    `NergError` for what the user can mend.
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
    seeds = range(options.first, options.first + options.folds)
    what = f"nerg eval folds {os.path.abspath(output)}"
    tasks = [Part(seed, f"fold {seed}") for seed in seeds]
    plan = Plan(what, train_and_score, common, tasks, FOLDER_SUFFIX, (*RENDER_LIBRARIES, "scipy"))
    each, fields, by_split = [], [], {split: [] for split in splits}
    positions, regions = [], {split: [] for split in splits}
    for seed, made in zip(seeds, parts.run(plan)):
        found: Any = read_json(made.path / SCORED, "scores of a fold")
        fields.append(made.path / FIELD)
        for split in splits:
            by_split[split].append(found[split]["rows"])
            each += [{"fold": seed, "split": split, **row} for row in found[split]["rows"]]
            # A zone of one fold is none of another, and its people are others in another split.
            of = lambda row, seed=seed, split=split: {"group": f"{seed} {split} {row['group']}"}
            positions += [{"fold": seed, "split": split, **row, **of(row)} for row in found[split]["by_position"]]
            regions[split].append(found[split]["calibration"])
        score = by_split[splits[0]][-1][0]
        reporter.message(f"fold {seed}, {splits[0]}: KLD {score['KLD']:.3f}, CC {score['CC']:.3f}")
    rows = [{"split": split, **row} for split, found in by_split.items() for row in summarise_folds(found)]
    populations = {split: [p for p in positions if p["split"] == split] for split in splits}
    if len(splits) > 1:
        populations["anywhere"] = positions
    ranks = [{"split": split, **row} for split, found in populations.items() for row in correlate_uncertainty(found)]
    held = [{"split": split, **row} for split, found in regions.items() for row in average_folds(found, _LEVELS)]
    written = _write(output, rows, each, options, positions, ranks, held)
    for path in written:
        reporter.message(f"wrote {path}")
    reporter.message(f"The folds are kept in {parts.store.folder}; nerg jobs says what they take.")
    return FoldResult(rows, each, fields, written, positions, ranks, held)


def print_folds(rays: Path, output: Path, options: FoldOptions, reporter: Reporter) -> None:
    """`evaluate_folds`, with the means as a table for each split."""
    result = evaluate_folds(rays, output, options, reporter)
    for split in options.splits.split(","):
        rows = [{k: row.get(k, math.nan) for k in ("method", *SCORES)} for row in result.rows if row["split"] == split]
        reporter.message(format_score_table(rows, f"{split}: means of {options.folds} folds"))


@dataclass(frozen=True)
class FoldInputs:
    """What all folds have in common: ``options``, ``splits`` to score in, ``rays`` or their file, and the ``scene``."""

    options: FoldOptions
    splits: tuple[str, ...]
    rays: Rays | Path
    scene: PlannedScene | None


def fold_options(options: FoldOptions) -> FoldOptions:
    """The ``options`` without what folds are counted and rays are chosen by: a fold has its seed, and all rays."""
    plain = FoldOptions()
    return replace(options, **{name: getattr(plain, name) for name in ("folds", "first", "splits", "most")})


def train_and_score(common: FoldInputs, seed: int, output: Path) -> None:
    """A fold: a gaze field that was trained without some people and zones (`FIELD`), and its rows in each split
    (`SCORED`), into the folder ``output``."""
    o, gaze = common.options, output / FIELD
    if common.scene is not None:
        common.scene.checked_path()
    training = GazeOptions(
        **shared_options(o, GazeOptions),
        **exposed_options(o),
        test_zones=o.zones,
        test_positions=o.positions,
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
            resamples=0,
            seed=seed,
            mode=o.mode,
        )
        scored = evaluate_gaze(gaze, common.rays, None, scoring)
        tables[split] = {"rows": scored.rows, "positions": scored.positions, "people": scored.people}
        tables[split] |= {"by_position": scored.by_position, "calibration": scored.calibration}
    write_json(output / SCORED, tables, allow_nan=True)


def _splits(text: str) -> list[str]:
    found = list(dict.fromkeys(text.split(",")))
    unknown = [split for split in found if split not in SPLITS]
    if unknown:
        raise NergError(f'--splits names some of {", ".join(SPLITS)}, got "{unknown[0]}"')
    return found


def _sources(rays: Rays | str | Path, options: FoldOptions) -> tuple[Rays | Path, PlannedScene | None]:
    """The rays of all folds, or their file, and the scene that they look around in."""
    if not isinstance(rays, Rays):
        rays = load_rays(rays, options.most, options.first) if is_dataset(rays) else Path(rays)
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
        f"# {options.folds} folds\n\nEach holds out {100 * options.people:g} % of the people and {options.positions} "
        f"positions in {options.zones} zones. Means over folds; brackets: 95 % of Student's t for {options.folds} "
        "folds, which share people who train: the spread over what was held out. The last row of each table is a "
        "difference fold by fold. How uncertainty ranks errors is of all folds' positions, with 95 % of resamples of "
        "their zones.\n"
    )
    of = lambda table, split: [row for row in table if row["split"] == split]
    for split in dict.fromkeys(row["split"] for row in (*rows, *ranks)):
        text += f"\n# {split}\n\n"
        if own := of(rows, split):
            text += f"{format_table(own, ('method', *SCORES, 'integral', 'folds'))}\n"
        text += format_uncertainty(of(ranks, split), of(regions, split))
    write_text(files[0], text)
    write_csv(files[1], each)
    write_csv(files[2], positions)
    tables = {"methods": rows, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {"folds": options.folds, "first": options.first, **tables})
    return files
