"""``nerg eval gaze``: Scores beside uniform, position-blind, nearest probes, nearest rays and the other half of the
people.

The evaluation of a gaze field, at positions and of people that it was not trained on, beside what needs no field.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import gaze as evaluation
from nerg_mi.evaluation.gaze import EPS, Baseline, Remembered, gaze_field, standard_baselines
from nerg_mi.evaluation.gaze_report import side_by_side, write_report
from nerg_mi.evaluation.uncertainty import calibration_rows, position_rows, rank_rows
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.figures.style import files_among, provenance
from nerg_mi.files.atomic import check_folder, file_sha256
from nerg_mi.formats.fields import load_gaze
from nerg_mi.rays.dataset_open import load_rays, rays_digest
from nerg_mi.rays.rays import Rays
from nerg_mi.train.geometry import GazePlace

from .backend import select_backend
from .commands import argument, command, out
from .gaze_places import check_place, place_of_training
from .gaze_prior import RECIPE as PRIOR
from .options.evaluation import GazeEvaluationOptions
from .reporter import SILENT, Reporter

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
    train, scored, centres = evaluation.held_out_rays(data, account, split, seed)
    test = evaluation.make_test(
        scored, centres, account["radius"], options.kappa, options.directions, options.min_rays, seed=seed
    )
    place = place_of_training(gaze, about, loaded.box, options, ns)
    option = f"--{place.kind} {options.field or options.scene or 'FILE'}"
    # What was trained by force is scored, and told.
    check_place(place, scored, option, True, reporter)
    blind, others = standard_baselines(train, account["radius"], options.kappa, options.blind_kappa, seed)
    depth, count = about.get("probes", {}).get("depth", "median"), len(test.centres)
    # Most of the time goes to the densities of the field.
    known = lambda number: reporter.progress(0.05 + 0.6 * min(number / count, 1), f"position {number} of {count}")
    # Each table asks for the same densities.
    members = Remembered(gaze_field(loaded, place.medium, place.align, depth, known).members)
    field_density = lambda positions, directions: members(positions, directions).mean(axis=0)
    kept = Remembered(blind)
    methods = {"gaze field": field_density} | {k: kept if m is blind else Remembered(m) for k, m in others.items()}
    reporter.progress(0.05, "scores")
    told = lambda share: reporter.progress(0.65 + 0.2 * share, "scores") if share > 0 else None
    rows = evaluation.evaluate_gaze(test, methods, kept, options.resamples, seed, told)
    half = evaluation.split_half(scored, test.centres, account["radius"], options.kappa, blind, options.min_rays, seed)
    rows += [half] if half else []
    reporter.progress(0.86, "each person")
    persons = evaluation.person_rows(test, {k: methods[k] for k in _BY_PERSON}, kept, options.min_rays)
    reporter.progress(0.9, "uncertainty")
    places = _positions(test, loaded, place, members, methods[_BLIND], _groups(account, split, test.centres), seed)
    ranks = rank_rows(places, options.resamples, seed)
    at = lambda method: method(test.centres, test.drawn)[:, : test.at.shape[1]]
    asked = {k: (methods[k](test.centres, test.directions), at(methods[k])) for k in _CALIBRATED}
    found = about.get("mix", {}).get("regions")
    regions = calibration_rows(test, asked, options.resamples, seed, {"gaze field": found} if found else None)
    files = []
    if output is not None:
        summary = {
            "gaze": gaze.name,
            "gaze_sha256": file_sha256(gaze),
            "split": split,
            "kappa": options.kappa,
            "positions": len(test.centres),
            "people": len(test.persons),
            "resamples": options.resamples,
        }
        notes = _notes(gaze.name, split, test, (len(train), len(data)), account["radius"], options)
        files = write_report(output, rows, persons, summary, notes, places, ranks, regions)
        if options.pictures:
            reporter.progress(0.95, "pictures")
            files.append(output / "positions.png")
            sources = files_among(gaze, rays, options.field, options.scene)
            made = provenance("nerg eval gaze", sources, seed, options)
            side_by_side(test, {k: methods[k] for k in _DRAWN}, files[-1], options.pictures, about=made)
    return GazeEvaluation(rows, persons, split, len(test.centres), len(test.persons), files, places, ranks, regions)


@command(
    "eval gaze",
    options=GazeEvaluationOptions,
    gaze=argument("Checkpoint of a gaze field that was trained with --test-zones (.safetensors)."),
    rays=argument("The rays file or dataset that it was trained on."),
    output=out("Folder for tables and pictures. Default: GAZE.eval.", default=None),
)
def print_evaluation(
    gaze: Path, rays: Path, output: Path | None, options: GazeEvaluationOptions, reporter: Reporter
) -> None:
    """`evaluate_gaze`, with its scores as a table and its files named."""
    result = evaluate_gaze(gaze, rays, output or gaze.with_suffix(".eval"), options, reporter)
    rows = [{k: row[k] for k in ("method", *evaluation.SCORES, "integral")} for row in result.rows]
    title = f"{gaze.name}, {result.split}: {result.positions} positions, {result.people} persons"
    reporter.message(evaluation.score_table(rows, title))
    for path in result.files:
        reporter.message(f"wrote {path}")


def _positions(
    test: evaluation.GazeTest,
    loaded: AnyGazeField,
    place: GazePlace,
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
        points = place.points_from_rays(test.centres)
        support = np.array([np.ravel(loaded.support.at(loaded.ns.Array3f(*map(float, p))))[0] for p in points])
    if len(members) > 1:
        spread = 4 * np.pi * members.std(axis=0, ddof=1).mean(axis=1)
    of_blind = np.asarray(blind(test.centres, test.directions))
    maps = members.mean(axis=0)
    return position_rows(test, maps, of_blind, support=support, spread=spread, groups=groups, seed=seed)


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
    if trained.get("sha256") not in (None, rays_digest(rays)):
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
        f"# {name}: {split}\n\n{len(test.centres)} positions, {len(test.persons)} persons; {trained:,} of {whole:,} "
        f"rays trained on. Truth: rays within {radius:g} m, kappa {options.kappa:g}, {options.directions} directions "
        f"of equal area; KLD in nats with {EPS:g} of the uniform density added; MAE in 1/sr; AUC against all "
        "directions, sAUC against rays of other positions; bits a ray beyond the position-blind density of kappa "
        f"{options.blind_kappa:g}; loglik in nats of 1/sr. Brackets: 1.96 standard errors either way, from "
        f"{options.resamples} resamples of the persons. Split half: half of the people predict the other half, where "
        "both have enough rays; a reference, no bound."
    )
