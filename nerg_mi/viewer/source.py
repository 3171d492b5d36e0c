"""The scene of the viewer, from objects, files and folders."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.bands import is_nerg
from nerg_mi.environment.contents import FieldVolume, format_content, load_objects
from nerg_mi.environment.gaze import GazeField, find_environment_record, read_training_alignment
from nerg_mi.environment.inputs import find_role
from nerg_mi.environment.kinds import KINDS, detect_kind
from nerg_mi.environment.nested_scene import GAZE_PROPERTIES, SceneDocument
from nerg_mi.environment.observers import ObserverChoice
from nerg_mi.environment.scene import Scene, find_content, make_scene
from nerg_mi.environment.scene_cameras import CameraChoice
from nerg_mi.environment.scene_file import open_shown, place_scene
from nerg_mi.environment.scene_loading import list_scene_files, load_scene, load_scene_text
from nerg_mi.environment.scene_writer import SceneText
from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.files.values import FilePath
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.formats.splats import READERS, is_splat_file
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.tracking.dataset import is_dataset, open_rays
from nerg_mi.tracking.rays import Rays

RAYS = 2_000_000
"""Maximum number of rays that are shown; larger datasets are subsampled uniformly."""

_SUFFIXES = {*KINDS, *READERS, ".safetensors", ".rays"}


@dataclass(frozen=True, eq=False)
class ViewerInputs:
    """What the viewer opens, and loads scenes from.

    Attributes
    ----------
    name
        Display name.
    rays
        Rays in their own frame, or None.
    align
        Transform from the rays to the scene.
    up
        Up direction (3,), a unit vector.
    gaze
        Gaze fields to choose from, by name; None: that of the scene. Empty if there is no choice.
    files
        Files of the scene.
    scene
        The scene without changes. None: it is not loaded yet.
    document
        Its scene file. None: ``scene`` was made in Python.
    volumes, shapes
        What the document lacks, by name: children of the integrator and of the scene, as in `SceneContent`.
    """

    name: str
    rays: Rays | None
    align: Similarity
    up: np.ndarray
    gaze: dict[str, GazeField | None]
    files: list[Path]
    scene: Scene | None
    document: SceneDocument | None
    volumes: Mapping[str, Any] = field(default_factory=dict)
    shapes: Mapping[str, Any] = field(default_factory=dict)

    def load(self, gaze: str, field: Any = None) -> Scene:
        """Load the scene with one of the gaze fields, and with the volume ``field`` as its radiance field unless None.

        Raises `NergError` if Mitsuba rejects the scene, or a file no longer exists.
        """
        chosen, volumes = self.gaze.get(gaze), {} if field is None else {"field": field}
        if self.document is None:
            return make_scene(self.scene, chosen, **volumes)
        if chosen is not None:
            volumes["gaze"] = FieldVolume(chosen.path or chosen, "gaze")
        if self.scene is not None and not volumes:
            return self.scene
        text = self.document.without_volumes(volumes).to_xml()
        return Scene(load_scene_text(text, {}, load_objects({**self.volumes, **volumes}), load_objects(self.shapes)))

    def list_files(self, gaze: str) -> list[Path]:
        """Return the files of the scene with one of the gaze fields."""
        chosen = self.gaze.get(gaze)
        return [*self.files, *([chosen.path] if chosen is not None and chosen.path is not None else [])]

    def describe(self, gaze: str) -> SceneDocument:
        """Return the scene file with one of the gaze fields. Raises `NergError` if it shows what has no file."""
        chosen, document = self.gaze.get(gaze), self.document
        if document is None and self.scene is not None:
            document = SceneDocument.parse(format_content(find_content(self.scene) or {}), self.name)
        replaced = set() if chosen is None else {"gaze"}
        if document is None or self.shapes or self.volumes.keys() - replaced or (chosen and chosen.path is None):
            raise NergError(
                'the viewer shows objects in memory, which a scene file cannot name; write them with "nerg scene", or '
                "in Python with write_scene"
            )
        return document.with_gaze(chosen.path) if chosen is not None and chosen.path is not None else document


def open_viewer_inputs(
    inputs: Any,
    *,
    observer: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
    align: AnySimilarity | FilePath | None = None,
    reporter: Reporter = SILENT,
) -> ViewerInputs:
    """Return the scene of ``inputs``: a scene with `nerg` and a camera, or one that `place_scene` makes.

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
    gaze = [GazeField.open(item) for item in gaze]
    scene = _load_complete(environments[0]) if len(environments) == 1 else None
    if scene is not None:
        upward = _normalize(np.array([0.0, 0, 1]) if up is None else up)
        choices = name_gaze(gaze, reporter, scene.integrator.children.get("gaze"))
        source = ViewerInputs(name, rays, placed or Similarity(), upward, choices, [], scene, None)
        if scene.source is None:
            return source
        # The viewer changes settings of its scene, so that of the caller is loaded again.
        loaded = None if isinstance(environments[0], Scene) else scene
        files, document = list_scene_files(*scene.source), SceneDocument.read(*scene.source)
        return replace(source, files=files, scene=loaded, document=document)
    shown = open_shown([*environments, *gaze[:1], *recordings], None, align, reporter)
    made = place_scene(shown, ObserverChoice(observer), CameraChoice(None), SceneText.width, up, reporter)
    if placed is None:
        placed = read_training_alignment({} if shown.gaze is None else shown.gaze.provenance)
    choices = name_gaze(gaze, reporter) if len(gaze) > 1 else {}
    named = (shown.environment.path, None if choices or not gaze else gaze[0].path, shown.rays_file)
    files = [file for path in named if path is not None for file in list_scene_files(path)]
    document, upward = SceneDocument.parse(made.text.to_xml(), name), _normalize(made.text.up if up is None else up)
    return ViewerInputs(
        name, rays, placed, upward, choices, files, None, document, made.volumes, made.text.content.shapes
    )


def name_gaze(
    gaze: Sequence[GazeField], reporter: Reporter = SILENT, volume: Any = None
) -> dict[str, GazeField | None]:
    """Return gaze fields by distinct names, after None for the gaze volume ``volume`` of the scene if it has one.

    Warns of fields that were trained in another scene than the first.
    """
    entries: list[tuple[Path, Mapping[str, Any], GazeField | None]] = [
        (item.path or Path(f"gaze {number}"), item.provenance, item) for number, item in enumerate(gaze)
    ]
    if volume is not None and gaze:
        # That of a field in memory is unknown.
        entries.insert(0, (Path(volume.filename), volume.metadata.get("provenance", gaze[0].provenance), None))
    named: dict[str, GazeField | None] = {}
    for number, (path, provenance, choice) in enumerate(entries):
        checksum, first = ((find_environment_record(p) or {}).get("sha256") for p in (provenance, entries[0][1]))
        if checksum != first:
            reporter.warn(
                f'"{path}" was trained in another scene than "{entries[0][0]}"; its gaze is valid only if surfaces and '
                "coordinates are the same"
            )
        # The shortest name that is not taken.
        names = (path.stem, f"{path.parent.name}/{path.stem}", f"{path.stem} ({number})")
        named[next(name for name in names if name not in named)] = choice
    return named


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


def _load_complete(environment: Any) -> Scene | None:
    """Return the scene of a file or in memory that has the integrator `nerg`, and a camera or gaze, and that can be
    loaded again; None for other environments."""
    if isinstance(environment, Path) and detect_kind(environment) == "scene":
        loaded = load_scene(environment)
        if not is_nerg(loaded.integrator()):
            return None
        scene = Scene(loaded)
        scene.source = environment, {}
    elif isinstance(environment, Scene) and (environment.source or find_content(environment)) is not None:
        scene = environment
    else:
        return None
    return scene if scene.mitsuba.sensors() or scene.integrator.children.keys() & {*GAZE_PROPERTIES} else None


def _normalize(up: Sequence[float] | np.ndarray) -> np.ndarray:
    up = np.asarray(up, float)
    length = float(np.linalg.norm(up))
    if up.shape != (3,) or not length > 0:
        raise NergError(f"up must be a direction, three numbers that are not all 0; give {parameter('up', 'x,y,z')}")
    return up / length
