"""Poses of real photos, found anew, against those that came with them: the fox.

    python benchmarks/fox_poses.py [--lens opencv,radial] [--size 960] [--threads 2] [--train MINUTES]

The photos are given without their poses to what `nerg poses` runs; what it finds is compared with the given poses,
which are COLMAP's as well, after the similarity that fits the cameras best. ``--train``: radiance fields are trained
with both for so long, and scored on the same held-out photos. ``--data DIR``: another posed image set.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from fox_radiance import default_data

import numpy as np


def main(argv=None) -> None:
    from nerg_mi.capture.sources import find_source, read_posed
    from nerg_mi.capture.structure.compare import pose_errors
    from nerg_mi.jobs.options.poses import PoseOptions
    from nerg_mi.jobs.poses import find_poses
    from output import print_table

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--lens", default="auto")
    parser.add_argument("--size", default="960")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--train", type=float, metavar="MINUTES")
    parser.add_argument("--width", type=int, default=135, help="of the photos that are trained on")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/fox_poses"))
    parser.add_argument("--update", type=Path, help="page of the documentation to put the table into")
    args = parser.parse_args(argv)
    if not args.data.exists():
        raise SystemExit(f"{args.data} does not exist; give a posed image set with --data")
    given = {f.image.name: f for f in read_posed(find_source(args.data)).frames}
    photos = next(iter(given.values())).image.parent
    args.out.mkdir(parents=True, exist_ok=True)
    rows, captures = [], []
    for lens in args.lens.split(","):
        for size in map(int, args.size.split(",")):
            capture = Path(tempfile.mkdtemp(dir=args.out), "capture")
            begin = time.perf_counter()
            options = PoseOptions(lens=lens, size=size, threads=args.threads)
            result = find_poses(photos, capture, options)
            seconds = time.perf_counter() - begin
            found = {f.image.name: f for f in read_posed(find_source(capture)).frames}
            names = sorted(set(found) & set(given))
            errors = pose_errors(*(np.array([of[n].to_world for n in names]) for of in (found, given)))
            rows.append(
                (
                    lens,
                    size,
                    f"{len(result.registered)} of {len(given)}",
                    f"{result.error:.2f}",
                    f"{np.median(errors.rotation):.2f}, {errors.rotation.max():.2f}",
                    f"{np.median(errors.scatter):.2f}, {errors.scatter.max():.2f}",
                    f"{np.median(errors.position):.2%}, {errors.position.max():.2%}",
                    f"{seconds:.0f}",
                )
            )
            captures.append(capture)
            print(capture, rows[-1], f"load {os.getloadavg()[0]:.1f}", flush=True)
    head = (
        "lens",
        "size",
        "with a pose",
        "reprojection error, pixels",
        "rotation error, degrees: median, max",
        "of it not common to all cameras",
        "position error, of the cameras' extent: median, max",
        "seconds",
    )
    print_table("Poses of the fox", head, rows, args.update)
    if args.train:
        for name, data in (("given", args.data), ("found", captures[0])):
            print(f"{name} poses: held-out PSNR {_train(data, args):.2f} dB; load {os.getloadavg()[0]:.1f}", flush=True)


def _train(data: Path, args) -> float:
    """Held-out PSNR in dB after training on ``data``."""
    from nerg_mi.capture.dataset import open_dataset
    from nerg_mi.evaluation.images import score_views
    from nerg_mi.jobs.options.radiance import RadianceOptions
    from nerg_mi.jobs.radiance import train_radiance

    options = RadianceOptions(minutes=args.train, width=args.width, threads=args.threads)
    field = args.out / f"{data.name}.safetensors"
    train_radiance(data, field, options)
    return score_views(field, open_dataset(data, None, args.width).held_out, 16, None).psnr_mean


if __name__ == "__main__":
    main()
