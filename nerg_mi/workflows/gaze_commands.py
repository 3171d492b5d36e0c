"""``nerg train gaze``: Train a gaze field on rays of attention, and report its scores at positions that were held out.
``nerg train prior``: Make a gaze field for a place where nobody was tracked: how high people looked in other places.
``nerg eval gaze``: Scores beside uniform, position-blind, nearest probes, nearest rays and the other half of the
people.
``nerg eval folds``: Train and score a gaze field again and again, each time without other people and zones, and tell
the means.
``nerg ablate``: Train every variant of a gaze field alike, and compare them.

What these commands take; their workflows run in `.train_gaze`, `.evaluate` and `.ablation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.ranges import (
    DIRECTIONS,
    BASE_SEEDS,
    KAPPAS,
    LENGTHS,
    RAYS,
    SECONDS,
    SEEDS,
    STEPS,
    TEST_FRACTIONS,
    ValidatedDataclass,
    Range,
)
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

from .base import argument, declare, out
from .options import DerivedOptions, PartOptions, GeometryOptions, cpu_threads, expose_settings, llvm_variant, option, repeat_options

# ---- Training ----


@dataclass(frozen=True, kw_only=True)
@expose_settings(ProbeSettings, GazeSettings, default="Default: the recipe's.")
class GazeOptions(DerivedOptions, GeometryOptions):
    """How a gaze field is trained; what is None is the recipe's. Lengths are metres, in the rays' frame."""

    if TYPE_CHECKING:
        # A dataclass's own would have the options below alone.
        def __init__(self, **options: Any) -> None: ...

    views: Path | None = option(None, "Posed photos (folder or transforms file) with salience.")
    salience: str | None = option(
        None, "Folder of them, called as the photos are (.png, .exr, .npy), or spectral-residual."
    )
    salience_unit: str = option("pixel", "What they count gaze per: pixel or steradian.")
    align_views: Path | None = option(None, "JSON file with the 4x4 similarity from the photos' frame to the place's.")
    allow_outside: bool = option(
        False, "Read files outside of --views' folder and that of --salience too, where they name them."
    )
    recipe: str = option(
        "default", "Word of docs/how-to/training.md; default generalises best. Sets what is not set below."
    )
    voxel_size: float | None = option(
        None,
        "Edge of the voxels of --geometry hits in metres.  [default: 0.08, more in very large places]",
        within=LENGTHS,
    )
    align: Path | None = option(
        None, "How the rays lie in the place: what nerg align writes, or JSON with the 4x4 similarity. Default: alike."
    )
    force: bool = option(False, "Train even where no gaze meets a surface of the place.")
    max_samples: int = option(
        10_000_000, "Rays of a dataset at most; of more, a sample by --seed in which each is as likely.", within=RAYS
    )
    variant: str | None = option(
        None, "emit, capture or emit_capture. Default: emit_capture; without any geometry folds choose it or capture."
    )
    activation: str | None = option(None, "Of the emit head of small and paper: softplus, exp or linear.")
    size: str | None = option(None, "Of the field of small and paper: small or paper.")
    normalize: bool = option(False, "Divide the field of small and paper by its integral over the sphere.")
    semantic: str = option(
        "", "Give emit the features of --field: accumulated along the ray, or snapshot at the surface."
    )
    semantic_concat: bool = option(False, "Besides the gaze field's own, not in their place.")
    init: str = option("random", "Weights of the trunk to begin with: random, or those of the radiance field (field).")
    test_zones: int = option(
        0, "Zones of test positions that are left out of everything; 0: none.", within=Range(0, 1000)
    )
    test_positions: int = option(64, "Test positions in them.", within=Range(1, 10**5))
    test_participants: float = option(0.0, "Share of the people who are left out of everything besides.", within=TEST_FRACTIONS)
    ensemble: int = option(
        0,
        "Train so many fields on resamples of the people and the images; the mean is the gaze, their spread its "
        "uncertainty. 0: one field.",
        within=Range(0, 1000),
    )
    resume: bool = option(False, "Go on with the interrupted run of this output.")
    save_every: float = option(
        60.0, "Seconds between two states for --resume; 0: only one, when it ends early.", within=SECONDS
    )
    seed: int = option(0, "Seed of probes, directions, weights, batches and splits.", within=SEEDS)
    half: bool = option(False, "Store the weights in fp16.")
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


declare(
    "train gaze",
    "nerg_mi.workflows.train_gaze:train_gaze",
    options=GazeOptions,
    rays=argument(
        "Rays file (.npz or .parquet) or dataset, as nerg rays import writes it. None: --views alone.", required=False
    ),
    output=out("Checkpoint to write (.safetensors)."),
)


@dataclass(frozen=True, kw_only=True)
class PriorOptions(ValidatedDataclass):
    """Which rays are read, and where the field is made."""

    max_samples: int = option(10_000_000, "Rays of a dataset at most; of more, a sample by --seed.", within=RAYS)
    seed: int = option(0, "Seed of that sample.", "-s", "--seed", within=SEEDS)
    mode: str = llvm_variant()


declare(
    "train prior",
    "nerg_mi.workflows.train_gaze:learn_prior",
    more="It stands in any place whose z axis points up. What it is worth: docs/explanation/accuracy.md.",
    options=PriorOptions,
    rays=argument("Rays files (.npz or .parquet) or datasets, one a place.", list[Path]),
    output=out("Checkpoint to write (.safetensors)."),
)


# ---- Evaluation ----


@dataclass(frozen=True, kw_only=True)
class GazeEvaluationOptions(ValidatedDataclass):
    """What a gaze field is scored on. The place is the one that it was trained in."""

    field: Path | None = option(None, "Radiance field, or splats, it was trained in. Default: its name, beside it.")
    scene: Path | None = option(None, "Or: the Mitsuba scene.")
    geometry: Path | None = option(None, "Or: the place of hit points (.vol).")
    split: str | None = option(
        None, "both: new positions and people; pos: new positions; people: new people. Default: both, or pos."
    )
    kappa: float = option(20.0, "Concentration of the kernel of truth and baselines.", within=KAPPAS)
    prior_kappa: float = option(50.0, "That of the blind density which bits are counted from.", within=KAPPAS)
    directions: int = option(2048, "Directions that maps are compared in.", within=DIRECTIONS)
    min_rays: int = option(64, "Rays at a test position at least.", within=Range(1, 10**6))
    resamples: int = option(200, "Of the people, for the intervals.", within=Range(0, 10**5))
    pictures: int = option(4, "Test positions to draw.", within=Range(0, 10000))
    seed: int = option(0, "Seed of rays, resamples and halves.", within=SEEDS)
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
@expose_settings(ProbeSettings, GazeSettings, default="Default: the recipe's.", without=("seed", "freeze"))
@repeat_options(GazeOptions, "recipe", "variant", "ensemble", "align", "mode")
@repeat_options(GazeEvaluationOptions, "kappa", "directions", "min_rays")
class FoldOptions(DerivedOptions, GeometryOptions, PartOptions):
    """How many folds there are, what each holds out, and how its field is trained and scored. Lengths are metres."""

    folds: int = option(5, "Folds: each holds out other people and other zones.", within=Range(2, 10_000))
    seed: int = option(0, "Seed of the first fold; the others have those that follow.", within=BASE_SEEDS)
    splits: str = option(
        "both,pos,people", "What is new, with commas between: both (people and positions), pos, people."
    )
    zones: int = option(3, "Zones of test positions.", within=Range(1, 1000))
    positions: int = option(60, "Test positions in them.", within=Range(1, 10**5))
    test_participants: float = option(0.5, "Share of the people who are held out of a fold's training.", within=Range(0.01, 0.99))
    max_samples: int = option(10_000_000, "Rays of a dataset at most; of more, a sample by --first.", within=RAYS)
    threads: int | None = cpu_threads("; 1 makes a training repeat itself to the bit")


declare(
    "eval gaze",
    "nerg_mi.workflows.evaluate:print_evaluation",
    options=GazeEvaluationOptions,
    gaze=argument("Checkpoint of a gaze field that was trained with --test-zones (.safetensors)."),
    rays=argument("The rays file or dataset that it was trained on."),
    output=out("Folder for tables and pictures. Default: GAZE.eval.", default=None),
)

declare(
    "eval folds",
    "nerg_mi.workflows.evaluate:print_folds",
    more="Each fold is kept when it is done, and the same command goes on where it ended.",
    options=FoldOptions,
    rays=argument("Rays file (.npz or .parquet) or dataset."),
    output=out("Folder for the table."),
)


@dataclass(frozen=True, kw_only=True)
@expose_settings(ProbeSettings, GazeSettings, default="Default: the recipe's.", without=("seed", "freeze", "loss", "mix_folds"))
@repeat_options(GazeOptions, "threads", "mode")
@repeat_options(GazeEvaluationOptions, "kappa", "min_rays")
@repeat_options(FoldOptions, "zones", "positions")
class AblationOptions(DerivedOptions, GeometryOptions, PartOptions):
    """Which variants are trained, on what they are scored, and how a frame is timed. Lengths are metres."""

    recipes: str = option("default,paper", "Recipes to ablate, separated by commas.")
    variant: tuple[str, ...] = option(
        (), 'Only this one, such as emit_capture or "semantic snapshot"; may be given several times.'
    )
    seeds: int = option(3, "Seeds of the default recipe; the others have one.", within=Range(1, 1000))
    seed: int = option(0, "Seed of what is held out, and of the first training.", within=BASE_SEEDS)
    steps: int | None = option(None, "Steps of every recipe but the default one. Default: the recipe's.", within=STEPS)
    default_steps: int | None = option(None, "Steps of the default recipe. Default: its own.", within=STEPS)
    test_participants: float = option(0.0, "Share of the people who are held out besides.", within=TEST_FRACTIONS)
    radius: float = option(0.25, "Radius of the test's probes in metres.", within=LENGTHS)
    ground_truth: str | None = option(
        None,
        'Truth in closed form, where it is known: "MODULE:CLASS", whose instances have density(positions, directions) '
        "in 1/sr.",
    )
    refit: bool = option(
        True,
        "Train every recipe but the default one, which always does, again on all rays for as many steps as were best "
        "on some.",
    )
    timing_cameras: int = option(4, "Cameras that a frame is timed over (the paper: 32); 0: none.", within=Range(0, 10000))
    timing_size: str = option("320x180", "Of a frame (the paper: 1280x720).")


declare(
    "ablate",
    "nerg_mi.workflows.ablation:ablate",
    "Train every variant of a gaze field alike; losses on training and held-out positions, and the time of a frame.",
    options=AblationOptions,
    rays=argument("Rays file (.npz or .parquet), as nerg rays import writes it."),
    output=out("Folder for checkpoints, table and plot."),
)
