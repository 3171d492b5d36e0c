"""Options of bakes, and what they come to: units, cones and sources."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import COORDINATES, DECADES, LENGTHS, RAYS, SEEDS, THREADS, VALUES, Range
from nerg_mi.rays.rays import Rays

from .options import PartOptions, option, parse_numbers

# ---- Options of baking gaze on surfaces ----


@dataclass(frozen=True, kw_only=True)
class BakeOptions(PartOptions):
    """Whose gaze is put on which surfaces, and how."""

    gaze: Path | None = option(None, "Gaze field (.safetensors).  [default: that of a scene file]")
    rays: Path | None = option(None, "Rays of attention, a file or a dataset: where people were, and looked.")
    source: str | None = option(
        None, "Whose gaze: of the field, or of the rays themselves.  [default: the field's if there is one]", "--from"
    )
    observer: tuple[float, ...] | None = option(
        None,
        "One observer's eye, x,y,z in the place, in place of the people of the rays.",
        parse=parse_numbers,
        within=COORDINATES,
    )
    path: Path | None = option(
        None, "Observers one by one: a CSV file with columns x, y, z in the place and, if they differ, weight."
    )
    observers: int = option(
        64, "Observers that stand for all places of the people of --rays.", within=Range(1, 100_000)
    )
    weights: str = option("time", "What rays count by: time, person (all people alike), or equal (all rays alike).")
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    shapes: tuple[str, ...] = option(
        (), "Only this shape of a scene receives gaze, the others hide it; repeatable.", "--shape"
    )
    cone: float | None = option(
        None,
        "Degrees (standard deviation) of the cone of a look: error of the tracker and fovea.  "
        "[default: 1.5 of rays, 0 of a field]",
        within=Range(0, 30),
    )
    bundle: int = option(16, "Rays that stand for the cone of a tracked one.", within=Range(1, 1024))
    smooth: float = option(
        0.0, "Metres (standard deviation) of smoothing along the surface; 0: none.", within=Range(0, 10**6)
    )
    detail: float | None = option(
        None,
        "Longest edge of a triangle in metres; longer ones are cut.  [default: about 100,000 triangles]",
        within=LENGTHS,
    )
    angle: float = option(
        2.0,
        "Degrees under which an observer sees a piece of a surface at most: less is exacter.",
        within=Range(0.2, 30),
    )
    unit: str = option("share", "Values are: share (of gaze, 1/m²), or seconds (of the rays, s/m²).")
    halves: bool = option(False, "Say how well two halves of the people agree (of rays).")
    texture: int | None = option(
        None, "Pixels a side of a texture in .glb, in place of colours of vertices.", within=Range(64, 8192)
    )
    top: float | None = option(
        None, "Upper end of the colours' scale.  [default: the 99.5th percentile]", within=VALUES
    )
    cmap: str = option("inferno", "Colour map: inferno, magma, plasma, viridis, cividis.")
    decades: float = option(0.0, "Powers of ten that the colours' scale spans; 0: a linear scale.", within=DECADES)
    resolution: int = option(
        256, "Of a radiance field, whose mesh is made: cells along its box's longest edge.", within=Range(8, 2048)
    )
    most: int | None = option(None, "Rays of a dataset at most; of more, a sample by --seed.", within=RAYS)
    seed: int = option(0, "Seed of what is drawn at random.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )


# ---- Whose gaze a bake is asked for, and in which unit ----

UNITS = {"share": "share of gaze per square metre [1/m²]", "seconds": "gaze per square metre [s/m²]"}
SOURCES = ("field", "rays")
CONE = 1.5
"""Degrees of a tracked ray's: the error of good trackers, and the radius of the fovea."""


def source_of(options: BakeOptions, rays: Rays | None, with_gaze: bool = False) -> str:
    """Whose gaze it is, of `SOURCES`; ``rays`` are those in memory, and ``with_gaze`` says whether the surface may have
    a gaze field of its own. Raises `NergError` for options that contradict each other."""
    people = rays is not None or options.rays is not None
    source = options.source or ("field" if options.gaze is not None or (with_gaze and not people) else "rays")
    if source not in SOURCES:
        raise NergError(f'--from is {" or ".join(SOURCES)}, got "{source}"')
    if options.unit not in UNITS:
        raise NergError(f'--unit is {" or ".join(UNITS)}, got "{options.unit}"')
    if source == "rays" and not people:
        raise NergError("whose gaze is it? give a gaze field by --gaze, or rays by --rays")
    if source == "rays" and (options.observer is not None or options.path is not None):
        raise NergError("--observer and --path look with a gaze field; give --gaze, or leave them out")
    if source == "field" and (options.unit == "seconds" or options.halves):
        raise NergError("--unit seconds and --halves are of rays, whose time is known; add --from rays")
    return source


def cone_of(options: BakeOptions, source: str) -> float:
    """Standard deviation in radian of the cone of a look."""
    return float(np.radians(CONE if options.cone is None and source == "rays" else options.cone or 0.0))
