"""Regression test: compares the outputs of all commands bit for bit with recorded ones.

    python tools/unchanged.py record FOLDER [--only NAME ...]   run every command below and store its outputs
    python tools/unchanged.py compare FOLDER [--only NAME ...]  run them again and list the differences; exit code 1 if
                                                                there are any

Channels, pixels, arrays, tables and the errors of a study are compared; headers, times and file names are not.

The outputs are pictures of the demo store with every kind of depth, visibility, quadrature, gaze field and AOV, of
shapes and through a panorama; radiance and gaze trainings with one thread; the errors of a study; tables and exports.
They only depend on the demo store, seeds and the command line, so one version can record them and another can compare.
The bits depend on the machine, libLLVM and Mitsuba: record and compare on the same machine.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / "scenes" / "store"
# Not the installed script, so that a tree with another entry point also works.
NERG = [sys.executable, "-m", "tools.with_defaults"]
SIZE = ["-D", "width=96", "-D", "height=64", "-D", "sphere_width=96", "-D", "sphere_height=48", "-D", "spp=2"]
ALL_AOVS = "depth,opacity,position,gaze,emit,capture,visibility,observer_depth,features,features_at"
COUNTS = "depth,gaze,gaze_evals,density_evals,color_evals"
VIEWS = [
    (7.4, 3.4, 2.2),
    (4.6, 3.0, 1.6),
    (2.4, 2.0, 1.7),
    (8.4, 5.0, 2.0),
    (5.5, 1.2, 1.8),
    (3.0, 5.0, 1.5),
    (6.5, 4.5, 2.3),
    (4.0, 1.5, 2.4),
]
TARGET = (4.8, 4.2, 1.0)
GAZE = {
    "default": ["--recipe", "default", "--steps", "12", "--test-zones", "2", "--test-positions", "8"],
    "small": ["--recipe", "small", "--steps", "12"],
    "paper": ["--recipe", "paper", "--steps", "2"],
    "emit": ["--recipe", "default", "--variant", "emit", "--steps", "6"],
    "capture": ["--recipe", "small", "--variant", "capture", "--steps", "6"],
    "zones": ["--recipe", "default", "--steps", "10"],
    "ensemble": ["--recipe", "default", "--ensemble", "2", "--steps", "6"],
}
"""Gaze fields by name, and the options that train them."""
VALIDATION_ZONES = {"small": 0, "paper": 0, "capture": 0, "zones": 2}
"""Zones of positions for validation, of fields where the recipe does not set them."""
PICTURES = {
    "plain": [],
    "all_aovs": ["aovs=" + ALL_AOVS],
    "counts": ["aovs=" + COUNTS],
    "expected": ["depth=expected"],
    "refined": ["depth=refined"],
    "transmittance": ["visibility=transmittance"],
    "map": ["visibility=map"],
    "open": ["occlusion=false"],
    "dark": ["radiance=false"],
}
"""Pictures of the store scene by name, and their changes of its defaults."""


def make_rays(folder: Path) -> Path:
    """Write the rays of three participants who walk through the store and look at its middle as a CSV file."""
    rng = np.random.default_rng(7)
    lines = ["person,time,x,y,z,dx,dy,dz"]
    for person in range(3):
        begin, end = rng.uniform([1.5, 1.0, 1.5], [8.5, 5.5, 1.7], (2, 3))
        for k in range(2000):
            place = begin + (end - begin) * (k / 2000) + rng.normal(0, 0.1, 3) * [1, 1, 0.1]
            to = np.array([4.8, 4.2, 1.0]) + rng.normal(0, 0.5, 3) - place
            to /= np.linalg.norm(to)
            lines.append(",".join([f"p{person}", f"{k * 0.1:.1f}", *(f"{v:.6f}" for v in (*place, *to))]))
    path = folder / "walk.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_transforms(folder: Path, width: int, height: int) -> None:
    """Write the poses of the pictures ``photos/K.png``."""
    frames = []
    for k, eye in enumerate(VIEWS):
        back = np.subtract(eye, TARGET)
        back = back / np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    focal = 0.5 * width / np.tan(np.radians(78) / 2)
    camera = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))


def iter_commands(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the command lines in the order of their dependencies, with the file or folder that each writes."""
    render = ["render", str(STORE / "scene.xml")]
    one = ["--threads", "1"]
    rays = str(folder / "rays.npz")
    yield (
        "rays.npz",
        ["rays", "import", str(make_rays(folder)), "--map", "origin=x,y,z direction=dx,dy,dz t=time person=person"],
    )
    yield "fewer.npz", ["rays", "filter", rays, "--fixations", "idt"]
    for name, changes in PICTURES.items():
        yield f"{name}.exr", [*render, *SIZE, *(v for c in changes for v in ("-D", c))]
    for sensor in ("1", "2"):
        yield f"sensor{sensor}.exr", [*render, *SIZE, "-s", sensor]
    for scene in ("shapes", "display", "twin"):
        yield f"{scene}.exr", ["render", str(STORE / f"{scene}.xml"), "-D", "width=96", "-D", "height=64", "--spp", "2"]
    (folder / "photos").mkdir(exist_ok=True)
    for k, eye in enumerate(VIEWS):
        place = ["-D", "camera={}, {}, {}".format(*eye), "-D", "target={}, {}, {}".format(*TARGET)]
        yield f"photos/{k}.png", [*render, *SIZE, *place, "-D", "aovs=depth"]
    write_transforms(folder / "photos", 96, 64)
    yield (
        "place.safetensors",
        [
            "train",
            "radiance",
            str(folder / "photos"),
            "--aabb",
            "0,0,0,10,7,3",
            "--steps",
            "60",
            "--holdout",
            "4",
            *one,
        ],
    )
    yield "place.ply", ["export", "points", str(folder / "place.safetensors")]
    yield "place.vol", ["export", "volume", str(folder / "place.safetensors"), "--resolution", "24"]
    for name, options in GAZE.items():
        defaults = ["probes=60"]
        if name in VALIDATION_ZONES:
            defaults.append(f"validation_zones={VALIDATION_ZONES[name]}")
        yield (
            f"gaze_{name}.safetensors",
            [
                *defaults,
                "train",
                "gaze",
                rays,
                "--environment",
                str(STORE / "store.safetensors"),
                "--min-rays",
                "8",
                *options,
                *one,
            ],
        )
        aovs = {"ensemble": "gaze,gaze_std,support", "emit": "gaze,emit", "capture": "gaze,capture"}.get(
            name, "gaze,emit,capture"
        )
        yield f"gaze_{name}.exr", [*render, *SIZE, "-D", f"gaze={folder}/gaze_{name}.safetensors", "-D", f"aovs={aovs}"]
    yield (
        "study",
        ["study", str(STORE / "scene.xml"), "--quick", "--width", "48", "--height", "32", "--only", "depth|visib|step"],
    )
    yield (
        "eval",
        [
            "pictures=1",
            "eval",
            "gaze",
            str(folder / "gaze_default.safetensors"),
            rays,
            "--environment",
            str(STORE / "store.safetensors"),
            "--min-rays",
            "8",
            "--resamples",
            "20",
            *one,
        ],
    )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the named arrays of a rays file or picture, without headers, which contain file names and times."""
    if path.suffix == ".exr":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: channel.pixels for name, channel in file.channels().items()}
    if path.suffix == ".png":
        with Image.open(path) as image:
            return {image.mode: np.asarray(image)}
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    return {name: array for name, array in stored.items() if array.dtype.kind in "fiub" and array.ndim}


def compute_digest(path: Path) -> str:
    """Return a digest of the arrays of a picture, rays file or checkpoint, of the rows of a study, or of the bytes of a
    file.
    """
    if path.name == "study":
        data = read_study_errors(path)
    elif path.suffix in (".exr", ".png", ".npz"):
        parts = [f"{name} {a.dtype} {a.shape}".encode() + a.tobytes() for name, a in sorted(read_arrays(path).items())]
        data = b"".join(parts)
    else:
        data = path.read_bytes()
    if path.suffix == ".safetensors":
        (size,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + size])
        header.pop("__metadata__", None)
        data = json.dumps(header, sort_keys=True).encode() + data[8 + size :]
    return hashlib.sha256(data).hexdigest()


def read_study_errors(folder: Path) -> bytes:
    """Read the rows of a study without times, memory, and Pareto fronts, which depend on times."""
    rows = list(csv.DictReader((folder / "study.csv").open()))
    measured = ("ms", "second", "time", "memory", "bytes", "peak", "pareto")
    errors = [{k: v for k, v in row.items() if not any(w in k for w in measured)} for row in rows]
    return json.dumps(errors, sort_keys=True).encode()


def select_commands(folder: Path, only: list[str]) -> list[tuple[str, list[str]]]:
    """Select the commands whose outputs contain one of ``only`` (all if it is empty), and those whose outputs they
    read.
    """
    selected = []
    for name, line in reversed(list(iter_commands(folder))):
        out = folder / name
        reads = lambda argument, out=out: str(out) in argument or (out.parent != folder and argument == str(out.parent))
        if not only or any(o in name for o in only) or any(reads(g) for _, other in selected for g in other):
            selected.append((name, line))
    return selected[::-1]


def run_commands(folder: Path, only: list[str]) -> dict[str, str]:
    """Run all selected commands; returns output -> digest, or the error."""
    results = {}
    for name, line in select_commands(folder, only):
        out = folder / name
        process = subprocess.run([*NERG, *line, "-o", str(out)], capture_output=True, text=True)
        tables = sorted(out.glob("*.csv")) if out.is_dir() and name != "study" else []
        for path in tables or [out]:
            output = path.relative_to(folder).as_posix()
            failed = f"exit code {process.returncode}: {process.stderr.strip()[-400:]}" if process.returncode else ""
            results[output] = failed or compute_digest(path)
            print(f"{output:28} {results[output][:70]}", flush=True)
    return results


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("folder", type=Path, help="folder of the recorded outputs")
    only_help = "only outputs whose names contain this, and their inputs; repeatable"

    parser.add_argument("--only", action="append", default=[], help=only_help)
    args = parser.parse_args(argv)
    if args.what == "record":
        args.folder.mkdir(parents=True, exist_ok=True)
        return int(any(v.startswith("exit code") for v in run_commands(args.folder.resolve(), args.only).values()))
    with tempfile.TemporaryDirectory(prefix="nerg-unchanged-") as temporary:
        results = run_commands(Path(temporary), args.only)
    before = {name: compute_digest(args.folder / name) for name in results if (args.folder / name).exists()}
    differ = [name for name, value in results.items() if before.get(name) != value]
    print(f"{len(results)} outputs, {len(differ)} of them differ" + "".join(f"\n  {n}" for n in differ))
    return int(bool(differ))


if __name__ == "__main__":
    sys.exit(main())
