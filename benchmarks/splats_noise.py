"""A noisy place of splats: how much of what is seen depends on where Gaussians are cut off, and on the tolerance.

    python benchmarks/splats_noise.py [--splats FILE] [--width 48] [--out out/benchmarks/splats_noise.csv]

The store's Gaussians (`--splats FILE`, or made of the field on a coarse lattice), each drawn twice with other centres
(3 cm), scales (a factor of e^0.6), rotations and opacities (.02 to .3), and a quarter as many floaters as there were
Gaussians, of up to .05. Rows are settings, errors are against rays that cut Gaussians off at 8 standard deviations and
end at 1e-9 of the light, with the default tolerance: a row of another tolerance says how much the choice matters, not
which one is right.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

SHOWN = ("color_rmse", "opacity_mae", "depth_mae", "depth_p99", "visibility_mae", "gaze_mae")


def disturb(path: Path, out: Path, seed: int = 0) -> int:
    """Write the noisy Gaussians of those in ``path``; returns how many."""
    from nerg_mi.field.splats import Splats, joined
    from nerg_mi.formats.splats.files import read_splats
    from nerg_mi.formats.splats.ply import write_ply_splats

    splats, rng = read_splats(path), np.random.default_rng(seed)
    n, few = len(splats), len(splats) // 4
    k = rng.integers(0, n, 2 * n)
    noisy = Splats(
        splats.centers[k] + rng.normal(0, 0.03, (2 * n, 3)),
        splats.scales[k] * np.exp(rng.normal(0, 0.6, (2 * n, 3))),
        splats.rotations[k] + 0.1 * rng.normal(size=(2 * n, 4)),
        rng.uniform(0.02, 0.3, 2 * n),
        splats.harmonics[k] + rng.normal(0, 0.2, splats.harmonics[k].shape),
    )
    floaters = Splats(
        rng.uniform(splats.centers.min(axis=0), splats.centers.max(axis=0), (few, 3)),
        np.exp(rng.normal(np.log(0.05), 0.7, (few, 3))),
        rng.normal(size=(few, 4)),
        rng.uniform(0.005, 0.05, few),
        rng.normal(0, 0.5, (few, *splats.harmonics.shape[1:])),
    )
    write_ply_splats(out, joined([noisy, floaters]))
    return 2 * n + few


def main(argv=None) -> None:
    from output import write_rows
    from splats import make, show

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=Path, help="file of splats (default: made of the field)")
    parser.add_argument("--resolution", type=int, default=96, help="lattice cells of what is made")
    parser.add_argument("--width", type=int, default=48, help="of the picture in pixels (3:2)")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/splats_noise.csv"))
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.evaluation.study.errors import errors
    from nerg_mi.evaluation.study.subject import open_subject
    from nerg_mi.jobs.demo import store_scene

    folder = args.out.parent.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if args.splats is None:
        args.splats = folder / "store_coarse.ply"
        make(args.splats, args.resolution)
    count = disturb(args.splats, folder / "noisy.ply")
    store = store_scene()
    text = store.read_text().replace('name="field" type="nerf"', 'name="field" type="splats"')
    text = text.replace("store.safetensors", str(folder / "noisy.ply"))
    scene = folder / "noisy.xml"
    scene.write_text(text.replace("shoppers.safetensors", str((store.parent / "shoppers.safetensors").resolve())))
    subject = open_subject(scene, "auto", args.width, 2 * args.width // 3)
    truth = subject.truth(1, "median", "depth")
    rows = []
    for setting in ({}, {"stop": 1e-2}, {"stop": 1e-3}, {"extent": 4.0}, {"tolerance": 0.02}, {"tolerance": 0.042}):
        name = ", ".join(f"{k} {v:g}" for k, v in setting.items()) or "default"
        found = errors(subject.channels(subject.integrator(setting), 1, 1), truth)
        rows.append({"setting": name} | {k: float(found[k]) for k in SHOWN if k in found})
    show(f"{count:,} noisy Gaussians, {args.width} pixels wide", rows)
    write_rows(args.out, rows)


if __name__ == "__main__":
    main()
