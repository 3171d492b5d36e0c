"""Cross-validation of a gaze field: trained and scored several times, each time without some participants and zones."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene import AnyEnvironment
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_folder, make_folder, write_text
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import add_notes, write_csv, write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter
from nerg_mi.ranges import BASE_SEEDS, DIRECTIONS, KAPPAS, LENGTHS, MINUTES, RAYS, STEPS, Range, check_ranges
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import FOLDER_SUFFIX, RENDER_LIBRARIES, Part, Plan
from nerg_mi.tracking.dataset import is_dataset, open_rays
from nerg_mi.tracking.probes import REGION_LEVELS, format_level
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze import check_recipe, find_word, train_gaze
from nerg_mi.train.gaze_recipes import FieldOptions, Recipe, get_recipe
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

from .gaze import SCORES, SPLITS, format_score_table
from .gaze_report import explain_missing, format_table, format_uncertainty
from .held_out import PRINTED, evaluate_gaze
from .position_scores import format_verdicts
from .uncertainty import average_folds, correlate_uncertainty, summarise_folds

FIELD, SCORED = "gaze.safetensors", "scores.json"
"""Files of a fold: its gaze field, and the rows of each split."""

Split: TypeAlias = Literal["both", "pos", "people"]

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
        Gaze field of each fold.
    files
        Written files.
    by_position
        One row per fold, split and position.
    uncertainty
        How well a signal ranks the errors of all positions, for each split and for all of them ("anywhere").
    calibration
        One row per split and method: means over folds.
    held_out
        What each fold holds out, in words.
    verdicts
        Bits where training participants stood and where none did, one row per fold, kind of positions and method.
    """

    TABLES = ("rows", "each", "by_position", "uncertainty", "calibration", "verdicts")

    rows: list[dict[str, Any]]
    each: list[dict[str, Any]]
    fields: list[GazeField]
    files: list[Path]
    by_position: list[dict[str, Any]]
    uncertainty: list[dict[str, Any]]
    calibration: list[dict[str, Any]]
    held_out: str
    verdicts: list[dict[str, Any]] = field(default_factory=list)

    def save(self, folder: FilePath) -> list[Path]:
        """Write folds.md, folds.csv (by fold), positions.csv (by position) and folds.json to ``folder``, and return
        their paths. Raises `NergError` if they cannot be written."""
        folder, folds = make_folder(to_path(folder)), len(self.fields)
        files = [folder / name for name in ("folds.md", "folds.csv", "positions.csv", "folds.json")]
        text = (
            f"# {folds} folds\n\nEach fold holds out {self.held_out}. Means over folds; brackets: 95 % confidence "
            f"intervals of Student's t for {folds} folds, which share training participants: the spread over what was "
            "held out. The last row of each table is the mean difference over folds. Ranks of errors by uncertainty "
            "use the positions of all folds, with 95 % bootstrap intervals over zones.\n"
        )
        select = lambda table, split: [row for row in table if row["split"] == split]
        for split in dict.fromkeys(row["split"] for row in (*self.rows, *self.uncertainty)):
            text += f"\n# {split}\n\n"
            if selected := select(self.rows, split):
                text += f"{format_table(selected, ('method', *SCORES, 'integral', 'folds'))}\n"
            text += format_uncertainty(select(self.uncertainty, split), select(self.calibration, split))
        write_text(files[0], text)
        write_csv(files[1], self.each)
        write_csv(files[2], self.by_position)
        tables = {"methods": self.rows, "uncertainty": self.uncertainty, "calibration": self.calibration}
        tables["verdicts"] = self.verdicts
        write_json(files[3], {"folds": folds, "seed": self.each[0]["fold"], **tables})
        return files


@dataclass(frozen=True)
class FoldInputs:
    """Inputs that all folds share, as plain data. ``recipe`` is the name of one with other settings."""

    rays: Rays | Path
    environment: PlannedFiles | str
    splits: tuple[Split, ...]
    recipe: str
    options: FieldOptions
    settings: GazeSettings
    probes: ProbeSettings
    variant: Literal["emit", "capture", "emit_capture"] | None
    ensemble: int
    align: tuple[tuple[float, ...], ...] | None
    test_zones: int
    test_positions: int
    test_participants: float
    kappa: float
    directions: int
    min_rays: int


@check_ranges
def folds(
    rays: Rays | FilePath,
    environment: AnyEnvironment | FilePath = None,
    *,
    folds: Annotated[int, Range(2, 10_000)] = 5,
    splits: str | Sequence[str] = "both,pos,people",
    seed: Annotated[int, BASE_SEEDS] = 0,
    test_zones: Annotated[int, Range(1, 1000)] = 3,
    test_positions: Annotated[int, Range(1, 10**5)] = 60,
    test_participants: Annotated[float, Range(0.01, 0.99)] = 0.5,
    recipe: str | Recipe = "default",
    variant: Literal["emit", "capture", "emit_capture"] | None = None,
    steps: Annotated[int, STEPS] | None = None,
    minutes: Annotated[float, MINUTES] | None = None,
    ensemble: Annotated[int, Range(0, 1000)] = 0,
    radius: Annotated[float, LENGTHS] | None = None,
    probes: Annotated[int, Range(1, 10**6)] | None = None,
    prior_folds: Annotated[int, Range(0, 1000)] | None = None,
    reaimed_hits: bool | None = None,
    align: AnySimilarity | FilePath | None = None,
    max_samples: Annotated[int, RAYS] = 10_000_000,
    kappa: Annotated[float, KAPPAS] = 20.0,
    directions: Annotated[int, DIRECTIONS] = 2048,
    min_rays: Annotated[int, Range(1, 10**6)] = 64,
    output: FilePath | None = None,
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> FoldResult:
    """Cross-validate a gaze field: train and score it several times, each time without some participants and zones, and
    report the means.

    With an output or a store, each finished fold is stored; the same call continues with the next one. Equal folds give
    bitwise equal scores with one thread, and equal scores up to rounding with more.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    environment : object or path
        What the participants saw, as for `train_gaze`.
    folds : int
        Number of folds; each holds out other participants and other zones.
    splits : str or sequence of str
        Comma-separated kinds of held-out data: both (new participants at new positions), pos (new positions), people
        (new participants).
    seed : int
        Seed of the first fold; the following folds use the next seeds.
    test_zones : int
        Number of zones whose positions are held out for testing.
    test_positions : int
        Maximum number of test positions, in all held-out zones together.
    test_participants : float
        Fraction of the participants that each fold holds out for testing.
    recipe : str or Recipe
        Training recipe, as for `train_gaze`.
    variant : str, optional
        Factors of the gaze field: emit, capture or emit_capture. Default: as for `train_gaze`.
    steps : int, optional
        Number of training steps.
    minutes : float, optional
        Time of each training in minutes, in place of ``steps``.
    ensemble : int
        Number of ensemble members; 0 trains a single field.
    radius : float, optional
        Radius R of a probe in metres.
    probes : int, optional
        Maximum number of probes.
    prior_folds : int, optional
        Number of cross-validation folds within each training.
    reaimed_hits : bool, optional
        Mix a kernel density of the samples' hit points into the field.
    align : Alignment, similarity or path, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene. Default: identity.
    max_samples : int
        Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with ``seed``.
    kappa : float or str
        Concentration (unitless), or standard deviation such as 13deg, of the von Mises-Fisher kernels that turn test
        rays into reference densities.
    directions : int
        Number of directions on the sphere at which densities are compared.
    min_rays : int
        Minimum number of rays around a test position.
    output : path, optional
        Folder for the tables folds.md, folds.csv (by fold), positions.csv (by position) and folds.json.
    parallel : Parallel
        Where finished folds are stored, and what computes them. Default: in ``OUTPUT.tasks``, by this process.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    FoldResult
        Means over folds (``rows``) and scores of each fold (``each``); ``to_dataframe`` returns them as data frames.

    Raises
    ------
    NergError
        An argument or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> small = {"splits": "pos", "steps": 2, "probes": 8, "directions": 64, "min_rays": 8}
    >>> result = nerg.folds(rays, "none", folds=2, test_zones=1, test_positions=4, **small)
    >>> result.to_dataframe()["method"][0], len(result.fields)
    ('gaze field', 2)
    """
    chosen = get_recipe(recipe).override(
        steps=steps, minutes=minutes, radius=radius, probes=probes, prior_folds=prior_folds, reaimed_hits=reaimed_hits
    )
    kinds = _list_splits(splits)
    folder = None if output is None else to_path(output)
    if folder is not None:
        check_folder(folder)
    word = find_word(environment)
    check_recipe(chosen, word or "field", variant or "")
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        matrix = None if align is None else open_similarity(align, "rays to field").matrix
        runner = PartRunner(parallel, folder, reporter) if folder is not None or parallel.in_parts else None
        data = open_rays(rays, max_samples, seed) if isinstance(rays, Rays) or is_dataset(rays) else to_path(rays)
        common = FoldInputs(
            data,
            word or (_plan_environment(environment, folder or parallel.store) if runner is not None else ""),
            kinds,
            chosen.name,
            chosen.options,
            chosen.settings,
            chosen.probes,
            variant,
            ensemble,
            None if matrix is None else tuple(map(tuple, matrix.tolist())),
            test_zones,
            test_positions,
            test_participants,
            kappa,
            directions,
            min_rays,
        )
        seeds = range(seed, seed + folds)
        if runner is not None:
            finished = _read_parts(runner, common, seeds, folder or runner.store.folder)
        else:
            show = lambda done: reporter.progress(done / folds, f"fold {done + 1} of {folds}")
            finished = _compute_folds(common, environment, seeds, show)
        held_out = (
            f"{100 * test_participants:g} % of the participants, {test_positions} positions in {test_zones} zones"
        )
        result = _summarise(finished, kinds, held_out, reporter)
        if folder is not None:
            result.files.extend(result.save(folder))
        for split in kinds:
            means = [row for row in result.rows if row["split"] == split]
            rows = [{k: row.get(k, math.nan) for k in ("method", *PRINTED)} for row in means]
            reporter.message(format_score_table(rows, f"{split}: means of {folds} folds"))
        for path in result.files:
            reporter.message(f"wrote {path}")
        if runner is not None:
            reporter.message(f"The folds are stored in {runner.store.folder}; nerg jobs shows their size.")
    return result


# ---- Folds ----


def _compute_folds(
    common: FoldInputs, environment: AnyEnvironment, seeds: Sequence[int], show: Callable[[int], None]
) -> Iterator[tuple[int, GazeField, dict[str, Any]]]:
    """Yield the seed, the field and the scores of each fold, in memory."""
    rays = open_rays(common.rays)
    opened = common.environment or Environment.open(environment)
    for done, seed in enumerate(seeds):
        show(done)
        gaze = _train_fold(common, rays, opened, seed)
        yield seed, gaze, _score_fold(common, gaze, rays, seed)


def _read_parts(
    runner: PartRunner, common: FoldInputs, seeds: Sequence[int], folder: Path
) -> Iterator[tuple[int, GazeField, dict[str, Any]]]:
    """Yield the same of folds that are parts of a job."""
    tasks = [Part(seed, f"fold {seed}") for seed in seeds]
    libraries = (*RENDER_LIBRARIES, "scipy")
    plan = Plan(f"nerg eval folds {os.path.abspath(folder)}", train_and_score, common, tasks, FOLDER_SUFFIX, libraries)
    for seed, made in zip(seeds, runner.run(plan)):
        results: Any = read_json(made.path / SCORED, "scores of a fold")
        yield seed, GazeField.load(made.path / FIELD), results


def train_and_score(common: FoldInputs, seed: int, output: Path) -> None:
    """Train a gaze field without some participants and zones (`FIELD`), score it in each split (`SCORED`).

    The files are written to the folder ``output``.
    """
    environment = common.environment
    if isinstance(environment, PlannedFiles):
        environment = Environment.open(environment.checked_path())
    gaze = _train_fold(common, common.rays, environment, seed, output / FIELD)
    write_json(output / SCORED, _score_fold(common, gaze, common.rays, seed), allow_nan=True)


def _train_fold(
    common: FoldInputs, rays: Rays | Path, environment: AnyEnvironment, seed: int, output: Path | None = None
) -> GazeField:
    recipe = replace(get_recipe(common.recipe), options=common.options, settings=common.settings, probes=common.probes)
    return train_gaze(
        rays,
        environment,
        recipe=recipe,
        variant=common.variant,
        ensemble=common.ensemble,
        align=common.align,
        test_zones=common.test_zones,
        test_positions=common.test_positions,
        test_participants=common.test_participants,
        seed=seed,
        output=output,
        progress=SILENT,
    )


def _score_fold(common: FoldInputs, gaze: GazeField, rays: Rays | Path, seed: int) -> dict[str, Any]:
    """Return the tables of each split."""
    tables = {}
    for split in common.splits:
        scored = evaluate_gaze(
            gaze,
            rays,
            gaze.environment,
            split=split,
            kappa=common.kappa,
            directions=common.directions,
            min_rays=common.min_rays,
            resamples=_FOLD_RESAMPLES,
            seed=seed,
            progress=SILENT,
        )
        tables[split] = {"rows": scored.rows, "positions": scored.positions, "people": scored.people}
        tables[split] |= {"by_position": scored.by_position, "calibration": scored.calibration}
        tables[split]["verdicts"] = scored.verdicts
    return tables


def _list_splits(splits: str | Sequence[str]) -> tuple[Split, ...]:
    names = dict.fromkeys(splits.split(",") if isinstance(splits, str) else splits)
    unknown = [split for split in names if split not in SPLITS]
    if unknown or not names:
        raise NergError(f'{parameter("splits")} must be some of {", ".join(SPLITS)}, got "{", ".join(unknown)}"')
    return tuple(split for name in names for split in SPLITS if split == name)


def _plan_environment(environment: AnyEnvironment, folder: Path | None) -> PlannedFiles:
    """Return the file of an environment; one in memory is written next to ``folder``."""
    opened = Environment.open(environment)
    if opened.path is None and folder is not None:
        opened = opened.save(folder.with_name(f"{folder.name}.environment"))
    assert opened.path is not None
    return PlannedFiles.plan(opened.path)


# ---- Tables ----


def _summarise(
    finished: Iterator[tuple[int, GazeField, dict[str, Any]]], splits: Sequence[str], held_out: str, reporter: Reporter
) -> FoldResult:
    """Return the result of the folds: their seeds, fields, and tables by split."""
    by_split, regions = {split: [] for split in splits}, {split: [] for split in splits}
    each, fields, positions, verdicts = [], [], [], []
    for seed, gaze, results in finished:
        fields.append(gaze)
        for split in splits:
            by_split[split].append(results[split]["rows"])
            each += [{"fold": seed, "split": split, **row} for row in results[split]["rows"]]
            # Zones of different folds, and participants of different splits, are different groups.
            group_key = lambda row, seed=seed, split=split: {"group": f"{seed} {split} {row['group']}"}
            positions += [
                {"fold": seed, "split": split, **row, **group_key(row)} for row in results[split]["by_position"]
            ]
            regions[split].append(results[split]["calibration"])
        # They are those of the held-out participants in every split that has them.
        verdicts += [{"fold": seed, **row} for row in results[splits[0]]["verdicts"]]
        for line in format_verdicts(results[splits[0]]["verdicts"]):
            reporter.message(f"fold {seed}, {line}")
        score = by_split[splits[0]][-1][0]
        reporter.message(f"fold {seed}, {splits[0]}: KLD {score['KLD']:.3f}, CC {score['CC']:.3f}")
    rows = [{"split": split, **row} for split, scores in by_split.items() for row in summarise_folds(scores)]
    populations = {split: [p for p in positions if p["split"] == split] for split in splits}
    if len(splits) > 1:
        populations["anywhere"] = positions
    ranks = [{"split": split, **row} for split, scores in populations.items() for row in correlate_uncertainty(scores)]
    held = [{"split": split, **row} for split, scores in regions.items() for row in average_folds(scores, _LEVELS)]
    for table in (rows, each, positions, ranks, held, verdicts):
        add_notes(table, explain_missing)
    return FoldResult(rows, each, fields, [], positions, ranks, held, held_out, verdicts)
