"""Options of finding the poses of photos."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.ranges import SEEDS, THREADS, Checked, Range

from . import option


@dataclass(frozen=True, kw_only=True)
class PoseOptions(Checked):
    """How the poses of photos are found."""

    frames: int = option(
        80, "Of a video: frames to take, each the sharpest of an equally long stretch.", within=Range(3, 10**6)
    )
    size: int = option(
        960, "Longer side, in pixels, of the copies that features are found in.", within=Range(64, 65536)
    )
    matching: str = option(
        "auto", "Pictures to compare: exhaustive (all), sequential (in order), auto (all up to 100, else in order)."
    )
    lens: str = option(
        "auto",
        "What is found of a lens: radial (f, k1), opencv (fx, fy, k1, k2, p1, p2), auto (opencv from 10 photos on).",
    )
    single_camera: bool = option(
        True, "Photos of equal size (and maker, model, focal length, where told) share a camera; else each has its own."
    )
    allow_outside: bool = option(False, "Follow links that lead out of the folder of photos.")
    orient: bool = option(True, "Turn the place so that up is +z, as far as cameras and a floor tell.")
    seed: int = option(0, "Seed of what is drawn at random.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
