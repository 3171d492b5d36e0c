"""PSNR against minutes of training on real photos: the fox, every 8th photo held out, rendered by the integrator.

    python benchmarks/fox_radiance.py [--minutes 1,2,4,7,10] [--width 135] [--validate] [--set hold=0.5] [--size small]

One training of the last of the ``--minutes``, with the learning rate's schedule over all of it; at each of them the
weights so far are written, the clock stopping, and scored as `nerg eval radiance` does, after training. A row for a
shorter time is thus what a longer run has come to, not what a run of that length ends with: give a single number for
that. "fitted" is the PSNR of right halves, their colours fitted on left ones, since nobody knows the exposure of a
photo that was held out. ``--validate`` never opens the held-out photos: every 8th of the *training* photos takes their
place; choices are made with it. ``--data DIR``: another posed image set. A CSV is written beside the printed table.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def default_data() -> Path:
    root = Path(os.environ.get("NERG_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    return root / "fox"


def validation(data):
    """The data set without its held-out photos: every 8th training photo replaces them."""
    from dataclasses import replace

    return replace(data, held_out=data.train[::8], train=[v for k, v in enumerate(data.train) if k % 8])


def parse_settings(pairs: list[str]) -> dict:
    """``key=value`` as arguments of `RadianceSettings`."""
    import ast

    return {k: ast.literal_eval(v) for k, v in (p.split("=", 1) for p in pairs)}


def main(argv=None) -> None:
    from timing import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--minutes", default="1,2,4,7,10")
    parser.add_argument("--width", type=int, default=135)
    parser.add_argument("--size", default="small")
    parser.add_argument("--deferred", action="store_true", help="ask the colour network once a ray")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--spp", type=int, default=16, help="rays a pixel; the default is that of nerg eval radiance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/fox_radiance"))
    args = parser.parse_args(argv)

    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(args.threads)
    from dataclasses import replace

    from nerg_mi.evaluation.metrics import score_views
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import save_radiance
    from nerg_mi.photos.dataset import open_dataset
    from nerg_mi.train.radiance_run import measure, warm_up
    from nerg_mi.train.radiance_settings import RadianceSettings, sized_config
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    ns = namespace("llvm_ad_rgb")
    if not args.data.exists():
        raise SystemExit(f"{args.data} does not exist; give a posed image set with --data")
    data = open_dataset(args.data, None, args.width)
    data = validation(data) if args.validate else data
    stops = sorted(float(m) for m in args.minutes.split(","))
    settings = RadianceSettings(minutes=stops[-1], seed=args.seed, **parse_settings(args.set))
    args.out.mkdir(parents=True, exist_ok=True)
    print(
        f"{len(data.train)} views to train on, {len(data.held_out)} to score, width {args.width}; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    begin = time.perf_counter()
    config = replace(sized_config(args.size, data.box), deferred=args.deferred)
    trainer = RadianceTrainer(data.train, data.box, config, settings, ns, depth=False)
    warm_up(trainer)
    rows = []
    for stop in stops:
        while trainer.seconds < 60 * stop and trainer.progress < 1:
            trainer.step()
        seconds = trainer.seconds
        path = args.out / f"{args.width}_{stop:g}.safetensors"
        save_radiance(trainer.field(), path, {"minutes": stop, "settings": settings.to_dict()})
        train = measure(trainer, data.train[::8], 2).mean
        # What was spent on looking is no training.
        trainer.restore(seconds, trainer.hard)
        rows.append(
            {
                "minutes": stop,
                "steps": trainer.steps,
                "ms_a_step": round(1e3 * seconds / trainer.steps, 1),
                "psnr_train": round(train, 2),
                "load": round(os.getloadavg()[0], 1),
                "file": path,
            }
        )
        print(
            f"{stop:g} min: {trainer.steps} steps, training views {train:.2f} dB, load {os.getloadavg()[0]:.1f}",
            flush=True,
        )
    head = ["minutes", "steps", "ms/step", "PSNR dB", "fitted", "SSIM", "training dB"]
    print("{:>8s} {:>7s} {:>8s} {:>8s} {:>7s} {:>7s} {:>12s}".format(*head))
    for row in rows:
        scores = score_views(row["file"], data.held_out, args.spp, args.out / f"{args.width}_{row['minutes']:g}")
        row |= {"psnr": round(scores.psnr_mean, 3), "psnr_fitted": round(scores.psnr_fitted_mean, 3)}
        row |= {"ssim": round(scores.ssim_mean, 4), "file": row["file"].name}
        print(
            f"{row['minutes']:8g} {row['steps']:7d} {row['ms_a_step']:8.1f} {row['psnr']:8.2f} "
            f"{row['psnr_fitted']:7.2f} {row['ssim']:7.4f} {row['psnr_train']:12.2f}",
            flush=True,
        )
    table = args.out / f"fox_radiance_{args.width}.csv"
    write_rows(table, rows)
    speed = trainer.clock.summary()
    print(f"{speed['evaluations_a_second']:.3g} field evaluations a second; step in ms: {speed['step_ms']}")
    print(f"whole benchmark {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
