"""Photos whose exposures and white balances differ, with and without learning those of each photo: the fox.

    python benchmarks/photo_colors.py [--steps 3000] [--width 135] [--stops 0,0.3] [--threads 2] [--update PAGE]

The light of each photo, training and held out, is multiplied by 2 to a normal number of so many ``--stops``, and by
another for each colour of 0.08 in its logarithm, before it is clipped and encoded as sRGB again; 0 leaves the photos as
they are. Rows of equal steps, scored on every pixel of the held-out photos by the trainer: as they are, and right
halves with colours fitted on left halves. ``--data DIR``: another posed image set.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from fox_radiance import default_data

import numpy as np

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

BALANCE = 0.08
"""Standard deviation of the logarithm of each colour's own gain."""
HEAD = ["exposures differ by", "learnt", "steps", "PSNR, dB", "right halves, fitted", "found"]


def varied(views: list, stops: float, rng: np.random.Generator) -> list:
    """``views`` in other light each."""
    from nerg_mi.maths.color import decode_srgb, encode_srgb

    out = []
    for view in views:
        gain = 2 ** (stops * rng.normal()) * np.exp(BALANCE * rng.normal(size=3))
        color = encode_srgb(np.clip(decode_srgb(view.color[..., :3]) * gain, 0, 1))
        pixels = np.dstack([color, view.color[..., 3:]])
        out.append(replace(view, pixels=np.round(255 * pixels).astype(np.uint8)))
    return out


def main(argv=None) -> None:
    from output import print_table

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--width", type=int, default=135)
    parser.add_argument("--stops", default="0,0.3")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--update", type=Path, help="page of the documentation to put the table into")
    args = parser.parse_args(argv)

    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(args.threads)
    from nerg_mi.capture.dataset import open_dataset
    from nerg_mi.field.backend import namespace
    from nerg_mi.training.radiance.held_out import measure
    from nerg_mi.training.radiance.photo_colors import PHOTOS
    from nerg_mi.training.radiance.settings import RadianceSettings, sized_config
    from nerg_mi.training.radiance.trainer import RadianceTrainer

    if not args.data.exists():
        raise SystemExit(f"{args.data} does not exist; give a posed image set with --data")
    data, rows = open_dataset(args.data, None, args.width), []
    for stops in map(float, args.stops.split(",")):
        rng = np.random.default_rng(args.seed)
        train, held_out = ((varied(v, stops, rng) if stops else v) for v in (data.train, data.held_out))
        for learnt in (False, True):
            settings = RadianceSettings(steps=args.steps, seed=args.seed, photo_colors=learnt)
            config = sized_config("small", data.box)
            trainer = RadianceTrainer(train, data.box, config, settings, namespace("llvm_ad_rgb"), depth=False)
            while trainer.progress < 1:
                trainer.step()
            error = measure(trainer, held_out, 1, trainer.field())
            found = f"{trainer.photos.stops(trainer.averaged[PHOTOS]):.2f} stops" if trainer.photos else "-"
            rows.append(
                [
                    f"{stops:g} stops" if stops else "nothing, but by the camera",
                    "yes" if learnt else "no",
                    f"{args.steps:,}",
                    f"{error.mean:.2f}",
                    f"{error.mean_fitted:.2f}",
                    found,
                ]
            )
            print(*rows[-1], sep="  ", flush=True)
    print_table("Exposures", HEAD, rows, args.update)


if __name__ == "__main__":
    main()
