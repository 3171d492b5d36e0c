"""``nerg train radiance``: Train a radiance field on posed photos and report the error on held-out views.
``nerg eval radiance``: Score a radiance field on held-out views: PSNR, SSIM and, where it is known, depth error.
``nerg export scene``: Write a scene with its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda).

Options of these commands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.options import (
    DETAILS_OF_EVENTS,
    INPUT,
    MODEL,
    OUTPUT,
    PERFORMANCE,
    TEST,
    TRAINING,
    DerivedOptions,
    EventOptions,
    coordinates,
    cpu_threads,
    definitions,
    expose_settings,
    llvm_variant,
    option,
    random_seed,
)
from nerg_mi.ranges import LENGTHS, POSITIVE_VALUES, SECONDS, SPP, Range, ValidatedDataclass
from nerg_mi.train.radiance_settings import RadianceSettings

from .base import argument, declare, out

# ---- From photos to a field ----


@dataclass(frozen=True, kw_only=True)
class PhotoOptions(ValidatedDataclass):
    """How posed photos are read."""

    holdout: int | None = option(
        None,
        "Hold out every N-th photo for testing; 0 holds out none.  [default: those of transforms_test.json, else 8]",
        within=Range(0, 10**6),
        group=TEST,
    )
    width: int | None = option(
        None,
        "Width in pixels to which photos are resized.  [default: the width of the photos]",
        within=Range(1, 65536),
        group=INPUT,
    )
    scale: float = option(
        1.0,
        "Length of one unit of the data set in metres; all lengths are multiplied by it. For nerg eval, give that of "
        "the training, which is not stored.",
        within=LENGTHS,
        group=INPUT,
    )
    coordinates: str = option(
        "file",
        "Coordinate frame of the field: file (as in the data set), upright (+z up), original (without "
        "applied_transform), or the path of a dataparser_transforms.json.",
        group=INPUT,
    )
    depth: bool = option(True, "Use the depth images of the data set, if there are any.", group=INPUT)
    allow_outside: bool = option(
        False, "Also read files outside the folder of the data set if it refers to them.", group=INPUT
    )


@dataclass(frozen=True, kw_only=True)
@expose_settings(RadianceSettings)
class RadianceOptions(DerivedOptions, PhotoOptions):
    """Options of ``nerg train radiance``."""

    size: str = option("small", "Size of the field: small, medium or paper.", group=MODEL)
    deferred: bool = option(
        False,
        "Deferred shading: evaluate the colour network once per ray and not at each sample, for faster rendering.",
        group=MODEL,
    )
    downscale: float | None = option(
        None, "Factor by which photos are reduced, in place of --width.", within=Range(1, 1000), group=INPUT
    )
    aabb: tuple[float, ...] | None = coordinates(
        "Axis-aligned bounding box of the scene, x0,y0,z0,x1,y1,z1, in the frame of the field.  [default: derived from "
        "the points and cameras]",
        group=MODEL,
    )
    unbounded: bool | None = option(
        None,
        "Whether there is anything to see beyond the bounding box.  [default: derived from the points; bounded without "
        "any]",
        "--unbounded/--bounded",
        group=MODEL,
    )
    threads: int | None = cpu_threads()
    half: bool = option(False, "Store the weights in half precision (fp16).", group=OUTPUT)
    resume: bool = option(False, "Resume the interrupted training of this output file.", group=TRAINING)
    save_every: float = option(
        60.0,
        "Interval in seconds between two saved states for --resume; 0 saves only when training is interrupted.",
        within=SECONDS,
        group=TRAINING,
    )
    view: bool = option(
        False,
        "Show the field in the browser while it trains, for up to a tenth of the time. The page is served to this "
        'machine only. Needs viser: pip install "nerg-mi[viewer]".',
        changes_result=False,
        group=OUTPUT,
    )
    port: int = option(
        8080,
        "Port to serve the page of --view at; 0: any free port.",
        within=Range(0, 65535),
        changes_result=False,
        group=OUTPUT,
    )
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
class RadianceScoreOptions(PhotoOptions):
    """Options of ``nerg eval radiance``. Photos are read as in the training."""

    width: int | None = option(
        None,
        "Width in pixels to which photos are resized.  [default: the width in the training of the field]",
        within=Range(1, 65536),
        group=INPUT,
    )
    train: bool = option(False, "Score the training views in place of the held-out views.", group=TEST)
    views: int | None = option(
        None,
        "Score this number of views, evenly spaced in the order of their names.  [default: all]",
        within=Range(1, 10**6),
        group=TEST,
    )
    spp: int = option(
        16, "Samples per pixel. The noise of few samples lowers the scores.", within=SPP, group=PERFORMANCE
    )
    pictures: Path | None = option(
        None,
        "Folder for the rendered images, each next to its photo.  [default: FIELD.eval]",
        "-o",
        "--output",
        group=OUTPUT,
    )
    json_file: Path | None = option(None, "JSON file to write the scores to.", "--json", group=OUTPUT)
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


declare(
    "train radiance",
    "nerg_mi.workflows.train_radiance:train_radiance",
    options=RadianceOptions,
    without=("depth_weight", "point_weight", "clear_fraction", "surrounding_fraction", "distortion_weight"),
    dataset=argument("Posed photos: their folder, its transforms.json, or a COLMAP model."),
    output=out("Radiance field to write (.safetensors)."),
)

declare(
    "eval radiance",
    "nerg_mi.workflows.train_radiance:evaluate_beside",
    options=RadianceScoreOptions,
    field=argument("Radiance field (.safetensors)."),
    dataset=argument("Posed photos to compare with: their folder, its transforms.json, or a COLMAP model."),
)


# ---- Conversion to other programs ----


@dataclass(frozen=True, kw_only=True)
class SceneExportOptions(EventOptions):
    """Options of ``nerg export scene``."""

    up: str = option("z", "Vertical axis of the scene, z or y.", group=INPUT)
    meters_per_unit: float = option(1.0, "Length of a unit in metres.", within=LENGTHS, group=INPUT)
    defaults: Mapping[str, str] | None = definitions()
    max_rays: int = option(
        20_000, "Maximum number of rays to write, evenly selected.", within=Range(1, 10**7), group=OUTPUT
    )
    dispersion_threshold: float | None = option(
        None,
        "Dispersion in degrees, to detect fixations by it (I-DT).  [default: fixations as in nerg rays events]",
        within=Range(1e-3, 90),
        group=INPUT,
    )
    max_points: int = option(
        100_000, "Maximum number of points of a field or of gaze.", within=Range(1, 10**7), group=OUTPUT
    )
    width: int = option(
        512,
        "Columns of the panorama in which the gaze of the observer is computed.",
        within=Range(16, 4096),
        group=OUTPUT,
    )
    vmax: float | None = option(
        None,
        "Upper end of the colours of gaze in 1/sr.  [default: the 99.5th percentile]",
        within=POSITIVE_VALUES,
        group=OUTPUT,
    )
    spp: int = option(4, "Samples per pixel of the panorama.", within=Range(1, 4096), group=PERFORMANCE)
    seed: int = random_seed("the selection of points")
    mode: str = llvm_variant()


declare(
    "export scene",
    "nerg_mi.workflows.export_scene:export_scene",
    "Write a scene with its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda).",
    options=SceneExportOptions,
    without=DETAILS_OF_EVENTS,
    files=argument(
        "A scene (.xml), meshes (with attention if nerg bake has written them), splats, a radiance field and rays, in "
        "any order and in the same frame.",
        list[Path],
        metavar="FILES",
    ),
    output=out("File to write (.rrd, .usdc, .usda or .usd)."),
)
