"""From what each device records to gaze in the place: every section of docs/tracking.md followed to its picture.

    python benchmarks/tracking_pictures.py [--people 6] [--only DEVICE] [--images docs/images] [--update PAGE]

Shoppers of the demo store wear each kind of device (`benchmarks/device_files.py`); its files, in its own frame, are
imported, aligned with the store's field by the evidence that such a device has, and a gaze field is trained on them at
the defaults; `nerg scene` chooses an observer and a camera, and the gaze is rendered over the picture. The table says
how far rays lie from where the shoppers looked from and where they looked, in the store (medians over rays, and the
greatest), and how far the alignment alone is off at the eyes. Seconds are those of the whole way, in one process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nerg_mi as nerg
from device_files import Walk, angles, arett, aria, make_walks, neon, points, qualisys, quest
from nerg_mi.alignment.umeyama import move
from nerg_mi.files.tables import write_csv
from nerg_mi.jobs.options.pictures import PictureOptions
from nerg_mi.jobs.options.scene import SceneOptions
from nerg_mi.jobs.pictures import render_file
from nerg_mi.jobs.scene import write_scene
from nerg_mi.rays.rays import Rays
from output import print_table, write_rows

import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[1]
FIELD = ROOT / "scenes" / "store" / "store.safetensors"
TITLE = "From a device's files to a picture"
HEAD = "device|frame|aligned by|rays|eyes off, mm|gaze off, degrees|alignment off, cm|s".split("|")

Evidence = Callable[[Path, np.ndarray], Mapping[str, Any]]
"""Options of the alignment, of files written into a folder, given the way (4, 4) from the store to the device."""


def of_points(folder: Path, truth: np.ndarray) -> Mapping[str, Any]:
    """The glasses' own points of the place."""
    from nerg_mi.alignment.point_file import read_surface

    mesh = read_surface(FIELD.parent / "twin.ply")
    rng = np.random.default_rng(2)
    some = mesh[rng.permutation(len(mesh))[:20_000]]
    points(move(truth, some + rng.normal(0, 0.01, some.shape)), folder / "semidense_points.csv.gz")
    return {"twin": folder / "semidense_points.csv.gz", "up": "z"}


def of_pairs(folder: Path, truth: np.ndarray) -> Mapping[str, Any]:
    """Five points, picked to a centimetre in both."""
    place = np.array([[0.3, 0.3, 0], [7.6, 0.4, 0.1], [7.4, 5.5, 1.9], [0.4, 5.6, 1.2], [3.8, 5.4, 1.9]])
    rng = np.random.default_rng(3)
    there = move(truth, place + rng.normal(0, 0.01, place.shape))
    pairs = np.c_[there, place]
    write_csv(folder / "pairs.csv", [dict(zip("x y z place_x place_y place_z".split(), row)) for row in pairs])
    return {"pairs": folder / "pairs.csv"}


def of_hits(folder: Path, truth: np.ndarray) -> Mapping[str, Any]:
    """Where the headset's gaze met its own mesh."""
    return {"up": "z"}


def of_heads(folder: Path, truth: np.ndarray) -> Mapping[str, Any]:
    """Heads in free space, gaze through it; the place is in metres."""
    return {"up": "z", "scale": 1.0}


@dataclass(frozen=True)
class Device:
    """A kind of recording: its files' ``writer``, the ``reader`` with its options, and the ``evidence`` by which it is
    aligned, None where it is in the place's frame as it is (or becomes so at the import)."""

    name: str
    frame: str
    writer: Callable[[Sequence[Walk], Path], None]
    reader: str
    files: str
    evidence: Evidence | None = None
    by: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)


MAP = 'origin=hx,hy,hz xyzw=qx,qy,qz,qw "azel=azimuth [deg],elevation [deg]" "t=timestamp [ns]" person=id'
FRAMES = {"poses": "transforms.json", "frames": "{recording}/frame_{frame1}", "fps": 5.0}
DEVICES = (
    Device("aria", "a world of its own", aria, "aria", "shopper-*", of_points, "the glasses' points of the place"),
    Device("quest", "tracking space, Unity's axes", quest, "quest", "*.csv", of_heads, "tracking without hit points"),
    Device("neon", "the scene camera's", neon, "neon", "shopper-*", by="frames beside the photos", options=FRAMES),
    Device("arett", "a world of its own, Unity's axes", arett, "arett", "*.csv", of_hits, "tracking with hit points"),
    Device("qualisys", "the laboratory's, mm", qualisys, "qualisys", "*.tsv", of_pairs, "5 picked points"),
    Device(
        "angles",
        "the place's, Unity's axes",
        angles,
        "table",
        "log.csv",
        by="-",
        options={"columns": MAP, "up": "y", "handedness": "left", "tick": 1e-9},
    ),
)


def follow(device: Device, walks: Sequence[Walk], out: Path, image: Path) -> list:
    """All commands of a device's section; a row of the table."""
    start = time.perf_counter()
    truth = np.eye(4)
    if device.evidence is not None:
        # Floors are level and at height 0, as such devices have them.
        truth[:3, :3] = Rotation.from_euler("z", 137, degrees=True).as_matrix()
        truth[:3, 3] = 3.2, -1.7, 0
    folder = out / device.name
    device.writer([walk.moved(truth) for walk in walks], folder)
    rays = read_files(device, folder, device.files)
    rays.save(folder / "rays.npz")
    found, off = np.eye(4), "-"
    if device.evidence is not None:
        evidence = device.evidence(folder, truth)
        found = nerg.align(folder / "rays.npz", folder / "align.json", field=FIELD, **evidence).matrix
        eyes = np.concatenate([walk.eye for walk in walks])
        off = f"{100 * np.median(np.linalg.norm(move(found @ truth, eyes) - eyes, axis=1)):.1f}"
    aligned = {"align": folder / "align.json"} if device.evidence else {}
    nerg.train_gaze(rays, folder / "gaze.safetensors", field=FIELD, **aligned)
    scene = folder / "scene.xml"
    write_scene([FIELD, folder / "gaze.safetensors", folder / "rays.npz"], scene, SceneOptions(width=420))
    render_file(scene, image, PictureOptions(overlay="gaze", spp=16))
    eyes, turns = compare(rays, found, walks)
    seconds = time.perf_counter() - start
    by = device.by or "-"
    return [device.name, device.frame, by, f"{len(rays):,}", eyes, turns, off, f"{seconds:.0f}"]


def read_files(device: Device, folder: Path, files: str) -> Rays:
    """The rays of the ``files`` (a pattern) in ``folder``."""
    options = dict(device.options)
    if "poses" in options:
        options["poses"] = folder / options["poses"]
    return nerg.import_rays(sorted(folder.glob(files)), device.reader, **options)


def compare(rays: Rays, matrix: np.ndarray, walks: Sequence[Walk]) -> tuple[str, str]:
    """How far the rays, moved by ``matrix``, lie from where the shoppers' eyes were, and point from where they looked:
    median and most, in millimetres and degrees."""
    eyes, turns = [], []
    for number, person in enumerate(rays.persons):
        walk = next(w for w in walks if w.name == person)
        at = np.flatnonzero(rays.person == number)
        t = rays.t[at] - rays.t[at].min()
        k = np.abs(walk.t[None] - t[:, None]).argmin(axis=1)
        eyes.append(np.linalg.norm(move(matrix, rays.origin[at]) - walk.eye[k], axis=1))
        direction = rays.direction[at] @ matrix[:3, :3].T
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        turns.append(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(direction - walk.gaze[k], axis=1) / 2, 0, 1))))
    eye, turn = 1000 * np.concatenate(eyes), np.concatenate(turns)
    return _pair(np.median(eye), eye.max()), _pair(np.median(turn), turn.max())


def _pair(*values: float) -> str:
    """Two figures of which less than a thousandth is nothing."""
    return ", ".join("0" if v < 1e-3 else f"{v:.0f}" if v >= 100 else f"{v:.2g}" for v in values)


def main() -> None:
    words = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    words.add_argument("--people", type=int, default=6, help="shoppers who wear each device")
    words.add_argument(
        "--only", choices=[d.name for d in DEVICES], action="append", help="only this device; repeatable"
    )
    words.add_argument("--seed", type=int, default=7, help="of the shoppers")
    words.add_argument("--out", type=Path, default=ROOT / "out" / "tracking_pictures", help="folder of all files")
    words.add_argument("--images", type=Path, help="folder of the pictures, tracking-DEVICE.png (default: --out)")
    words.add_argument("--update", type=Path, help="page of the documentation to put the table into")
    given = words.parse_args()
    walks = make_walks(given.people, given.seed)
    rows = []
    for device in DEVICES:
        if given.only is None or device.name in given.only:
            image = (given.images or given.out) / f"tracking-{device.name}.png"
            rows.append(follow(device, walks, given.out, image))
            print("; ".join(map(str, rows[-1])), flush=True)
    print_table(TITLE, HEAD, rows, given.update)
    write_rows(given.out / "tracking_pictures.csv", [dict(zip(HEAD, row)) for row in rows])


if __name__ == "__main__":
    main()
