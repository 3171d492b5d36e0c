"""``nerg eval folds``: Train and score a gaze field again and again, each time without other people and zones, and
tell the means.

Gaze fields over folds: trained and scored again and again, each time without other people and other zones.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.evaluation.folds import mean_rows, means
from nerg_mi.evaluation.gaze import SCORES, SPLITS, score_table
from nerg_mi.evaluation.gaze_report import markdown, uncertainty_text
from nerg_mi.evaluation.uncertainty import rank_rows
from nerg_mi.files.atomic import check_folder, write_text
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.probes.probes import LEVELS, level_name
from nerg_mi.rays.dataset import is_dataset
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.task import FOLDER, RENDERS, Part, Plan
from nerg_mi.threads import set_thread_count

from .commands import argument, command, out
from .evaluation import evaluate_gaze
from .gaze import train_gaze
from .gaze_places import place_kind
from .options.evaluation import GazeEvaluationOptions
from .options.folds import FoldOptions
from .options.gaze import GazeOptions
from .parts import Parts, PlannedScene
from .reporter import SILENT, Reporter

FIELD, SCORED = "gaze.safetensors", "scores.json"
"""What the output of a fold holds: its field, and the rows of each split."""

_LEVELS = tuple(level_name(level) for level in LEVELS)


@dataclass(frozen=True)
class FoldResult:
    """``rows``: a row a split and method, means over folds (`evaluation.folds.mean_rows`); ``each``: a row a fold,
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
    place_kind(options)
    check_folder(output)
    parts = Parts(options, output, reporter, options.threads)
    if options.threads:
        set_thread_count(options.threads)
    reporter.progress(0.0, "reading")
    common = Folds(fold_options(options), splits, *_sources(rays, options))
    seeds = range(options.first, options.first + options.folds)
    what = f"nerg eval folds {os.path.abspath(output)}"
    tasks = [Part(seed, f"fold {seed}") for seed in seeds]
    plan = Plan(what, train_and_score, common, tasks, FOLDER, (*RENDERS, "scipy"))
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
    rows = [{"split": split, **row} for split, found in by_split.items() for row in mean_rows(found)]
    populations = {split: [p for p in positions if p["split"] == split] for split in splits}
    if len(splits) > 1:
        populations["anywhere"] = positions
    ranks = [{"split": split, **row} for split, found in populations.items() for row in rank_rows(found)]
    held = [{"split": split, **row} for split, found in regions.items() for row in means(found, _LEVELS)]
    written = _write(output, rows, each, options, positions, ranks, held)
    for path in written:
        reporter.message(f"wrote {path}")
    reporter.message(f"The folds are kept in {parts.store.folder}; nerg jobs says what they take.")
    return FoldResult(rows, each, fields, written, positions, ranks, held)


@command(
    "eval folds",
    more="Each fold is kept when it is done, and the same command goes on where it ended.",
    options=FoldOptions,
    rays=argument("Rays file (.npz or .parquet) or dataset."),
    output=out("Folder for the table."),
)
def print_folds(rays: Path, output: Path, options: FoldOptions, reporter: Reporter) -> None:
    """`evaluate_folds`, with the means as a table for each split."""
    result = evaluate_folds(rays, output, options, reporter)
    for split in options.splits.split(","):
        rows = [{k: row.get(k, math.nan) for k in ("method", *SCORES)} for row in result.rows if row["split"] == split]
        reporter.message(score_table(rows, f"{split}: means of {options.folds} folds"))


@dataclass(frozen=True)
class Folds:
    """What all folds have in common: ``options``, ``splits`` to score in, ``rays`` or their file, and the ``scene``."""

    options: FoldOptions
    splits: tuple[str, ...]
    rays: Rays | Path
    scene: PlannedScene | None


def fold_options(options: FoldOptions) -> FoldOptions:
    """The ``options`` without what folds are counted and rays are chosen by: a fold has its seed, and all rays."""
    plain = FoldOptions()
    return replace(options, **{name: getattr(plain, name) for name in ("folds", "first", "splits", "most")})


def train_and_score(common: Folds, seed: int, output: Path) -> None:
    """A fold: a gaze field that was trained without some people and zones (`FIELD`), and its rows in each split
    (`SCORED`), into the folder ``output``."""
    o, gaze = common.options, output / FIELD
    if common.scene is not None:
        common.scene.checked()
    training = GazeOptions(
        field=o.field,
        scene=o.scene,
        geometry=o.geometry,
        align=o.align,
        recipe=o.recipe,
        variant=o.variant,
        radius=o.radius,
        probes=o.probes,
        steps=o.steps,
        mix_folds=o.mix_folds,
        mix_kappa=o.mix_kappa,
        ensemble=o.ensemble,
        test_zones=o.zones,
        test_positions=o.positions,
        test_people=o.people,
        seed=seed,
        mode=o.mode,
    )
    train_gaze(common.rays, gaze, training)
    tables = {}
    for split in common.splits:
        scoring = GazeEvaluationOptions(
            field=o.field,
            scene=o.scene,
            split=split,
            kappa=o.kappa,
            directions=o.directions,
            min_rays=o.min_rays,
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
    return rays, None if options.scene is None else PlannedScene.of(options.scene)


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
            text += f"{markdown(own, ('method', *SCORES, 'integral', 'folds'))}\n"
        text += uncertainty_text(of(ranks, split), of(regions, split))
    write_text(files[0], text)
    write_csv(files[1], each)
    write_csv(files[2], positions)
    tables = {"methods": rows, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {"folds": options.folds, "first": options.first, **tables})
    return files
