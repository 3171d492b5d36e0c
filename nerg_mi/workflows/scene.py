"""Writing a scene file for fields, meshes, splats or rays, with a camera and an observer."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.figures.overview import PinholeFrame, SeenSurfaces
from nerg_mi.files.atomic import check_writable, write_text
from nerg_mi.formats.fields import load_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.dataset import Conditions, RayDataset, is_dataset, load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import write_frames
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import (
    LookAt,
    GazeFiles,
    Lens,
    SceneText,
    free_default_name,
    format_numbers,
    relative_path,
    check_attribute,
)
from nerg_mi.train.geometry import make_hit_geometry

from .base import SILENT, Reporter, select_backend
from .scene_cameras import (
    ObserverPath,
    SceneProbe,
    find_best_camera,
    find_best_photo,
    find_eye,
    check_point,
    probe_values,
    sees_anything,
    support_of_rays,
    to_scene_frame,
    turn_to_attention,
    make_upright,
    interpolate_walk,
)
from .scene_commands import SceneOptions
from .scene_places import (
    LAMP,
    InputFiles,
    WrittenGeometry,
    load_photo_camera,
    load_photo_cameras,
    colors_path,
    write_scene_geometry,
    recognise,
)

# ---- Rays that a scene shows: those of a file, or some of a dataset, which are kept in a file beside the scene ----


MAX_SCENE_RAYS = 1_000_000
"""Rays of a dataset that a scene shows, at most."""


@dataclass(frozen=True, eq=False)
class SceneRays:
    """``rays`` and the ``file`` of them that the scene names, None where there are none; ``made``: files that were
    written; ``dataset``: what the rays are of, if they are some of a dataset."""

    rays: Rays | None
    file: Path | None
    written_files: tuple[Path, ...] = ()
    dataset: Path | None = None

    def select_person(self, person: str) -> Rays | None:
        """The rays to look a ``person`` up in: of a dataset all of theirs, since a sample lacks most moments."""
        if self.dataset is None:
            return self.rays
        return RayDataset.open(self.dataset).load(Conditions(persons=[person]))


def check_rays(given: Path | None, scene: Path) -> None:
    """Raise `NergError` where rays of a dataset cannot be written beside the ``scene``."""
    if given is not None and is_dataset(given):
        check_writable(_file_beside(scene))


def load_scene_rays(given: Path | None, scene: Path, reporter: Reporter) -> SceneRays:
    """The rays of the file or dataset ``given``; of a dataset `MOST` at most, each as likely as any other, are written
    beside the ``scene``, which reads files alone."""
    if given is None or not is_dataset(given):
        return SceneRays(None if given is None else Rays.load(given), given)
    path, rays = _file_beside(scene), load_rays(given, max_rays=MAX_SCENE_RAYS)
    rays.save(path)
    reporter.message(f'the scene shows {len(rays):,} rays of "{given}", kept beside it')
    return SceneRays(rays, path, (path,), given)


def _file_beside(scene: Path) -> Path:
    return scene.with_suffix(".rays.npz")


# ---- From checkpoints, meshes and rays to a scene file that `nerg render` renders ----


SMALLEST = 0.05
"""Places of shapes below this extent, in units, are lit inexactly: a surface's rays begin some 1e-4 units off it."""


@dataclass(frozen=True)
class SceneResult:
    """``path``: the scene; ``files``: all that was written; ``camera``, ``observer``: where they are and what they look
    at, in the place's coordinates (no observer: the camera is it); ``quantity``: the AOV of attention, or None;
    ``frames``: how many of a walk there are; ``taken``: names of `<default>`s that another file has taken."""

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
    """Write the scene file ``output`` (.xml) of a place, a gaze field or rays, of which ``files`` are, in any order.

    A place is a radiance field, a mesh (.ply, .obj, .glb), a scene (.xml) or hit points (.vol); of a gaze field without
    one it is what that was trained in, found beside it. The scene has the sensors and the `<default>`s of the demo
    store's: sensor 0 is a camera, 1 the observer's own view, 2 all that the observer could turn to. Names of files are
    relative to the scene's folder where that is possible. Of a dataset of rays a million at most, a fair sample, are
    written beside the scene. Raises `NergError` for what the user can mend.
    """
    options, output = options or SceneOptions(), Path(output)
    check_writable(output, ".xml")
    _check_options(options)
    frames_file = output.with_suffix(".frames.csv")
    if options.time_range is not None:
        check_writable(frames_file)
    reporter.progress(0.0, "reading the files")
    given = recognise([Path(file) for file in files], options.geometry, reporter)
    check_rays(given.rays, output)
    if given.kind == "hits":
        check_writable(colors_path(output))
        check_writable(output.with_suffix(".vol") if given.place is None else output)
    ns = select_backend(options.mode)
    align = given.align if options.align is None else read_similarity(options.align, "--align", "rays to place")
    found = load_scene_rays(given.rays, output, reporter)
    given, rays = replace(given, rays=found.file), found.rays
    given, made = _with_hits(given, rays, output, reporter)
    place = write_scene_geometry(given, output)
    for note in place.notes:
        reporter.message(f"of {given.place}: {note}")
    up = _up(given, align, options)
    reporter.progress(0.1, "placing the observer")
    theirs = rays if options.person is None else found.select_person(options.person)
    observer, walk, about = _observer(given, theirs, align, ns, options, reporter)
    observer = None if observer is None else make_upright(observer, up)
    tracked = given.gaze is not None or given.rays is not None
    scene = _Draft(given, place, align, up, observer, tracked)
    with tempfile.TemporaryDirectory() as folder:
        # The same scene, with a camera anywhere, to look around in.
        probe_file = Path(folder) / "scene.xml"
        write_text(
            probe_file, scene.text(probe_file.parent, observer or make_upright(LookAt(np.zeros(3), up), up), Lens(), 96).to_xml()
        )
        taken = place.make(probe_file.parent, scene.lamps(1, 1)).reserved_names
        values = {free_default_name(name, taken): value for name, value in probe_values().items()}
        probe = SceneProbe(load_scene(probe_file, values), scene.attention(probe_file.parent).quantity, up)
        reporter.progress(0.3, "looking around")
        seen = None if observer is None else probe.around(observer)
        if seen is not None and observer is not None and not seen.is_hit.any() and given.kind != "none":
            reporter.warn("the observer meets no surface at all; give --observer another place, or check the alignment")
        if observer is not None and seen is not None and walk is None and options.person is None:
            observer = make_upright(turn_to_attention(observer, seen), up)
            scene = replace(scene, observer=observer)
        reporter.progress(0.5, "looking for the best overview")
        camera, lens, chosen = _camera(scene, probe, seen, options, reporter)
        camera = make_upright(camera, up)
        usual = seen.median_depth if seen is not None and seen.median_depth > 0 else 0.0
        away = float(np.linalg.norm(camera.target - camera.origin))
        scene = replace(scene, usual=(max(away, usual), usual), extent=probe.extent(camera, scene.observer))
        if given.kind in ("mesh", "scene") and scene.extent < SMALLEST:
            reporter.warn(
                f"the place is {scene.extent:.3g} units large, and Mitsuba moves rays off surfaces by 1e-4 units at "
                "least, so that light leaks through walls; scale the place to metres"
            )
        reporter.progress(0.8, "looking at the picture")
        write_text(probe_file, scene.text(probe_file.parent, camera, lens, 96).to_xml())
        if not sees_anything(load_scene(probe_file, values)):
            raise NergError(
                "the camera shows nothing of the place, and its picture would be empty; give another one with --from "
                "and --to"
            )
    text = scene.text(output.parent, camera, lens, options.width)
    text = replace(text, comment=_about(output, text, place, scene), camera_comment=chosen, observer_comment=about)
    write_text(output, text.to_xml())
    written = [output, *found.written_files, *made, *place.files]
    if walk is not None:
        write_frames(frames_file, _frames(walk, options.first_person, text.content.reserved_names))
        written.append(frames_file)
        missing = f"; {walk.missing} more have no rays within {options.max_gap:g} s" if walk.missing else ""
        reporter.message(f"{len(walk.eyes)} frames{missing}: nerg render {output} -o walk.png --frames {frames_file}")
    for sentence in (about, chosen):
        if sentence:
            reporter.message(sentence)
    for path in written:
        reporter.message(f"wrote {path}")
    quantity = text.gaze_files.quantity
    count = 0 if walk is None else len(walk.eyes)
    return SceneResult(output, tuple(written), camera, observer, quantity, count, text.content.reserved_names)


@dataclass(frozen=True, eq=False)
class _Draft:
    """A scene but for its camera."""

    given: InputFiles
    place: WrittenGeometry
    align: Similarity
    up: np.ndarray
    observer: LookAt | None
    tracked: bool
    # How far away things are usually from the camera and from the observer, for lamps.
    usual: tuple[float, float] = (1.0, 1.0)
    extent: float = 10.0

    @property
    def unit(self) -> float:
        """Scene units of a metre, where tracking tells; else 1."""
        return self.align.scale if self.tracked else 1.0

    def attention(self, folder: Path) -> GazeFiles:
        """What is shown of attention, by the names that files have in ``folder``."""
        name = lambda path: None if path is None else check_attribute(relative_path(path, folder))
        align = None if self.align.is_identity else self.align.matrix
        return GazeFiles(name(self.given.gaze), name(self.given.rays), align)

    def lamps(self, camera: float, eye: float) -> dict[str, float]:
        """Intensities of lamps by the `<default>` that says where they are."""
        if self.observer is None:
            return {"camera": LAMP * camera**2}
        return {"eye": LAMP * max(eye, 0.1 * camera) ** 2, "camera": 0.5 * LAMP * camera**2}

    def text(self, folder: Path, camera: LookAt, lens: Lens, width: int) -> SceneText:
        """The scene in ``folder``."""
        place = self.place.make(folder, self.lamps(*self.usual))
        return SceneText(
            place, self.attention(folder), camera, self.observer, self.up, lens, width, self.unit, self.extent
        )


def _check_options(options: SceneOptions) -> None:
    """Raise `NergError` for options that contradict each other, or need others."""
    moment = options.time is not None or options.time_range is not None
    if moment != (options.person is not None) or (options.time is not None and options.time_range is not None):
        raise NergError("whose eye it is takes --person and one of --time and --times; give both, or neither")
    if options.person is not None and options.observer is not None:
        raise NergError("the observer is either at --observer or a --person; leave out one of them")
    if options.photo is not None and options.photos is None:
        raise NergError("--photo is one of the photos that the field was trained on; give these, --photos DATASET")
    ways = [options.camera is not None, options.photos is not None, options.first_person]
    if sum(ways) > 1 or (options.target is not None and options.camera is None):
        raise NergError("a camera is given by --from and --to, by --photo or by --own; give one of these")
    if options.time_range is not None and len(options.time_range) != 2:
        raise NergError(f"--times is two times, A,B, got {len(options.time_range)}")


def _with_hits(
    given: InputFiles, rays: Rays | None, output: Path, reporter: Reporter
) -> tuple[InputFiles, tuple[Path, ...]]:
    """``given`` with the place made of hit points where rays alone are shown in these, and the file of it."""
    if given.kind != "hits" or given.place is not None:
        return given, ()
    if rays is None:
        raise NergError("--geometry hits shows rays in their hit points, and there are no rays; name their file")
    path = output.with_suffix(".vol")
    made = make_hit_geometry(rays, path).metadata["geometry_file"]
    size = " x ".join(map(str, made["shape"]))
    reporter.message(f"the place is made of the rays' hit points: {size} voxels of {made['voxel']:.3g} m")
    return replace(given, place=path), (path,)


def _up(given: InputFiles, align: Similarity, options: SceneOptions) -> np.ndarray:
    """Which way is up in the place: as it is given, that of the rays, that of the radiance field, or +z."""
    chosen = check_point(options.up, "--up")
    if chosen is None and (given.rays is not None or "rays_file" in given.about or not align.is_identity):
        chosen = align.matrix[:3, 2] / align.scale
    if chosen is None:
        known = given.field_about.get("provenance", {}).get("up")
        chosen = np.array([0.0, 0, 1]) if known is None else np.asarray(known, float)
    length = float(np.linalg.norm(chosen))
    if chosen.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise NergError("up must be a direction, three numbers that are not all 0; give --up x,y,z")
    return chosen / length


def _observer(
    given: InputFiles, rays: Rays | None, align: Similarity, ns, options: SceneOptions, reporter: Reporter
) -> tuple[LookAt | None, ObserverPath | None, str]:
    """The observer, the walk of one, and a sentence on them."""
    point = check_point(options.observer, "--observer")
    if point is not None:
        return (
            LookAt(point, point + np.array([1.0, 0, 0])),
            None,
            "The observer's eye, as given, turned to where most gaze goes.",
        )
    if options.person is not None:
        if rays is None:
            raise NergError("--person is one of the rays, and there are none; name their file, too")
        if options.time_range is not None:
            first, last = options.time_range
            walk = interpolate_walk(rays, options.person, first, last, options.fps, options.max_gap, align)
            middle = len(walk.eyes) // 2
            about = f"The eye of {options.person} at {walk.times[middle]:.6g} s, in the middle of the walk."
            return walk.eyes[middle], walk, about
        assert options.time is not None
        eye, when = find_eye(rays, options.person, options.time, options.max_gap, align)
        return eye, None, f"The eye of {options.person} at {when:.6g} s, and a point ahead of it."
    if rays is not None:
        at = to_scene_frame(support_of_rays(rays).find_densest_position(), align)
        return (
            LookAt(at, at + align.matrix[:3, 0]),
            None,
            "The observer: where most rays are, turned to where most gaze goes.",
        )
    if given.gaze is not None:
        support = load_gaze(given.gaze, ns)[0].support
        if support is not None:
            at = support.find_densest_position()
            words = "The observer: where the gaze field rests on most rays, turned to where most gaze goes."
            return LookAt(at, at + np.array([1.0, 0, 0])), None, words
        if given.kind == "none":
            raise NergError(
                f'"{given.gaze}" knows no place, and not where people were; say where the observer is with --observer'
            )
        reporter.message("nothing says where people were: the camera is the observer; --observer x,y,z places one")
    return None, None, ""


def _camera(
    scene: _Draft, probe: SceneProbe, seen: SeenSurfaces | None, options: SceneOptions, reporter: Reporter
) -> tuple[LookAt, Lens, str]:
    """The camera, its lens, and a sentence on how they were chosen."""
    lens = Lens() if options.fov is None else Lens(options.fov)
    if options.photos is not None:
        about, outside = scene.given.field_about.get("provenance", {}), options.allow_outside
        if options.photo is None:
            found = find_best_photo(probe, seen, load_photo_cameras(options.photos, about, outside))
            words = f"that of the photo {found.name}, which shows most of it"
        else:
            found = load_photo_camera(options.photos, options.photo, about, outside)
            words = f"that of the photo {found.name}"
        if found.bent:
            reporter.message(f"the lens of {found.name} bends lines, which this camera does not")
        lens = found.lens if options.fov is None else replace(found.lens, fov=options.fov)
        return found.eye, lens, f"The camera of sensor 0: {words}."
    origin, target = check_point(options.camera, "--from"), check_point(options.target, "--to")
    if origin is not None:
        if target is None:
            target = None if seen is None else seen.mean_target()
        if target is None:
            target = np.mean(probe.bounds(), axis=0)
        return LookAt(origin, target), lens, "The camera of sensor 0, and the point that it looks at."
    if options.first_person or (scene.given.kind == "none" and scene.observer is not None):
        if scene.observer is None:
            raise NergError("--own is the observer's view, and there is no observer; give --observer or --person")
        return scene.observer, lens, "The camera of sensor 0: the observer's own eye."
    frame = PinholeFrame(lens.fov, lens.aspect, scene.up)
    box = scene.given.field_about.get("box") if scene.given.kind == "field" else None
    shot = find_best_camera(probe, seen, frame, box)
    if shot is None:
        raise NergError("no camera was found that shows anything of the place; give one with --from and --to")
    whose = "what the observer attends to" if probe.quantity else "what is around the observer"
    attended = "" if shot.attention_share is None else f" and {100 * shot.attention_share:.0f} % of {whose}"
    words = f"The camera of sensor 0: the best overview that was found; it shows surfaces in {100 * shot.opaque:.0f} %"
    if scene.given.kind == "field" and seen is None:
        reporter.message(
            "a field is clearest from where its photos were taken: --photos DATASET takes a camera of theirs"
        )
    return LookAt(shot.origin, shot.target), lens, f"{words} of the picture{attended}."


def _about(output: Path, text: SceneText, place: WrittenGeometry, scene: _Draft) -> str:
    """The first comment of the file."""
    gaze = {"gaze": "with the gaze of an observer", "kde": "with where people around an observer looked", None: ""}
    what = f"{place.words} {gaze[text.gaze_files.quantity]}".rstrip() + "."
    unit = f"A metre is {scene.unit:.4g} units." if scene.tracked and abs(scene.unit - 1) > 1e-4 else ""
    names = text.content.reserved_names
    example = f'-D {free_default_name("spp", names)}=64 -D {free_default_name("camera", names)}="{format_numbers(text.camera.origin)}"'
    sensors = "Sensors: 0 a camera, 1 the observer's own view, 2 all that the observer could turn to."
    if text.observer is None:
        sensors = "Sensors: 0 a camera, which is the observer; 1 the same view; 2 all directions around it."
    return (
        f"{what} {unit}\n{sensors}\nEvery default can be set from the command line: "
        f"nerg render {output.name} -o out.png {example}"
    )


def _frames(walk: ObserverPath, own: bool, taken: frozenset[str]) -> list[dict[str, str]]:
    names = ["eye", "ahead", *(["camera", "target"] if own else [])]
    rows = []
    for eye in walk.eyes:
        values = [format_numbers(eye.origin), format_numbers(eye.target)] * 2
        rows.append({free_default_name(name, taken): value for name, value in zip(names, values)})
    return rows
