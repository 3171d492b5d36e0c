"""An unbounded capture, photos around a table in a room with a view, trained at the defaults of `nerg train radiance`:
PSNR, SSIM, and depth near the object and far behind it.

    python -m nerg_mi.scenes.tabletop.make                     # the photos, rendered from a place made of a seed
    python benchmarks/tabletop_radiance.py [--minutes 4] [--bounded] [--views DIR] [--threads 2] [--seed 0] [--out DIR]

The photos are read as a user's are: COLMAP's model, every 8th held out, the box found by its points. Pictures and
median depth are those of the `nerg` integrator at its defaults; depth is compared with exact ray casts. "near": what
lies within 1.5 m of the object; "far": what is farther than 4 m from the camera, without the sky; "beyond": what lies
outside of the field's box, or of the core of one whose surroundings are contracted, the sky too. ``--bounded``: as if
nothing were to be seen beyond that box.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

VIEWS = Path(__file__).resolve().parents[1] / "scenes" / "tabletop" / "build"
NEAR, FAR = 1.5, 4.0
"""Metres: from the object's middle at most, and from the camera at least."""
OFF = 0.1
"""Depth that errs by a larger share is off."""


def score(field: Path, views: list, box, center, spp: int, pictures: Path) -> dict[str, float]:
    """Means over ``views`` of PSNR in dB and SSIM, and over all of their pixels: PSNR within and ``beyond`` the
    ``box``, and errors of depth near ``center`` and far."""
    from nerg_mi.evaluation.metrics import Renderer, ssim
    from nerg_mi.figures.overlay import write_png
    from nerg_mi.files.atomic import make_folder
    from nerg_mi.maths.color import decibels, psnr
    from nerg_mi.photos.cameras import pixel_directions

    make_folder(pictures)
    render, rows, parts = Renderer(field, spp), [], []
    for k, view in enumerate(views):
        seen, truth = render(view.camera, k), view.over(0)
        rows.append((psnr(seen.color, truth), ssim(seen.color, truth)))
        write_png(pictures / f"{Path(view.name).stem}.png", np.concatenate([seen.color, truth], axis=1))
        directions = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        place = view.camera.center + view.depth[..., None] * directions
        inside = np.all((place >= box.lower) & (place <= box.upper), axis=-1) & (view.depth > 0)
        near = (np.linalg.norm(place - center, axis=-1) < NEAR) & (view.depth > 0)
        squares = np.mean((np.clip(seen.color, 0, 1) - truth) ** 2, axis=-1)
        parts.append([v.ravel() for v in (view.depth, seen.depth, squares, ~inside, near)])
    depth, found, squares, beyond, near = (np.concatenate(v) for v in zip(*parts))
    beyond, near, far = beyond.astype(bool), near.astype(bool), depth > FAR
    error = np.abs(found - depth)
    share = error / np.maximum(depth, 1e-9)
    out = {"psnr": float(np.mean([p for p, _ in rows])), "ssim": float(np.mean([s for _, s in rows]))}
    for name, which in (("within", ~beyond), ("beyond", beyond)):
        out[f"psnr_{name}"] = decibels(float(squares[which].mean())) if which.any() else float("nan")
    return out | {
        "beyond": float(beyond.mean()),
        "near_median": float(np.median(error[near])),
        "near_off": float(np.mean(share[near] > OFF)),
        "far_median": float(np.median(share[far])),
        "far_off": float(np.mean(share[far] > OFF)),
    }


def main(argv=None) -> None:
    from timing import print_table, write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=Path, default=VIEWS)
    parser.add_argument("--minutes", type=float, default=4)
    parser.add_argument("--bounded", action="store_true", help="as of nerg train radiance")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/tabletop_radiance"))
    args = parser.parse_args(argv)

    from nerg_mi.photos.dataset import open_dataset
    from nerg_mi.scenes.tabletop.photos import DEPTH_FILE
    from nerg_mi.scenes.tabletop.table import CENTRE
    from nerg_mi.workflows.radiance_commands import RadianceOptions
    from nerg_mi.workflows.train_radiance import train_radiance

    if not (args.views / DEPTH_FILE).is_file():
        raise SystemExit(f"{args.views} holds no photos; make them with: python -m nerg_mi.scenes.tabletop.make")
    path = args.out / "field.safetensors"
    unbounded = False if args.bounded else None
    options = RadianceOptions(minutes=args.minutes, unbounded=unbounded, threads=args.threads, seed=args.seed)
    result = train_radiance(args.views, path, options)
    about, box = result.provenance, result.field.box.core
    held_out = open_dataset(args.views / DEPTH_FILE).held_out
    if [v.name.rpartition("/")[2] for v in held_out] != about["held_out"]["frames"]:
        raise SystemExit(f"{args.views / DEPTH_FILE} holds out other photos than the capture beside it")
    scores = score(path, held_out, box, CENTRE, args.spp, args.out / "pictures")
    size = " x ".join(f"{u - l:.1f}" for l, u in zip(box.lower, box.upper)) + " m"
    size += ", contracted" if result.field.box.contracted else ""
    rows = [{"minutes": args.minutes, "seconds": about["seconds"], "steps": about["steps"], **scores, "box": size}]
    for line in about["complaints"]:
        print(line)
    s = scores
    cells = [
        f"{args.minutes:g}",
        f"{about['seconds']:.0f}",
        f"{about['steps']:,}",
        f"{s['psnr']:.2f}",
        f"{s['ssim']:.3f}",
        f"{s['psnr_within']:.2f}, {s['psnr_beyond']:.2f}",
        f"{s['beyond']:.1%}",
        f"{100 * s['near_median']:.2f} cm, {s['near_off']:.1%}",
        f"{s['far_median']:.1%}, {s['far_off']:.1%}",
        size,
    ]
    head = ["minutes", "seconds", "steps", "PSNR, dB", "SSIM", "within, beyond", "pixels beyond"]
    head += ["near: median, off", "far: median, off", "box"]
    print_table("An unbounded capture", head, [cells])
    write_rows(args.out / "tabletop_radiance.csv", rows)


if __name__ == "__main__":
    main()
