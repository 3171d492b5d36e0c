"""Options of the evaluation of gaze fields over folds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import DIRECTIONS, FIRST_SEEDS, KAPPAS, LENGTHS, RAYS, STEPS, THREADS, Range

from . import option
from .parts import PartOptions
from .place import PlaceOptions


@dataclass(frozen=True, kw_only=True)
class FoldOptions(PlaceOptions, PartOptions):
    """How many folds there are, what each holds out, and how its field is trained and scored. Lengths are metres."""

    folds: int = option(5, "Folds: each holds out other people and other zones.", within=Range(2, 10_000))
    first: int = option(0, "Seed of the first fold; the others have those that follow.", within=FIRST_SEEDS)
    splits: str = option(
        "both,pos,people", "What is new, with commas between: both (people and positions), pos, people."
    )
    zones: int = option(3, "Zones of test positions of a fold.", within=Range(1, 1000))
    positions: int = option(60, "Test positions in them.", within=Range(1, 10**5))
    people: float = option(0.5, "Share of the people who are held out of a fold's training.", within=Range(0.01, 0.99))
    recipe: str = option("default", "Recipe of the trainings; see docs/gaze-training.md.")
    variant: str | None = option(
        None, "emit, capture or emit_capture. Default: emit_capture, and capture without any geometry."
    )
    ensemble: int = option(
        0, "Members of each fold's field, whose spread is judged as support is. 0: one field.", within=Range(0, 100)
    )
    align: Path | None = option(None, "JSON file with the 4x4 similarity from the rays' frame to the place's.")
    radius: float | None = option(None, "Radius R of a probe in metres. Default: the recipe's.", within=LENGTHS)
    probes: int | None = option(None, "Probes of a training at most. Default: the recipe's.", within=Range(1, 10**6))
    steps: int | None = option(None, "Steps of a training. Default: the recipe's.", within=STEPS)
    mix_folds: int | None = option(
        None,
        "Folds within each training that choose the share of the blind density. Default: the recipe's.",
        within=Range(0, 1000),
    )
    mix_kappa: float | None = option(
        None, "Concentration of the kernels of that blind density. Default: the recipe's.", within=KAPPAS
    )
    most: int = option(10_000_000, "Rays of a dataset at most; of more, a sample by --first.", within=RAYS)
    kappa: float = option(20.0, "Concentration of the kernel of truth and baselines.", within=KAPPAS)
    directions: int = option(2048, "Directions that maps are compared in.", within=DIRECTIONS)
    min_rays: int = option(64, "Rays at a test position at least.", within=Range(1, 10**6))
    threads: int | None = option(
        None,
        "CPU threads. Default: all; 1 makes a training repeat itself to the bit.",
        within=THREADS,
        changes_result=False,
    )
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
