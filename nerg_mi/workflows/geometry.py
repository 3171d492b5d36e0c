"""The place that gaze is tied to: of a training, and of a field that is evaluated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.alignment.check import check_alignment
from nerg_mi.errors import NergError
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.maths.geometry import AnyBox, Similarity
from nerg_mi.photos.salience import SalienceView
from nerg_mi.rays.rays import Rays
from nerg_mi.train import geometry
from nerg_mi.train.geometry import TrainingGeometry

from .base import SILENT, Reporter
from .gaze_commands import GazeEvaluationOptions
from .options import GeometryOptions

# ---- Gaze places ----
#
# The places of jobs on gaze: made of a field, a scene, hit points or nothing, and found again for an evaluation.


def geometry_kind(options: GeometryOptions) -> str:
    """Kind of the place (`GazePlace.kind`) that is asked for. Raises `NergError` unless it is exactly one."""
    if sum(v is not None for v in (options.field, options.scene, options.geometry)) != 1:
        raise NergError(
            "say where people looked around: one of --field FILE, --scene FILE, --geometry hits, --geometry none"
        )
    if options.geometry not in (None, "hits", "none"):
        raise NergError(f'--geometry must be "hits" or "none", got "{options.geometry}"')
    return options.geometry or ("field" if options.field is not None else "scene")


def make_geometry(
    options: GeometryOptions,
    rays: Rays | None,
    views: Sequence[SalienceView],
    volume: Path | None,
    ns: ModuleType,
    voxel: float | None = None,
    reporter: Reporter = SILENT,
) -> TrainingGeometry:
    """The place that is asked for, with arrays of the backend ``ns``; one of hit points is written to ``volume``
    (.vol), in voxels of edge ``voxel`` metres.

    Raises `NergError` for a file that cannot be used, and for rays without hits.
    """
    kind = geometry_kind(options)
    if options.field is not None or options.scene is not None:
        path = Path(options.field or options.scene or "")
        place = geometry.load_field_geometry(path, ns) if options.field is not None else geometry.load_scene_geometry(path)
        for note in place.notes:
            reporter.message(f"of {path}: {note}")
        return place
    if kind == "none":
        origins = [v.camera.center[None] for v in views] + ([] if rays is None else [rays.origin])
        return geometry.no_geometry(np.concatenate(origins))
    if rays is None or volume is None:
        raise NergError(
            "a place of hit points is made of rays and written beside the gaze field: give both, or a field"
        )
    place = geometry.make_hit_geometry(rays, volume, voxel)
    made = place.metadata["geometry_file"]
    reporter.message(
        f"wrote {volume}: {' x '.join(map(str, made['shape']))} voxels of {made['voxel']:.3g} m, "
        f"{100 * made['solid']:.1f} % solid"
    )
    if made["beyond"]:
        reporter.message(
            f"{100 * made['beyond']:.1f} % of the hit points lie beyond this box and stand on its shell, in their true "
            "directions but too near"
        )
    return place


def load_training_geometry(
    gaze: Path, provenance: dict, box: AnyBox, options: GazeEvaluationOptions, ns: ModuleType
) -> TrainingGeometry:
    """What the field in the checkpoint ``gaze`` was trained in: the file that is named, or the one of the checkpoint's
    beside it, with the alignment of the training.

    ``box``: of the gaze field. Raises `NergError` for a file that is missing or another one.
    """
    align = read_training_alignment(provenance)
    if provenance.get("geometry") == "none":
        return TrainingGeometry(None, box, "none", align=align)
    makers: dict[str, tuple[Path | None, str, Callable[[Path], TrainingGeometry]]] = {
        "field_file": (options.field, "--field", lambda path: geometry.load_field_geometry(path, ns)),
        "scene_file": (options.scene, "--scene", geometry.load_scene_geometry),
        "geometry_file": (options.geometry, "--geometry", geometry.load_volume_geometry),
    }
    key = geometry_key(gaze, provenance)
    given, name, make = makers[key]
    path = find_training_file(gaze, provenance, given, f"say where it is with {name}", f"give that one with {name}")
    return replace(make(path), align=align)


def read_training_alignment(provenance: dict) -> Similarity:
    """From the rays that a gaze field was trained on to its place. Raises `NergError` for one that is damaged."""
    return Similarity() if provenance.get("align") is None else Similarity(provenance["align"])


def geometry_key(gaze: Path, provenance: dict) -> str:
    """The entry of the ``provenance`` of the checkpoint ``gaze`` that names the file of its place: "field_file",
    "scene_file" or "geometry_file". Raises `NergError` where there is none."""
    key = next((k for k in ("field_file", "scene_file", "geometry_file") if k in provenance), None)
    if key is None:
        raise NergError(f'"{gaze}" does not say what it was trained in')
    return key


def find_training_file(gaze: Path, provenance: dict, given: Path | None, where: str, other: str) -> Path:
    """The file of the place that ``gaze`` was trained in: ``given``, or the one of its name beside the checkpoint.

    Raises `NergError` for a file that is missing, which ends in ``where``, or is another one, which ends in ``other``.
    """
    about = provenance[geometry_key(gaze, provenance)]
    path = gaze.parent / about["file"] if given is None else Path(given)
    if not path.exists():
        raise NergError(f'"{path}", which the field was trained in, does not exist; {where}')
    if not matches_checksum(path, about["sha256"]):
        raise NergError(f'"{path}" is not the file that "{gaze}" was trained in; {other}')
    return path


def check_geometry(place: TrainingGeometry, rays: Rays | None, options: str, force: bool, reporter: Reporter = SILENT) -> None:
    """Tell where ``rays`` do not lie in ``place`` as people do; ``options``: by which the place was given, for the
    command that is named as the remedy.

    Raises `NergError` where (nearly) all their gaze meets no surface, unless ``force``. A place of hit points is in the
    rays' own frame, and where there is no geometry nothing can be met.
    """
    if rays is None or place.medium is None or place.kind == "hits":
        return
    found = check_alignment(place.medium, rays, place.align)
    remedy = f"find the alignment with: nerg align RAYS {options} -o alignment.json, and give it with --align"
    if found.is_impossible and not force:
        raise NergError(
            f"{100 * found.escaped:.1f} % of the gaze meets no surface of the place, so that the rays lie elsewhere; "
            f"{remedy} (or go on all the same with --force)"
        )
    doubts = found.list_warnings()
    if doubts:
        reporter.warn(f"the rays may not lie where they belong: {', '.join(doubts)}; {remedy}")
