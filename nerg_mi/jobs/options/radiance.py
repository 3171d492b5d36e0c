"""Options of the training and of the evaluation of a radiance field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.ranges import COORDINATES, LENGTHS, SECONDS, SPP, THREADS, Checked, Range
from nerg_mi.train.radiance_settings import RadianceSettings

from . import exposes, option, parse_numbers


@dataclass(frozen=True, kw_only=True)
class PhotoOptions(Checked):
    """How a posed image set is read."""

    holdout: int | None = option(
        None, "Hold out every so many frames, 0 none. Default: transforms_test.json, else 8.", within=Range(0, 10**6)
    )
    width: int | None = option(
        None, "Width of the pictures in pixels. Default: as they are, or as it was trained.", within=Range(1, 65536)
    )
    scale: float = option(
        1.0, "Multiply all lengths by this: what a unit of the data set measures, in metres.", within=LENGTHS
    )
    coordinates: str = option(
        "file",
        "Of the field: file, upright (+z up), original (applied_transform undone), a dataparser_transforms.json.",
    )
    depth: bool = option(True, "Use the data set's depth, where it has any.")
    allow_outside: bool = option(False, "Read files outside of the data set's folder too, where it names them.")


@dataclass(frozen=True, kw_only=True)
@exposes(RadianceSettings)
class RadianceOptions(PhotoOptions):
    """How a radiance field is trained."""

    if TYPE_CHECKING:
        # Options that are settings, too.
        def __init__(self, **options: Any) -> None: ...
        def __getattr__(self, name: str) -> Any: ...

    size: str = option("small", "Size of the field: small, medium or paper.")
    deferred: bool = option(False, "Ask the colour network once a ray, not at every sample: faster frames.")
    downscale: float | None = option(
        None, "In place of a width: divide the pictures' size by this.", within=Range(1, 1000)
    )
    aabb: tuple[float, ...] | None = option(
        None,
        "Bounds of what is seen: x0,y0,z0,x1,y1,z1, in the coordinates of the field.",
        parse=parse_numbers,
        within=COORDINATES,
    )
    unbounded: bool | None = option(
        None,
        "Whether anything is to be seen beyond those bounds. Default: as the points tell, and no without any.",
        "--unbounded/--bounded",
    )
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
    half: bool = option(False, "Store the weights in fp16.")
    resume: bool = option(False, "Go on with the interrupted run of this output.")
    save_every: float = option(
        60.0, "Seconds between two states for --resume; 0: only one, when it ends early.", within=SECONDS
    )
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")


@dataclass(frozen=True, kw_only=True)
class RadianceScoreOptions(PhotoOptions):
    """On which views a radiance field is scored, and how they are rendered. The photos are read as in its training."""

    train: bool = option(False, "Score the training views instead.")
    spp: int = option(16, "Rays a pixel. The scatter of few is part of the score.", within=SPP)
    pictures: Path | None = option(None, "Folder for the pictures, each beside its photo.", "-o", "--output")
    json_file: Path | None = option(None, "Write the scores to this file.", "--json")
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
