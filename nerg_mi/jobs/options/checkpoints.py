"""Options of the import of checkpoints of other programs, and of their refinement."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.ranges import Checked, Range

from . import option


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Checked):
    """What a checkpoint does not say of itself, and how its fields are stored."""

    ema: bool | None = option(
        None, "Moving averages of the weights, or the weights.  [default: averages, if there are any]", "--ema/--no-ema"
    )
    color_space: str = option("srgb", "What --color_space was in training: srgb or linear.")
    bg_radius: float | None = option(
        None,
        "What --bg_radius was in training, where there is a background network; 0: leave it out.",
        within=Range(0, 10**6),
    )
    finest: int | None = option(
        None, "Finest resolution of the hash grid.  [default: 2048 x bound]", within=Range(2, 1 << 24)
    )
    half: bool = option(False, "Store the weights in fp16.")
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")


@dataclass(frozen=True, kw_only=True)
class RefineOptions(Checked):
    """On what a bound is refined."""

    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
