"""Writing of a scene file for fields, meshes, splats or rays, with a camera and an observer."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.environment.environment import make_hit_geometry
from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.overview import PinholeFrame, SeenSurfaces
from nerg_mi.files.atomic import check_writable, write_text
from nerg_mi.formats.fields import load_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import Conditions, RayDataset, is_dataset, load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import write_frames
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import (
    GazeFiles,
    Lens,
    LookAt,
    SceneText,
    check_attribute,
    format_numbers,
    free_default_name,
    relative_path,
)

from .base import select_backend
from .render import describe_observer
from .scene_cameras import (
    ObserverPath,
    SceneProbe,
    check_point,
    find_best_camera,
    find_best_photo,
    find_eye,
    interpolate_walk,
    make_upright,
    probe_values,
    sees_anything,
    support_of_rays,
    to_scene_frame,
    turn_to_attention,
)
from .scene_commands import SceneOptions
from .scene_environments import (
    InputFiles,
    WrittenGeometry,
    colors_path,
    load_photo_camera,
    load_photo_cameras,
    recognise,
    write_scene_geometry,
)

# ---- Rays of a scene: those of a file, or a sample of a dataset, stored next to the scene ----


MAX_SCENE_RAYS = 1_000_000
"""Maximum number of rays of a dataset in a scene."""


@dataclass(frozen=True, eq=False)
class SceneRays:
    """Rays of a scene.

    Attributes
    ----------
    rays
        The rays, or None.
    file
        Their file, which the scene refers to, or None.
    written_files
        Written files.
    dataset
        The dataset of which ``rays`` are a sample, or None.
    """

    rays: Rays | None
    file: Path | None
    written_files: tuple[Path, ...] = ()
    dataset: Path | None = None

    def select_person(self, person: str) -> Rays | None:
        """Return rays in which to look up a ``person``: of a dataset all of theirs, not only the sample."""
        if self.dataset is None:
            return self.rays
        return RayDataset.open(self.dataset).load(Conditions(persons=[person]))


def check_rays(rays_file: Path | None, scene: Path) -> None:
    """Raise `NergError` if the rays of a dataset cannot be written next to the ``scene``."""
    if rays_file is not None and is_dataset(rays_file):
        check_writable(_rays_file(scene))


def load_scene_rays(rays_file: Path | None, scene: Path, reporter: Reporter) -> SceneRays:
    """Load the rays of the file or dataset ``rays_file``.

    Of a dataset, a uniform sample of at most `MAX_SCENE_RAYS` is written next to the ``scene``, which can only read
    files.
    """
    if rays_file is None or not is_dataset(rays_file):
        return SceneRays(None if rays_file is None else Rays.load(rays_file), rays_file)
    path, rays = _rays_file(scene), load_rays(rays_file, max_rays=MAX_SCENE_RAYS)
    rays.save(path)
    reporter.message(f'the scene shows {len(rays):,} rays of "{rays_file}", stored next to it')
    return SceneRays(rays, path, (path,), rays_file)


def _rays_file(scene: Path) -> Path:
    return scene.with_suffix(".rays.npz")


# ---- Writing a scene file ----


SMALLEST = 0.05
"""Smallest extent in scene units with accurate lighting: rays start about 1e-4 units off a surface."""


@dataclass(frozen=True)
class SceneResult:
    """A written scene.

    Attributes
    ----------
    path
        Scene file.
    files
        All written files.
    camera, observer
        Positions and targets in scene coordinates; without an observer, the camera is the observer.
    quantity
        AOV of attention, or None.
    frames
        Number of frames of a walk.
    taken
        Names of `<default>`s that another file defines.
    """

    path: Path
    files: tuple[Path, ...]
    camera: LookAt
    observer: LookAt | None
    quantity: str | None
    frames: int = 0
    taken: frozenset[str] = frozenset()


def write_scene(
    files: Sequence[str | Path], output: str | Path, options: SceneOptions | None = None, reporter: Reporter = SILENT
) -> SceneResult:
    """Write a scene file for a scene, a gaze field or rays.

    Parameters
    ----------
    files
        A radiance field, splats, a mesh (.ply, .obj, .glb), a scene (.xml) or hit points (.vol); a gaze field; rays; in
        any order. For a gaze field alone, the geometry of its training is looked up next to it.
    output
        Scene file (.xml).
    options
        Camera, observer and alignment.
    reporter
        Receives messages and progress.

    Raises
    ------
    NergError
        For errors that the user can correct.

    Notes
    -----
    The scene has the sensors and `<default>`s of the demo store: sensor 0 is a camera, 1 the observer's view, 2 the
    observer's sphere. File names are relative to the folder of the scene where possible. Of a dataset of rays, a
    uniform sample of at most a million is written next to the scene.
    """
    options, output = options or SceneOptions(), Path(output)
    check_writable(output, ".xml")
    _check_options(options)
    frames_file = output.with_suffix(".frames.csv")
    if options.time_range is not None:
        check_writable(frames_file)
    reporter.progress(0.0, "reading the files")
    inputs = recognise([Path(file) for file in files], options.geometry, reporter)
    check_rays(inputs.rays, output)
    if inputs.kind == "hits":
        check_writable(colors_path(output))
        check_writable(output.with_suffix(".vol") if inputs.environment is None else output)
    ns = select_backend(options.mode)
    align = (
        inputs.align
        if options.align is None
        else read_similarity(options.align, parameter("align"), "rays to place", reporter.warn)
    )
    scene_rays = load_scene_rays(inputs.rays, output, reporter)
    inputs, rays = replace(inputs, rays=scene_rays.file), scene_rays.rays
    inputs, made = _with_hits(inputs, rays, output, reporter)
    environment = write_scene_geometry(inputs, output)
    for note in environment.notes:
        reporter.message(f"{inputs.environment}: {note}")
    up = _up(inputs, align, options)
    reporter.progress(0.1, "placing the observer")
    person_rays = rays if options.person is None else scene_rays.select_person(options.person)
    observer, walk, observer_note = _observer(inputs, person_rays, align, ns, options, reporter)
    observer = None if observer is None else make_upright(observer, up)
    tracked = inputs.gaze is not None or inputs.rays is not None
    scene = _Draft(inputs, environment, align, up, observer, tracked)
    with tempfile.TemporaryDirectory() as folder:
        # The same scene with a preliminary camera, for probing.
        probe_file = Path(folder) / "scene.xml"
        write_text(
            probe_file,
            scene.text(probe_file.parent, observer or make_upright(LookAt(np.zeros(3), up), up), Lens(), 96).to_xml(),
        )
        taken = environment.make(probe_file.parent, scene.center).reserved_names
        values = {free_default_name(name, taken): value for name, value in probe_values().items()}
        probe = SceneProbe(load_scene(probe_file, values), scene.attention(probe_file.parent).quantity, up)
        reporter.progress(0.3, "probing the surroundings")
        seen = None if observer is None else probe.around(observer)
        if sentence := describe_observer(probe.scene):
            reporter.warn(sentence)
        elif seen is not None and observer is not None and not seen.is_hit.any() and inputs.kind != "none":
            reporter.warn(f"the observer sees no surface; move it with {parameter('observer')}, or check the alignment")
        if observer is not None and seen is not None and walk is None and options.person is None:
            observer = make_upright(turn_to_attention(observer, seen), up)
            scene = replace(scene, observer=observer)
        reporter.progress(0.5, "searching for the best camera")
        camera, lens, camera_note = _camera(scene, probe, seen, options, reporter)
        camera = make_upright(camera, up)
        scene = replace(scene, extent=probe.extent(camera, scene.observer))
        if inputs.kind == "scene" and scene.extent < SMALLEST:
            reporter.warn(
                f"the scene is {scene.extent:.3g} units large, and Mitsuba offsets rays from surfaces by at least "
                "1e-4 units, so light leaks through walls; scale the scene to metres"
            )
        reporter.progress(0.8, "checking the image")
        write_text(probe_file, scene.text(probe_file.parent, camera, lens, 96).to_xml())
        probed = load_scene(probe_file, values)
        if not sees_anything(probed):
            raise NergError(
                f"the image of the camera would be empty; choose another one with {parameter('camera')} and "
                f"{parameter('target')}"
            )
    text = scene.text(output.parent, camera, lens, options.width)
    text = replace(
        text,
        comment=_describe_scene(output, text, environment, scene),
        camera_comment=camera_note,
        observer_comment=observer_note,
    )
    write_text(output, text.to_xml())
    written = [output, *scene_rays.written_files, *made, *environment.files]
    if walk is not None:
        write_frames(frames_file, _frames(walk, options.first_person, text.content.reserved_names))
        written.append(frames_file)
        missing = f"; {walk.missing} more have no rays within {options.max_gap:g} s" if walk.missing else ""
        reporter.message(f"{len(walk.eyes)} frames{missing}: nerg render {output} -o walk.png --frames {frames_file}")
    for sentence in (observer_note, camera_note):
        if sentence:
            reporter.message(sentence)
    for path in written:
        reporter.message(f"wrote {path}")
    quantity = text.gaze_files.quantity
    count = 0 if walk is None else len(walk.eyes)
    return SceneResult(output, tuple(written), camera, observer, quantity, count, text.content.reserved_names)


@dataclass(frozen=True, eq=False)
class _Draft:
    """A scene without its camera."""

    inputs: InputFiles
    environment: WrittenGeometry
    align: Similarity
    up: np.ndarray
    observer: LookAt | None
    tracked: bool
    extent: float = 10.0

    @property
    def unit(self) -> float:
        """Scene units per metre if there is tracking, else 1."""
        return self.align.scale if self.tracked else 1.0

    def attention(self, folder: Path) -> GazeFiles:
        """Return the files of attention by their names relative to ``folder``."""
        name = lambda path: None if path is None else check_attribute(relative_path(path, folder))
        align = None if self.align.is_identity else self.align.matrix
        return GazeFiles(name(self.inputs.gaze), name(self.inputs.rays), align)

    @property
    def center(self) -> str:
        """Name of the `<default>` of the observer's position."""
        return "camera" if self.observer is None else "eye"

    def text(self, folder: Path, camera: LookAt, lens: Lens, width: int) -> SceneText:
        """Return the scene as written to ``folder``."""
        environment = self.environment.make(folder, self.center)
        return SceneText(
            environment, self.attention(folder), camera, self.observer, self.up, lens, width, self.unit, self.extent
        )


def _check_options(options: SceneOptions) -> None:
    """Raise `NergError` for options that contradict or need each other."""
    moment = options.time is not None or options.time_range is not None
    if moment != (options.person is not None) or (options.time is not None and options.time_range is not None):
        raise NergError(
            f"{parameter('person')} needs one of {parameter('time')} and {parameter('time_range')}, and these need "
            f"{parameter('person')}; give both, or neither"
        )
    if options.person is not None and options.observer is not None:
        raise NergError(
            f"{parameter('observer')} and {parameter('person')} both place the observer; leave out one of them"
        )
    if options.photo is not None and options.photos is None:
        raise NergError(f"{parameter('photo')} needs the photos of the training; add {parameter('photos', 'DATASET')}")
    cameras = [options.camera is not None, options.photos is not None, options.first_person]
    if sum(cameras) > 1 or (options.target is not None and options.camera is None):
        raise NergError(
            f"the camera is set by {parameter('camera')} and {parameter('target')}, by {parameter('photos')} or by "
            f"{parameter('first_person', True)}; give one of these"
        )
    if options.time_range is not None and len(options.time_range) != 2:
        raise NergError(f"{parameter('time_range')} must be two times A,B, got {len(options.time_range)}")
    for name in ("observer", "camera", "target", "up"):
        check_point(getattr(options, name), parameter(name))


def _with_hits(
    inputs: InputFiles, rays: Rays | None, output: Path, reporter: Reporter
) -> tuple[InputFiles, tuple[Path, ...]]:
    """Build a geometry of hit points if rays alone are shown in it; also return its file."""
    if inputs.kind != "hits" or inputs.environment is not None:
        return inputs, ()
    if rays is None:
        raise NergError(f"{parameter('geometry', 'hits')} needs rays; name their file")
    path = output.with_suffix(".vol")
    made = make_hit_geometry(rays, path).metadata["geometry_file"]
    size = " x ".join(map(str, made["shape"]))
    reporter.message(f"the geometry is built from the hit points of the rays: {size} voxels of {made['voxel']:.3g} m")
    return replace(inputs, environment=path), (path,)


def _up(inputs: InputFiles, align: Similarity, options: SceneOptions) -> np.ndarray:
    """Return the up direction: as given, that of the rays, that of the radiance field, or +z."""
    up = check_point(options.up, parameter("up"))
    if up is None and (inputs.rays is not None or "rays_file" in inputs.gaze_provenance or not align.is_identity):
        up = align.matrix[:3, 2] / align.scale
    if up is None:
        stored = inputs.field_metadata.get("provenance", {}).get("up")
        up = np.array([0.0, 0, 1]) if stored is None else np.asarray(stored, float)
    length = float(np.linalg.norm(up))
    if up.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise NergError(f"up must be a direction, three numbers that are not all 0; give {parameter('up', 'x,y,z')}")
    return up / length


def _observer(
    inputs: InputFiles, rays: Rays | None, align: Similarity, ns, options: SceneOptions, reporter: Reporter
) -> tuple[LookAt | None, ObserverPath | None, str]:
    """Return the observer, its walk, and a sentence on them."""
    point = check_point(options.observer, parameter("observer"))
    if point is not None:
        return (
            LookAt(point, point + np.array([1.0, 0, 0])),
            None,
            "The observer's eye as given, turned to the main direction of gaze.",
        )
    if options.person is not None:
        if rays is None:
            raise NergError(f"{parameter('person')} needs rays; name their file")
        if options.time_range is not None:
            first, last = options.time_range
            walk = interpolate_walk(rays, options.person, first, last, options.fps, options.max_gap, align)
            middle = len(walk.eyes) // 2
            note = f"The eye of {options.person} at {walk.times[middle]:.6g} s, the middle of the walk."
            return walk.eyes[middle], walk, note
        assert options.time is not None
        eye, when = find_eye(rays, options.person, options.time, options.max_gap, align)
        return eye, None, f"The eye of {options.person} at {when:.6g} s, and a point ahead of it."
    if rays is not None:
        at = to_scene_frame(support_of_rays(rays).find_densest_position(), align)
        return (
            LookAt(at, at + align.matrix[:3, 0]),
            None,
            "The observer where the density of rays is highest, turned to the main direction of gaze.",
        )
    if inputs.gaze is not None:
        support = load_gaze(inputs.gaze, ns)[0].support
        if support is not None:
            at = support.find_densest_position()
            words = "The observer where the support of the gaze field is highest, turned to the main direction of gaze."
            return LookAt(at, at + np.array([1.0, 0, 0])), None, words
        if inputs.kind == "none":
            raise NergError(
                f'"{inputs.gaze}" stores neither geometry nor recorded positions; place the observer with '
                f"{parameter('observer')}"
            )
        reporter.message(
            f"no recorded positions are known: the camera is the observer; use {parameter('observer', 'x,y,z')} to "
            "place one"
        )
    return None, None, ""


def _camera(
    scene: _Draft, probe: SceneProbe, seen: SeenSurfaces | None, options: SceneOptions, reporter: Reporter
) -> tuple[LookAt, Lens, str]:
    """Return the camera, its lens, and a sentence on how they were chosen."""
    lens = Lens() if options.fov is None else Lens(options.fov)
    if options.photos is not None:
        provenance, outside = scene.inputs.field_metadata.get("provenance", {}), options.allow_outside
        if options.photo is None:
            photo = find_best_photo(probe, seen, load_photo_cameras(options.photos, provenance, outside))
            words = f"that of the photo {photo.name}, which has the best view"
        else:
            photo = load_photo_camera(options.photos, options.photo, provenance, outside)
            words = f"that of the photo {photo.name}"
        if photo.has_distortion:
            reporter.message(f"the lens of {photo.name} has distortion, which this camera has not")
        lens = photo.lens if options.fov is None else replace(photo.lens, fov=options.fov)
        return photo.eye, lens, f"The camera of sensor 0: {words}."
    origin, target = check_point(options.camera, parameter("camera")), check_point(options.target, parameter("target"))
    if origin is not None:
        if target is None:
            target = None if seen is None else seen.mean_target()
        if target is None:
            target = np.mean(probe.bounds(), axis=0)
        return LookAt(origin, target), lens, "The camera of sensor 0, and its target."
    if options.first_person or (scene.inputs.kind == "none" and scene.observer is not None):
        if scene.observer is None:
            raise NergError(
                f"{parameter('first_person', True)} needs an observer; add {parameter('observer')} or "
                f"{parameter('person')}"
            )
        return scene.observer, lens, "The camera of sensor 0: the observer's eye."
    frame = PinholeFrame(lens.fov, lens.aspect, scene.up)
    box = scene.inputs.field_metadata.get("box") if scene.inputs.kind == "field" else None
    shot = find_best_camera(probe, seen, frame, box)
    if shot is None:
        raise NergError(
            f"no camera position with a view of the scene was found; set one with {parameter('camera')} and "
            f"{parameter('target')}"
        )
    whose = "what the observer looks at" if probe.quantity else "the surroundings of the observer"
    attended = "" if shot.attention_share is None else f" and {100 * shot.attention_share:.0f} % of {whose}"
    words = f"The camera of sensor 0: the best overview; it shows surfaces in {100 * shot.surface_fraction:.0f} %"
    if scene.inputs.kind == "field" and seen is None:
        reporter.message(
            f"a field looks best from the positions of its photos: {parameter('photos', 'DATASET')} uses the "
            "camera of one of them"
        )
    return LookAt(shot.origin, shot.target), lens, f"{words} of the image{attended}."


def _describe_scene(output: Path, text: SceneText, environment: WrittenGeometry, scene: _Draft) -> str:
    """Return the first comment of the file."""
    gaze = {"gaze": "with the gaze of an observer", "kde": "with the recorded gaze around an observer", None: ""}
    what = f"{environment.words} {gaze[text.gaze_files.quantity]}".rstrip() + "."
    unit = f"One metre is {scene.unit:.4g} units." if scene.tracked and abs(scene.unit - 1) > 1e-4 else ""
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


def _frames(walk: ObserverPath, first_person: bool, taken: frozenset[str]) -> list[dict[str, str]]:
    names = ["eye", "ahead", *(["camera", "target"] if first_person else [])]
    rows = []
    for eye in walk.eyes:
        values = [format_numbers(eye.origin), format_numbers(eye.target)] * 2
        rows.append({free_default_name(name, taken): value for name, value in zip(names, values)})
    return rows
