"""Options of baking gaze on surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import COORDINATES, DECADES, LENGTHS, RAYS, SEEDS, THREADS, VALUES, Range

from . import option, parse_numbers
from .parts import PartOptions


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
