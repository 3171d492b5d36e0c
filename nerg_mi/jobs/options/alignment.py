"""Options of finding how tracking lies in a place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import COORDINATES, LENGTHS, SEEDS, THREADS, Checked, Range

from . import option


@dataclass(frozen=True, kw_only=True)
class AlignOptions(Checked):
    """What an alignment is found from, and what is known beforehand. Lengths of the tracking are metres."""

    field: Path | None = option(None, "The place: a radiance field, or Gaussian splats.")
    scene: Path | None = option(None, "Or: a Mitsuba scene.")
    surface: Path | None = option(
        None, "Or: a mesh or points on surfaces (.ply, .obj, .glb, .npy, .csv of x,y,z or of Aria)."
    )
    pairs: Path | None = option(
        None, "Evidence: picked points, CSV of x,y,z,place_x,place_y,place_z (three or more), or JSON."
    )
    twin: Path | None = option(None, "Or: a mesh or points (as --surface) in the tracking's frame.")
    cameras: Path | None = option(None, "Or: posed photos in the tracking's frame (transforms.json, COLMAP), with ...")
    place_cameras: Path | None = option(None, "... the same photos' poses in the place's frame.")
    start: Path | None = option(None, "Or: an alignment that is near, which the tracking refines.")
    refine: bool = option(False, "Refine what the evidence gave by the tracking.")
    up: str | None = option(
        None, "Axis of the place that is up (z, -y, ... or x,y,z): only turns about it are left. The tracking's is z."
    )
    floor: float = option(0.0, "Height of the floor in the tracking.", within=COORDINATES)
    place_floor: float | None = option(
        None, "Height of the floor in the place, along --up. Default: found.", within=COORDINATES
    )
    scale: float | None = option(
        None, "Units of the place a metre of the tracking, where that is known.", within=LENGTHS
    )
    max_residual: float = option(
        10.0, "Centimetres of the median residual beyond which a fit is refused.", within=Range(0, 10**9)
    )
    force: bool = option(False, "Write a fit that is refused, too.")
    seed: int = option(0, "Seed of the rays by which the place is traced.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
