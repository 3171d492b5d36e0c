"""Options of the training of a gaze field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import (
    DIRECTIONS,
    KAPPAS,
    LEARNING_RATES,
    LENGTHS,
    LOSS_WEIGHTS,
    MINUTES,
    RAYS,
    SECONDS,
    SEEDS,
    STEPS,
    TEST_SHARES,
    THREADS,
    WEIGHT_DECAYS,
    Range,
)

from . import option
from .place import PlaceOptions


@dataclass(frozen=True, kw_only=True)
class GazeOptions(PlaceOptions):
    """How a gaze field is trained; what is None is the recipe's. Lengths are metres, in the rays' frame."""

    views: Path | None = option(None, "Posed photos (folder or transforms file) with salience.")
    salience: str | None = option(
        None, "Folder of them, called as the photos are (.png, .exr, .npy), or spectral-residual."
    )
    salience_per: str = option("pixel", "What they count gaze per: pixel or steradian.")
    align_views: Path | None = option(None, "JSON file with the 4x4 similarity from the photos' frame to the place's.")
    allow_outside: bool = option(
        False, "Read files outside of --views' folder and that of --salience too, where they name them."
    )
    recipe: str = option(
        "default", "Word of docs/gaze-training.md; default generalises best. Sets what is not set below."
    )
    voxel: float | None = option(
        None,
        "Edge of the voxels of --geometry hits in metres.  [default: 0.08, more in very large places]",
        within=LENGTHS,
    )
    align: Path | None = option(
        None, "How the rays lie in the place: what nerg align writes, or JSON with the 4x4 similarity. Default: alike."
    )
    force: bool = option(False, "Train even where no gaze meets a surface of the place.")
    radius: float | None = option(None, "Radius R of a probe in metres.", within=LENGTHS)
    most: int = option(
        10_000_000, "Rays of a dataset at most; of more, a sample by --seed in which each is as likely.", within=RAYS
    )
    probes: int | None = option(None, "Number of probes at most.", within=Range(1, 10**6))
    placement: str | None = option(None, "Of probes: data, grid, random or blue.")
    cap: int | None = option(None, "Rays in a probe at most, the nearest.", within=Range(1, 10**6))
    min_rays: int | None = option(None, "Rays in a probe at least.", within=Range(1, 10**6))
    kappa_rule: str | None = option(None, "Concentration of a ray's kernel: fixed, silverman or loo.")
    kappa: float | None = option(None, "That of the rule fixed.", within=KAPPAS)
    weights: str | None = option(
        None, "Of a probe's rays: equal, distance (1 - d/R), or person (all people of a probe count alike)."
    )
    directions: int | None = option(None, "Directions of a probe.", within=DIRECTIONS)
    fresh: bool = option(False, "Draw the directions anew for every epoch, not once a probe.", "--fresh-directions")
    variant: str | None = option(
        None, "emit, capture or emit_capture. Default: emit_capture; without any geometry folds choose it or capture."
    )
    activation: str | None = option(None, "Of the emit head of small and paper: softplus, exp or linear.")
    size: str | None = option(None, "Of the field of small and paper: small or paper.")
    normalized: bool = option(False, "Divide the field of small and paper by its integral over the sphere.")
    semantic: str = option(
        "", "Give emit the features of --field: accumulated along the ray, or snapshot at the surface."
    )
    semantic_own: bool = option(False, "Besides the gaze field's own, not in their place.")
    begin: str = option("random", "Weights of the trunk to begin with: random, or those of the radiance field (field).")
    freeze: bool = option(False, "Do not train the weights that --begin field gives.")
    loss: str | None = option(None, "Of small and paper. paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")
    integral: float | None = option(None, "Weight of the error of the integral over the sphere.", within=LOSS_WEIGHTS)
    minutes: float | None = option(None, "Train for this long, both fits together.", within=MINUTES)
    steps: int | None = option(None, "Or: train for so many steps. Default: the recipe's.", within=STEPS)
    learning_rate: float | None = option(None, "Learning rate at the start.", within=LEARNING_RATES)
    weight_decay: float | None = option(None, "Decoupled weight decay.", within=WEIGHT_DECAYS)
    zones: int | None = option(
        None,
        "Zones of positions watched as validation, whose best weights count; 0: none. Default: the recipe's.",
        within=Range(0, 1000),
    )
    mix_folds: int | None = option(
        None,
        "Folds of people and positions that choose how much of the blind density default mixes in; 0: a twentieth. "
        "Default: the recipe's.",
        within=Range(0, 1000),
    )
    mix_kappa: float | None = option(
        None,
        "Concentration of the kernels of that blind density, which default also begins with. Default: the recipe's.",
        within=KAPPAS,
    )
    refit: bool = option(True, "Train again on all rays once the best number of steps is known.")
    test_zones: int = option(
        0, "Zones of test positions that are left out of everything; 0: none.", within=Range(0, 1000)
    )
    test_positions: int = option(64, "Test positions in them.", within=Range(1, 10**5))
    test_people: float = option(0.0, "Share of the people who are left out of everything besides.", within=TEST_SHARES)
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
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
