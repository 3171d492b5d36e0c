"""Training every variant of a gaze field alike, in parts, and comparing them."""

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
from nerg_mi.evaluation.gaze import Baseline, FieldDensity, GazeTest, select_held_out_rays
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import check_folder, replace_atomically
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.formats.fields import save_gaze
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.engines import prepare_once
from nerg_mi.tasks.task import FOLDER_SUFFIX, RENDER_LIBRARIES, Part, Plan
from nerg_mi.train.gaze_data import Supervision, digest_rays, hold_out
from nerg_mi.train.gaze_recipes import get_recipe
from nerg_mi.train.gaze_trainer import GazePlan
from nerg_mi.train.geometry import TrainingGeometry

from .base import SILENT, Reporter, select_backend
from .gaze_commands import AblationOptions, GazeOptions
from .geometry import check_geometry, make_geometry, geometry_kind
from .options import exposed_options
from .parts import PartRunner, PlannedScene
from .train_gaze import plan_gaze, train_planned

# ---- What the variants of an ablation have in common, and the training of one of them ----


@dataclass(frozen=True)
class AblationBenchmark:
    """What all variants have in common: the rays of training, tests at ``centres`` (T, 3) and so many ``people`` who
    are held out, the place, and the ``folder`` of checkpoints."""

    train: Rays
    tests: dict[str, GazeTest]
    centres: np.ndarray
    people: int
    place: TrainingGeometry
    folder: Path
    ns: ModuleType
    options: AblationOptions


def prepare_benchmark(data: Rays, options: AblationOptions, folder: Path, ns: ModuleType, reporter: Reporter) -> AblationBenchmark:
    """What all variants have in common that are trained on some of the rays ``data`` and scored on the others; a place
    of hit points is written into ``folder``."""
    truth = load_ground_truth(options.law) if options.law else None
    _, account = hold_out(
        data, options.radius, options.zones, options.positions, options.first, options.min_rays, options.people
    )
    train, scored, centres = select_held_out_rays(data, account, "both" if options.people else "pos")
    place = make_geometry(options, train, (), folder / "place.vol", ns, reporter=reporter)
    # Bad places are part of what may be compared: it is told, and no more.
    check_geometry(place, train, f"--{place.kind} FILE", True, reporter)
    tests = ablation.make_tests(scored, train, centres, options.radius, options.kappa, options.min_rays, truth)
    return AblationBenchmark(train, tests, np.asarray(centres), len(account["people"]), place, folder, ns, options)


def train_variant(variant: Variant, seed: int, path: Path, bench: AblationBenchmark) -> dict:
    """Scores and times of one training, whose checkpoint is written to ``path``."""
    made = {"recipe": variant.recipe, "variant": variant.name, "seed": seed}
    return _train(made, make_plan(variant, seed, bench), path, bench)


def make_plan(variant: Variant, seed: int, bench: AblationBenchmark) -> GazePlan:
    """How a variant is trained with a seed."""
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
            # Heads are compared: what is mixed in besides would make them alike.
            mix_folds=0,
            seed=seed,
        ),
        bench.place,
    )
    # Positions that validate are to be had wherever there are some that test.
    watched = plan.settings.validation_min_rays or plan.probes.min_rays
    return plan.with_settings(validation_min_rays=min(watched, options.min_rays))


def _train(made: dict, plan: GazePlan, path: Path, bench: AblationBenchmark) -> dict:
    """Train, write the checkpoint (``made``: what it is), and score. Raises ``KeyboardInterrupt`` after Ctrl-C."""
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
    """The density of an instance of the class that ``MODULE:CLASS`` names."""
    module, _, kind = name.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)().density
    except (ImportError, AttributeError, ValueError) as error:
        raise NergError(
            "--law needs MODULE:CLASS that can be imported, such as nerg_mi.scenes.store.attention_law:AttentionLaw, "
            f'got "{name}"'
        ) from error


# ---- Ablation ----
#
# The paper's ablation: every variant of a gaze field, trained alike, scored on what it saw and on what it did not.


_FIELD, _ROW = "gaze.safetensors", "row.json"


@dataclass(frozen=True)
class AblationResult:
    """What every variant scored."""

    # A row a variant and seed (`evaluation.ablation.COLUMNS`).
    rows: list[dict]
    # Tables and plot that were written.
    files: list[Path]


def ablate(
    rays: Rays | str | Path, output: str | Path, options: AblationOptions | None = None, reporter: Reporter = SILENT
) -> AblationResult:
    """Train and score every variant of the recipes in one place, on ``rays`` of attention or their file.

    Checkpoints go to the folder ``output``, each with its row: what an earlier run with the same rays, place, tests and
    settings has left there is not trained again. With ``options.store`` or ``options.scheduler`` a training is a part,
    which is kept with its row and may be run by others; frames are timed here all the same. Raises `NergError` for what
    the user can mend.
    """
    options, output = options or AblationOptions(), Path(output)
    geometry_kind(options)
    width, height = _size(options.size)
    recipes = options.recipes.split(",")
    radiance = options.field is not None and not is_splat_file(options.field)
    known = ablation.list_variants(radiance, recipes)
    variants = _chosen(known, options.variant)
    if options.law:
        load_ground_truth(options.law)
    check_folder(output)
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.0, "preparing")
    data = rays if isinstance(rays, Rays) else load_rays(rays)
    bench = prepare_benchmark(data, options, output, ns, reporter)
    timer = None
    if options.cameras:
        folder = output if options.field is None else Path(options.field).parent
        timer = make_frame_timer(bench.place, bench.centres, folder, options.cameras, width, height)
    seeds = lambda v: range(options.first, options.first + (options.seeds if get_recipe(v.recipe).is_quick else 1))
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
    """The row of each training that is ``due``."""
    if bench.options.in_parts:
        yield from _rows_in_parts(due, bench, data, reporter)
        return
    for k, (variant, seed) in enumerate(due):
        reporter.progress(k / len(due), f"{variant.recipe} {variant.name}, seed {seed}")
        yield _row(variant, seed, bench)


def _rows_in_parts(due: list[tuple[Variant, int]], bench: AblationBenchmark, rays: Rays, reporter: Reporter) -> Iterator[dict]:
    """The same from parts, of which some may have been kept; ``rays``: all of them. Checkpoints are copied into the
    folder of ``bench``."""
    options, folder = bench.options, bench.folder
    scene = None if options.scene is None else PlannedScene.plan(options.scene)
    common = Ablation(training_options(options), rays, scene)
    tasks = [Part((v.recipe, v.name, seed), f"{v.recipe} {v.name}, seed {seed}") for v, seed in due]
    plan = Plan(f"nerg ablate {os.path.abspath(folder)}", train_part, common, tasks, FOLDER_SUFFIX, (*RENDER_LIBRARIES, "scipy"))
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
    """What all trainings of an ablation have in common, wherever they run."""

    options: AblationOptions
    rays: Rays
    scene: PlannedScene | None


def training_options(options: AblationOptions) -> AblationOptions:
    """The ``options`` without what trainings are chosen by, and without how the command times frames."""
    plain = AblationOptions()
    chosen = {name: getattr(plain, name) for name in ("recipes", "variant", "seeds", "cameras", "size")}
    return replace(options, **chosen)


def train_part(common: Ablation, value: tuple[str, str, int], output: Path) -> None:
    """The checkpoint and the row (JSON) of one training, into the folder ``output``; ``value``: recipe, variant and
    seed."""
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
    """Scores and times of one training, which an earlier run may have left."""
    path = bench.folder / variant.file_name(seed)
    kept = path.with_suffix(".json")
    found = read_json(kept, "kept row") if path.exists() and kept.exists() else None
    same = json.loads(json.dumps(_identity(variant, seed, bench)))
    if isinstance(found, dict) and "row" in found and found.get("same") == same:
        return found["row"]
    row = train_variant(variant, seed, path, bench)
    _keep(row, variant, seed, bench)
    return row


def _keep(row: dict, variant: Variant, seed: int, bench: AblationBenchmark) -> None:
    """Write ``row`` beside its checkpoint."""
    path = (bench.folder / variant.file_name(seed)).with_suffix(".json")
    write_json(path, {"row": row, "same": _identity(variant, seed, bench)}, allow_nan=True)


def _identity(variant: Variant, seed: int, bench: AblationBenchmark) -> dict:
    """All that a row depends on, as JSON has it."""
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


def _chosen(variants: list[Variant], names: tuple[str, ...]) -> list[Variant]:
    """Those of ``variants`` that are called one of ``names``; all without any."""
    known = list(dict.fromkeys(v.name for v in variants))
    if unknown := sorted(set(names) - set(known)):
        raise NergError(f'--variant must be one of {", ".join(known)} here, got "{unknown[0]}"')
    return [v for v in variants if not names or v.name in names]


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(x) for x in text.lower().split("x"))
    except ValueError as error:
        raise NergError(f'--size needs WIDTHxHEIGHT, got "{text}"') from error
    return width, height


def _notes(centres: int, people: int, count: tuple[int, int], options: AblationOptions, timed: bool) -> str:
    """What the tables say, for whoever reads them later; ``count``: of the rays that were trained on, and of all."""
    trained, whole = count
    without = f", {people} people held out" if people else ""
    source = f"that of {options.law}" if options.law else f"with kappa {options.kappa:g}"
    width, height = _size(options.size)
    frame = f" A frame: {width} x {height}, mean of {options.cameras} cameras." if timed else ""
    return (
        f"{centres} held-out positions in {options.zones} zones{without}; {trained:,} of {whole:,} rays trained on. "
        f"Losses: KLD + (1 - CC) + MAE over 2,048 directions, truth {source}; relative to emit_capture of the same "
        f"recipe; ± is the standard deviation over seeds.{frame}"
    )
