"""Writing of a scene file for an environment, a gaze field or rays, with a camera and an observer."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_writable, write_text
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter
from nerg_mi.ranges import COORDINATES, FIELDS_OF_VIEW, RATES, TIMES, Range, check_ranges
from nerg_mi.tracking.dataset import Conditions, RayDataset, open_rays, open_recordings
from nerg_mi.tracking.rays import Rays

from .arrays import check_point
from .contents import FieldVolume, load_objects, make_kde_volume
from .environment import Environment, make_hit_geometry, no_geometry
from .gaze import GazeField, read_training_alignment
from .inputs import sort_inputs
from .nested_scene import GAZE_PROPERTIES
from .observers import ObserverChoice, ObserverPath
from .rendering_files import write_frames
from .scene import AnyEnvironment, Scene
from .scene_cameras import (
    PROBE_SIZE,
    CameraChoice,
    SceneProbe,
    make_upright,
    probe_values,
    sees_anything,
    turn_to_attention,
)
from .scene_loading import activate_mitsuba, load_scene_text
from .scene_parts import colors_path
from .scene_writer import GazeFiles, LookAt, SceneContent, SceneText, format_numbers, free_default_name
from .sensors import describe_observer

MAX_SCENE_RAYS = 1_000_000
"""Maximum number of rays of a dataset in a scene."""

SMALLEST = 0.05
"""Smallest extent in scene units with accurate lighting: rays start about 1e-4 units off a surface."""


@dataclass(frozen=True, eq=False, repr=False)
class WrittenScene(Summary):
    """A written scene.

    Attributes
    ----------
    path : Path
        Scene file.
    files : tuple of Path
        All written files.
    environment : Environment
        What the scene shows.
    gaze : GazeField or None
        Its gaze field.
    camera, observer : LookAt or None
        Positions and targets in scene coordinates; without an observer, the camera is the observer.
    quantity : str or None
        AOV of attention.
    num_frames : int
        Number of frames of a walk.
    reserved_names : frozenset of str
        Names of ``<default>`` elements that another file defines.
    """

    path: Path
    files: tuple[Path, ...]
    environment: Environment
    gaze: GazeField | None
    camera: LookAt
    observer: LookAt | None
    quantity: str | None
    num_frames: int
    reserved_names: frozenset[str]

    def load(self, **defaults: object) -> Scene:
        """Load the scene, with values of its ``<default>`` elements (`Scene.load`)."""
        return Scene.load(self.path, **defaults)

    def __repr__(self) -> str:
        return f"<WrittenScene: {', '.join(path.name for path in self.files)}>"


@check_ranges
def write_scene(
    inputs: object | Sequence[object | FilePath],
    output: FilePath,
    *,
    environment: AnyEnvironment | FilePath | None = None,
    observer: Annotated[Sequence[float], COORDINATES] | None = None,
    person: str | None = None,
    time: Annotated[float, TIMES] | None = None,
    time_range: Annotated[Sequence[float], TIMES] | None = None,
    fps: Annotated[float, RATES] = 10.0,
    camera: Annotated[Sequence[float], COORDINATES] | None = None,
    target: Annotated[Sequence[float], COORDINATES] | None = None,
    first_person: bool = False,
    photos: FilePath | None = None,
    photo: str | None = None,
    allow_outside: bool = False,
    fov: Annotated[float, FIELDS_OF_VIEW] | None = None,
    width: Annotated[int, Range(1, 16384)] = 480,
    up: Annotated[Sequence[float], COORDINATES] | None = None,
    align: AnySimilarity | FilePath | None = None,
    progress: Progress = None,
) -> WrittenScene:
    """Write a commented scene file with the best overview as its camera, and an observer.

    A gaze field alone is shown in the scene that it was trained in, which must be in the same folder. Each <default> of
    the file can be set when it is rendered.

    Parameters
    ----------
    inputs : object, path or sequence of these
        A scene (radiance field, splats, mesh, .xml, .vol), a gaze field and rays, or some of them, in any order.
    output : path
        Scene file to write (.xml).
    environment : AnyEnvironment or path, optional
        Environment if it is not among the inputs. Of rays alone: hits (a volume of their hit points) or none. Default:
        that of the gaze field; hits of rays that have any.
    observer : sequence of float, optional
        Position of the observer's eye, x,y,z. Default: where the density of rays is highest.
    person : str, optional
        Person in the rays whose eye position the observer takes, at ``time`` or over ``time_range``.
    time : float, optional
        Time of that position in seconds of the rays' clock.
    time_range : sequence of float, optional
        Start and end A,B of a walk in seconds of the rays' clock; also writes a CSV file of frames to render.
    fps : float
        Frame rate of ``time_range`` in frames per second.
    camera : sequence of float, optional
        Position of the camera, x,y,z. Default: the best overview.
    target : sequence of float, optional
        Point that the camera looks at, x,y,z. Default: the centre of what the observer looks at.
    first_person : bool
        Place the camera at the observer's eye.
    photos : path, optional
        Photos that the radiance field was trained on; the camera is that of a photo.
    photo : str, optional
        Name or number (from 0) of that photo. Default: the one with the best view.
    allow_outside : bool
        Also read files outside the folder of the photos if it refers to them.
    fov : float, optional
        Horizontal field of view in degrees. Default: 70, or that of the photo.
    width : int
        Width of the image in pixels.
    up : sequence of float, optional
        Up direction of the scene, x,y,z. Default: as its files state, else 0,0,1.
    align : Alignment, Similarity, array_like or path, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: the alignment of the gaze field.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    WrittenScene
        The ``path`` of the scene, its other files, the camera and the observer. Its method ``load`` returns the scene.

    Raises
    ------
    NergError
        An input cannot be shown, arguments contradict each other, or the image would be empty.

    Notes
    -----
    The scene has the sensors and ``<default>`` elements of the demo store: sensor 0 is a camera, 1 the observer's view,
    2 the observer's sphere. File names are relative to the folder of the scene where possible. What has no file is
    written next to the scene: objects in memory, and a uniform sample of at most a million rays of a dataset.

    Examples
    --------
    >>> import nerg_mi as nerg, trimesh
    >>> room = trimesh.creation.box((4, 3, 2.5))
    >>> written = nerg.write_scene(room, folder / "room.xml", observer=(0, 0, 0), width=48)
    >>> len(written.load().mitsuba.sensors())
    3
    """
    output = to_path(output)
    frames_file = output.with_suffix(".frames.csv")
    check_writable(output, ".xml")
    observers = ObserverChoice(observer, person, time, time_range, fps)
    cameras = CameraChoice(camera, target, first_person, photos, photo, allow_outside, fov)
    check_point(up, parameter("up"))
    activate_mitsuba()
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading the files")
        shown = open_shown(inputs, environment, align, reporter)
        for path in (*_plan_files(shown, output), *(() if time_range is None else (frames_file,))):
            check_writable(path)
        placed = place_scene(shown, observers, cameras, width, up, reporter)
        written = placed.save(output, reporter)
        if (walk := placed.walk) is not None:
            write_frames(frames_file, _make_frames(walk, first_person, written.reserved_names))
            written = replace(written, files=(*written.files, frames_file), num_frames=len(walk.eyes))
            pauses = f"; {walk.missing} more are in pauses of the rays" if walk.missing else ""
            count = len(walk.eyes)
            reporter.message(f"{count} frames{pauses}: nerg render {output} -o walk.png --frames {frames_file}")
        text = placed.text
        for sentence in (text.observer_comment, text.camera_comment, *(f"wrote {path}" for path in written.files)):
            if sentence:
                reporter.message(sentence)
    return written


# ---- What a scene shows ----


@dataclass(frozen=True, eq=False)
class ShownObjects:
    """What a scene shows, in memory or in files.

    ``rays`` are a sample of ``recordings``, with a ``rays_file`` if that has all of them, and ``align`` transforms from
    them to the scene.
    """

    environment: Environment
    gaze: GazeField | None
    recordings: Rays | RayDataset | None
    rays: Rays | None
    rays_file: Path | None
    align: Similarity

    @property
    def gaze_files(self) -> GazeFiles:
        """The gaze, as files where there are any."""
        gaze = self.gaze if self.gaze is None else self.gaze.path or self.gaze
        align = None if self.align.is_identity else self.align.matrix
        return GazeFiles(gaze, self.rays if self.rays_file is None else self.rays_file, align)

    def select_person(self, person: str | None) -> Rays | None:
        """Return rays in which to look up a ``person``: of a dataset all of theirs, not only the sample."""
        if person is not None and isinstance(self.recordings, RayDataset):
            return self.recordings.load(Conditions(persons=[person]))
        return self.rays

    def save_beside(self, output: Path, reporter: Reporter) -> tuple[ShownObjects, list[Path]]:
        """Write what has no file next to the scene ``output``. Return these objects with their files, and the new ones.

        Raises `NergError` if one cannot be written.
        """
        rays_file, written, gaze = self.rays_file, list[Path](), self.gaze
        if self.rays is not None and rays_file is None:
            self.rays.save(rays_file := output.with_suffix(".rays.npz"))
            written.append(rays_file)
            if isinstance(self.recordings, RayDataset):
                reporter.message(f"the scene shows {len(self.rays):,} rays of the dataset, stored next to it")
        saved = self.environment.save_beside(output)
        if saved is not self.environment and saved.path is not None:
            written.append(saved.path)
        if gaze is not None and gaze.path is None:
            # Its environment is that of the scene, unless it was trained in another one.
            recorded = replace(gaze, environment=saved) if gaze.is_trained_in(saved) else gaze
            written.append(recorded.save(output.with_suffix(".gaze.safetensors")))
            gaze = replace(gaze, path=written[-1])
        return replace(self, environment=saved, gaze=gaze, rays_file=rays_file), written


def open_shown(
    inputs: object,
    environment: AnyEnvironment = None,
    align: AnySimilarity | FilePath | None = None,
    reporter: Reporter = SILENT,
) -> ShownObjects:
    """Open what a scene shows. Parameters and errors as for `write_scene`."""
    sources = sort_inputs(inputs)
    if environment is not None and sources.environment is not None:
        raise NergError(f"there is already an environment among the files; leave out {parameter('environment')}")
    sources = sources._replace(environment=sources.environment if environment is None else environment)
    if all(part is None for part in sources):
        raise NergError("a scene needs a field, a mesh, a scene file, a gaze field or rays; name at least one")
    recordings = None if sources.rays is None else open_recordings(sources.rays)
    rays = None if recordings is None else open_rays(recordings, MAX_SCENE_RAYS)
    rays_file = Path(sources.rays) if isinstance(sources.rays, (str, os.PathLike)) else None
    if isinstance(recordings, RayDataset):
        rays_file = None  # The scene shows a sample.
    gaze = None if sources.gaze is None else GazeField.open(sources.gaze)
    opened = _open_environment(sources.environment, gaze, rays, reporter)
    placed = opened.align if align is None else open_similarity(align, "rays to place", reporter.warn)
    return ShownObjects(opened, gaze, recordings, rays, rays_file, placed)


def _plan_files(shown: ShownObjects, output: Path) -> list[Path]:
    """Return the files next to ``output`` that can be named in advance."""
    rays = [output.with_suffix(".rays.npz")] if shown.rays is not None and shown.rays_file is None else []
    return [*rays, output.with_suffix(".vol"), colors_path(output)] if shown.environment.kind == "hits" else rays


def _open_environment(
    environment: AnyEnvironment, gaze: GazeField | None, rays: Rays | None, reporter: Reporter
) -> Environment:
    """Open the environment of a scene, by default that of the training of ``gaze``, or the hit points of ``rays``."""
    word = str(environment) if isinstance(environment, (str, os.PathLike)) else ""
    if gaze is not None and (environment is None or word in ("hits", "none")):
        return gaze.open_environment(environment)
    if environment is not None and word not in ("hits", "none"):
        opened = Environment.open(environment)
        if gaze is None:
            return opened
        gaze.warn_environment(opened, reporter)
        return replace(opened, align=read_training_alignment(gaze.provenance))
    if rays is None:
        raise NergError(f"{parameter('environment', word)} needs rays; name their file")
    has_hits = rays.hit is not None and bool(np.isfinite(rays.hit).all(axis=1).any())
    if word == "none" or not (word or has_hits):
        return no_geometry(rays.origin)
    made = make_hit_geometry(rays)
    size = made.metadata["geometry_file"]
    shape = " x ".join(map(str, size["shape"]))
    reporter.message(f"the geometry is built from the hit points of the rays: {shape} voxels of {size['voxel']:.3g} m")
    return made


def _show_environment(shown: ShownObjects, reporter: Reporter) -> SceneContent:
    """Return the content of the scene in memory, and report what is not used of its file."""
    content, path = shown.environment.to_scene_content(), shown.environment.path
    name = "the environment" if path is None else path
    # Gaze is replaced, and never only lost.
    replaced_by = dict(zip(GAZE_PROPERTIES, (shown.gaze, shown.gaze or shown.rays)))
    for part in content.left_out:
        if part in replaced_by and replaced_by[part] is None:
            raise NergError(
                f'"{name}" already has the "{part}" of an observer; use it as it is, or also name the gaze field to '
                "show in its place"
            )
    left_out = [part for part in content.left_out if part != "aovs"]
    unused = [f"not used of its integrator: {', '.join(left_out)}"] if left_out else []
    for note in (*shown.environment.notes, *unused):
        reporter.message(f"{name}: {note}")
    return content


def _find_up(shown: ShownObjects, up: Sequence[float] | None) -> np.ndarray:
    """Return the up direction: as given, that of the rays, that of the radiance field, or +z."""
    direction: Any = up
    is_tracked = shown.rays is not None or (shown.gaze is not None and "rays_file" in shown.gaze.provenance)
    if direction is None and (is_tracked or not shown.align.is_identity):
        direction = shown.align.matrix[:3, 2] / shown.align.scale
    if direction is None:
        direction = shown.environment.provenance.get("up", (0.0, 0.0, 1.0))
    direction = np.asarray(direction, float)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise NergError(f"up must be a direction, three numbers that are not all 0; give {parameter('up', 'x,y,z')}")
    return direction / length


# ---- A scene in memory, and its camera ----


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """A scene in memory: what it shows, its ``text`` with camera and observer, and the ``walk`` of the observer."""

    shown: ShownObjects
    text: SceneText
    walk: ObserverPath | None = None

    def load(self, **defaults: object) -> Any:
        """Load the scene with Mitsuba, with values of its `<default>`s by their names in a scene of `write_scene`."""
        content = self.text.content
        values = {free_default_name(name, content.reserved_names): str(value) for name, value in defaults.items()}
        return load_scene_text(self.text.to_xml(), values, load_objects(self.volumes), load_objects(content.shapes))

    @property
    def volumes(self) -> dict[str, Any]:
        """What has no file, by name, as in `SceneContent`: children of the integrator."""
        volumes, gaze = dict(self.text.content.volumes), self.text.gaze_files
        if isinstance(gaze.gaze, GazeField):
            volumes["gaze"] = FieldVolume(gaze.gaze, "gaze")
        if isinstance(gaze.rays, Rays):
            volumes["kde"] = make_kde_volume(gaze.rays, gaze.align)
        return volumes

    def save(self, output: Path, reporter: Reporter) -> WrittenScene:
        """Write the scene file ``output``, and what has no file next to it. Raises `NergError`."""
        shown, written = self.shown.save_beside(output, reporter)
        content = shown.environment.to_scene_content(output)
        text = replace(self.text, content=content, gaze_files=shown.gaze_files)
        write_text(output, replace(text, comment=_describe_scene(output, text)).to_xml(output.parent))
        return WrittenScene(
            output,
            (output, *written, *content.written),
            shown.environment,
            shown.gaze,
            text.camera,
            text.observer,
            text.gaze_files.quantity,
            0,
            content.reserved_names,
        )


def place_scene(
    shown: ShownObjects,
    observers: ObserverChoice,
    cameras: CameraChoice,
    width: int,
    up: Sequence[float] | None = None,
    reporter: Reporter = SILENT,
) -> PlacedScene:
    """Place the observer and the camera in a scene in memory; Mitsuba must be active.

    Raises `NergError` if they cannot be placed, or the image would be empty.
    """
    content = _show_environment(shown, reporter)
    reporter.progress(0.1, "placing the observer")
    person, has_surfaces = observers.person, shown.environment.has_surfaces
    placed = observers.place(shown.select_person(person), shown.gaze, shown.align, has_surfaces, reporter)
    upward = _find_up(shown, up)
    eye = None if placed.eye is None else make_upright(placed.eye, upward)
    # With a preliminary camera; the unit is that of the rays if there is gaze.
    first = eye or make_upright(LookAt(np.zeros(3), upward), upward)
    unit = 1.0 if shown.gaze_files.quantity is None else shown.align.scale
    text = SceneText(content, shown.gaze_files, first, eye, upward, unit=unit, observer_comment=placed.note)
    draft = PlacedScene(shown, replace(text, width=PROBE_SIZE[0]), placed.walk)
    draft = _place_camera(draft, placed.walk is None and person is None, cameras, reporter)
    return replace(draft, text=replace(draft.text, width=width))


def _place_camera(draft: PlacedScene, is_turned: bool, cameras: CameraChoice, reporter: Reporter) -> PlacedScene:
    """Return the scene with its extent, and its camera; the observer is turned to its attention if ``is_turned``."""
    environment, text = draft.shown.environment, draft.text
    up, observer = text.up, text.observer
    probe = SceneProbe(draft.load(**probe_values()), text.gaze_files.quantity, up)
    reporter.progress(0.3, "probing the surroundings")
    seen = None if observer is None else probe.around(observer)
    if sentence := describe_observer(probe.scene):
        reporter.warn(sentence)
    elif seen is not None and not seen.is_hit.any() and environment.has_surfaces:
        reporter.warn(f"the observer sees no surface; move it with {parameter('observer')}, or check the alignment")
    if observer is not None and seen is not None and is_turned:
        observer = make_upright(turn_to_attention(observer, seen), up)
    reporter.progress(0.5, "searching for the best camera")
    placed = cameras.place(environment, observer, probe, seen, reporter)
    eye = make_upright(placed.eye, up)
    extent = probe.extent(eye, observer)
    if environment.kind == "scene" and extent < SMALLEST:
        reporter.warn(
            f"the scene is {extent:.3g} units large, and Mitsuba offsets rays from surfaces by at least 1e-4 units, so "
            "light leaks through walls; scale the scene to metres"
        )
    reporter.progress(0.8, "checking the image")
    text = replace(text, camera=eye, observer=observer, lens=placed.lens, extent=extent, camera_comment=placed.note)
    draft = replace(draft, text=text)
    if not sees_anything(draft.load(**probe_values())):
        raise NergError(
            f"the image of the camera would be empty; choose another one with {parameter('camera')} and "
            f"{parameter('target')}"
        )
    return draft


def _describe_scene(output: Path, text: SceneText) -> str:
    """Return the first comment of the file."""
    gaze = {"gaze": "with the gaze of an observer", "kde": "with the recorded gaze around an observer", None: ""}
    what = f"{text.content.subject} {gaze[text.gaze_files.quantity]}".rstrip() + "."
    unit = f"One metre is {text.unit:.4g} units." if abs(text.unit - 1) > 1e-4 else ""
    names = text.content.reserved_names
    spp, camera = free_default_name("spp", names), free_default_name("camera", names)
    example = f'-D {spp}=64 -D {camera}="{format_numbers(text.camera.origin)}"'
    sensors = "Sensors: 0 a camera, 1 the observer's view, 2 the observer's sphere."
    if text.observer is None:
        sensors = "Sensors: 0 a camera, which is the observer; 1 the same view; 2 all directions around it."
    return (
        f"{what} {unit}\n{sensors}\nEvery default can be set from the command line: "
        f"nerg render {output.name} -o out.png {example}"
    )


def _make_frames(walk: ObserverPath, first_person: bool, taken: frozenset[str]) -> list[dict[str, str]]:
    names = ["eye", "ahead", *(["camera", "target"] if first_person else [])]
    rows = []
    for eye in walk.eyes:
        values = [format_numbers(eye.origin), format_numbers(eye.target)] * 2
        rows.append({free_default_name(name, taken): value for name, value in zip(names, values)})
    return rows
