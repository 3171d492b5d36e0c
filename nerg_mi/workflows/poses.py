"""Photos without poses, or a video, made a capture that can be trained on."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.maps import camera_figure
from nerg_mi.figures.style import make_provenance, save
from nerg_mi.files.atomic import check_new_folder, make_folder, create_folder_atomically
from nerg_mi.files.tables import write_json
from nerg_mi.photos.colmap import read_colmap
from nerg_mi.photos.posed import UnusedFrame, format_names
from nerg_mi.photos.structure import (
    PhotoFolders,
    PhotoCopy,
    Reconstruction,
    StructureSettings,
    check_installed,
    copy_photos,
    list_photos,
    reconstruct,
)
from nerg_mi.photos.video_frames import copy_frames

from .base import SILENT, Reporter
from .radiance_commands import PoseOptions

# ---- Photos without poses, or a video, made a capture that can be trained on ----


STAGES = {"pictures": 0.0, "features": 0.08, "matching": 0.25, "mapping": 0.65, "writing": 0.98}
"""Stages -> the share of the work that is done when each begins."""

MIN_PHOTOS = 3
"""So many pictures are needed; a useful capture has dozens."""

_ADVICE = (
    "take more of them, each sharing more than half of what it shows with its neighbours, sharp, from places some "
    "steps apart (not by turning on the spot), of things that do not move, shine or look all alike"
)


@dataclass(frozen=True)
class PosesResult:
    """``output``: the capture; ``registered``, ``unregistered``: names of the pictures with a pose, and without;
    ``skipped``: files that were not used, each with its reason; ``error``: mean reprojection error in pixels, at the
    size at which features were found; ``points``: how many were found on surfaces; ``report``: what poses.json
    holds."""

    output: Path
    registered: list[str]
    unregistered: list[str]
    skipped: list[UnusedFrame]
    error: float
    points: int
    report: dict


def find_poses(
    pictures: str | Path, output: str | Path, options: PoseOptions | None = None, reporter: Reporter = SILENT
) -> PosesResult:
    """Find the poses of ``pictures``, a folder of photos or a video, and make the capture ``output``: a folder with
    images/, a COLMAP model in sparse/0/, poses.png (cameras and points from above and from the side) and poses.json.

    Lengths are in units of the capture's own. The folder is finished or absent. Raises `NergError` for what the user
    can mend, and ``ImportError`` where pycolmap, or for a video PyAV, is not installed.
    """
    options = options or PoseOptions()
    pictures, output = Path(pictures), Path(output)
    settings = StructureSettings(
        options.camera_model, options.matching, options.single_camera, options.orient, options.seed, options.threads
    )
    check_new_folder(output)
    check_installed()
    with create_folder_atomically(output) as folder, tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as work:
        folders = PhotoFolders(make_folder(folder / "images"), make_folder(Path(work, "small")))
        copies, skipped = _copy(pictures, folders, options, reporter)
        _tell_pictures(copies, skipped, reporter)
        found = reconstruct(copies, Path(work), settings, lambda *now: _progress(reporter, *now))
        if found is None:
            raise NergError(f'no {MIN_PHOTOS} of the {len(copies)} pictures of "{pictures}" show the same place; {_ADVICE}')
        _progress(reporter, "writing", 0, 1)
        registered = set(found.models[0])
        unregistered = [p.name for p in copies if p.name not in registered]
        for name in unregistered:
            (folders.images / name).unlink()
        Path(work, "sparse").rename(folder / "sparse")
        # A disk that fills is not told of by COLMAP, whose files would then end too early.
        read_colmap(folder / "sparse" / "0", folders.images)
        report = _report(copies, unregistered, skipped, found, options)
        write_json(folder / "poses.json", report)
        title = f"{len(registered)} of {len(copies)} pictures, {found.num_points:,} points"
        about = make_provenance("nerg poses", (folders.images / name for name in sorted(registered)), None, options)
        save(camera_figure(found.to_world, found.point_positions, found.point_colors, title), folder / "poses.png", about)
    result = PosesResult(output, found.models[0], unregistered, skipped, found.error, found.num_points, report)
    _tell_result(result, found, options, reporter)
    return result


def _copy(
    pictures: Path, folders: PhotoFolders, options: PoseOptions, reporter: Reporter
) -> tuple[list[PhotoCopy], list[UnusedFrame]]:
    progress = lambda done, of: _progress(reporter, "pictures", done, of)
    skipped: list[UnusedFrame] = []
    if pictures.is_dir():
        photos, others = list_photos(pictures)
        copies, unused = copy_photos(photos, folders, options.max_image_size, progress, options.allow_outside)
        skipped = [*others, *unused]
    else:
        copies = copy_frames(pictures, options.num_frames, folders, options.max_image_size, options.threads, progress)
    if len(copies) < MIN_PHOTOS:
        why = f"; of the others, {skipped[0]}" if skipped else ""
        raise NergError(
            f'"{pictures}" has {len(copies)} pictures that can be used, and poses need {MIN_PHOTOS} or more of the same '
            f"place{why}"
        )
    return copies, skipped


def _progress(reporter: Reporter, stage: str, done: int, of: int) -> None:
    names = list(STAGES)
    after = [*STAGES.values(), 1.0][names.index(stage) + 1]
    share = STAGES[stage] + (after - STAGES[stage]) * done / max(of, 1)
    text = {
        "pictures": f"copying pictures, {done} of {of}",
        "features": f"finding features, {done} of {of} pictures",
        "matching": f"comparing pictures, {done} of {of} pairs",
        "mapping": f"placing pictures, {done} of {of}",
        "writing": "writing",
    }
    reporter.progress(min(share, 1.0), text[stage])


def _tell_pictures(copies: list[PhotoCopy], skipped: list[UnusedFrame], reporter: Reporter) -> None:
    for line in skipped:
        reporter.message(str(line))
    sizes = sorted({p.size for p in copies})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:4]) + (", ..." if len(sizes) > 4 else "")
    reporter.message(f"{len(copies)} pictures of {shown} pixels")


def _report(
    copies: list[PhotoCopy], unregistered: list[str], skipped: list[UnusedFrame], found: Reconstruction, options: PoseOptions
) -> dict:
    up = found.up
    return {
        "registered": found.models[0],
        "unregistered": unregistered,
        "skipped": {u.name: u.reason for u in skipped},
        "other_parts": found.models[1:],
        "reprojection_error_pixels": found.error,
        "reprojection_error_at": options.max_image_size,
        "points": found.num_points,
        "cameras": found.lenses,
        "up": None
        if up is None
        else {"roll_degrees": up.median_roll, "plane_share": up.plane_fraction, "plane_degrees_from_cameras": up.plane_angle},
        "seconds": {p.name: p.seconds for p in copies if p.seconds is not None},
        "seed": options.seed,
    }


def _tell_result(result: PosesResult, found: Reconstruction, options: PoseOptions, reporter: Reporter) -> None:
    count = len(result.registered) + len(result.unregistered)
    reporter.message(
        f"{len(result.registered)} of {count} pictures have a pose, {result.points:,} points; mean reprojection error "
        f"{result.error:.2f} pixels, at a longer side of {options.max_image_size} at most"
    )
    if result.unregistered:
        reporter.message(f"without a pose: {format_names(result.unregistered)}")
    if found.up is None:
        reporter.message("up was not looked for")
    else:
        reporter.message(f"turned so that up is +z: {found.up}")
        if not found.up.is_reliable:
            reporter.warn("the cameras do not agree on what is up; look at poses.png, or leave it with --no-orient")
    spread = float(np.max(np.ptp(found.to_world[:, :3, 3], axis=0)))
    reporter.message(
        f"lengths have no unit (the cameras spread over {spread:.3g}); nerg train radiance gives them one by --scale"
    )
    others = [part for part in found.models[1:] if set(part) - set(result.registered)]
    if others:
        reporter.warn(
            f"the pictures fall into parts that nothing connects; the largest was kept, another has {len(others[0])} "
            f"({format_names(others[0])}); take pictures between them"
        )
    if 2 * len(result.registered) < count:
        reporter.warn(f"less than half of the pictures have a pose; {_ADVICE}")
    reporter.message(
        f"wrote {result.output} (poses.png shows it); next: nerg train radiance {result.output} -o FIELD.safetensors"
    )
