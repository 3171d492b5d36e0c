"""Options of the study of error against run time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from nerg_mi.ranges import Range

from . import definitions, option
from .parts import PartOptions


@dataclass(frozen=True, kw_only=True)
class StudyOptions(PartOptions):
    """What a study renders, and how often."""

    scene_kind: str = option("auto", "What SCENE is: auto, analytic or file.")
    width: int = option(192, "Width of a picture in pixels.", within=Range(1, 16384))
    height: int = option(128, "Height of a picture in pixels.", within=Range(1, 16384))
    repeats: int = option(5, "Timed renders of each setting; their median counts.", within=Range(1, 10000))
    quick: bool = option(False, "A few settings only, each timed once.")
    only: str = option("", "Only the default, and settings whose name matches.", metavar="REGEX")
    defaults: Mapping[str, str] | None = definitions()
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
