"""The scene of the viewer, from files and folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.environment.kinds import KINDS, detect_kind
from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.files.atomic import write_text
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.splats import READERS, is_splat_file
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import is_dataset, load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.nested_scene import GAZE_PROPERTIES, GAZE_PROPERTY, find_field_file, replace_gaze
from nerg_mi.rendering.scene import load_scene
from nerg_mi.train.geometry_files import read_training_alignment

from .base import select_backend
from .scene import write_scene
from .scene_cameras import check_point
from .scene_commands import SceneOptions, ViewOptions
from .scene_environments import find_training_scene

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


def make_viewer_scene(
    files: Sequence[str | Path], folder: Path, options: ViewOptions | None = None, reporter: Reporter = SILENT
) -> ViewerScene:
    """Return the scene of ``files``: a scene file with `nerg` and a camera, or one that `write_scene` writes.

    It is written to ``folder``. A folder is replaced by the files in it, at most one of a kind, or is a dataset of rays
    (.rays). Rays are shown in the scene. Several gaze fields, such as those of other seeds, are variants to choose
    from; the gaze field of a scene is the first of them. Raises `NergError` for errors that the user can correct.
    """
    options = options or ViewOptions()
    select_backend(options.mode)
    paths = [path for file in files for path in _expanded(Path(file))]
    if not paths:
        raise NergError(
            "there is nothing to view; name a scene, a field, a mesh, a gaze field, rays, or a folder of these"
        )
    kinds = {path: detect_kind(path) for path in paths}
    rays_files = [path for path, kind in kinds.items() if kind == "rays"]
    if len(rays_files) > 1:
        raise NergError(
            f'"{rays_files[0]}" and "{rays_files[1]}" are both rays, and the viewer shows one; leave out one of them'
        )
    rays = load_rays(rays_files[0], RAYS) if rays_files else None
    name = " + ".join(path.name for path in paths)
    scenes = [path for path, kind in kinds.items() if kind == "scene"]
    gaze = [path for path, kind in kinds.items() if kind == "gaze"]
    if len(scenes) == 1 and set(kinds.values()) <= {"scene", "rays", "gaze"} and _is_complete(scenes[0]):
        align = _explicit_align(options, reporter) or Similarity(np.eye(4))
        own_gaze = find_field_file(scenes[0], GAZE_PROPERTY) if gaze else None
        variants = (
            write_variants(scenes[0], [*([own_gaze] if own_gaze else []), *gaze], folder, reporter) if gaze else {}
        )
        scene = next(iter(variants.values()), scenes[0])
        return ViewerScene(scene, bool(gaze), rays, align, _up(options, np.array([0.0, 0, 1])), name, folder, variants)
    inputs = [path for path in paths if not is_dataset(path) and path not in gaze[1:]]
    if rays is not None and rays_files[0] not in inputs:
        copy = folder / "rays.npz"
        rays.save(copy)
        inputs.append(copy)
    output = folder / "scene.xml"
    scene_options = SceneOptions(
        observer=options.observer, up=options.up, align=options.align, geometry=options.geometry, mode=options.mode
    )
    write_scene(inputs, output, scene_options, reporter)
    align = _explicit_align(options, reporter)
    if align is None:
        align = read_training_alignment(read_metadata(gaze[0]).get("provenance", {}) if gaze else {})
    variants = write_variants(output, gaze, folder, reporter) if len(gaze) > 1 else {}
    return ViewerScene(output, True, rays, align, _up(options, _up_of(output)), name, folder, variants)


def write_variants(scene: Path, gaze: Sequence[Path], folder: Path, reporter: Reporter = SILENT) -> dict[str, Path]:
    """Write copies of the file ``scene`` to ``folder``, one for each gaze field of ``gaze``; return them by distinct
    names.

    Warns of fields that were trained in another scene than the first. Raises `NergError` for a scene that cannot have a
    gaze field.
    """
    first = read_metadata(gaze[0]).get("provenance", {})
    variants: dict[str, Path] = {}
    for number, path in enumerate(gaze):
        if find_training_scene(read_metadata(path).get("provenance", {})) != find_training_scene(first):
            reporter.warn(
                f'"{path}" was trained in another scene than "{gaze[0]}"; its gaze is valid only if surfaces and '
                "coordinates are the same"
            )
        name = next(n for n in _names(path, number) if n not in variants)
        variants[name] = folder / f"variant{number}.xml"
        write_text(variants[name], replace_gaze(scene, path))
    return variants


def _names(path: Path, number: int) -> Iterator[str]:
    """Yield names for the gaze field of a file, the shortest first."""
    yield path.stem
    yield f"{path.parent.name}/{path.stem}"
    yield f"{path.stem} ({number})"


def _expanded(path: Path) -> list[Path]:
    """Return the file, or the files in a folder that the viewer can show."""
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


def _is_complete(path: Path) -> bool:
    """Return whether a scene file has the integrator `nerg`, and a camera or gaze: others are environments."""
    scene = load_scene(path)
    nerg = scene.integrator()
    return is_nerg(nerg) and (len(scene.sensors()) > 0 or not nerg.children.keys().isdisjoint(GAZE_PROPERTIES))


def _explicit_align(options: ViewOptions, reporter: Reporter) -> Similarity | None:
    return (
        None
        if options.align is None
        else read_similarity(options.align, parameter("align"), "rays to place", reporter.warn)
    )


def _up(options: ViewOptions, otherwise: np.ndarray) -> np.ndarray:
    up = check_point(options.up, parameter("up"))
    up = otherwise if up is None else up
    length = float(np.linalg.norm(up))
    if not length > 0:
        raise NergError(f"up must be a direction, three numbers that are not all 0; give {parameter('up', 'x,y,z')}")
    return up / length


def _up_of(written: Path) -> np.ndarray:
    """Return the up direction of a scene that `write_scene` wrote."""
    defaults = {d.get("name"): d.get("value", "") for d in ElementTree.parse(written).getroot().iter("default")}
    text = defaults.get("nerg_up", defaults.get("up", "0, 0, 1"))
    return np.array([float(v) for v in text.split(",")])
