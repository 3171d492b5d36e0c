"""``nerg poses``: Find out from where photos, or frames of a video, were taken.
``nerg train radiance``: Train a radiance field on posed pictures, and report the error on those held out.
``nerg eval radiance``: PSNR and SSIM on held-out views, and the error of depth where it is known, rendered by the
integrator.
``nerg import``: Convert checkpoints of torch-ngp and of the NeRG paper's authors.
``nerg export mesh``: A mesh by marching cubes, with vertex colours: .ply or .glb.
``nerg export points``: A cloud of surface points with normals and colours: .ply or .glb.
``nerg export splats``: Gaussian splats on the surface, with its colours: .ply, for viewers of splats and the volume
"splats".
``nerg export volume``: Density, and colour, as Mitsuba grid volumes (.vol).
``nerg export torch-ngp``: A torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes.
``nerg refine``: Find more closely where a radiance field holds matter, so that it renders faster.

What these commands take; their workflows run in `.poses`, `.train_radiance` and `.export`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import LENGTHS, SECONDS, SEEDS, SPP, POSITIVE_VALUES, ValidatedDataclass, Range
from nerg_mi.train.radiance_settings import RadianceSettings

from .base import argument, declare, extra, out
from .options import DerivedOptions, coordinates, cpu_threads, expose_settings, llvm_variant, option, repeat_options

# ---- From photos to a field ----


@dataclass(frozen=True, kw_only=True)
class PoseOptions(ValidatedDataclass):
    """How the poses of photos are found."""

    num_frames: int = option(
        80, "Of a video: frames to take, each the sharpest of an equally long stretch.", within=Range(3, 10**6)
    )
    max_image_size: int = option(
        960, "Longer side, in pixels, of the copies that features are found in.", within=Range(64, 65536)
    )
    matching: str = option(
        "auto", "Pictures to compare: exhaustive (all), sequential (in order), auto (all up to 100, else in order)."
    )
    camera_model: str = option(
        "auto",
        "What is found of a lens: radial (f, k1), opencv (fx, fy, k1, k2, p1, p2), auto (opencv from 10 photos on).",
    )
    single_camera: bool = option(
        True, "Photos of equal size (and maker, model, focal length, where told) share a camera; else each has its own."
    )
    allow_outside: bool = option(False, "Follow links that lead out of the folder of photos.")
    orient: bool = option(True, "Turn the place so that up is +z, as far as cameras and a floor tell.")
    seed: int = option(0, "Seed of what is drawn at random.", within=SEEDS)
    threads: int | None = cpu_threads()


declare(
    "poses",
    "nerg_mi.workflows.poses:find_poses",
    "Find out from where photos were taken, or frames of a video, and write them as a capture for nerg train radiance.",
    more='Needs pycolmap, and PyAV for videos: pip install "nerg-mi[poses]".',
    options=PoseOptions,
    pictures=argument("Folder of photos (JPEG, PNG), or a video.", metavar="PHOTOS|VIDEO"),
    output=out("Folder to make: a capture with poses."),
)


@dataclass(frozen=True, kw_only=True)
class PhotoOptions(ValidatedDataclass):
    """How a posed image set is read."""

    holdout: int | None = option(
        None, "Hold out every so many frames, 0 none. Default: transforms_test.json, else 8.", within=Range(0, 10**6)
    )
    width: int | None = option(
        None, "Width of the pictures in pixels. Default: as they are, or as it was trained.", within=Range(1, 65536)
    )
    scale: float = option(
        1.0, "Multiply all lengths by this: what a unit of the data set measures, in metres.", within=LENGTHS
    )
    coordinates: str = option(
        "file",
        "Of the field: file, upright (+z up), original (applied_transform undone), a dataparser_transforms.json.",
    )
    depth: bool = option(True, "Use the data set's depth, where it has any.")
    allow_outside: bool = option(False, "Read files outside of the data set's folder too, where it names them.")


@dataclass(frozen=True, kw_only=True)
@expose_settings(RadianceSettings)
class RadianceOptions(DerivedOptions, PhotoOptions):
    """How a radiance field is trained."""

    size: str = option("small", "Size of the field: small, medium or paper.")
    deferred: bool = option(False, "Ask the colour network once a ray, not at every sample: faster frames.")
    downscale: float | None = option(
        None, "In place of a width: divide the pictures' size by this.", within=Range(1, 1000)
    )
    aabb: tuple[float, ...] | None = coordinates(
        "Bounds of what is seen: x0,y0,z0,x1,y1,z1, in the coordinates of the field."
    )
    unbounded: bool | None = option(
        None,
        "Whether anything is to be seen beyond those bounds. Default: as the points tell, and no without any.",
        "--unbounded/--bounded",
    )
    threads: int | None = cpu_threads()
    half: bool = option(False, "Store the weights in fp16.")
    resume: bool = option(False, "Go on with the interrupted run of this output.")
    save_every: float = option(
        60.0, "Seconds between two states for --resume; 0: only one, when it ends early.", within=SECONDS
    )
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
class RadianceScoreOptions(PhotoOptions):
    """On which views a radiance field is scored, and how they are rendered. The photos are read as in its training."""

    train: bool = option(False, "Score the training views instead.")
    spp: int = option(16, "Rays a pixel. The scatter of few is part of the score.", within=SPP)
    pictures: Path | None = option(None, "Folder for the pictures, each beside its photo.", "-o", "--output")
    json_file: Path | None = option(None, "Write the scores to this file.", "--json")
    threads: int | None = cpu_threads()
    mode: str = llvm_variant()


declare(
    "train radiance",
    "nerg_mi.workflows.train_radiance:train_radiance",
    options=RadianceOptions,
    dataset=argument("Folder of posed photos, its transforms.json, or a COLMAP model."),
    output=out("Checkpoint to write (.safetensors)."),
)

declare(
    "eval radiance",
    "nerg_mi.workflows.train_radiance:evaluate_beside",
    more="The pictures are written into FIELD.eval where no other folder is given.",
    options=RadianceScoreOptions,
    field=argument("Checkpoint of a radiance field (.safetensors)."),
    dataset=argument("Posed image set with the views to compare with."),
)


# ---- To and from other programs ----


@dataclass(frozen=True, kw_only=True)
class CheckpointImportOptions(ValidatedDataclass):
    """What a checkpoint does not say of itself, and how its fields are stored."""

    ema: bool | None = option(
        None, "Moving averages of the weights, or the weights.  [default: averages, if there are any]", "--ema/--no-ema"
    )
    color_space: str = option("srgb", "What --color_space was in training: srgb or linear.")
    bg_radius: float | None = option(
        None,
        "What --bg_radius was in training, where there is a background network; 0: leave it out.",
        within=Range(0, 10**6),
    )
    finest_resolution: int | None = option(
        None, "Finest resolution of the hash grid.  [default: 2048 x bound]", within=Range(2, 1 << 24)
    )
    half: bool = option(False, "Store the weights in fp16.")
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
class RefineOptions(ValidatedDataclass):
    """On what a bound is refined."""

    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
class LatticeOptions(ValidatedDataclass):
    """Where a radiance field is evaluated."""

    resolution: int = option(256, "Lattice cells along the longest edge of the field's box.", within=Range(2, 2048))
    mode: str = llvm_variant()


@dataclass(frozen=True, kw_only=True)
class IsosurfaceOptions(LatticeOptions):
    """Where the surface of a field lies."""

    density: float | None = option(
        None,
        "Density, 1/unit, at which the surface lies.  [default: half of the light absorbed in a cell]",
        within=POSITIVE_VALUES,
    )
    up: str = option("z", "Up axis of the field, for .glb: z or y.")


@dataclass(frozen=True, kw_only=True)
class MeshOptions(IsosurfaceOptions):
    """What is left out of a mesh, and what is added to it."""

    fill_holes: int = option(1, "Close holes of up to twice so many cells; 0: none.", within=Range(0, 2048))
    min_component_area: float = option(0.001, "Drop pieces with less than this share of the largest one's area.", within=Range(0, 1))
    keep_unseen: bool = option(False, "Keep the backs and insides that training never looked at.")


@dataclass(frozen=True, kw_only=True)
class PointOptions(IsosurfaceOptions):
    """Which points of a surface are written."""

    max_points: int | None = option(None, "Points at most.  [default: all]", within=Range(1, 10**9))


@dataclass(frozen=True, kw_only=True)
@repeat_options(IsosurfaceOptions, "density")
class SplatOptions(DerivedOptions, LatticeOptions):
    """How many Gaussians a surface becomes, and where it lies."""


@dataclass(frozen=True, kw_only=True)
class VolumeOptions(LatticeOptions):
    """What a grid volume holds."""

    color: Path | None = option(None, "Also write the colour, to this .vol file.")


@dataclass(frozen=True, kw_only=True)
class TorchNgpOptions(ValidatedDataclass):
    """How a field is read that becomes a torch-ngp checkpoint."""

    mode: str = llvm_variant()


declare(
    "import",
    "nerg_mi.workflows.export:import_to_files",
    "Convert a checkpoint to the fields of the volumes `nerf` and `gazefield`. Nothing in the file is run.",
    options=CheckpointImportOptions,
    file=argument("Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors."),
    output=out("Radiance field to write (.safetensors).", default=None),
    gaze=extra(None, "Gaze field to write (.safetensors).", Path, "-g", "--gaze"),
)

_FIELD, _FILE = argument("Radiance field (.safetensors)."), out("File to write.")

declare("export mesh", "nerg_mi.workflows.export:export_mesh", options=MeshOptions, field=_FIELD, output=_FILE)

declare("export points", "nerg_mi.workflows.export:export_points", options=PointOptions, field=_FIELD, output=_FILE)

declare("export splats", "nerg_mi.workflows.export:export_splats", options=SplatOptions, field=_FIELD, output=_FILE)

declare("export volume", "nerg_mi.workflows.export:export_volume", options=VolumeOptions, field=_FIELD, output=_FILE)

declare(
    "export torch-ngp", "nerg_mi.workflows.export:export_torch_ngp", options=TorchNgpOptions, field=_FIELD, output=_FILE
)

declare(
    "refine",
    "nerg_mi.workflows.export:refine_checkpoint",
    "Find more closely where a trained field holds matter, so that it renders with fewer evaluations.",
    more="Fields that are trained or imported now have it. Weights stay as they are, and gaze fields know the new "
    "file.",
    options=RefineOptions,
    field=argument("Radiance field (.safetensors)."),
    output=out("Radiance field to write (.safetensors)."),
)
