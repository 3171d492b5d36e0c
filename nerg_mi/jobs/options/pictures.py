"""Options of the rendering of a scene file, and of the demo's pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import DECADES, RATES, SEEDS, SPP, VALUES, Checked, Range

from . import definitions, option


@dataclass(frozen=True, kw_only=True)
class PictureOptions(Checked):
    """How a scene file is rendered."""

    defaults: Mapping[str, str] | None = definitions()
    sensor: int = option(0, "Index of the sensor, counted from 0.", "-s", "--sensor", within=Range(0, 65535))
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
    spp: int = option(0, "Samples a pixel; 0: as the scene says.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    threads: int = option(
        0, "Worker threads; 0: one a core.", "-t", "--threads", within=Range(0, 1024), changes_result=False
    )
    memory: float = option(
        1.0, "GB that rendering may take; larger pictures are made in bands.", within=Range(1e-6, 10**6)
    )
    overlay: str | None = option(
        None, "Lay this over the colour, with its scale (.png, .svg, .mp4): gaze, kde, visibility, depth, support, ..."
    )
    top: float | None = option(
        None, "Upper end of the overlay's scale, for gaze in 1/sr.  [default: the 99.5th percentile]", within=VALUES
    )
    cmap: str | None = option(
        None, "Colour map of the overlay: inferno, magma, plasma, viridis, cividis.  [default: the overlay's own]"
    )
    decades: float = option(0.0, "Powers of ten that the overlay's scale spans; 0: a linear scale.", within=DECADES)
    hatching: bool = option(True, "Hatch the overlay where nothing is known.")
    frames: Path | None = option(
        None, "Render a sequence: CSV file whose header names <default>s, a line of values for each picture."
    )
    fps: float = option(25.0, "Pictures a second of an .mp4.", within=RATES)


@dataclass(frozen=True, kw_only=True)
class DemoOptions(Checked):
    """Which pictures the demo makes."""

    scene: Path | None = option(None, "Scene file.  [default: the demo store's]")
    defaults: Mapping[str, str] | None = definitions()
    width: int = option(600, "Width of a picture in pixels; pictures are 3:2.", within=Range(3, 16384))
    spp: int = option(8, "Samples a pixel.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
