"""Radiance fields trained on photos: PSNR, SSIM and depth of held-out views, rendered by the integrator.

    python benchmarks/radiance.py fox [--minutes 1,2,4,7,10 | --steps 9000] [--width 135] [--size medium]
    python -m nerg_mi.scenes.store.make --stage views          # once: images of the store, rendered from the twin
    python benchmarks/radiance.py store [--minutes 10 | --steps 15000] [--size medium]
    python -m nerg_mi.scenes.tabletop.make                     # once: photos, rendered from a generated scene
    python benchmarks/radiance.py tabletop [--minutes 4 | --steps 6000]

``fox``: real photos, of which every 8th is held out. There is one training, for the last of the ``--minutes`` or for
``--steps``, whose learning-rate schedule covers the whole time. After each of the ``--minutes``, the clock stops and
the current weights are written. They are scored after the training, like by `nerg eval radiance`. A row for a shorter
time is therefore an intermediate state of a longer training, not the result of a training of that length. "PSNR,
colours fitted" is the PSNR of the right halves of the images after a colour correction that is fitted to the left
halves, because the exposure of the held-out photos is unknown.

``store``: a room seen from inside, trained from its images alone and from images with depth. Depth and the opacity of
the walls are compared with exact ray casts at the store's mesh.

``tabletop``: an unbounded scene, with photos taken around a table in a room with a view through a window, and the
defaults of `nerg train radiance`. The photos are read as a COLMAP model, with every 8th photo held out and the box
determined from its points. Depth is compared with exact ray casts. "Near" is within 1.5 m of the object. "Far" is more
than 4 m from the camera, without the sky. "Beyond" is outside of the field's box, or of the core of a contracted field,
with the sky. The first training treats the scene as if nothing were visible beyond the box.

Each saves a result.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

# BLAS threads spin while they wait, and slow down the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]
FOX = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")) / "fox"
NEAR, FAR = 1.5, 4.0
"""Metres: maximum distance from the object's centre, and minimum distance from the camera."""
OFF = 0.1
"""Relative error above which a depth counts as wrong."""
SCORES = {
    "minutes": "training time, min",
    "steps": "steps",
    "ms a step": "time per step, ms",
    "PSNR, dB": "PSNR, dB",
    "fitted, dB": "PSNR, colours fitted, dB",
    "SSIM": "SSIM",
}
"""Key of a row -> its title in the table."""


def open_views(folder: Path, width: int | None = None):
    """The data set of ``folder``."""
    from nerg_mi.photos.dataset import open_dataset

    if not folder.exists():
        raise SystemExit(f"{folder} does not exist; give a posed image set with --data, or make it (--help)")
    data = open_dataset(folder, None, width)
    print(f"{len(data.train)} views to train on, {len(data.held_out)} to score; load {os.getloadavg()[0]:.1f}")
    return data


def make_lengths(args: argparse.Namespace) -> list[dict[str, float]]:
    """The length of each training as a keyword argument, in ascending order."""
    if args.steps is not None:
        return [{"steps": args.steps}]
    return [{"minutes": minutes} for minutes in sorted(float(m) for m in args.minutes.split(","))]


def fields(data, args: argparse.Namespace, name: str, depth: bool) -> Iterator:
    """Train once; yields ``(trainer, path, row)`` after each of `make_lengths`, with the current field in a file whose
    name starts with ``name``."""
    from nerg_mi.cli.declarations import select_backend
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import save_radiance
    from nerg_mi.train.radiance_run import warm_up
    from nerg_mi.train.radiance_settings import RadianceSettings, make_radiance_config
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    select_backend("llvm_ad_rgb", args.threads)
    ns = namespace("llvm_ad_rgb")
    settings = RadianceSettings(seed=args.seed, **make_lengths(args)[-1])
    config = make_radiance_config(args.size, data.box)
    trainer = RadianceTrainer(data.train, data.box, config, settings, ns, depth=depth)
    warm_up(trainer)
    for length in make_lengths(args):
        while trainer.progress < 1 and trainer.seconds < 60 * length.get("minutes", np.inf):
            trainer.step()
        seconds = trainer.seconds
        path = args.out / f"{name}_{next(iter(length.values())):g}.safetensors"
        save_radiance(trainer.make_field(), path, {"minutes": seconds / 60, "settings": settings.to_dict()})
        row = {"minutes": seconds / 60, "steps": trainer.steps, "ms a step": 1e3 * seconds / trainer.steps}
        yield trainer, path, row | {"load": os.getloadavg()[0]}
        # Evaluation does not count as training time.
        trainer.set_seconds(seconds)
    speed = trainer.clock.summary()
    print(f"{speed['evaluations_a_second']:.3g} field evaluations per second; step in ms: {speed['step_ms']}")


def scored(path: Path, held_out: list, spp: int):
    """Scores of a field, and the columns of `SCORES` derived from them."""
    from nerg_mi.evaluation.metrics import score_views

    scores = score_views(path, held_out, spp, path.with_suffix(""))
    row = {"PSNR, dB": scores.psnr_mean, "fitted, dB": scores.psnr_fitted_mean, "SSIM": scores.ssim_mean}
    return scores, row


def cells(row: dict) -> list[str]:
    """The columns of `SCORES`."""
    formats = (".3g", ",", ".1f", ".2f", ".2f", ".3f")
    return [f"{row[key]:{format_}}" for key, format_ in zip(SCORES, formats)]


def fox(args: argparse.Namespace) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the table."""
    from nerg_mi.train.radiance_run import evaluate_views

    data = open_views(args.data, args.width)
    rows = []
    for trainer, path, row in fields(data, args, f"fox_{args.width}", False):
        rows.append(row | {"training views, dB": evaluate_views(trainer, data.train[::8], 2).mean, "file": path})
    for row in rows:
        row |= scored(row["file"], data.held_out, args.spp)[1]
    table = [[*cells(row), f"{row['training views, dB']:.1f}"] for row in rows]
    return [*SCORES.values(), "PSNR of training views, dB"], table


def store(args: argparse.Namespace) -> tuple[list[str], list[list[str]]]:
    data, table = open_views(args.data), []
    for source in ("images", "depth"):
        for _, path, row in fields(data, args, source, source == "depth"):
            scores, columns = scored(path, data.held_out, args.spp)
            depth = scores.depth
            name = "images alone" if source == "images" else "images and depth"
            overrides = [f"{100 * depth.median:.2f} cm", f"{depth.outlier_fraction:.1%}", f"{depth.opacity:.4f}"]
            table.append([name, *cells(row | columns), *overrides])
    return ["training data", *SCORES.values(), "median depth error", "depth errors above 10 %", "opacity"], table


def tabletop(args: argparse.Namespace) -> tuple[list[str], list[list[str]]]:
    from nerg_mi.cli.declarations import select_backend
    from nerg_mi.photos.dataset import open_dataset
    from nerg_mi.scenes.tabletop.photos import DEPTH_FILE
    from nerg_mi.scenes.tabletop.table import OBJECT_CENTER
    from nerg_mi.train.radiance import train_radiance
    from nerg_mi.train.radiance_settings import RadianceSettings

    if not (args.data / DEPTH_FILE).is_file():
        raise SystemExit(f"{args.data} holds no photos; make them with: python -m nerg_mi.scenes.tabletop.make")
    held_out = open_dataset(args.data / DEPTH_FILE).held_out
    table = []
    for length, unbounded in product(make_lengths(args), (False, None)):
        path = args.out / f"tabletop_{next(iter(length.values())):g}_{unbounded}.safetensors"
        select_backend("llvm_ad_rgb", args.threads)
        settings = RadianceSettings(**length)
        result = train_radiance(args.data, unbounded=unbounded, seed=args.seed, settings=settings, output=path)
        metadata, box = result.provenance, result.network.box.core
        if [v.name.rpartition("/")[2] for v in held_out] != metadata["held_out"]["frames"]:
            raise SystemExit(f"{args.data / DEPTH_FILE} holds out other photos than the capture next to it")
        for line in metadata["complaints"]:
            print(line)
        test = [v for v in held_out if v.name.rpartition("/")[2] not in metadata["validation_views"]]
        s = score_depths(path, test, box, OBJECT_CENTER, args.spp, path.with_suffix(""))
        size = " x ".join(f"{u - l:.1f}" for l, u in zip(box.lower, box.upper)) + " m"
        size += ", contracted" if result.network.box.is_contracted else ""
        columns = [f"{metadata['seconds'] / 60:.1f}", f"{metadata['steps']:,}", f"{s['psnr']:.2f}", f"{s['ssim']:.3f}"]
        columns += [f"{s['psnr_within']:.2f}, {s['psnr_beyond']:.2f}", f"{s['beyond']:.1%}"]
        columns += [f"{100 * s['near_median']:.2f} cm, {s['near_off']:.1%}"]
        table.append([*columns, f"{s['far_median']:.1%}, {s['far_off']:.1%}", size])
    head = ["training time, min", "steps", "PSNR, dB", "SSIM", "PSNR within, beyond, dB"]
    head += ["pixels beyond", *(f"{name}: median depth error, outliers" for name in ("near", "far")), "box"]
    return head, table


def score_depths(field: Path, views: list, box, center, spp: int, pictures: Path) -> dict[str, float]:
    """Means over ``views`` of PSNR in dB and SSIM, and over all of their pixels: PSNR inside and ``beyond`` the
    ``box``, and depth errors near ``center`` and far."""
    from nerg_mi.evaluation.metrics import FieldRenderer, ssim
    from nerg_mi.figures.overlay import write_png
    from nerg_mi.files.atomic import make_folder
    from nerg_mi.maths.color import psnr, psnr_from_mse
    from nerg_mi.photos.cameras import pixel_directions

    make_folder(pictures)
    render, rows, parts = FieldRenderer(field, spp), [], []
    for k, view in enumerate(views):
        seen, truth = render(view.camera, k), view.composite_over(0)
        rows.append((psnr(seen.color, truth), ssim(seen.color, truth)))
        write_png(pictures / f"{Path(view.name).stem}.png", np.concatenate([seen.color, truth], axis=1))
        directions = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        place = view.camera.center + view.depth[..., None] * directions
        inside = np.all((place >= box.lower) & (place <= box.upper), axis=-1) & (view.depth > 0)
        near = (np.linalg.norm(place - center, axis=-1) < NEAR) & (view.depth > 0)
        squares = np.mean((np.clip(seen.color, 0, 1) - truth) ** 2, axis=-1)
        parts.append([v.ravel() for v in (view.depth, seen.depth, squares, ~inside, near)])
    depth, rendered, squares, beyond, near = (np.concatenate(v) for v in zip(*parts))
    beyond, near, far = beyond.astype(bool), near.astype(bool), depth > FAR
    error = np.abs(rendered - depth)
    share = error / np.maximum(depth, 1e-9)
    out = {"psnr": float(np.mean([p for p, _ in rows])), "ssim": float(np.mean([s for _, s in rows]))}
    for name, which in (("within", ~beyond), ("beyond", beyond)):
        out[f"psnr_{name}"] = psnr_from_mse(float(squares[which].mean())) if which.any() else float("nan")
    return out | {
        "beyond": float(beyond.mean()),
        "near_median": float(np.median(error[near])),
        "near_off": float(np.mean(share[near] > OFF)),
        "far_median": float(np.median(share[far])),
        "far_off": float(np.mean(share[far] > OFF)),
    }


SETS = {
    "fox": (fox, FOX, "1,2,4,7,10"),
    "store": (store, ROOT / "scenes" / "store" / "build", "10"),
    "tabletop": (tabletop, ROOT / "scenes" / "tabletop" / "build", "4"),
}
"""Training and scoring functions, the folder of the views, and the minutes, by name."""


def main(argv=None) -> None:
    from timing import save_result

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=SETS, help="Training to measure; see above.")
    parser.add_argument(
        "--data",
        type=Path,
        help="Folder of the posed images. Default: the fox of NERG_DATA, or the generated images of the scene.",
    )
    parser.add_argument(
        "--minutes",
        help="Training time in minutes, or several, separated by commas: times in one training at which the field is "
        "scored (fox, store), or lengths of several trainings (tabletop). Default: 1,2,4,7,10 (fox), 10 (store), 4 "
        "(tabletop).",
    )
    parser.add_argument("--steps", type=int, help="Number of training steps in place of --minutes.")
    parser.add_argument(
        "--width", type=int, default=135, help="Width of the photos in pixels (fox). Default: %(default)s."
    )
    parser.add_argument(
        "--size", default="small", help="Size of the field: small, medium or paper (fox, store). Default: %(default)s."
    )
    parser.add_argument(
        "--spp",
        type=int,
        default=16,
        help="Number of samples per pixel of the scored images. Default: %(default)s, as for nerg eval radiance.",
    )
    parser.add_argument("--result", help="Name of the result. Default: radiance- and the training.")
    parser.add_argument("--threads", type=int, default=2, help="Number of CPU threads. Default: %(default)s.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the training. Default: %(default)s.")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/benchmarks/radiance"),
        help="Folder for the results. Default: %(default)s.",
    )
    args = parser.parse_args(argv)
    work, folder, minutes = SETS[args.what]
    args.data, args.minutes = args.data or folder, args.minutes or minutes
    args.out.mkdir(parents=True, exist_ok=True)
    save_result(args.result or f"radiance-{args.what}", *work(args), str(args.seed))


if __name__ == "__main__":
    main()
