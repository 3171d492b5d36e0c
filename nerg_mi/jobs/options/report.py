"""Options of the report on a gaze field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import COORDINATES, FIELDS_OF_VIEW, SEEDS, SPP, THREADS, Checked, Range

from . import option, parse_numbers


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Checked):
    """What a report shows. Positions are in the coordinates of the place."""

    objects: Path | None = option(None, 'JSON file of named objects: {"shelf": [[x0, y0, z0], [x1, y1, z1]], ...}.')
    evaluate: bool = option(
        False, "Score the field on the rays that were held out of its training (about a minute a split)."
    )
    names: bool = option(False, "Show the names of people. Without it they are numbered.")
    min_persons: int = option(1, "Hide shares of objects that fewer people could see.", within=Range(1, 10**6))
    paths: bool = option(True, "Draw people's paths in 3D. How somebody walks can tell who it is.")
    title: str | None = option(None, "Title.  [default: the gaze field's name]")
    observer: tuple[float, ...] | None = option(
        None,
        "Position of the observer in the pictures, x,y,z.  [default: where most rays are]",
        parse=parse_numbers,
        within=COORDINATES,
    )
    camera_from: tuple[float, ...] | None = option(
        None,
        "Position of the camera, x,y,z.  [default: the best overview]",
        "--from",
        parse=parse_numbers,
        within=COORDINATES,
    )
    camera_to: tuple[float, ...] | None = option(
        None, "Point that it looks at, x,y,z.", "--to", parse=parse_numbers, within=COORDINATES
    )
    fov: float | None = option(
        None, "Degrees between the left and right border of its picture.  [default: 70]", within=FIELDS_OF_VIEW
    )
    eyes: int = option(200, "Places of people from which objects are looked for.", within=Range(1, 10_000))
    points: int = option(80_000, "Points of the 3D scene at most.", within=Range(100, 100_000))
    width: int = option(480, "Width of the pictures in pixels.", within=Range(24, 1200))
    spp: int = option(2, "Samples a pixel.", within=SPP)
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
