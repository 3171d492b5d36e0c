"""From files and folders to the scene that a viewer shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.splats import READERS, is_splat_file
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.dataset import is_dataset, load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.nested_scene import find_gaze_file, replace_gaze
from nerg_mi.rendering.scene import load_scene

from .base import SILENT, Reporter, select_backend
from .geometry import read_training_alignment
from .scene import write_scene
from .scene_cameras import check_point
from .scene_commands import SceneOptions, ViewOptions
from .scene_places import KINDS, detect_kind, find_training_scene

RAYS = 2_000_000
"""Of larger datasets so many rays are shown, drawn at random."""

_SUFFIXES = {*KINDS, *READERS, ".safetensors", ".rays"}


@dataclass(frozen=True, eq=False)
class ViewerScene:
    """``scene``: a scene file with the integrator `nerg`; ``made``: whether it was written for the viewer, and ends
    with it; ``rays`` in their own frame, or None, and ``align`` from there to the place; ``up`` (3,), a unit vector;
    ``name`` for people; ``variants``: scene files that differ in their gaze field alone, by its name, of which
    ``scene`` is the first; none where there is nothing to choose."""

    scene: Path
    made: bool
    rays: Rays | None
    align: Similarity
    up: np.ndarray
    name: str
    variants: dict[str, Path] = field(default_factory=dict)


def make_viewer_scene(
    files: Sequence[str | Path], folder: Path, options: ViewOptions | None = None, reporter: Reporter = SILENT
) -> ViewerScene:
    """The scene of ``files``: a scene file with `nerg`, or whatever `write_scene` makes one of, in ``folder``.

    A folder stands for the files in it, of which there must be one of a kind, or is a dataset of rays (.rays). Rays
    beside a scene are shown in it. Several gaze fields, as `nerg ablate` trains them, are variants to choose among; a
    scene's own is the first of them. Raises `NergError` for what the user can mend.
    """
    options = options or ViewOptions()
    select_backend(options.mode)
    found = [path for file in files for path in _expanded(Path(file))]
    if not found:
        raise NergError(
            "there is nothing to view; name a scene, a field, a mesh, a gaze field, rays, or a run's folder"
        )
    kinds = {path: detect_kind(path) for path in found}
    rays_files = [path for path, kind in kinds.items() if kind == "rays"]
    if len(rays_files) > 1:
        raise NergError(f'"{rays_files[0]}" and "{rays_files[1]}" are both rays; a viewer shows one of them')
    rays = load_rays(rays_files[0], RAYS) if rays_files else None
    name = " + ".join(path.name for path in found)
    scenes = [path for path, kind in kinds.items() if kind == "scene"]
    gaze = [path for path, kind in kinds.items() if kind == "gaze"]
    if len(scenes) == 1 and set(kinds.values()) <= {"scene", "rays", "gaze"} and _is_nerg(scenes[0]):
        align = _given_align(options) or Similarity(np.eye(4))
        own = find_gaze_file(scenes[0]) if gaze else None
        variants = write_variants(scenes[0], [*([own] if own else []), *gaze], folder, reporter) if gaze else {}
        scene = next(iter(variants.values()), scenes[0])
        return ViewerScene(scene, bool(gaze), rays, align, _up(options, np.array([0.0, 0, 1])), name, variants)
    given = [path for path in found if not is_dataset(path) and path not in gaze[1:]]
    if rays is not None and rays_files[0] not in given:
        copy = folder / "rays.npz"
        rays.save(copy)
        given.append(copy)
    output = folder / "scene.xml"
    chosen = SceneOptions(
        observer=options.observer, up=options.up, align=options.align, geometry=options.geometry, mode=options.mode
    )
    write_scene(given, output, chosen, reporter)
    align = _given_align(options)
    if align is None:
        align = read_training_alignment(read_metadata(gaze[0]).get("provenance", {}) if gaze else {})
    variants = write_variants(output, gaze, folder, reporter) if len(gaze) > 1 else {}
    return ViewerScene(output, True, rays, align, _up(options, _up_of(output)), name, variants)


def write_variants(scene: Path, gaze: Sequence[Path], folder: Path, reporter: Reporter = SILENT) -> dict[str, Path]:
    """Copies of the file ``scene``, with each of the files ``gaze`` as its gaze field, into ``folder``: by the names of
    these, which are their paths' last parts as far as they differ.

    Warns of fields that were trained in other places than the first. Raises `NergError` for a scene that takes none.
    """
    first = read_metadata(gaze[0]).get("provenance", {})
    found: dict[str, Path] = {}
    for number, path in enumerate(gaze):
        if find_training_scene(read_metadata(path).get("provenance", {})) != find_training_scene(first):
            reporter.warn(
                f'"{path}" was trained in another place than "{gaze[0]}"; its gaze is right only where surfaces and '
                "coordinates are the same"
            )
        name = next(n for n in _names(path, number) if n not in found)
        found[name] = folder / f"variant{number}.xml"
        write_text(found[name], replace_gaze(scene, path))
    return found


def _names(path: Path, number: int) -> Iterator[str]:
    """Names for the gaze field of a file, the shortest first."""
    yield path.stem
    yield f"{path.parent.name}/{path.stem}"
    yield f"{path.stem} ({number})"


def _expanded(path: Path) -> list[Path]:
    """A file itself; of a folder the files in it that a viewer knows."""
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if not path.is_dir() or is_dataset(path):
        return [path]
    inside = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
    # Of glTF a viewer shows splats alone.
    inside = [p for p in inside if p.suffix.lower() != ".glb" or is_splat_file(p)]
    if not inside:
        raise NergError(f'the folder "{path}" holds nothing that a viewer shows; name a file, or another folder')
    ready = [p for p in inside if p.suffix.lower() == ".xml"]
    if len(ready) > 1:
        ready = [p for p in ready if p.name == "scene.xml"] or ready
    if len(ready) > 1:
        raise NergError(f'the folder "{path}" has {len(ready)} scenes; name the one to view')
    return ready or inside


def _is_nerg(path: Path) -> bool:
    return is_nerg(load_scene(path).integrator())


def _given_align(options: ViewOptions) -> Similarity | None:
    return None if options.align is None else read_similarity(options.align, "--align", "rays to place")


def _up(options: ViewOptions, otherwise: np.ndarray) -> np.ndarray:
    up = check_point(options.up, "--up")
    up = otherwise if up is None else up
    length = float(np.linalg.norm(up))
    if not length > 0:
        raise NergError("up must be a direction, three numbers that are not all 0; give --up x,y,z")
    return up / length


def _up_of(written: Path) -> np.ndarray:
    """Up in a scene that `write_scene` wrote."""
    defaults = {d.get("name"): d.get("value", "") for d in ElementTree.parse(written).getroot().iter("default")}
    text = defaults.get("nerg_up", defaults.get("up", "0, 0, 1"))
    return np.array([float(v) for v in text.split(",")])
