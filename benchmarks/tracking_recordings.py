"""Recordings of real devices against what is known of them: the points that glasses saw, and the sizes of people.

    python benchmarks/tracking_recordings.py [--data FOLDER] [--update docs/tracking.md]

First table: Project Aria's sample, of two gaze files; the angle between each ray and the point of the place nearest to
it, as the files are read, and with each mistake of axes; a mistake is `named` where `nerg align` would warn of it.
Second table: the places of EyeNavGS; recordings that hold gaze, and those that the reader leaves out; how far apart the
eyes of those who are kept are, how high above the floor, and how far heads are from upright (medians over people, and
the range).
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.alignment.flips import compare_flips
from nerg_mi.capture.semidense import read_semidense
from nerg_mi.rays.checks.head import EXCHANGES, head_frames
from nerg_mi.rays.checks.mirror import DECLARED
from nerg_mi.rays.readers.registry import read_rays
from output import print_table

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
ARIA = "Aria's gaze and the points of its place"
GAZE = ("eye_gaze/generalized_eye_gaze.csv", "eye_gaze_vergence/generalized_gaze.csv")
NAVGS = "People of EyeNavGS"
PLACES = "room", "playroom", "truck"


def aria_rows(sample: Path) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the first table: median and 90 % in degrees."""
    points = read_semidense(sample / "trajectory" / "global_points.csv.gz")
    columns: dict[str, list[str]] = {}
    for file in GAZE:
        rays = read_rays("aria", sample / file)
        frames = head_frames(rays.head)
        own = np.einsum("nij,nj->ni", frames, rays.direction)
        ways = {DECLARED: rays.direction}
        ways |= {f"{'xyz'[k]} negated": rays.direction * np.where(np.arange(3) == k, -1, 1) for k in range(3)}
        ways |= {f"{what} exchanged": np.einsum("nij,ni->nj", frames, own * s) for what, s in EXCHANGES.items()}
        for name, direction in ways.items():
            flips = compare_flips(points, np.eye(4), rays.origin, direction, rays.head)
            median, most = np.percentile(flips.degrees[DECLARED], [50, 90])
            told = ", named" if flips.warning() else ""
            columns.setdefault(name, []).append(f"{median:.2g}, {most:.2g}{told}")
    return ["gaze", *(f"`{Path(file).name}`" for file in GAZE)], [[name, *cells] for name, cells in columns.items()]


def navgs_row(place: Path) -> list[str]:
    rays = read_rays("eyenavgs", place)
    dropped = [d["reason"] for d in rays.metadata["dropped"]]
    frozen, locked = (sum(word in reason for reason in dropped) for word in ("frozen", "locked"))
    eyes = 1000 * np.array(list(rays.metadata["eye_distance"].values()))
    people = range(len(rays.persons))
    heights = [np.median(rays.origin[rays.person == p, 2]) for p in people]
    return [
        place.name,
        str(len(rays.persons)),
        str(frozen),
        str(locked),
        f"{np.median(eyes):.1f} ({eyes.min():.1f} to {eyes.max():.1f})",
        f"{np.median(heights):.2f} ({min(heights):.2f} to {max(heights):.2f})",
    ]


def main() -> None:
    words = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
    words.add_argument("--data", type=Path, default=data, help="folder of recorded data")
    words.add_argument("--update", type=Path, help="page of the documentation to put the tables into")
    given = words.parse_args()
    sample = given.data / "aria" / "gen1" / "mps_sample"
    if sample.is_dir():
        print_table(ARIA, *aria_rows(sample), given.update)
    else:
        print(f"no sample of Aria in {given.data.name}")
    places = [given.data / "eyenavgs" / name for name in PLACES]
    if all(place.is_dir() for place in places):
        head = "place|read|frozen|locked to the head|eyes apart, mm|above the floor, m".split("|")
        print_table(NAVGS, head, [navgs_row(place) for place in places], given.update)
    else:
        print(f"no recordings of EyeNavGS in {given.data.name}")


if __name__ == "__main__":
    main()
