"""Generate the demo store from a seed: ``python -m nerg_mi.scenes.store.make --seed 0 [--stage NAME ...]``.

Stages run in the order of `STAGES`. Files that are part of the package are written next to this file, all others into
``build/``. Each stage only reads files of earlier stages.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
SAMPLE_DIVISOR = 10
"""The packaged sample has one in this many parts of each shopper's visit."""


@dataclass(frozen=True)
class Job:
    """Arguments of a stage: the seed, the folder of the packaged results and the folder of all other files."""

    seed: int
    store: Path = FOLDER
    build: Path = FOLDER / "build"


def make_twin(job: Job) -> list[Path]:
    """Mitsuba shapes and areas of interest: twin.xml, two meshes, regions.json."""
    from nerg_mi.scenes.store import layout, twin

    store = layout.build_store(job.seed)
    return [*twin.write_twin(store, job.store), layout.write_regions(store, job.store / "regions.json")]


def make_views(job: Job) -> list[Path]:
    """Posed pictures with exact depth, rendered from the twin."""
    from nerg_mi.scenes.store import layout, twin, views

    views.write_views(
        layout.build_store(job.seed), job.build, seed=job.seed, scene=twin.load_twin(job.store / "twin.xml")
    )
    return [job.build / "transforms.json", job.build / "transforms_test.json"]


def make_shoppers(job: Job) -> list[Path]:
    """Tracking data: shoppers whose heads follow the attention law."""
    from nerg_mi.scenes.store import layout, shoppers, twin

    path = job.build / "shoppers.csv"
    shoppers.write_shoppers(
        layout.build_store(job.seed), path, seed=job.seed, scene=twin.load_twin(job.store / "twin.xml")
    )
    return [path]


def make_field(job: Job) -> list[Path]:
    """Radiance field, trained on the pictures and their exact depth; the test views are held out."""
    from nerg_mi.train.radiance import train_radiance

    _require_file(job.build / "transforms.json", "views")
    path = job.build / "store.safetensors"
    train_radiance(job.build, steps=6500, seed=job.seed, half=True, output=path)
    # The preview and the state of the run stay in the build folder.
    return [path.replace(job.store / path.name)]


def make_rays(job: Job) -> list[Path]:
    """Gaze rays of the tracking data, and a sample of each visit.

    The rays are those of `nerg rays import --preset skeleton --tick 0.001`; the sample, a tenth of each visit, is for
    the report of the demo.
    """
    import numpy as np

    from nerg_mi.tracking.readers.registry import read_rays
    from nerg_mi.tracking.readers.skeleton import SkeletonOptions

    tracking, path = job.build / "shoppers.csv", job.build / "rays.npz"
    _require_file(tracking, "shoppers")
    rays = read_rays("skeleton", tracking, SkeletonOptions(tick=1e-3))
    rays.save(path)
    sample = job.store / "shoppers.npz"
    visits = [np.flatnonzero(rays.person == k) for k in range(len(rays.persons))]
    # A contiguous part of each visit, from its begin for the first shopper to its end for the last.
    starts = [int(k * (len(v) - len(v) // SAMPLE_DIVISOR) / max(len(visits) - 1, 1)) for k, v in enumerate(visits)]
    sampled = rays.select(
        np.sort(np.concatenate([v[s : s + len(v) // SAMPLE_DIVISOR] for v, s in zip(visits, starts)]))
    )
    sampled.with_step(step="sample", kept=len(sampled), of=len(rays)).save(sample)
    return [path, sample]


def make_gaze(job: Job) -> list[Path]:
    """Gaze field, trained on the rays in the radiance field of the store.

    64 positions are held out and recorded in it.
    """
    from nerg_mi.train.gaze import train_gaze

    source, field_path = job.build / "rays.npz", job.store / "store.safetensors"
    _require_file(source, "rays")
    _require_file(field_path, "field")
    path = job.store / "shoppers.safetensors"
    train_gaze(
        source,
        field_path,
        # Heads are sampled from the law at 5 Hz: rays are exact and independent, so more steps do not overfit.
        steps=640,
        test_zones=8,
        test_positions=64,
        seed=job.seed,
        half=True,
        output=path,
    )
    return [path]


def make_evaluation(job: Job) -> list[Path]:
    """Scores of the gaze field and of the baselines at the held-out positions."""
    from nerg_mi.evaluation.held_out import evaluate_gaze
    from nerg_mi.reports.inputs import RESULTS

    source, gaze = job.build / "rays.npz", job.store / "shoppers.safetensors"
    _require_file(source, "rays")
    _require_file(gaze, "gaze")
    folder = job.build / "shoppers.eval"
    evaluate_gaze(gaze, source, job.store / "store.safetensors", pictures=0, seed=job.seed, output=folder)
    path = job.store / RESULTS
    return [(folder / RESULTS).replace(path)]


def _require_file(path: Path, stage: str) -> None:
    if not path.exists():
        raise FileNotFoundError(
            f'"{path}" is missing; create it with: python -m nerg_mi.scenes.store.make --stage {stage}'
        )


# Stages in order. Each returns the files that it wrote.
STAGES = {
    "twin": make_twin,
    "views": make_views,
    "field": make_field,
    "shoppers": make_shoppers,
    "rays": make_rays,
    "gaze": make_gaze,
    "evaluation": make_evaluation,
}


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(prog="python -m nerg_mi.scenes.store.make", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="seed of the generation (default: 0)")
    parser.add_argument(
        "--stage", action="append", choices=list(STAGES), help="stage to run (default: all); repeatable"
    )
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")
    args = parser.parse_args(argv)

    import mitsuba as mi

    from nerg_mi.files.atomic import check_folder

    mi.set_variant(args.mode)
    job = Job(args.seed)
    check_folder(job.store)
    check_folder(job.build)
    for name, stage in STAGES.items():
        if args.stage and name not in args.stage:
            continue
        print(f"[{name}] {stage.__doc__.splitlines()[0]}")
        start = time.perf_counter()
        for path in stage(job):
            shown = path.relative_to(job.store) if path.is_relative_to(job.store) else path
            print(f"[{name}] wrote {shown} ({path.stat().st_size / 1e6:.2f} MB)")
        print(f"[{name}] {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
