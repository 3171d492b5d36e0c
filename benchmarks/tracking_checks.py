"""What the checks of rays say of mistakes that are planted, and of recordings that are right.

    python benchmarks/tracking_checks.py [--data FOLDER] [--mistake WORD] [--update docs/tracking.md]

Each mistake is made in a generated recording (six people of two and a half minutes, with heads, hit points and the
distance of the eyes), in some of the people, in the last of everybody's rays, or in all of it; in all of it once more
where neither heads nor hit points are known; and in the recordings of the VR supermarket (ten people). A cell has the
names of the checks that speak; an empty one, that the mistake cannot be made there. Then what is said of recordings as
they are, which should be nothing; and what the checks take of the time of an import.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.rays import summary
from nerg_mi.rays.checks.figures import Figures
from nerg_mi.rays.checks.registry import CHECKS
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.builder import RaysBuilder
from nerg_mi.rays.readers.frames import Frame
from nerg_mi.rays.readers.parsing.poses import rotations_from_quaternions
from nerg_mi.rays.readers.parsing.tables import iterate_table
from nerg_mi.rays.readers.registry import read_rays
from output import print_table
from tracking_people import MISTAKES, Mistake, last_people, last_rows, make_recording

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PLACES = {"room": 2.0, "playroom": 2.7, "truck": 0.76}
"""Places of EyeNavGS, with the units of their frames in a metre."""


def figures_of(rays: Rays) -> Figures:
    """What checks are given of ``rays``."""
    found: list[Figures] = []
    known = summary.find_warnings
    summary.find_warnings = lambda figures: found.append(figures) or []
    try:
        summary.summarise(rays)
    finally:
        summary.find_warnings = known
    return found[0]


def named(rays: Rays) -> list[str]:
    """Names of the checks that find something."""
    figures = figures_of(rays)
    return [check.name for check in CHECKS if check.find(figures)]


def read_eyenavgs(files: list[Path], scale: float) -> Rays:
    """Recordings of EyeNavGS by their columns: the left eye's rows, and how far away the right eye is. The reader that
    there is for them leaves out those whose gaze is frozen or locked to the head."""
    builder = RaysBuilder(Frame(up="y"))
    builder.note(floor="unknown")
    columns = {"Position": "XYZ", "Quaternion": "XYZW", "GazeQ": "XYZW"}
    vectors = [name + axis for name, axes in columns.items() for axis in axes]
    for path in files:
        builder.source(path)
        for v, _, lines in iterate_table(path, ["ViewIndex", "Timestamp", *vectors]):
            left = np.flatnonzero(v[:-1, 0] == 0)
            head, gaze = (-rotations_from_quaternions(v[left, a : a + 4])[:, :, 2] for a in (5, 9))
            eyes = np.where(v[left + 1, 0] == 1, np.linalg.norm(v[left + 1, 2:5] - v[left, 2:5], axis=1), np.nan)
            builder.add(
                v[left, 1] / 1000,
                path.name.split("_")[0],
                v[left, 2:5] / scale,
                gaze,
                rows=lines[left],
                head=head,
                eye_distance=eyes / scale,
            )
    return builder.build()


def bare(rays: Rays) -> Rays:
    """Without heads and hit points."""
    return replace(rays, head=None, hit=None)


def row(mistake: Mistake, made: Rays, recorded: Rays | None) -> list[str]:
    """A row of the table of mistakes."""

    def cell(rays: Rays | None, of: str, share: float, strip: Callable[[Rays], Rays] = lambda r: r) -> str:
        if rays is None or of not in mistake.of.split() or (strip is bare and mistake.head):
            return ""
        mask = (last_rows if of == "rays" else last_people)(rays, share)
        return ", ".join(named(strip(mistake.plant(rays, mask)))) or "-"

    return [
        mistake.name,
        cell(made, "people", 0.01),
        cell(made, "people", 0.5),
        cell(made, "rays", 0.1),
        cell(made, "rays", 0.5),
        cell(made, "all", 1.0),
        cell(made, "all", 1.0, bare),
        cell(recorded, "people", 0.01),
        cell(recorded, "rays" if "rays" in mistake.of else "people", 0.5),
        cell(recorded, "all", 1.0),
    ]


HEAD = ["mistake", "one of 6", "half of them", "10 % of the rays", "half", "all", "all, bare"]
HEAD += ["shop: one of 10", "shop: half", "shop: all"]
CLEAN = ["recordings", "people", "rays", "checks that speak"]
COSTS = ["2.6 million rays", "processor seconds"]


def clean_rows(made: Rays, recorded: Rays | None, data: Path) -> list[list[str]]:
    """Recordings as they are, and what is said of them."""
    sets = {"generated": made, "generated, without heads and hit points": bare(made)}
    if recorded is not None:
        sets["VR supermarket"] = recorded
        sets["VR supermarket, without heads and hit points"] = bare(recorded)
    for place, scale in PLACES.items():
        files = sorted((data / "eyenavgs" / place).glob("*.csv.gz"))
        if files:
            rays = read_eyenavgs(files, scale)
            read = read_rays("eyenavgs", files)
            sets[f"EyeNavGS, {place}"] = read
            left_out = ~np.isin(rays.persons, read.persons)
            sets[f"EyeNavGS, {place}, the recordings that its reader leaves out"] = rays.select(left_out[rays.person])
    for name in ("gen1/mps_sample", "adt"):
        if (data / "aria" / name).is_dir():
            sets[f"Project Aria, {name}"] = read_rays("aria", data / "aria" / name)
    return [
        [name, str(len(np.unique(rays.person))), f"{len(rays):,}", ", ".join(named(rays)) or "-"]
        for name, rays in sets.items()
    ]


def cost_rows(rays: Rays, count: int = 2_600_000) -> list[list[str]]:
    """Processor seconds of each check for ``count`` rays made of copies of ``rays``."""
    copies, rng = -(-count // len(rays)), np.random.default_rng(0)
    shift = np.repeat(rng.normal(0, 0.15, (copies, 3)) * (1, 1, 0.3), len(rays), axis=0)
    columns = {name: np.concatenate([column] * copies) for name, column in rays.columns().items()}
    columns["person"] = columns["person"] + len(rays.persons) * np.repeat(np.arange(copies), len(rays))
    columns |= {"origin": columns["origin"] + shift, "hit": columns["hit"] + shift}
    names = tuple(f"{name}_{k}" for k in range(copies) for name in rays.persons)
    many = replace(rays, persons=names, **columns).select(slice(0, count))
    figures, rows = figures_of(many), []

    def timed(name: str, work: Callable[[], object]) -> None:
        start = time.process_time()
        work()
        rows.append([name, f"{time.process_time() - start:.2f}"])

    timed("recordings, and what is frozen in them", lambda: figures.frozen)
    for check in CHECKS:
        timed(check.name, lambda check=check: check.find(figures))
    timed("the whole card", lambda: summary.summarise(many))
    return rows


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")))
    parser.add_argument("--mistake", default="", help="only those whose name has this word")
    parser.add_argument("--update", type=Path, help="page of the documentation to put the tables into")
    options = parser.parse_args(argv)
    files = sorted((options.data / "vr_supermarket").glob("*.csv.gz"))
    recorded, made = read_rays("vr_supermarket", files) if files else None, make_recording()
    rows = [row(mistake, made, recorded) for mistake in MISTAKES if options.mistake in mistake.name]
    print_table("Mistakes that were planted", HEAD, rows, options.update)
    if not options.mistake:
        print_table("Recordings as they are", CLEAN, clean_rows(made, recorded, options.data), options.update)
        print_table("What the checks cost", COSTS, cost_rows(recorded or made), options.update)


if __name__ == "__main__":
    main()
