"""The store, a room seen from inside, trained from its pictures alone and with their depth: PSNR, depth, opacity of its
walls.

    python -m nerg_mi.scenes.store.make --stage views          # the pictures, rendered from the twin
    python benchmarks/store_radiance.py [--minutes 10] [--size small] [--views DIR] [--only images|depth] [--set
    hold=0.5]

Scores are those of `nerg eval radiance` on the held-out views (the `nerg` integrator at its defaults, median depth),
against exact ray casts to the twin. ``--validate`` leaves the held-out views alone: every 8th of the training views
takes their place.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

VIEWS = Path(__file__).resolve().parents[1] / "scenes" / "store" / "build"


def main(argv=None) -> None:
    from timing import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=Path, default=VIEWS)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--size", default="small")
    parser.add_argument("--only", choices=("images", "depth"))
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/store_radiance"))
    args = parser.parse_args(argv)

    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(args.threads)
    from fox_radiance import parse_settings, validation
    from nerg_mi.evaluation.metrics import score_views
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import save_radiance
    from nerg_mi.photos.dataset import open_dataset
    from nerg_mi.train.radiance_run import warm_up
    from nerg_mi.train.radiance_settings import RadianceSettings, sized_config
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    if not args.views.exists():
        raise SystemExit(
            f"{args.views} does not exist; make the pictures with: python -m nerg_mi.scenes.store.make --stage views"
        )
    data = open_dataset(args.views)
    data = validation(data) if args.validate else data
    settings = RadianceSettings(minutes=args.minutes, seed=args.seed, **parse_settings(args.set))
    args.out.mkdir(parents=True, exist_ok=True)
    print(
        f"{len(data.train)} views to train on, {len(data.held_out)} to score, "
        f"{data.source['width']} x {data.source['height']}"
    )
    print(
        f"{'from':>7s} {'minutes':>8s} {'steps':>6s} {'PSNR dB':>8s} {'fitted':>7s} {'SSIM':>6s} "
        f"{'median cm':>10s} {'mean cm':>8s} {'> 10 %':>7s} {'opacity':>8s} {'< 0.9':>6s} {'load':>5s}"
    )
    rows = []
    for source in ("images", "depth") if args.only is None else (args.only,):
        trainer = RadianceTrainer(
            data.train,
            data.box,
            sized_config(args.size, data.box),
            settings,
            namespace("llvm_ad_rgb"),
            depth=source == "depth",
        )
        warm_up(trainer)
        begin = time.process_time()
        while trainer.progress < 1:
            trainer.step()
        minutes, cpu, load = trainer.seconds / 60, time.process_time() - begin, os.getloadavg()[0]
        path = args.out / f"{source}.safetensors"
        save_radiance(trainer.field(), path, {"minutes": minutes, "settings": settings.to_dict()})
        scores = score_views(path, data.held_out, args.spp, args.out / source)
        depth = scores.depth
        rows.append(
            {
                "from": source,
                "size": args.size,
                "minutes": minutes,
                "cpu_minutes": cpu / 60,
                "steps": trainer.steps,
                "psnr": scores.psnr_mean,
                "psnr_fitted": scores.psnr_fitted_mean,
                "ssim": scores.ssim_mean,
                "depth_median": depth.median,
                "depth_mean": depth.mean,
                "depth_off": depth.off,
                "opacity": depth.opacity,
                "translucent": depth.translucent,
                "load": load,
            }
        )
        print(
            f"{source:>7s} {minutes:8.1f} {trainer.steps:6d} {scores.psnr_mean:8.2f} {scores.psnr_fitted_mean:7.2f} "
            f"{scores.ssim_mean:6.3f} {100 * depth.median:10.2f} {100 * depth.mean:8.2f} {depth.off:7.2%} "
            f"{depth.opacity:8.4f} {depth.translucent:6.2%} {load:5.1f}",
            flush=True,
        )
    table = args.out / "store_radiance.csv"
    write_rows(table, rows)


if __name__ == "__main__":
    main()
