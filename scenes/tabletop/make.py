"""Make the capture of the table from a seed: ``python -m nerg_mi.scenes.tabletop.make --seed 0``.

Writes into ``build/`` what somebody brings home who walked around a table with a phone, ``images/`` and a COLMAP model
in ``sparse/0/``, and beside it what nobody has but this place: exact depth, named in ``transforms_depth.json``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

BUILD = Path(__file__).resolve().parent / "build"


def make_capture(
    folder: str | Path = BUILD, *, seed: int = 0, count: int = 64, width: int = 320, spp: int = 24, log=print
) -> Path:
    """Take ``count`` photos of 4 : 3, ``width`` pixels along their longer side, with ``spp`` samples of light a pixel,
    and write the capture into ``folder``, which is returned. ``say``: where progress goes."""
    from nerg_mi.scenes.tabletop import cameras, layout, photos, sparse, stage

    from nerg_mi.files.atomic import check_folder

    folder = Path(folder)
    check_folder(folder)
    start = time.perf_counter()
    place = layout.build_tabletop(seed)
    scene = stage.load_stage(place)
    log(f"{len(place.triangles)} triangles in {time.perf_counter() - start:.0f} s")
    views = cameras.make_cameras(seed, count, width, round(0.75 * width))
    taken = photos.take_photos(scene, views, spp, seed, log)
    photos.write_photos(taken, folder)
    points = sparse.write_colmap(taken, folder / "sparse" / "0")
    log(f"wrote {count} photos and {points} points to {folder} after {time.perf_counter() - start:.0f} s")
    return folder


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(prog="python -m nerg_mi.scenes.tabletop.make", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="everything is made from it (default: 0)")
    parser.add_argument("--count", type=int, default=64, help="number of photos (default: 64)")
    parser.add_argument("--width", type=int, default=320, help="pixels along a photo's longer side (default: 320)")
    parser.add_argument("--spp", type=int, default=24, help="samples of light a pixel (default: 24)")
    parser.add_argument(
        "--out", type=Path, default=BUILD, help="folder to write into (default: build/ beside this file)"
    )
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant(args.mode)
    make_capture(args.out, seed=args.seed, count=args.count, width=args.width, spp=args.spp)


if __name__ == "__main__":
    main()
