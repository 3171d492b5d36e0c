"""Options of the gaze field for a place where nobody was tracked."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.ranges import RAYS, SEEDS, Checked

from . import option


@dataclass(frozen=True, kw_only=True)
class PriorOptions(Checked):
    """Which rays are read, and where the field is made."""

    most: int = option(10_000_000, "Rays of a dataset at most; of more, a sample by --seed.", within=RAYS)
    seed: int = option(0, "Seed of that sample.", "-s", "--seed", within=SEEDS)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
