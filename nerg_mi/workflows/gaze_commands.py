"""``nerg train gaze``: Train a gaze field on gaze rays and score it at held-out positions.
``nerg eval gaze``: Score a gaze field on held-out data and compare it with baselines.
``nerg eval next``: Predict the next look from the last looks and a gaze field; score it on held-out participants.
``nerg eval folds``: Cross-validate a gaze field: train and score it several times on different splits.

Options of these commands. The workflows are in `.train_gaze`, `.evaluate` and `.next_look`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.options import (
    INPUT,
    MODEL,
    OUTPUT,
    TEST,
    TRAINING,
    DerivedOptions,
    GeometryOptions,
    PartOptions,
    cpu_threads,
    expose_settings,
    llvm_variant,
    option,
    parse_numbers,
    random_seed,
    repeat_options,
)
from nerg_mi.ranges import (
    BASE_SEEDS,
    DIRECTIONS,
    KAPPAS,
    LENGTHS,
    RAYS,
    SECONDS,
    SEEDS,
    TEST_FRACTIONS,
    Range,
    ValidatedDataclass,
)
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

from .base import argument, declare, out

_BY_RECIPE = "[default: set by the recipe]"
_IN_PYTHON = (
    *("max_rays", "kappa_rule", "placement", "resample_directions", "ray_weights", "prior_kappa"),
    *("loss", "integral_weight", "learning_rate", "weight_decay", "refit"),
)
"""Settings of trainings that follow from the recipe, and that are not options of a command."""

# ---- Training ----


@dataclass(frozen=True, kw_only=True)
@expose_settings(ProbeSettings, GazeSettings, default=_BY_RECIPE)
class GazeOptions(DerivedOptions, GeometryOptions):
    """Options of ``nerg train gaze``; None is the recipe's value. Lengths are in metres, in the frame of the rays."""

    if TYPE_CHECKING:
        # The generated one would have the options below alone.
        def __init__(self, **options: Any) -> None: ...

    views: Path | None = option(
        None,
        "Posed photos (folder or transforms file) that --salience has saliency maps for. With them, the rays may "
        "be left out.",
        group=INPUT,
    )
    salience: str | None = option(
        None,
        "Folder of saliency maps, one for each photo of --views and with its name (.png, .exr, .npy); or "
        "spectral-residual to compute them.",
        group=INPUT,
    )
    salience_unit: str = option("pixel", "What the saliency maps are densities over: pixel or steradian.", group=INPUT)
    align_views: Path | None = option(
        None,
        "JSON file with the 4x4 similarity from the frame of the photos of --views to that of the scene.  "
        "[default: identity]",
        group=INPUT,
    )
    allow_outside: bool = option(
        False, "Also read files outside the folders of --views and --salience if these refer to them.", group=INPUT
    )
    recipe: str = option(
        "default",
        "Training recipe: default (log-density with a prior; generalises best), small (emit and capture networks of "
        "small size) or paper (networks and losses of the NeRG paper). Options given explicitly override it.",
        group=MODEL,
    )
    voxel_size: float | None = option(
        None,
        "Edge length of the voxels of --geometry hits in metres.  [default: 0.08, more in very large scenes]",
        within=LENGTHS,
        group=INPUT,
    )
    align: Path | None = option(
        None,
        "JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.  "
        "[default: identity]",
        group=INPUT,
    )
    force: bool = option(
        False,
        "Train even if no gaze ray hits a surface of the scene, a sign of a wrong alignment, or if the alignment is "
        "undetermined.",
        group=INPUT,
    )
    max_samples: int = option(
        10_000_000,
        "Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with --seed.",
        within=RAYS,
        group=INPUT,
    )
    variant: str | None = option(
        None,
        "Factors of the gaze field: emit, capture or emit_capture.  [default: emit_capture; without geometry, "
        "cross-validation chooses emit_capture or capture]",
        group=MODEL,
    )
    activation: str | None = option(
        None,
        f"Only for the recipes small and paper: output activation of the emit network, softplus, exp or linear.  "
        f"{_BY_RECIPE}",
        group=MODEL,
    )
    size: str | None = option(
        None, f"Only for the recipes small and paper: size of the networks, small or paper.  {_BY_RECIPE}", group=MODEL
    )
    normalize: bool = option(
        False, "Only for the recipes small and paper: divide the density by its integral over the sphere.", group=MODEL
    )
    semantic: str = option(
        "",
        "Give the emit network the features that the density network of the radiance field of --field computes: "
        "accumulated (integrated along the ray from the observer) or snapshot (at the surface). They replace the "
        "features of emit's own hash grid, unless --semantic-concat is set.  [default: no features]",
        group=MODEL,
    )
    semantic_concat: bool = option(
        False,
        "Add the features of --semantic to those of emit's own hash grid, in place of replacing these.",
        group=MODEL,
    )
    init: str = option(
        "random",
        "Initial weights of the trunk: random, or field for those of the radiance field of --field.",
        group=TRAINING,
    )
    test_zones: int = option(
        0,
        "Number of zones whose positions are held out for testing; 0 holds out none.",
        within=Range(0, 1000),
        group=TEST,
    )
    test_positions: int = option(
        64, "Maximum number of test positions, in all held-out zones together.", within=Range(1, 10**5), group=TEST
    )
    test_participants: float = option(
        0.0,
        "Fraction of the participants that are held out for testing, in addition to the positions of --test-zones.",
        within=TEST_FRACTIONS,
        group=TEST,
    )
    ensemble: int = option(
        0,
        "Number of ensemble members, each trained on a bootstrap resample of the participants and images; their "
        "mean is the gaze, their spread its uncertainty. 0 trains a single field.",
        within=Range(0, 1000),
        group=MODEL,
    )
    resume: bool = option(False, "Resume the interrupted training of this output file.", group=TRAINING)
    save_every: float = option(
        60.0,
        "Interval in seconds between two saved states for --resume; 0 saves only when training is interrupted.",
        within=SECONDS,
        group=TRAINING,
    )
    seed: int = option(
        0, "Seed of probes, directions, initial weights, batches and splits.", within=SEEDS, group=TRAINING
    )
    half: bool = option(False, "Store the weights in half precision (fp16).", group=OUTPUT)
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


declare(
    "train gaze",
    "nerg_mi.workflows.train_gaze:train_gaze",
    options=GazeOptions,
    without=(*_IN_PYTHON, "kappa"),
    rays=argument(
        "Rays file (.npz or .parquet) or dataset (.rays), as nerg rays import writes it. Not needed with --views.",
        required=False,
    ),
    output=out("Gaze field to write (.safetensors)."),
)


# ---- Evaluation ----


@dataclass(frozen=True, kw_only=True)
class GazeEvaluationOptions(ValidatedDataclass):
    """Options of ``nerg eval gaze``. The scene is the one of the training."""

    field: Path | None = option(
        None,
        "Radiance field or Gaussian splats that the gaze field was trained in.  [default: the file of the same name, "
        "next to the gaze field]",
        group=INPUT,
    )
    scene: Path | None = option(
        None, "Mitsuba scene that the gaze field was trained in, in place of --field.", group=INPUT
    )
    geometry: Path | None = option(
        None,
        "Volume of hit points (.vol) that the gaze field was trained in, in place of --field; hits or none, as in the "
        "training, select what is stored.  [default: the file of the same name, next to the gaze field]",
        group=INPUT,
    )
    split: str | None = option(
        None,
        "Held-out data to score on: both (new participants at new positions), pos (new positions) or people (new "
        "participants).  [default: both if participants were held out, else pos]",
        group=TEST,
    )
    kappa: float = option(
        20.0,
        "Concentration (unitless), or standard deviation such as 13deg, of the von Mises-Fisher kernels that turn test "
        "rays into reference densities.",
        within=KAPPAS,
        group=TEST,
    )
    prior_kappa: float | None = option(
        None,
        "Concentration (unitless), or standard deviation such as 10deg, of the kernels of the position-independent "
        "prior, against which information gain is measured in bits. Default: chosen by leaving out participants.",
        within=KAPPAS,
        group=TEST,
    )
    directions: int = option(
        2048, "Number of directions on the sphere at which densities are compared.", within=DIRECTIONS, group=TEST
    )
    min_rays: int = option(64, "Minimum number of rays around a test position.", within=Range(1, 10**6), group=TEST)
    resamples: int = option(
        200,
        "Number of bootstrap resamples of the participants for confidence intervals; 0 computes none.",
        within=Range(0, 10**5),
        group=TEST,
    )
    pictures: int = option(
        4,
        "Number of test positions in the figure that compares reference and predicted densities; 0 draws no figure.",
        within=Range(0, 10000),
        group=OUTPUT,
    )
    seed: int = random_seed("sampled rays, bootstrap resamples and split halves")
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
@expose_settings(ProbeSettings, GazeSettings, default=_BY_RECIPE, without=("seed", "freeze", "validation_zones"))
@repeat_options(GazeOptions, "recipe", "variant", "ensemble", "align", "mode")
@repeat_options(GazeEvaluationOptions, "kappa", "directions", "min_rays")
class FoldOptions(DerivedOptions, GeometryOptions, PartOptions):
    """Options of ``nerg eval folds``. Lengths are in metres."""

    folds: int = option(
        5, "Number of folds; each holds out other participants and other zones.", within=Range(2, 10_000), group=TEST
    )
    seed: int = option(
        0, "Seed of the first fold; the following folds use the next seeds.", within=BASE_SEEDS, group=TEST
    )
    splits: str = option(
        "both,pos,people",
        "Comma-separated kinds of held-out data: both (new participants at new positions), pos (new positions), people "
        "(new participants).",
        group=TEST,
    )
    test_zones: int = option(
        3, "Number of zones whose positions are held out for testing.", within=Range(1, 1000), group=TEST
    )
    test_positions: int = option(
        60, "Maximum number of test positions, in all held-out zones together.", within=Range(1, 10**5), group=TEST
    )
    test_participants: float = option(
        0.5, "Fraction of the participants that each fold holds out for testing.", within=Range(0.01, 0.99), group=TEST
    )
    max_samples: int = option(
        10_000_000,
        "Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with --seed.",
        within=RAYS,
        group=INPUT,
    )
    threads: int | None = cpu_threads("; with 1, training is reproducible to the bit")


declare(
    "eval gaze",
    "nerg_mi.workflows.evaluate:print_evaluation",
    "Score a gaze field on held-out data and compare it with baselines: uniform, position-independent, nearest "
    "rays, conditional kernel density, re-aimed hits, and the other half of the participants.",
    options=GazeEvaluationOptions,
    gaze=argument("Gaze field that was trained with --test-zones (.safetensors)."),
    rays=argument("Rays file or dataset that it was trained on."),
    output=out("Folder for tables and figures.  [default: GAZE.eval]", default=None),
)


@dataclass(frozen=True, kw_only=True)
@repeat_options(GazeEvaluationOptions, "field", "scene", "geometry", "resamples", "threads", "mode")
class NextLookOptions(DerivedOptions):
    """Options of ``nerg eval next``. The scene is the one of the training."""

    elapsed: tuple[float, ...] | None = option(
        None,
        "Comma-separated times in seconds between the last look and the next one, increasing.  [default: 0.2,1,2,5]",
        parse=parse_numbers,
        within=Range(1e-3, 1e4),
        group=TEST,
    )
    earlier: int = option(
        120,
        "Number of looks before the last one that a participant may return to, half a second apart.",
        within=Range(0, 10_000),
        group=MODEL,
    )
    head: bool = option(
        False, "Predict gaze from the direction of the head at the same time, in place of earlier looks.", group=MODEL
    )
    max_looks: int = option(
        500,
        "Maximum number of looks that determine the weights, and of looks that are scored.",
        within=Range(16, 10**6),
        group=TEST,
    )
    seed: int = random_seed("selected looks and bootstrap resamples")


declare(
    "eval next",
    "nerg_mi.workflows.next_look:print_next_look",
    "Predict where a participant looks next from the last looks, the elapsed time and a gaze field; score held-out "
    "participants at held-out positions.",
    more="The weights of the prediction are fitted to training participants at held-out positions.",
    options=NextLookOptions,
    gaze=argument("Gaze field that was trained with --test-zones and --test-participants (.safetensors)."),
    rays=argument("Rays file or dataset that it was trained on."),
    output=out("Folder for tables and weights.  [default: GAZE.next]", default=None),
)

declare(
    "eval folds",
    "nerg_mi.workflows.evaluate:print_folds",
    "Cross-validate a gaze field: train and score it several times, each time without some participants and zones, and "
    "report the means.",
    more="Each finished fold is stored; running the command again continues with the next one.",
    options=FoldOptions,
    without=(*_IN_PYTHON, "worker_wait"),
    rays=argument("Rays file (.npz or .parquet) or dataset (.rays)."),
    output=out("Folder for the table."),
)
