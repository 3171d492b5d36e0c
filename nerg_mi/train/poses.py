"""Estimation of camera poses of photos or a video, for training a radiance field."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.maps import camera_figure
from nerg_mi.figures.style import changed_arguments, make_provenance, save
from nerg_mi.files.atomic import check_new_folder, create_folder_atomically, make_folder
from nerg_mi.files.html import Summary
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.photos.colmap import read_colmap
from nerg_mi.photos.posed import UnusedFrame, describe_unused, format_names
from nerg_mi.photos.structure import (
    PhotoCopy,
    PhotoFolders,
    Reconstruction,
    StructureSettings,
    check_installed,
    copy_photos,
    list_photos,
    reconstruct,
)
from nerg_mi.photos.video_frames import copy_frames
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import SEEDS, THREADS, Range, check_ranges

STAGES = {"pictures": 0.0, "features": 0.08, "matching": 0.25, "mapping": 0.65, "writing": 0.98}
"""Stages and the progress at which each begins."""

MIN_PHOTOS = 3
"""Minimum number of images; useful results need dozens."""

_ADVICE = (
    "take more images, each overlapping its neighbours by more than half, sharp, from positions some steps apart "
    "(not by rotating on the spot), of a static scene without glossy or uniform surfaces"
)


@dataclass(frozen=True, repr=False)
class PosesResult(Summary):
    """Result of a pose estimation.

    Attributes
    ----------
    output
        Written folder.
    registered, unregistered
        Names of the images with and without a pose.
    skipped
        Files that were not used, each with its reason.
    error
        Mean reprojection error in pixels, at the resolution of feature extraction.
    points
        Number of triangulated points.
    report
        Content of poses.json.
    """

    output: Path
    registered: list[str]
    unregistered: list[str]
    skipped: list[UnusedFrame]
    error: float
    points: int
    report: dict


@check_ranges
def find_poses(
    pictures: FilePath,
    output: FilePath,
    *,
    num_frames: Annotated[int, Range(3, 10**6)] = 80,
    max_image_size: Annotated[int, Range(64, 65536)] = 960,
    matching: Literal["auto", "exhaustive", "sequential"] = "auto",
    camera_model: Literal["auto", "radial", "opencv"] = "auto",
    single_camera: bool = True,
    allow_outside: bool = False,
    orient: bool = True,
    seed: Annotated[int, SEEDS] = 0,
    threads: Annotated[int, THREADS] | None = None,
    progress: Progress = None,
) -> PosesResult:
    """Estimate the camera poses of photos or video frames, and write them as a folder for nerg train radiance.

    Needs pycolmap, and PyAV for videos: pip install "nerg-mi[poses]". The folder contains images/, a COLMAP model in
    sparse/0/, poses.png (cameras and points from above and from the side) and poses.json. Lengths are in arbitrary
    units.

    Parameters
    ----------
    pictures : path
        Folder of photos (JPEG, PNG), or a video.
    output : path
        Folder to create: photos with their poses.
    num_frames : int
        Number of frames taken from a video; each is the sharpest of an equally long interval.
    max_image_size : int
        Length in pixels of the longer side to which images are reduced for feature extraction.
    matching : str
        Which image pairs are matched: exhaustive (all pairs), sequential (neighbours), or auto (exhaustive up to 100
        images, else sequential).
    camera_model : str
        Lens parameters that are estimated: radial (f, k1), opencv (fx, fy, k1, k2, p1, p2), or auto (opencv from 10
        photos on, else radial).
    single_camera : bool
        Share one camera among photos of equal size, and of equal maker, model and focal length if these are stored;
        else each photo has its own.
    allow_outside : bool
        Follow links that lead outside the folder of photos.
    orient : bool
        Rotate the scene so that up is +z, estimated from the cameras and a floor plane.
    seed : int
        Seed of the random numbers for feature matching and reconstruction.
    threads : int, optional
        Number of CPU threads. Default: all cores.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    PosesResult
        The written folder (``output``), the photos with and without a pose, and the error in pixels.

    Raises
    ------
    NergError
        The photos do not show one scene, or an argument is invalid.
    ImportError
        pycolmap, or for a video PyAV, is not installed.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> try:
    ...     nerg.find_poses(folder / "nowhere", folder / "posed")
    ... except nerg.NergError as error:
    ...     print("nowhere" in str(error))
    True
    """
    changed = changed_arguments(find_poses, locals())
    pictures, output = to_path(pictures), to_path(output)
    settings = StructureSettings(camera_model, matching, single_camera, orient, seed, threads)
    check_new_folder(output)
    check_installed()
    with open_reporter(progress) as reporter:
        with (
            create_folder_atomically(output) as folder,
            tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as work,
        ):
            folders = PhotoFolders(make_folder(folder / "images"), make_folder(Path(work, "small")))
            copied = lambda done, total: _progress(reporter, "pictures", done, total)
            skipped: list[UnusedFrame] = []
            if pictures.is_dir():
                photos, ignored = list_photos(pictures)
                copies, unused = copy_photos(photos, folders, max_image_size, copied, allow_outside)
                skipped = [*ignored, *unused]
            else:
                copies = copy_frames(pictures, num_frames, folders, max_image_size, threads, copied)
            if len(copies) < MIN_PHOTOS:
                why = f"; {skipped[0]}" if skipped else ""
                raise NergError(
                    f'"{pictures}" has {len(copies)} usable images, and pose estimation needs at least {MIN_PHOTOS} of '
                    f"the same scene{why}"
                )
            for line in describe_unused(skipped):
                reporter.message(line)
            sizes = sorted({p.size for p in copies})
            shown = ", ".join(f"{w} x {h}" for w, h in sizes[:4]) + (", ..." if len(sizes) > 4 else "")
            reporter.message(f"{len(copies)} images of {shown} pixels")
            structure = reconstruct(copies, Path(work), settings, lambda *now: _progress(reporter, *now))
            if structure is None:
                raise NergError(
                    f'no {MIN_PHOTOS} of the {len(copies)} images in "{pictures}" show the same scene; {_ADVICE}'
                )
            _progress(reporter, "writing", 0, 1)
            registered = set(structure.models[0])
            unregistered = [p.name for p in copies if p.name not in registered]
            for name in unregistered:
                (folders.images / name).unlink()
            Path(work, "sparse").rename(folder / "sparse")
            # COLMAP does not report a full disk; truncated files are detected here.
            read_colmap(folder / "sparse" / "0", folders.images)
            report = _make_report(copies, unregistered, skipped, structure, max_image_size, seed)
            write_json(folder / "poses.json", report)
            title = f"{len(registered)} of {len(copies)} images, {structure.num_points:,} points"
            figure = camera_figure(structure.to_world, structure.point_positions, structure.point_colors, title)
            inputs = (folders.images / name for name in sorted(registered))
            save(figure, folder / "poses.png", make_provenance("nerg poses", inputs, None, changed))
        result = PosesResult(
            output, structure.models[0], unregistered, skipped, structure.error, structure.num_points, report
        )
        _report_result(result, structure, reporter)
    return result


def _progress(reporter: Reporter, stage: str, done: int, total: int) -> None:
    names = list(STAGES)
    after = [*STAGES.values(), 1.0][names.index(stage) + 1]
    share = STAGES[stage] + (after - STAGES[stage]) * done / max(total, 1)
    text = {
        "pictures": f"copying images, {done} of {total}",
        "features": f"extracting features, {done} of {total} images",
        "matching": f"matching images, {done} of {total} pairs",
        "mapping": f"registering images, {done} of {total}",
        "writing": "writing",
    }
    reporter.progress(min(share, 1.0), text[stage])


def _make_report(
    copies: list[PhotoCopy],
    unregistered: list[str],
    skipped: list[UnusedFrame],
    reconstruction: Reconstruction,
    size: int,
    seed: int,
) -> dict[str, Any]:
    up = reconstruction.up
    return {
        "registered": reconstruction.models[0],
        "unregistered": unregistered,
        "skipped": {u.name: u.reason for u in skipped},
        "other_parts": reconstruction.models[1:],
        "reprojection_error_pixels": reconstruction.error,
        "reprojection_error_at": size,
        "points": reconstruction.num_points,
        "cameras": reconstruction.lenses,
        "up": None
        if up is None
        else {
            "roll_degrees": up.median_roll,
            "plane_share": up.plane_fraction,
            "plane_degrees_from_cameras": up.plane_angle,
        },
        "seconds": {p.name: p.seconds for p in copies if p.seconds is not None},
        "seed": seed,
    }


def _report_result(result: PosesResult, reconstruction: Reconstruction, reporter: Reporter) -> None:
    count = len(result.registered) + len(result.unregistered)
    reporter.message(
        f"{len(result.registered)} of {count} images have a pose, {result.points:,} points; mean reprojection "
        f"error {result.error:.2f} pixels at a longer side of at most {result.report['reprojection_error_at']} pixels"
    )
    if result.unregistered:
        reporter.message(f"without a pose: {format_names(result.unregistered)}")
    if reconstruction.up is None:
        reporter.message("the up direction was not estimated")
    else:
        reporter.message(f"rotated so that up is +z: {reconstruction.up}")
        if not reconstruction.up.is_reliable:
            reporter.warn(
                f"the cameras disagree on the up direction; check poses.png, or use {parameter('orient', False)}"
            )
    spread = float(np.max(np.ptp(reconstruction.to_world[:, :3, 3], axis=0)))
    reporter.message(
        f"lengths are in arbitrary units (the cameras span {spread:.3g}); set the scale with {parameter('scale')} "
        "of nerg train radiance"
    )
    other_models = [part for part in reconstruction.models[1:] if set(part) - set(result.registered)]
    if other_models:
        reporter.warn(
            f"the images form several unconnected models; the largest was kept, another has {len(other_models[0])} "
            f"images ({format_names(other_models[0])}); take images that connect them"
        )
    if 2 * len(result.registered) < count:
        reporter.warn(f"less than half of the images have a pose; {_ADVICE}")
    reporter.message(
        f"wrote {result.output} (see poses.png); next: nerg train radiance {result.output} -o FIELD.safetensors"
    )
