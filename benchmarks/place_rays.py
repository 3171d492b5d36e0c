"""The places in which gaze is scored, and the options that all benchmarks of them have.

Real people in a supermarket and in three scenes of EyeNavGS, where their recordings are at hand, the demo store's
shoppers, and generated places (`generated_places.py`).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

Make = Callable[[Path], tuple[Path, dict]]
"""Writes the rays of a place into a folder; gives their file and where the place is: options of a fold."""


def place_parser(what: str, out: str, folds: int, choose: bool = True) -> argparse.ArgumentParser:
    """Options of a benchmark of places: which, if they may be chosen, in how many ``folds``, and where to (below
    out/benchmarks)."""
    parser = argparse.ArgumentParser(description=what.splitlines()[0])
    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of vr_supermarket and eyenavgs")
    if choose:
        parser.add_argument("--only", help="names of places, with commas between. Default: all that there are.")
    parser.add_argument("--folds", type=int, default=folds)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks") / out)
    return parser


def parse(parser: argparse.ArgumentParser, argv=None) -> argparse.Namespace:
    """The options that were given; the output's folder is there then."""
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    return args


def asked_places(args: argparse.Namespace) -> dict[str, Make]:
    """What makes each of the places that are asked for, by their names. Raises ``SystemExit`` for others."""
    known = makers(args.data)
    names = args.only.split(",") if args.only else list(known)
    for name in names:
        if name not in known:
            raise SystemExit(f'no place is called "{name}" here; there are {", ".join(known)} (set NERG_DATA for more)')
    return {name: known[name] for name in names}


def write_place(name: str, make: Make, args: argparse.Namespace) -> tuple[Path, Path, dict]:
    """``(folder, rays, where)`` of a place, below the output's folder."""
    folder = args.out / name
    folder.mkdir(exist_ok=True)
    return folder, *make(folder)


def makers(data: Path) -> dict[str, Make]:
    """By name, what writes the rays of a place into a folder and says where it is: options of a fold."""
    from generated_places import PLACES

    out: dict[str, Make] = {}
    if shop := sorted((data / "vr_supermarket").glob("*.csv.gz")):
        out["supermarket"] = lambda folder: (recorded(shop, "vr_supermarket", folder), {"geometry": "hits"})
    for scene in ("room", "playroom", "truck"):
        if files := sorted((data / "eyenavgs" / scene).glob("*.csv.gz")):
            out[scene] = lambda folder, files=files: (recorded(files, "eyenavgs", folder), {"geometry": "none"})
    out["store"] = store
    for make in PLACES:
        place = make()
        out[place.name] = lambda folder, place=place: generated(place, folder)
    return out


def recorded(files: list[Path], reader: str, folder: Path) -> Path:
    """Rays of recordings; a reader leaves out those whose gaze is frozen, and says so."""
    from nerg_mi.jobs.tracking import ImportOptions, import_rays

    path = folder / "rays.npz"
    import_rays(files, ImportOptions(reader=reader, output=path))
    return path


def store(folder: Path) -> tuple[Path, dict]:
    """The demo store's shoppers among its radiance field."""
    from nerg_mi.jobs import demo
    from nerg_mi.jobs.tracking import ImportOptions, import_rays
    from nerg_mi.rays.readers.skeleton import SkeletonOptions
    from nerg_mi.scenes.store import make

    csv = Path(make.__file__).parent / "build" / "shoppers.csv"
    if not csv.is_file():
        make.main(["--stage", "shoppers"])
    path = folder / "rays.npz"
    import_rays([csv], ImportOptions(reader="skeleton", settings=SkeletonOptions(tick=0.001), output=path))
    return path, {"field": demo.store_scene().parent / "store.safetensors"}


def generated(place, folder: Path) -> tuple[Path, dict]:
    scene, path = place.write(folder / "scene.xml"), folder / "rays.npz"
    place.record(scene).save(path)
    return path, {"scene": scene}
