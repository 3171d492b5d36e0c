"""How full the packets of a march are, by the order of pixels.

    python benchmarks/lanes.py [SCENE.xml] [-D KEY=VALUE] [--sizes 320x180,1280x720] [--lanes 16]
    [--out out/benchmarks/lanes.csv]

Rays are marched in packets, as many together as a vector has lanes, and a packet goes on until the last of its rays
has ended. Its occupancy is the share of evaluations that some ray needed: the sum of the rays' over the packets' lanes
times their longest ray. Counted are the densities of the camera's rays and those of the observer's, and, for the gaze
networks, the pixels whose gaze is seen. Orders: rows of pixels, as Mitsuba has them, tiles, and rays sorted by their
length, which no order beats. Nothing is timed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nerg_mi as nerg
from nerg_mi.files.tables import markdown_table
from nerg_mi.jobs.demo import store_scene

import numpy as np


def packets(image: np.ndarray, order: str, lanes: int) -> np.ndarray:
    """The values of ``image`` (rows, columns) in packets (N, ``lanes``); what does not fill one is left out."""
    if order == "rows":
        flat = image.ravel()
    elif order == "sorted":
        flat = np.sort(image, axis=None)
    else:
        high, wide = map(int, order.split("x"))
        rows, columns = (n // side for n, side in zip(image.shape, (high, wide)))
        flat = image[: rows * high, : columns * wide].reshape(rows, high, columns, wide).swapaxes(1, 2).ravel()
    return flat[: len(flat) // lanes * lanes].reshape(-1, lanes)


def occupancy(counts: np.ndarray, order: str, lanes: int) -> float:
    """Share of the lanes that work, over all steps of all packets."""
    found = packets(counts, order, lanes)
    return float(found.sum() / (lanes * found.max(axis=1).sum()))


def main(argv=None) -> None:
    from output import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", default=store_scene())
    parser.add_argument("-D", "--define", action="append", default=[])
    parser.add_argument("--sizes", default="320x180,1280x720")
    parser.add_argument("--lanes", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/lanes.csv"))
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    side = round(args.lanes**0.5)
    orders = ["rows", f"2x{args.lanes // 2}", f"{side}x{args.lanes // side}", "sorted"]
    rows = []
    for size in args.sizes.split(","):
        width, height = map(int, size.split("x"))
        given = dict(word.split("=", 1) for word in args.define)

        def evaluations(aovs: str, last: int) -> np.ndarray:
            values = {**given, "width": width, "height": height, "spp": 1, "aovs": aovs}  # noqa: B023
            scene = nerg.Scene.load(args.scene, **values).mitsuba
            return np.array(mi.render(scene, sensor=0, spp=1, seed=0))[..., -last:]

        camera = evaluations("depth,density_evals", 1)[..., 0]
        both = evaluations("depth,visibility,density_evals,gaze,gaze_evals", 4)
        passes = {
            "camera": camera,
            "observer": both[..., 1] - camera,
            "gaze networks": (both[..., 3] > 0).astype(float),
        }
        for name, counts in passes.items():
            found = {order: occupancy(counts, order, args.lanes) for order in orders}
            rows.append({"frame": size, "pass": name, "a ray": counts.mean(), **found})
    write_rows(args.out, rows)
    cell = lambda v: v if isinstance(v, str) else f"{v:.2f}"
    print(markdown_table(list(rows[0]), [[cell(v) for v in row.values()] for row in rows]))


if __name__ == "__main__":
    main()
