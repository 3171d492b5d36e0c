"""Options of the ablation of gaze fields."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.ranges import FIRST_SEEDS, KAPPAS, LENGTHS, STEPS, TEST_SHARES, THREADS, Range

from . import option
from .parts import PartOptions
from .place import PlaceOptions


@dataclass(frozen=True, kw_only=True)
class AblationOptions(PlaceOptions, PartOptions):
    """Which variants are trained, on what they are scored, and how a frame is timed. Lengths are metres."""

    recipes: str = option("default,paper", "Recipes to ablate, separated by commas.")
    variant: tuple[str, ...] = option(
        (), 'Only this one, such as emit_capture or "semantic snapshot"; may be given several times.'
    )
    seeds: int = option(3, "Seeds of the default recipe; the others have one.", within=Range(1, 1000))
    first: int = option(0, "Seed of what is held out, and of the first training.", within=FIRST_SEEDS)
    steps: int | None = option(None, "Steps of every recipe but the default one. Default: the recipe's.", within=STEPS)
    default_steps: int | None = option(None, "Steps of the default recipe. Default: its own.", within=STEPS)
    probes: int | None = option(None, "Probes of a training at most. Default: the recipe's.", within=Range(1, 10**6))
    zones: int = option(3, "Zones of test positions.", within=Range(1, 1000))
    positions: int = option(60, "Test positions.", within=Range(1, 10**5))
    people: float = option(0.0, "Share of the people who are held out besides.", within=TEST_SHARES)
    radius: float = option(0.25, "Radius of the test's probes in metres.", within=LENGTHS)
    kappa: float = option(20.0, "Concentration of the truth's kernel.", within=KAPPAS)
    min_rays: int = option(64, "Rays at a test position at least.", within=Range(1, 10**6))
    law: str | None = option(
        None,
        'Truth in closed form, where it is known: "MODULE:CLASS", whose instances have density(positions, directions) '
        "in 1/sr.",
    )
    refit: bool = option(
        True,
        "Train every recipe but the default one, which always does, again on all rays for as many steps as were best "
        "on some.",
    )
    cameras: int = option(4, "Cameras that a frame is timed over (the paper: 32); 0: none.", within=Range(0, 10000))
    size: str = option("320x180", "Of a frame (the paper: 1280x720).")
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
