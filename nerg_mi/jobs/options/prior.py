"""Options of the gaze field for a place where nobody was tracked."""

from __future__ import annotations

from dataclasses import dataclass

from . import option


@dataclass(frozen=True, kw_only=True)
class PriorOptions:
    """Which rays are read, and where the field is made."""

    most: int = option(10_000_000, "Rays of a dataset at most; of more, a sample by --seed.", min=1)
    seed: int = option(0, "Seed of that sample.", "-s", "--seed", min=0)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
