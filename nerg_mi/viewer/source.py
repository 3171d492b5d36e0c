"""The scene of the viewer, from objects, files and folders."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from nerg_mi.environment.bands import is_nerg
from nerg_mi.environment.gaze import GazeField, find_environment_record, read_training_alignment
from nerg_mi.environment.inputs import find_role
from nerg_mi.environment.kinds import KINDS, detect_kind
from nerg_mi.environment.nested_scene import GAZE_PROPERTIES, GAZE_PROPERTY, find_field_file, replace_gaze
from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_file import write_scene
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.files.atomic import write_text
from nerg_mi.files.values import FilePath
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.splats import READERS, is_splat_file
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.tracking.dataset import is_dataset, open_rays
from nerg_mi.tracking.rays import Rays

RAYS = 2_000_000
"""Maximum number of rays that are shown; larger datasets are subsampled uniformly."""

_SUFFIXES = {*KINDS, *READERS, ".safetensors", ".rays"}


@dataclass(frozen=True, eq=False)
class ViewerScene:
    """Scene of the viewer.

    Attributes
    ----------
    scene
        Scene file with the integrator `nerg`.
    made
        Whether it is a temporary file of the viewer.
    rays
        Rays in their own frame, or None.
    align
        Transform from the rays to the scene.
    up
        Up direction (3,), a unit vector.
    name
        Display name.
    folder
        Folder for temporary files.
    variants
        Scene files that differ in their gaze field only, by its name; the first is ``scene``. Empty if there is no
        choice.
    """

    scene: Path
    made: bool
    rays: Rays | None
    align: Similarity
    up: np.ndarray
    name: str
    folder: Path
    variants: dict[str, Path] = field(default_factory=dict)


def open_viewer_scene(
    inputs: Any,
    folder: Path,
    *,
    observer: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
    align: AnySimilarity | FilePath | None = None,
    reporter: Reporter = SILENT,
) -> ViewerScene:
    """Return the scene of ``inputs``: a scene with `nerg` and a camera, or one that `write_scene` writes to ``folder``.

    A folder is replaced by the files in it, at most one of a kind, or is a dataset of rays (.rays). Rays are shown in
    the scene. Several gaze fields, such as those of other seeds, are variants to choose from; the gaze field of a scene
    is the first of them. Raises `NergError` for errors that the user can correct.
    """
    items = [item for each in (inputs if isinstance(inputs, (list, tuple)) else [inputs]) for item in _expand(each)]
    if not items:
        raise NergError(
            "there is nothing to view; name a scene, a field, a mesh, a gaze field, rays, or a folder of these"
        )
    by_role: dict[str, list[Any]] = {"environment": [], "gaze": [], "rays": []}
    for item in items:
        by_role[find_role(item)].append(item)
    environments, gaze, recordings = by_role.values()
    if len(recordings) > 1:
        raise NergError(
            f'"{recordings[0]}" and "{recordings[1]}" are both rays, and the viewer shows one; leave out one of them'
        )
    rays = recordings[0] if recordings else None
    rays = open_rays(rays, RAYS) if isinstance(rays, Path) else rays
    name = " + ".join(item.name if isinstance(item, Path) else find_role(item) for item in items)
    placed = None if align is None else open_similarity(align, "rays to place", reporter.warn)
    complete = _find_complete(environments[0], folder) if len(environments) == 1 else None
    if complete is not None:
        own_gaze = find_field_file(complete, GAZE_PROPERTY) if gaze else None
        fields = [*([own_gaze] if own_gaze else []), *_save_fields(gaze, folder)]
        variants = write_variants(complete, fields, folder, reporter) if gaze else {}
        scene = next(iter(variants.values()), complete)
        upward = _normalize(np.array([0.0, 0, 1]) if up is None else up)
        return ViewerScene(scene, bool(gaze), rays, placed or Similarity(), upward, name, folder, variants)
    output = folder / "scene.xml"
    shown = [*environments, *gaze[:1], *recordings]
    written = write_scene(shown, output, observer=observer, up=up, align=align, progress=reporter)
    if placed is None:
        placed = read_training_alignment({} if written.gaze is None else written.gaze.provenance)
    variants = write_variants(output, _save_fields(gaze, folder), folder, reporter) if len(gaze) > 1 else {}
    upward = _normalize(_read_up(output) if up is None else up)
    return ViewerScene(output, True, rays, placed, upward, name, folder, variants)


def write_variants(scene: Path, gaze: Sequence[Path], folder: Path, reporter: Reporter = SILENT) -> dict[str, Path]:
    """Write copies of the file ``scene`` to ``folder``, one for each gaze field of ``gaze``; return them by distinct
    names.

    Warns of fields that were trained in another scene than the first. Raises `NergError` for a scene that cannot have a
    gaze field.
    """
    first = _read_checksum(gaze[0])
    variants: dict[str, Path] = {}
    for number, path in enumerate(gaze):
        if _read_checksum(path) != first:
            reporter.warn(
                f'"{path}" was trained in another scene than "{gaze[0]}"; its gaze is valid only if surfaces and '
                "coordinates are the same"
            )
        name = next(n for n in _names(path, number) if n not in variants)
        variants[name] = folder / f"variant{number}.xml"
        write_text(variants[name], replace_gaze(scene, path))
    return variants


def _read_checksum(gaze: Path) -> str | None:
    """Return the checksum of the environment's file of a gaze field, or None."""
    return (find_environment_record(read_metadata(gaze).get("provenance", {})) or {}).get("sha256")


def _names(path: Path, number: int) -> Iterator[str]:
    """Yield names for the gaze field of a file, the shortest first."""
    yield path.stem
    yield f"{path.parent.name}/{path.stem}"
    yield f"{path.stem} ({number})"


def _save_fields(gaze: Sequence[Any], folder: Path) -> list[Path]:
    """Return the files of gaze fields; those in memory are written to ``folder``."""
    files = []
    for number, item in enumerate(gaze):
        field = GazeField.open(item)
        files.append(field.path or field.save(folder / f"gaze{number}.safetensors"))
    return files


def _expand(item: object) -> list[Any]:
    """Return an input, or the files in a folder that the viewer can show."""
    if not isinstance(item, (str, os.PathLike)):
        return [item]
    path = Path(item)
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if not path.is_dir() or is_dataset(path):
        return [path]
    inside = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
    # Of glTF files, the viewer shows splats only.
    inside = [p for p in inside if p.suffix.lower() != ".glb" or is_splat_file(p)]
    if not inside:
        raise NergError(
            f'the folder "{path}" contains nothing that the viewer can show; name a file, or another folder'
        )
    ready = [p for p in inside if p.suffix.lower() == ".xml"]
    if len(ready) > 1:
        ready = [p for p in ready if p.name == "scene.xml"] or ready
    if len(ready) > 1:
        raise NergError(f'the folder "{path}" contains {len(ready)} scenes; name one of them')
    return ready or inside


def _find_complete(environment: Any, folder: Path) -> Path | None:
    """Return the file of a scene with the integrator `nerg`, and a camera or gaze; None for other environments."""
    if isinstance(environment, Path) and detect_kind(environment) != "scene":
        return None
    if not isinstance(environment, (Path, Scene)):
        return None
    scene: Any = load_scene(environment) if isinstance(environment, Path) else environment.mitsuba
    nerg = scene.integrator()
    if not is_nerg(nerg) or not (len(scene.sensors()) or not nerg.children.keys().isdisjoint(GAZE_PROPERTIES)):
        return None
    if isinstance(environment, Path):
        return environment
    return environment.path or environment.save(folder / "shown.xml")


def _normalize(up: Sequence[float] | np.ndarray) -> np.ndarray:
    up = np.asarray(up, float)
    length = float(np.linalg.norm(up))
    if up.shape != (3,) or not length > 0:
        raise NergError(f"up must be a direction, three numbers that are not all 0; give {parameter('up', 'x,y,z')}")
    return up / length


def _read_up(written: Path) -> np.ndarray:
    """Return the up direction of a scene that `write_scene` wrote."""
    defaults = {d.get("name"): d.get("value", "") for d in ElementTree.parse(written).getroot().iter("default")}
    text = defaults.get("nerg_up", defaults.get("up", "0, 0, 1"))
    return np.array([float(v) for v in text.split(",")])
