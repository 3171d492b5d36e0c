"""Train the variants of a gaze field under equal conditions, in parts or directly, and compare them."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import ablation
from nerg_mi.evaluation.ablation import Variant, make_frame_timer
from nerg_mi.evaluation.baselines import Baseline
from nerg_mi.evaluation.gaze import FieldDensity, GazeTest, select_held_out_rays
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_folder, replace_atomically
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.formats.fields import save_gaze
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.options import exposed_options
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.task import FOLDER_SUFFIX, RENDER_LIBRARIES, Part, Plan
from nerg_mi.train.gaze_data import Supervision, digest_rays, hold_out
from nerg_mi.train.gaze_recipes import get_recipe
from nerg_mi.train.gaze_trainer import GazePlan
from nerg_mi.train.geometry import TrainingGeometry
from nerg_mi.train.geometry_files import check_geometry, geometry_kind, make_geometry

from .base import select_backend
from .gaze_commands import AblationOptions, GazeOptions
from .parts import PartRunner, PlannedScene
from .train_gaze import plan_gaze, train_planned

# ---- Inputs that all variants share, and the training of one variant ----


@dataclass(frozen=True)
class AblationBenchmark:
    """Inputs that all variants share.

    The training rays, the tests at ``centres`` (T, 3), the number of held-out participants (``people``), the geometry,
    and the ``folder`` for checkpoints.
    """

    train: Rays
    tests: dict[str, GazeTest]
    centres: np.ndarray
    people: int
    place: TrainingGeometry
    folder: Path
    ns: ModuleType
    options: AblationOptions


def prepare_benchmark(
    data: Rays, options: AblationOptions, folder: Path, ns: ModuleType, reporter: Reporter
) -> AblationBenchmark:
    """Split the rays ``data`` into training and test rays, and build the geometry and the tests.

    A volume of hit points is written to ``folder``.
    """
    truth = load_ground_truth(options.ground_truth) if options.ground_truth else None
    _, account = hold_out(
        data,
        options.radius,
        options.test_zones,
        options.test_positions,
        options.seed,
        options.min_rays,
        options.test_participants,
    )
    train, scored, centres = select_held_out_rays(data, account, "both" if options.test_participants else "pos")
    place = make_geometry(options, train, (), folder / "place.vol", ns, reporter=reporter)
    # A wrong alignment is reported and not rejected: it may be what is compared.
    check_geometry(place, train, f"--{place.kind} FILE", True, reporter)
    tests = ablation.make_tests(scored, train, centres, options.radius, options.kappa, options.min_rays, truth)
    return AblationBenchmark(train, tests, np.asarray(centres), len(account["people"]), place, folder, ns, options)


def train_variant(variant: Variant, seed: int, path: Path, bench: AblationBenchmark) -> dict:
    """Train one variant, write its checkpoint to ``path``, and return its scores and times."""
    made = {"recipe": variant.recipe, "variant": variant.name, "seed": seed}
    return _train(made, make_plan(variant, seed, bench), path, bench)


def make_plan(variant: Variant, seed: int, bench: AblationBenchmark) -> GazePlan:
    """Return the training plan of a variant for one seed."""
    options, quick = bench.options, get_recipe(variant.recipe).is_quick
    plan = plan_gaze(
        GazeOptions(
            **exposed_options(options),
            recipe=variant.recipe,
            variant=variant.field_variant,
            semantic=variant.semantic,
            semantic_concat=variant.semantic_own,
            init="field" if variant.init_from_field else "random",
            freeze=variant.frozen,
            loss=variant.loss or None,
            steps=(options.default_steps if quick else options.steps) or None,
            refit=options.refit or quick,
            # A prior would make the networks that are compared more alike.
            prior_folds=0,
            seed=seed,
        ),
        bench.place,
    )
    # Validation probes exist wherever test positions exist.
    watched = plan.settings.validation_min_rays or plan.probes.min_rays
    return plan.with_settings(validation_min_rays=min(watched, options.min_rays))


def _train(made: dict, plan: GazePlan, path: Path, bench: AblationBenchmark) -> dict:
    """Train, write the checkpoint with the metadata ``made``, and score. Raises ``KeyboardInterrupt`` after Ctrl-C."""
    started = time.perf_counter()
    result = train_planned(Supervision(bench.train), bench.place, plan, bench.ns)
    if result.interrupted:
        raise KeyboardInterrupt
    seconds = time.perf_counter() - started
    save_gaze(result.field, path, {**bench.place.metadata, **result.provenance, **made})
    density = FieldDensity(result.field, bench.place.medium, bench.place.align, plan.probes.depth)
    times = {"steps": result.provenance["steps"], "train_seconds": seconds}
    return {**made, **times, **ablation.score_density(bench.tests, density)}


def load_ground_truth(name: str) -> Baseline:
    """Return the density of an instance of the class that ``MODULE:CLASS`` names. Raises `NergError`."""
    module, _, kind = name.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)().density
    except (ImportError, AttributeError, ValueError) as error:
        raise NergError(
            "--ground-truth must be an importable MODULE:CLASS, such as "
            f'nerg_mi.scenes.store.attention_law:AttentionLaw, got "{name}"'
        ) from error


# ---- Ablation ----
#
# The ablation of the paper: all variants are trained alike and scored on training and held-out data.


_FIELD, _ROW = "gaze.safetensors", "row.json"


@dataclass(frozen=True, repr=False)
class AblationResult(ResultTables):
    """Scores of all variants."""

    TABLES = ("rows",)

    # One row per variant and seed (`evaluation.ablation.COLUMNS`).
    rows: list[dict]
    # Written tables and plot.
    files: list[Path]


def ablate(
    rays: Rays | str | Path, output: str | Path, options: AblationOptions | None = None, reporter: Reporter = SILENT
) -> AblationResult:
    """Train and score all variants of the recipes on ``rays``, or on a file of rays.

    Checkpoints are written to the folder ``output``, each with its row of the table. A variant is not trained again if
    an earlier run with the same rays, geometry, tests and settings has written its checkpoint there. With
    ``options.store`` or ``options.scheduler`` each training is a part that is stored and may run elsewhere; frames are
    always timed in this process. Raises `NergError` for errors that the user can correct.
    """
    options, output = options or AblationOptions(), Path(output)
    geometry_kind(options)
    width, height = _size(options.timing_size)
    recipes = options.recipes.split(",")
    radiance = options.field is not None and not is_splat_file(options.field)
    available = ablation.list_variants(radiance, recipes)
    variants = _select_variants(available, options.variant, options.recipes)
    if options.ground_truth:
        load_ground_truth(options.ground_truth)
    check_folder(output)
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.0, "preparing")
    data = rays if isinstance(rays, Rays) else load_rays(rays)
    bench = prepare_benchmark(data, options, output, ns, reporter)
    timer = None
    if options.timing_cameras:
        folder = output if options.field is None else Path(options.field).parent
        timer = make_frame_timer(bench.place, bench.centres, folder, options.timing_cameras, width, height)
    seeds = lambda v: range(options.seed, options.seed + (options.seeds if get_recipe(v.recipe).is_quick else 1))
    due = [(v, seed) for v in variants for seed in seeds(v)]
    rows = []
    for (variant, seed), row in zip(due, _rows(due, bench, data, reporter)):
        if timer is not None:
            row["frame_seconds"] = timer(output / variant.file_name(seed))
        rows.append(row)
        reporter.message(
            f"{variant.recipe:8s} {variant.name:28s} seed {seed}: test KLD {row['test_KLD']:.3f}, "
            f"CC {row['test_CC']:.3f}; {row['train_seconds']:.0f} s"
        )
    ablation.add_relative_losses(rows)
    notes = _notes(len(bench.centres), bench.people, (len(bench.train), len(data)), options, timer is not None)
    made = make_provenance("nerg ablate", existing_files(rays, options.field, options.scene), None, options)
    files = ablation.write_ablation(output, rows, notes, made)
    for path in files:
        reporter.message(f"wrote {path}")
    return AblationResult(rows, files)


def _rows(due: list[tuple[Variant, int]], bench: AblationBenchmark, data: Rays, reporter: Reporter) -> Iterator[dict]:
    """Yield the row of each of the trainings ``due``."""
    if bench.options.in_parts:
        yield from _rows_in_parts(due, bench, data, reporter)
        return
    for k, (variant, seed) in enumerate(due):
        reporter.progress(k / len(due), f"{variant.recipe} {variant.name}, seed {seed}")
        yield _row(variant, seed, bench)


def _rows_in_parts(
    due: list[tuple[Variant, int]], bench: AblationBenchmark, rays: Rays, reporter: Reporter
) -> Iterator[dict]:
    """Yield the rows from parts, some of which may be stored already.

    ``rays`` are all rays. Checkpoints are copied to the folder of ``bench``.
    """
    options, folder = bench.options, bench.folder
    scene = None if options.scene is None else PlannedScene.plan(options.scene)
    common = Ablation(training_options(options), rays, scene)
    tasks = [Part((v.recipe, v.name, seed), f"{v.recipe} {v.name}, seed {seed}") for v, seed in due]
    plan = Plan(
        f"nerg ablate {os.path.abspath(folder)}", train_part, common, tasks, FOLDER_SUFFIX, (*RENDER_LIBRARIES, "scipy")
    )
    made = PartRunner(options, folder, reporter, options.threads).run(plan)
    for (variant, seed), part in zip(due, made):
        with replace_atomically(folder / variant.file_name(seed)) as temporary:
            shutil.copyfile(part.path / _FIELD, temporary)
        row = read_json(part.path / _ROW, "row of an ablation")
        assert isinstance(row, dict)
        _keep(row, variant, seed, bench)
        yield row


@dataclass(frozen=True)
class Ablation:
    """Inputs that all parts of an ablation share."""

    options: AblationOptions
    rays: Rays
    scene: PlannedScene | None


def training_options(options: AblationOptions) -> AblationOptions:
    """Return ``options`` without those that select trainings and those that time frames."""
    plain = AblationOptions()
    return replace(
        options,
        recipes=plain.recipes,
        variant=plain.variant,
        seeds=plain.seeds,
        timing_cameras=plain.timing_cameras,
        timing_size=plain.timing_size,
    )


def train_part(common: Ablation, value: tuple[str, str, int], output: Path) -> None:
    """Write the checkpoint and the row (JSON) of one training to the folder ``output``.

    ``value`` holds the recipe, the variant and the seed.
    """
    options, (recipe, name, seed) = common.options, value
    ns = select_backend(options.mode)
    if common.scene is not None:
        common.scene.checked_path()

    def prepare() -> tuple[AblationBenchmark, TemporaryDirectory]:
        folder = TemporaryDirectory(prefix="nerg-ablation-")
        return prepare_benchmark(common.rays, options, Path(folder.name), ns, SILENT), folder

    bench = prepare_once(common, prepare)[0]
    variants = ablation.list_variants(options.field is not None, [recipe])
    variant = next(v for v in variants if v.name == name)
    write_json(output / _ROW, train_variant(variant, seed, output / _FIELD, bench), allow_nan=True)


def _row(variant: Variant, seed: int, bench: AblationBenchmark) -> dict:
    """Return the scores and times of one training, which may be stored by an earlier run."""
    path = bench.folder / variant.file_name(seed)
    row_file = path.with_suffix(".json")
    stored = read_json(row_file, "row of an earlier run") if path.exists() and row_file.exists() else None
    same = json.loads(json.dumps(_identity(variant, seed, bench)))
    if isinstance(stored, dict) and "row" in stored and stored.get("same") == same:
        return stored["row"]
    row = train_variant(variant, seed, path, bench)
    _keep(row, variant, seed, bench)
    return row


def _keep(row: dict, variant: Variant, seed: int, bench: AblationBenchmark) -> None:
    """Write ``row`` next to its checkpoint."""
    path = (bench.folder / variant.file_name(seed)).with_suffix(".json")
    write_json(path, {"row": row, "same": _identity(variant, seed, bench)}, allow_nan=True)


def _identity(variant: Variant, seed: int, bench: AblationBenchmark) -> dict:
    """Return everything that a row depends on, as JSON."""
    plan = make_plan(variant, seed, bench)
    return {
        "architecture": plan.config.to_dict(),
        "settings": plan.settings.to_dict(),
        "probes": plan.probes.to_dict(),
        "rays": digest_rays(bench.train),
        "tests": {k: hashlib.sha256(t.truth.tobytes()).hexdigest() for k, t in bench.tests.items()},
        "begin": variant.init_from_field,
        **bench.place.metadata,
    }


def _select_variants(variants: list[Variant], names: tuple[str, ...], recipes: str) -> list[Variant]:
    """Return those of ``variants`` of the ``recipes`` whose name is in ``names``, or all if ``names`` is empty."""
    available = list(dict.fromkeys(v.name for v in variants))
    if unknown := sorted(set(names) - set(available)):
        raise NergError(
            f'the training recipes "{recipes}" have no variant "{unknown[0]}"; --variant must be one of '
            f"{', '.join(available)}"
        )
    return [v for v in variants if not names or v.name in names]


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(x) for x in text.lower().split("x"))
    except ValueError as error:
        raise NergError(f'--timing-size must be WIDTHxHEIGHT, got "{text}"') from error
    return width, height


def _notes(centres: int, people: int, count: tuple[int, int], options: AblationOptions, timed: bool) -> str:
    """Return the text above the tables; ``count`` holds the number of training rays and of all rays."""
    trained, total = count
    without = f", {people} participants held out" if people else ""
    source = f"analytic ({options.ground_truth})" if options.ground_truth else f"with kappa {options.kappa:g}"
    width, height = _size(options.timing_size)
    frame = f" Frame time: {width} x {height} pixels, mean of {options.timing_cameras} cameras." if timed else ""
    return (
        f"{centres} held-out positions in {options.test_zones} zones{without}; {trained:,} of {total:,} rays used "
        f"for training. Losses: KLD + (1 - CC) + MAE over 2,048 directions, reference {source}; relative to "
        f"emit_capture of the same recipe; ± is the standard deviation over seeds.{frame}"
    )
