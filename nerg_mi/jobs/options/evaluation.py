"""Options of the evaluation of a gaze field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import DIRECTIONS, KAPPAS, SEEDS, THREADS, Checked, Range

from . import option


@dataclass(frozen=True, kw_only=True)
class GazeEvaluationOptions(Checked):
    """What a gaze field is scored on. The place is the one that it was trained in."""

    field: Path | None = option(None, "Radiance field, or splats, it was trained in. Default: its name, beside it.")
    scene: Path | None = option(None, "Or: the Mitsuba scene.")
    geometry: Path | None = option(None, "Or: the place of hit points (.vol).")
    split: str | None = option(
        None, "both: new positions and people; pos: new positions; people: new people. Default: both, or pos."
    )
    kappa: float = option(20.0, "Concentration of the kernel of truth and baselines.", within=KAPPAS)
    blind_kappa: float = option(50.0, "That of the blind density which bits are counted from.", within=KAPPAS)
    directions: int = option(2048, "Directions that maps are compared in.", within=DIRECTIONS)
    min_rays: int = option(64, "Rays at a test position at least.", within=Range(1, 10**6))
    resamples: int = option(200, "Of the people, for the intervals.", within=Range(0, 10**5))
    pictures: int = option(4, "Test positions to draw.", within=Range(0, 10000))
    seed: int = option(0, "Seed of rays, resamples and halves.", within=SEEDS)
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
