"""The geometry of a gaze field: created for training, and loaded again for evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import check_alignment
from nerg_mi.environment import environment as geometry
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.maths.geometry import AnyBox, Similarity
from nerg_mi.options import GeometryOptions
from nerg_mi.photos.salience import SalienceView
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.rays import Rays

# ---- Geometry of gaze workflows ----
#
# Created from a field, a scene, hit points or nothing, and loaded again for an evaluation.


def geometry_kind(options: GeometryOptions) -> str:
    """Return the kind of geometry that is selected. Raises `NergError` unless it is exactly one."""
    if sum(v is not None for v in (options.field, options.scene, options.geometry)) != 1:
        raise NergError(
            f"give the geometry that the participants saw: one of {parameter('field', 'FILE')}, "
            f"{parameter('scene', 'FILE')}, {parameter('geometry', 'hits')}, {parameter('geometry', 'none')}"
        )
    if options.geometry not in (None, "hits", "none"):
        raise NergError(
            f'{parameter("geometry")} must be "hits" or "none", got "{options.geometry}"; the file of a mesh or '
            f"scene is given with {parameter('scene')}, that of a radiance field with {parameter('field')}"
        )
    return options.geometry or ("field" if options.field is not None else "scene")


def make_geometry(
    options: GeometryOptions,
    rays: Rays | None,
    views: Sequence[SalienceView],
    volume: Path | None,
    voxel: float | None = None,
    reporter: Reporter = SILENT,
) -> Environment:
    """Create the selected geometry.

    Parameters
    ----------
    options
        Selection of the geometry.
    rays
        Rays whose hit points may form the geometry.
    views
        Views with saliency.
    volume
        File (.vol) for a geometry of hit points.
    voxel
        Edge length of voxels in metres, for hit points.
    reporter
        Receives messages.

    Raises
    ------
    NergError
        For unsuitable files, and for rays without hit points.
    """
    kind = geometry_kind(options)
    if options.field is not None or options.scene is not None:
        path = Path(options.field or options.scene or "")
        environment = Environment.open(path)
        for note in environment.notes:
            reporter.message(f"{path}: {note}")
        return environment
    if kind == "none":
        origins = [v.camera.center[None] for v in views] + ([] if rays is None else [rays.origin])
        return geometry.no_geometry(np.concatenate(origins))
    if rays is None or volume is None:
        raise NergError(
            "a geometry of hit points needs rays, and is written next to the gaze field: give both, or use "
            f"{parameter('field')}"
        )
    environment = geometry.make_hit_geometry(rays, volume, voxel)
    made = environment.metadata["geometry_file"]
    reporter.message(
        f"wrote {volume}: {' x '.join(map(str, made['shape']))} voxels of {made['voxel']:.3g} m, "
        f"{100 * made['solid']:.1f} % solid"
    )
    if made["beyond"]:
        reporter.message(
            f"{100 * made['beyond']:.1f} % of the hit points are outside this box and were moved to its boundary, "
            "in their direction but too near"
        )
    return environment


def load_training_geometry(
    gaze: Path,
    provenance: dict,
    box: AnyBox,
    *,
    field: Path | None = None,
    scene: Path | None = None,
    choice: Path | str | None = None,
) -> Environment:
    """Load the geometry of the training of the checkpoint ``gaze``, with the alignment of the training.

    The file is ``field``, ``scene`` or ``choice`` (a volume), or the one with the stored name next to the checkpoint.
    As in training, ``choice`` may also be "hits" or "none", if that is how the gaze field was trained. ``box`` is that
    of the gaze field. Raises `NergError` for a missing or a different file, and for another kind of geometry.
    """
    align = read_training_alignment(provenance)
    if choice is not None and str(choice) in ("hits", "none"):
        _check_trained_kind(gaze, provenance, str(choice))
        choice = None
    if provenance.get("geometry") == "none":
        return Environment(None, box, "none", align=align)
    options = {"field_file": (field, "field"), "scene_file": (scene, "scene"), "geometry_file": (choice, "geometry")}
    explicit, name = options[geometry_key(gaze, provenance)]
    remedies = f"name it with {parameter(name)}", f"give the right one with {parameter(name)}"
    path = find_training_file(gaze, provenance, None if explicit is None else Path(explicit), *remedies)
    return replace(Environment.open(path), align=align)


def _check_trained_kind(gaze: Path, provenance: dict, kind: str) -> None:
    """Raise `NergError` unless ``gaze`` was trained with ``--geometry kind``."""
    trained_options = {
        "field_file": parameter("field"),
        "scene_file": parameter("scene"),
        "geometry_file": parameter("geometry", "hits"),
    }
    is_without = provenance.get("geometry") == "none"
    trained = parameter("geometry", "none") if is_without else trained_options[geometry_key(gaze, provenance)]
    if trained != parameter("geometry", kind):
        raise NergError(
            f'{parameter("geometry")} is "{kind}", but "{gaze}" was trained with {trained}, and is evaluated in '
            f"the geometry of its training; leave out {parameter('geometry')}"
        )


def read_training_alignment(provenance: dict) -> Similarity:
    """Return the transform from the training rays to the scene. Raises `NergError` for a damaged one."""
    return Similarity() if provenance.get("align") is None else Similarity(provenance["align"])


def geometry_key(gaze: Path, provenance: dict) -> str:
    """Return the key in ``provenance`` of the geometry file: "field_file", "scene_file" or "geometry_file".

    Raises `NergError` if there is none.
    """
    key = next((k for k in ("field_file", "scene_file", "geometry_file") if k in provenance), None)
    if key is None:
        raise NergError(f'"{gaze}" does not store the geometry that it was trained in')
    return key


def find_training_file(gaze: Path, provenance: dict, explicit: Path | None, where: str, other: str) -> Path:
    """Return the geometry file of the training of ``gaze``: ``explicit``, or the file with the stored name next to it.

    Raises `NergError` for a missing file, with the remedy ``where``, and for a different one, with the remedy
    ``other``.
    """
    entry = provenance[geometry_key(gaze, provenance)]
    path = gaze.parent / entry["file"] if explicit is None else Path(explicit)
    if not path.exists():
        raise NergError(f'"{path}", which the field was trained in, does not exist; {where}')
    if not matches_checksum(path, entry["sha256"]):
        raise NergError(f'"{path}" is not the file that "{gaze}" was trained in; {other}')
    return path


def check_geometry(
    environment: Environment, rays: Rays | None, options: str, force: bool, reporter: Reporter = SILENT
) -> None:
    """Warn if ``rays`` do not fit the geometry: gaze without hits, or heads inside objects.

    ``options`` selects the geometry in the command that is suggested as a remedy. Raises `NergError` if (nearly) no
    gaze hits a surface, unless ``force`` is set. A geometry of hit points always fits, and without geometry there are
    no hits.
    """
    if rays is None or environment.medium is None or environment.kind == "hits":
        return
    check = check_alignment(environment.medium, rays, environment.align)
    remedy = f"find the alignment with: nerg align RAYS {options} -o alignment.json, and use it with --align"
    if check.is_impossible and not force:
        raise NergError(
            f"{100 * check.escaped:.1f} % of the gaze hits no surface, so the rays are not aligned with the scene; "
            f"{remedy} (or add {parameter('force', True)} to continue anyway)"
        )
    doubts = check.list_warnings()
    if doubts:
        reporter.warn(f"the rays may not be aligned with the scene: {', '.join(doubts)}; {remedy}")
