"""Ablation: variants of a gaze field trained alike, scored on training positions and on held-out positions.

    python benchmarks/ablation.py RAYS [--environment ENVIRONMENT] [--recipes default,paper] [--variant VARIANT]
        [--test-participants 0.5] [--seeds 3] [--steps N] [--out out/benchmarks/ablation]

The variants of a recipe are emit, capture and their product, the other losses that it supports and, in a radiance
field, the semantic features and the initialisations that it supports. All are trained on the same rays, without those
within 2R of the held-out positions and those of held-out participants. The loss is that of the paper, KLD + (1 - CC) +
MAE of densities in 2,048 directions; `relative` is divided by that of the product of the same recipe. A frame is a
rendering of the gaze with the camera as the observer. Rows are stored next to the checkpoints, and a second run with
the same rays and settings does not train them again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256
from importlib import import_module
from itertools import product
from pathlib import Path

import nerg_mi as nerg
from nerg_mi.cli.declarations import select_backend
from nerg_mi.evaluation.gaze import compute_map_scores, make_test, select_held_out_rays
from nerg_mi.files.tables import write_json
from nerg_mi.train.gaze_data import digest_rays
from nerg_mi.train.gaze_folds import hold_out
from nerg_mi.train.gaze_recipes import Recipe, get_recipe
from timing import save_result

import numpy as np

WHOLE = "emit_capture"
COLUMNS = ("train_relative", "test_relative", "train_loss", "test_loss", "test_KLD", "test_CC", "test_MAE")
COLUMNS += ("train_seconds", "frame_seconds")


def list_variants(recipe: Recipe, in_field: bool) -> dict[str, dict]:
    """Options of `nerg.train_gaze` by the name of the variant; ``in_field``: whether there is a radiance field."""
    out: dict[str, dict] = {name: {"variant": name} for name in ("emit", "capture", WHOLE)}
    change = lambda settings, **options: {
        "recipe": replace(
            recipe, options=replace(recipe.options, **options), settings=replace(recipe.settings, **settings)
        )
    }
    out |= {f"loss {loss}": change({"loss": loss}) for loss in recipe.losses if loss != recipe.settings.loss}
    if in_field and "semantic" in recipe.supported_options:
        for kind in ("accumulated", "snapshot"):
            out |= {f"semantic {kind}": change({}, semantic=kind)}
            out |= {f"semantic {kind}, own too": change({}, semantic=kind, semantic_own=True)}
    if in_field and "init_from_field" in recipe.supported_options:
        out |= {"begins as the field, frozen": change({"freeze": True}, init_from_field=True)}
        out |= {"begins as the field": change({}, init_from_field=True)}
    return out


def make_tests(rays, args: argparse.Namespace) -> tuple:
    """Training rays, and the tests at training positions and at held-out positions."""
    split = (args.radius, args.test_zones, args.test_positions, args.seed, args.min_rays, args.test_participants)
    account = hold_out(rays, *split)[1]
    train, scored, centres = select_held_out_rays(rays, account, "both" if args.test_participants else "pos")
    near = train.origin[np.random.default_rng(0).permutation(len(train))[: len(centres)]]
    tests = {"train": make_test(train, near, args.radius, args.kappa, min_rays=min(args.min_rays, 16))}
    tests["test"] = make_test(scored, centres, args.radius, args.kappa, min_rays=args.min_rays)
    if args.ground_truth:
        module, _, name = args.ground_truth.partition(":")
        truth = getattr(import_module(module), name)().density
        # A known density is not smoothed.
        tests = {k: replace(t, truth=truth(t.centres, t.directions), kappa=None) for k, t in tests.items()}
    return train, tests


def describe(value: object) -> object:
    """What determines a training, of a recipe: without functions, whose addresses differ between processes."""
    if is_dataclass(value):
        values = {f.name: getattr(value, f.name) for f in fields(value)}
        return {name: v for name, v in values.items() if not callable(v)}
    return sorted(value) if isinstance(value, frozenset) else str(value)


def train_variant(rays, tests: dict, file: Path, settings: dict) -> dict:
    """Scores and seconds of a training with ``settings``, whose checkpoint is ``file``; stored next to it."""
    path, digests = file.with_suffix(".json"), {k: sha256(t.truth.tobytes()).hexdigest() for k, t in tests.items()}
    same = json.loads(json.dumps({**settings, "rays": digest_rays(rays), "tests": digests}, default=describe))
    stored = json.loads(path.read_text()) if path.is_file() and file.is_file() else {}
    if stored.get("same") != same:
        started = time.perf_counter()
        field = nerg.train_gaze(rays, **settings, output=file)
        row = {"steps": field.provenance["steps"], "train_seconds": time.perf_counter() - started}
        for side, test in tests.items():
            row |= {f"{side}_{k}": v for k, v in score(test, field).items()}
        stored = {"same": same, "row": row}
        write_json(path, stored)
    return stored["row"]


def score(test, field) -> dict[str, float]:
    """KLD, CC, MAE and the loss of ``field`` at the positions of ``test``."""
    pairs = np.repeat(test.centres, len(test.directions), axis=0), np.tile(test.directions, (len(test.centres), 1))
    scores = compute_map_scores(test.truth, test.smooth(field.density(*pairs).reshape(len(test.centres), -1)))
    return {k: scores[k] for k in ("KLD", "CC", "MAE")} | {"loss": scores["KLD"] + 1 - scores["CC"] + scores["MAE"]}


def time_frames(geometry: str, gaze: Path, eyes: np.ndarray, size: str) -> float:
    """Mean seconds of a frame from each of ``eyes``. The first one, which compiles kernels, is not counted."""
    width, height = map(int, size.split("x"))
    scene, times = nerg.make_scene(geometry, gaze, radiance=False), []
    for eye, angle in zip([eyes[0], *eyes], np.random.default_rng(0).uniform(0, 2 * np.pi, len(eyes) + 1)):
        target = eye + (np.cos(angle), np.sin(angle), -0.1)
        camera = nerg.Camera(origin=eye, target=target, fov=70, width=width, height=height)
        started = time.perf_counter()
        nerg.render(scene, quantities="gaze", camera=camera, spp=1, progress=False)
        times.append(time.perf_counter() - started)
    return float(np.mean(times[1:]))


def summarise(rows: list[dict]) -> list[list]:
    """Means of `COLUMNS` over seeds with standard deviations, for each recipe and variant."""
    out = []
    for key in dict.fromkeys((r["recipe"], r["variant"]) for r in rows):
        group = [r for r in rows if (r["recipe"], r["variant"]) == key]
        values = [[r[k] for r in group if k in r] for k in COLUMNS]
        spread = lambda v: f" ± {np.std(v, ddof=1):.3f}" if len(v) > 1 else ""
        out.append([*key, len(group), *(f"{np.mean(v):.3f}{spread(v)}" if v else "" for v in values)])
    return out


def main(argv=None) -> list[dict]:
    """Train, print and write the table; returns its rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("rays", type=Path, help="Rays file (.npz or .parquet).")
    add(
        "--environment", default="hits", help="hits, none, or a field, splats, a scene or a mesh. Default: %(default)s."
    )
    add("--recipes", default="default,paper", help="Recipes, separated by commas. Default: %(default)s.")
    add("--variant", action="append", default=[], help="Name of a variant to train; can be repeated. Default: all.")
    add("--seeds", type=int, default=1, help="Number of trainings of a variant. Default: %(default)s.")
    add("--seed", type=int, default=0, help="Seed of the held-out data and the first training. Default: %(default)s.")
    add("--steps", type=int, help="Number of training steps of all recipes. Default: set by the recipe.")
    add("--no-refit", dest="refit", action="store_false", help="Only the default recipe trains again on all rays.")
    add("--test-zones", type=int, default=3, help="Zones with held-out positions. Default: %(default)s.")
    add("--test-positions", type=int, default=60, help="Held-out positions in all zones. Default: %(default)s.")
    add("--test-participants", type=float, default=0.0, help="Held-out fraction of participants. Default: %(default)s.")
    add("--min-rays", type=int, default=64, help="Minimum number of rays of a held-out position. Default: %(default)s.")
    add("--radius", type=float, default=0.25, help="Radius of a test probe in metres. Default: %(default)s.")
    add("--kappa", type=float, default=20.0, help="Concentration of the reference's kernels. Default: %(default)s.")
    add("--ground-truth", help="MODULE:CLASS with the true density(positions, directions). Default: the test rays.")
    add("--timing-cameras", type=int, default=0, help="Cameras of timed frames (paper: 32). Default: %(default)s.")
    add("--timing-size", default="320x180", help="Size of timed frames (paper: 1280x720). Default: %(default)s.")
    add("--threads", type=int, help="Number of CPU threads. Default: all cores.")
    add("--out", type=Path, default=Path("out/benchmarks/ablation"), help="Output folder. Default: %(default)s.")
    add("--result", default="ablation", help="Name of the result. Default: %(default)s.")
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    select_backend("llvm_ad_rgb", args.threads)
    (train, tests), rows = make_tests(nerg.Rays.load(args.rays), args), []
    centres = tests["test"].centres
    for recipe in args.recipes.split(","):
        # A prior would make the networks that are compared more alike.
        chosen = get_recipe(recipe)
        if not args.refit and recipe != "default":
            chosen = replace(chosen, settings=replace(chosen.settings, refit=False))
        common = {"recipe": chosen, "environment": args.environment, "prior_folds": 0}
        variants = list_variants(chosen, args.environment.endswith(".safetensors"))
        for name, seed in product(args.variant or variants, range(args.seed, args.seed + args.seeds)):
            file = args.out / f"{recipe}_{name.replace(', ', '_').replace(' ', '_')}_{seed}.safetensors"
            settings = {**common, **variants[name], "seed": seed, "steps": args.steps}
            rows.append(
                {"recipe": recipe, "variant": name, "seed": seed, **train_variant(train, tests, file, settings)}
            )
            if args.timing_cameras and args.environment not in ("hits", "none"):
                eyes = centres[np.random.default_rng(0).integers(0, len(centres), args.timing_cameras)]
                rows[-1]["frame_seconds"] = time_frames(args.environment, file, eyes, args.timing_size)
        for side in ("train", "test"):
            whole = [r[f"{side}_loss"] for r in rows if (r["recipe"], r["variant"]) == (recipe, WHOLE)]
            for row in (r for r in rows if whole and r["recipe"] == recipe):
                row[f"{side}_relative"] = row[f"{side}_loss"] / np.mean(whole)
    seeds = ", ".join(map(str, range(args.seed, args.seed + args.seeds)))
    save_result(args.result, ("recipe", "variant", "seeds", *COLUMNS), summarise(rows), seeds)
    return rows


if __name__ == "__main__":
    main()
