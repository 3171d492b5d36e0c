"""What the variants of an ablation have in common, and the training of one of them."""

from __future__ import annotations

import importlib
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import ablation
from nerg_mi.evaluation.ablation import Variant
from nerg_mi.evaluation.gaze import Baseline, GazeTest, gaze_field, held_out_rays
from nerg_mi.formats.fields import save_gaze
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import Supervision, hold_out
from nerg_mi.train.gaze_recipes import gaze_recipe
from nerg_mi.train.gaze_trainer import GazePlan
from nerg_mi.train.geometry import GazePlace

from .gaze import train_planned
from .gaze_places import check_place, make_place
from .gaze_plan import plan_gaze
from .options.ablation import AblationOptions
from .options.gaze import GazeOptions
from .reporter import Reporter


@dataclass(frozen=True)
class Bench:
    """What all variants have in common: the rays of training, tests at ``centres`` (T, 3) and so many ``people`` who
    are held out, the place, and the ``folder`` of checkpoints."""

    train: Rays
    tests: dict[str, GazeTest]
    centres: np.ndarray
    people: int
    place: GazePlace
    folder: Path
    ns: ModuleType
    options: AblationOptions


def bench_of(data: Rays, options: AblationOptions, folder: Path, ns: ModuleType, reporter: Reporter) -> Bench:
    """What all variants have in common that are trained on some of the rays ``data`` and scored on the others; a place
    of hit points is written into ``folder``."""
    truth = law_of(options.law) if options.law else None
    _, account = hold_out(
        data, options.radius, options.zones, options.positions, options.first, options.min_rays, options.people
    )
    train, scored, centres = held_out_rays(data, account, "both" if options.people else "pos")
    place = make_place(options, train, (), folder / "place.vol", ns, reporter=reporter)
    # Bad places are part of what may be compared: it is told, and no more.
    check_place(place, train, f"--{place.kind} FILE", True, reporter)
    tests = ablation.make_tests(scored, train, centres, options.radius, options.kappa, options.min_rays, truth)
    return Bench(train, tests, np.asarray(centres), len(account["people"]), place, folder, ns, options)


def train_variant(variant: Variant, seed: int, path: Path, bench: Bench) -> dict:
    """Scores and times of one training, whose checkpoint is written to ``path``."""
    made = {"recipe": variant.recipe, "variant": variant.name, "seed": seed}
    return _train(made, plan_of(variant, seed, bench), path, bench)


def plan_of(variant: Variant, seed: int, bench: Bench) -> GazePlan:
    """How a variant is trained with a seed."""
    options, quick = bench.options, gaze_recipe(variant.recipe).quick
    plan = plan_gaze(
        GazeOptions(
            recipe=variant.recipe,
            variant=variant.gaze,
            semantic=variant.semantic,
            semantic_own=variant.semantic_own,
            begin="field" if variant.begin else "random",
            freeze=variant.frozen,
            loss=variant.loss or None,
            steps=(options.default_steps if quick else options.steps) or None,
            probes=options.probes or None,
            refit=options.refit or quick,
            # Heads are compared: what is mixed in besides would make them alike.
            mix_folds=0,
            seed=seed,
        ),
        bench.place,
    )
    # Positions that validate are to be had wherever there are some that test.
    watched = plan.settings.watched_rays or plan.probes.min_rays
    return plan.with_settings(watched_rays=min(watched, options.min_rays))


def _train(made: dict, plan: GazePlan, path: Path, bench: Bench) -> dict:
    """Train, write the checkpoint (``made``: what it is), and score. Raises ``KeyboardInterrupt`` after Ctrl-C."""
    started = time.perf_counter()
    result = train_planned(Supervision(bench.train), bench.place, plan, bench.ns)
    if result.interrupted:
        raise KeyboardInterrupt
    seconds = time.perf_counter() - started
    save_gaze(result.field, path, {**bench.place.about, **result.provenance, **made})
    density = gaze_field(result.field, bench.place.medium, bench.place.align, plan.probes.depth)
    times = {"steps": result.provenance["steps"], "train_seconds": seconds}
    return {**made, **times, **ablation.score(bench.tests, density)}


def law_of(name: str) -> Baseline:
    """The density of an instance of the class that ``MODULE:CLASS`` names."""
    module, _, kind = name.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)().density
    except (ImportError, AttributeError, ValueError) as error:
        raise NergError(
            "--law needs MODULE:CLASS that can be imported, such as nerg_mi.scenes.store.attention_law:AttentionLaw, "
            f'got "{name}"'
        ) from error
