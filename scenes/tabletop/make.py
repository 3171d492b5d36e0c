"""Generate the capture of the table from a seed: ``python -m nerg_mi.scenes.tabletop.make --seed 0``.

Writes into ``build/`` a capture as taken with a phone, ``images/`` and a COLMAP model in ``sparse/0/``, and in addition
exact depth, listed in ``transforms_depth.json``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

BUILD = Path(__file__).resolve().parent / "build"


def make_capture(
    folder: str | Path = BUILD, *, seed: int = 0, count: int = 64, width: int = 320, spp: int = 24, log=print
) -> Path:
    """Render ``count`` photos of 4 : 3 and write the capture into ``folder``, which is returned.

    ``width`` are the pixels along the longer side, ``spp`` the light samples per pixel. ``log`` receives progress
    messages.
    """
    from nerg_mi.scenes.tabletop import cameras, layout, photos, sparse, stage

    from nerg_mi.files.atomic import check_folder

    folder = Path(folder)
    check_folder(folder)
    start = time.perf_counter()
    tabletop = layout.build_tabletop(seed)
    scene = stage.load_stage(tabletop)
    log(f"{len(tabletop.triangles)} triangles in {time.perf_counter() - start:.0f} s")
    views = cameras.make_cameras(seed, count, width, round(0.75 * width))
    photos_taken = photos.take_photos(scene, views, spp, seed, log)
    photos.write_photos(photos_taken, folder)
    points = sparse.write_colmap(photos_taken, folder / "sparse" / "0")
    log(f"wrote {count} photos and {points} points to {folder} after {time.perf_counter() - start:.0f} s")
    return folder


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(prog="python -m nerg_mi.scenes.tabletop.make", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="seed of the generation (default: 0)")
    parser.add_argument("--count", type=int, default=64, help="number of photos (default: 64)")
    parser.add_argument("--width", type=int, default=320, help="pixels along the longer side of a photo (default: 320)")
    parser.add_argument("--spp", type=int, default=24, help="light samples per pixel (default: 24)")
    parser.add_argument("--out", type=Path, default=BUILD, help="output folder (default: build/ next to this file)")
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant(args.mode)
    make_capture(args.out, seed=args.seed, count=args.count, width=args.width, spp=args.spp)


if __name__ == "__main__":
    main()
