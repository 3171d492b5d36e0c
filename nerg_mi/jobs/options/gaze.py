"""Options of the training of a gaze field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.ranges import LENGTHS, RAYS, SECONDS, SEEDS, TEST_SHARES, THREADS, Range
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

from . import exposes, option
from .place import PlaceOptions


@dataclass(frozen=True, kw_only=True)
@exposes(ProbeSettings, GazeSettings, default="Default: the recipe's.")
class GazeOptions(PlaceOptions):
    """How a gaze field is trained; what is None is the recipe's. Lengths are metres, in the rays' frame."""

    if TYPE_CHECKING:
        # Options that are settings, too.
        def __init__(self, **options: Any) -> None: ...
        def __getattr__(self, name: str) -> Any: ...

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
    most: int = option(
        10_000_000, "Rays of a dataset at most; of more, a sample by --seed in which each is as likely.", within=RAYS
    )
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
    threads: int | None = option(None, "CPU threads. Default: all.", within=THREADS, changes_result=False)
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
