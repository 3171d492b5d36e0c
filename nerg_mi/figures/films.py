"""Films: a picture of a scene, a sequence of pictures or a video, with overlays, rendered at once or in parts."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from nerg_mi.environment.moments import Moment
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.rendering_files import IMAGE_FORMATS, frame_path, read_frames
from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_loading import activate_variant
from nerg_mi.environment.scene_sequence import SceneSequence
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.files.video import check_video_output, open_video_writer
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter
from nerg_mi.ranges import POSITIVE_VALUES, RATES, SEEDS, SPP, TIMES, Range, check_ranges
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import Part, Plan
from nerg_mi.tracking.objects import ObjectPoses

from .frames import (
    DrawnPicture,
    FilmProvenance,
    Frame,
    FrameRenderer,
    FrameSettings,
    Picture,
    StoredLayers,
    StoredPicture,
    name_picture,
)
from .overlay import Limits, OverlayLayers, find_overlay, shared_limits
from .settings import SMOOTHING, Style
from .style import FORMATS, Provenance, existing_files

if TYPE_CHECKING:
    from nerg_mi.tasks.engines import TaskOutput

VIDEO, DEFAULT_FPS = ".mp4", 25.0

_LAYERS_SHARE = 0.8
"""Fraction of the work that is rendering, for a film with an overlay in parts; the rest is drawing."""


@dataclass(frozen=True, repr=False)
class Film(Summary):
    """Result of `render_film`.

    Attributes
    ----------
    files
        All written files.
    mode
        Mitsuba variant.
    seconds
        Run time.
    size
        Width and height in pixels of the rendered images.
    channels
        Number of channels.
    undivided_reason
        Why the last image was not rendered in bands although it exceeded the memory limit, or None.
    vmax
        Upper end of the colour scale of overlays, or None.
    observer_note
        Why the gaze of the observer is extrapolated, in the first picture where it is; "" if it is not.
    """

    files: tuple[Path, ...]
    mode: str
    seconds: float
    size: tuple[int, int]
    channels: int
    undivided_reason: str | None = None
    vmax: float | None = None
    observer_note: str = ""

    @property
    def path(self) -> Path:
        """The first file."""
        return self.files[0]


@check_ranges
def render_film(
    scene: Scene | FilePath,
    output: FilePath,
    *,
    frames: FilePath | Sequence[Mapping[str, object]] | None = None,
    defaults: Mapping[str, str] | None = None,
    sensor: Annotated[int, Range(0, 65535)] = 0,
    spp: Annotated[int, Range(0, SPP.high)] = 0,
    seed: Annotated[int, SEEDS] = 0,
    objects: FilePath | ObjectPoses | None = None,
    time: Annotated[float, TIMES] | None = None,
    person: str | None = None,
    align: FilePath | AnySimilarity | None = None,
    overlay: str | None = None,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    smoothing: Annotated[float, Range(0, 30)] = SMOOTHING,
    style: Style = Style(),
    fps: Annotated[float, RATES] = 25.0,
    memory: Annotated[float, Range(1e-6, 10**6)] = 1.0,
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> Film:
    """Render a scene file to an image or a video, with the integrator of the scene.

    An EXR file holds all channels, including AOVs, in float32. A PNG file holds the sRGB colour, or an overlay with its
    colour scale, which can also be written as SVG. The images of a sequence get numbered names, or become the frames of
    an MP4 file. In parts, each finished image is stored, and the same command continues with the next one.

    Parameters
    ----------
    scene : Scene or path
        Mitsuba scene file (.xml).
    output : path
        Image (.exr with all channels, .png; .svg needs ``overlay``) or video (.mp4, needs ``frames``) to write.
    frames : path or sequence of mappings, optional
        CSV file of an image sequence: the header names <default>s of the scene, each further line has their values for
        one frame; or a camera path of nerfstudio (.json). Default: a single image.
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    sensor : int
        Index of the sensor that is rendered, counted from 0.
    spp : int
        Samples per pixel; 0: as in the scene file.
    seed : int
        Seed of the random numbers for sampling.
    objects : ObjectPoses or path, optional
        Table with columns time,object,x,y,z,qw,qx,qy,qz (`nerg_mi.tracking.objects`): poses of shapes that move. They
        are rendered where they were at the time of the picture, and those that are absent are left out.
    time : float, optional
        Time in seconds on the clock of the objects. A column time of the frames gives each picture its own.
    person : str, optional
        Participant whose objects are rendered, if participants have poses of their own.
    align : path or similarity, optional
        JSON file with the 4x4 similarity from the frame of the objects to that of the scene, as nerg align writes it.
        Default: the identity.
    overlay : str, optional
        Name of the AOV that is drawn over the colour, with a colour scale: gaze, kde, depth or any other. The output
        must be .png, .svg or .mp4. Default: colour only.
    vmax : float, optional
        Upper end of the overlay's colour scale, for gaze in 1/sr. The pictures of a sequence share one scale, so all of
        them are rendered before the first is drawn, unless it is given. Default: the 99.5th percentile.
    smoothing : float
        Standard deviation in degrees by which gaze is smoothed on surfaces before it is drawn; 0: as computed. Images
        of perspective cameras only; .exr files are not smoothed.
    style : Style
        Appearance of the overlay (`nerg_mi.figures.settings.Style`).
    fps : float
        Frame rate of an .mp4 video in frames per second.
    memory : float
        Memory limit of rendering in GB; larger images are rendered in bands.
    parallel : Parallel
        Where parts run (`nerg_mi.tasks.settings.Parallel`). Each image of a film is a part, with bitwise the same
        result.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Film
        The written files.

    Raises
    ------
    NergError
        An argument or a file is invalid.
    KeyboardInterrupt
        Within a second after Ctrl-C. Images that have been written are complete.

    Notes
    -----
    An image that exceeds ``memory`` is rendered in bands of rows. With a box filter its pixels do not depend on the
    bands; with wider filters they differ by rounding in single precision (`nerg_mi.environment.bands`). Samplers other
    than `independent`, films other than `hdrfilm`, scalar and spectral variants, and Mitsuba's differentiable
    integrators are rendered in one piece, and a message tells if that exceeds the limit. An overlay is drawn in one
    piece, and rejected if that exceeds the limit.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
    >>> nerg.render_film(scene, folder / "gaze.png", overlay="gaze", spp=1).path.name
    'gaze.png'
    """
    output = to_path(output)
    start, is_video = perf_counter(), output.suffix.lower() == VIDEO
    appearance = {name: getattr(style, name) for name in ("cmap", "log_decades", "hatching")}
    look = {"vmax": vmax, "smoothing": smoothing, **appearance}
    _check_output(output, overlay, look, frames is not None, fps)
    moment = _open_moment(objects, time, person, align)
    source, listed = _open_scene(scene, defaults or {}, moment), _list_frames(frames)
    if moment is not None and parallel.in_parts:
        raise NergError(f"pictures with {parameter('objects')} are rendered at once; leave out {parameter('store')}")
    if not source.has_file and (defaults or frames is not None or parallel.in_parts):
        raise NergError(
            "a scene in memory has one picture, which is rendered at once; save the scene, and pass its file"
        )
    files = [output]
    if frames is not None and not is_video:
        files = [frame_path(output, k + 1, len(listed)) for k in range(len(listed))]
        for file in files:
            check_writable(file)
    drawing = None
    if overlay is not None:
        find_overlay(overlay).check_style(style)
        drawing = Drawing(overlay, vmax, style)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading the scene")
        import mitsuba as mi

        mode = mi.variant() or activate_variant()
        settings = FrameSettings(mode, sensor, spp, seed, memory, overlay, smoothing)
        recorded = {} if overlay is None else {"overlay": overlay, **look}
        recorded |= {k: v for k, v in (("time", time), ("person", person)) if v is not None}
        work = _FilmTask(source, listed, settings, drawing, FilmProvenance(source, settings, recorded))
        video = work.provenance.make_video(listed[0], existing_files(frames), fps) if is_video else None
        with _open_writer(files, video, fps) as write:
            if parallel.in_parts:
                shown = _render_in_parts(work, output, files, parallel, reporter, write)
            else:
                shown = _render_at_once(work, reporter, write)
        film = Film(tuple(files), mode, perf_counter() - start, *shown)
        reporter.message(_summarize(film, f"{len(listed)} frames at {fps:g} per second" if is_video else "", memory))
    return film


# ---- What is rendered and written ----


@dataclass(frozen=True)
class Drawing:
    """How the overlay of pictures is drawn; ``vmax`` is the upper end of the colour scale, if it is given."""

    overlay: str
    vmax: float | None
    style: Style

    def find_limits(self, all_limits: Sequence[Limits]) -> Limits:
        """Return the common colour scale of pictures. Raises `NergError` if the values are 0 everywhere."""
        limits = shared_limits(all_limits, self.vmax)
        find_overlay(self.overlay).check_limits(limits)
        return limits

    def needs_all(self, count: int) -> bool:
        """Return whether none of ``count`` pictures can be drawn before all are rendered."""
        overlay = find_overlay(self.overlay)
        return count > 1 and overlay.needs_limits and (self.vmax is None or not overlay.is_scaled_by_top)

    def draw(self, layers: OverlayLayers, limits: Limits) -> Any:
        """Return the figure of a picture."""
        return find_overlay(self.overlay).draw(layers, limits, self.style)


@dataclass(frozen=True)
class _FilmTask:
    scene: SceneSequence
    frames: Sequence[Frame]
    settings: FrameSettings
    drawing: Drawing | None
    provenance: FilmProvenance


class _Shown(NamedTuple):
    """Attributes of a `Film` that its pictures have."""

    size: tuple[int, int]
    channels: int
    undivided_reason: str | None = None
    vmax: float | None = None
    observer_note: str = ""


Write = Callable[[Picture], None]
"""Writes the next picture."""


@contextmanager
def _open_writer(files: Sequence[Path], video: Provenance | None, fps: float) -> Iterator[Write]:
    """Yield the function that writes pictures to ``files``, or to the single ``video`` with this provenance."""
    if video is None:
        remaining = iter(files)
        yield lambda picture: picture.save(next(remaining))
    else:
        with open_video_writer(files[0], fps, video.text()) as add:
            yield lambda picture: add(picture.pixels())


def _check_output(output: Path, overlay: str | None, look: Mapping[str, Any], is_sequence: bool, fps: float) -> None:
    """Raise `NergError` for contradictory arguments; ``look`` is the appearance of the overlay."""
    suffix, overlay_formats = output.suffix.lower(), (*FORMATS, VIDEO)
    check_writable(output, *dict.fromkeys((*IMAGE_FORMATS, *overlay_formats)))
    if overlay is None:
        defaults = {"vmax": None, "smoothing": SMOOTHING, **asdict(Style())}
        if changed := [name for name, value in look.items() if value != defaults[name]]:
            mention = parameter(changed[0], False if changed[0] == "hatching" else "")
            raise NergError(f"{mention} applies to overlays only; add {parameter('overlay')}")
    else:
        if suffix not in overlay_formats:
            raise NergError(
                f'an overlay cannot be written to "{output}": use a name that ends in {" or ".join(overlay_formats)} '
                "(an .exr file holds the AOV itself, if it is in the scene's aovs)"
            )
    if suffix == VIDEO and not is_sequence:
        raise NergError(
            f'"{output}" is a video, and there is a single image; add {parameter("frames")}, or use another name (.png)'
        )
    if suffix == VIDEO:
        check_video_output(fps)
    elif fps != DEFAULT_FPS:
        raise NergError(
            f'{parameter("fps")} applies to videos only, and "{output}" is not one; use a name that ends in {VIDEO}'
        )
    elif overlay is None and suffix not in IMAGE_FORMATS:
        raise NergError(
            f'"{output}" can only hold an overlay; add {parameter("overlay")}, or use a name that ends in '
            f"{' or '.join(IMAGE_FORMATS)}"
        )


def _open_moment(objects: Any, time: float | None, person: str | None, align: Any) -> Moment | None:
    """Return where objects are in the pictures; None without any. Raises `NergError`."""
    if objects is None:
        options = {"time": time, "person": person, "align": align}
        if name := next((name for name, value in options.items() if value is not None), None):
            raise NergError(f"{parameter(name)} applies to objects that move; add {parameter('objects', 'FILE')}")
        return None
    to_scene = Similarity() if align is None else open_similarity(align, "objects to scene")
    return Moment(ObjectPoses.open(objects), time, person or "", to_scene, tuple(existing_files(objects, align)))


def _open_scene(scene: Any, defaults: Frame, moment: Moment | None) -> SceneSequence:
    """Return a scene with values of its `<default>`s. Raises `NergError` if there is no such file."""
    if isinstance(scene, (str, os.PathLike)):
        if not os.path.exists(scene):
            raise NergError(f'there is no scene file "{scene}"')
        return SceneSequence(Path(scene), defaults, moment=moment)
    opened = Scene.coerce(scene)
    if opened.source is None:
        if moment is not None:
            raise NergError("shapes of a scene in memory are moved by its method move_objects; call it before")
        return SceneSequence(Path("scene in memory"), defaults, opened.mitsuba)
    path, values = opened.source
    return SceneSequence(path, {**values, **defaults}, moment=moment)


def _list_frames(frames: Any) -> Sequence[Frame]:
    if frames is None:
        return [{}]
    if isinstance(frames, (str, os.PathLike)):
        return read_frames(Path(frames))
    return [{name: str(value) for name, value in frame.items()} for frame in frames]


def _summarize(film: Film, frames: str, memory: float) -> str:
    """Return the line that reports what was written; ``frames`` describes those of a video."""
    width, height = film.size
    what = str(film.path) if len(film.files) == 1 else f"{len(film.files)} images, {film.path} to {film.files[-1]}"
    what += f", {frames}" if frames else ""
    scale = "" if film.vmax is None else f", colour scale up to {film.vmax:.4g}"
    line = f"Wrote {what} ({width} x {height}, {film.channels} channels, {film.mode}, {film.seconds:.1f} s{scale})."
    if film.undivided_reason:
        line += f" It was rendered in one piece, above {memory:g} GB, because of {film.undivided_reason}."
    return line


# ---- Rendering at once ----


def _render_at_once(work: _FilmTask, reporter: Reporter, write: Write) -> _Shown:
    vmax = None
    with Interruption() as stop:
        renderer = FrameRenderer(work.scene, work.settings, len(work.frames), reporter, stop)
        if work.drawing is None:
            for frame in work.frames:
                write(renderer.render(frame, work.provenance))
        else:
            vmax = _render_overlays(work, work.drawing, renderer, write)
        # The pictures are complete, but the caller must not continue.
        stop.check()
    return _Shown(renderer.size, renderer.channels, renderer.undivided_reason, vmax, renderer.observer_note)


def _render_overlays(work: _FilmTask, drawing: Drawing, renderer: FrameRenderer, write: Write) -> float | None:
    """Render pictures with an overlay, and return the upper end of their colour scale.

    Pictures of a sequence are stored on disk until the common colour scale is known, unless it is given.
    """
    overlay, all_limits, stored = find_overlay(drawing.overlay), list[Limits](), list[StoredLayers]()

    def draw(layers: OverlayLayers, limits: Limits, frame: Frame) -> None:
        write(DrawnPicture(drawing.draw(layers, limits), lambda: work.provenance.make(frame).text()))

    with tempfile.TemporaryDirectory() as folder:
        for number, frame in enumerate(work.frames):
            layers = renderer.render_layers(frame)
            all_limits.append(overlay.limits(layers))
            if drawing.needs_all(len(work.frames)):
                stored.append(StoredLayers.store(Path(folder, f"{number}.npy"), layers))
            else:
                draw(layers, drawing.find_limits(all_limits[-1:]), frame)
        limits = drawing.find_limits(all_limits)
        for frame, one in zip(work.frames, stored):
            draw(one.read(), limits, frame)
            one.file.unlink()
    return None if limits is None else limits[1]


# ---- Rendering in parts ----


def _render_in_parts(
    work: _FilmTask, output: Path, files: Sequence[Path], parallel: Parallel, reporter: Reporter, write: Write
) -> _Shown:
    """Render each picture as a part, which is stored and not rendered again: the same call resumes.

    A part depends on the scene, on the files that it refers to, on its own values and on the settings.
    """
    # Imported here, because a film at once does not need them.
    from nerg_mi.environment.planned import PlannedFiles
    from nerg_mi.tasks.parts import PartRunner

    parts, drawing = PartRunner(parallel, output, reporter), work.drawing
    what, is_video = f"nerg render {os.path.abspath(files[0])}", output.suffix.lower() == VIDEO
    suffix = ".png" if is_video else output.suffix.lower()
    scenes = [
        Part(PlannedFiles.plan(work.scene.path, {**work.scene.values, **frame}), f"picture {k + 1}")
        for k, frame in enumerate(work.frames)
    ]
    plan, until = Plan(what, make_picture, work.settings, scenes, suffix), 1.0
    if drawing is not None:
        plan, until = Plan(f"{what} (values)", make_layers, work.settings, scenes, ".npy"), _LAYERS_SHARE
    rendered: list[TaskOutput] = []
    vmax, observer_note = None, ""
    for index, made in enumerate(parts.run(plan, 0.0, until)):
        rendered.append(made)
        if not observer_note and (observer_note := made.notes["observer"]):
            reporter.warn(name_picture(index, len(scenes)) + observer_note)
        if drawing is None:
            write(StoredPicture(made.path))
    if drawing is not None:
        limits = drawing.find_limits([made.notes["limits"] for made in rendered])
        vmax = None if limits is None else limits[1]
        drawings = []
        for number, (frame, made) in enumerate(zip(work.frames, rendered), 1):
            layers = StoredLayers(made.path, *(made.notes[name] for name in ("marker", "supported", "basis")))
            header = {} if is_video else work.provenance.make(frame).text()
            drawings.append(Part(LayerDrawing(layers, limits, header), f"drawing {number}"))
        for made in parts.run(Plan(what, draw_layers, drawing, drawings, suffix), _LAYERS_SHARE):
            write(StoredPicture(made.path))
    reporter.message(f"The parts are stored in {parts.store.folder}; nerg jobs shows their size.")
    last = rendered[-1].notes
    return _Shown(tuple(last["size"]), last["channels"], last["whole"], vmax, observer_note)


@contextmanager
def _open_part(settings: FrameSettings, scene: PlannedFiles) -> Iterator[tuple[FrameRenderer, FilmProvenance]]:
    """Yield what renders a part, with the scene of the last one: no file changes during a job (`run_task`)."""
    from nerg_mi.tasks.execution import prepare_once

    activate_variant(settings.mode)
    path, opened = scene.checked_path(), prepare_once(settings, dict[Path, tuple[SceneSequence, FilmProvenance]])
    if path not in opened:
        # A single scene, whose memory is free before the next one is read.
        opened.clear()
        opened[path] = (source := SceneSequence(path), FilmProvenance(source, settings))
    source, provenance = opened[path]
    with Interruption() as stop:
        yield FrameRenderer(source, settings, 1, SILENT, stop), provenance
        stop.check()


def make_picture(settings: FrameSettings, scene: PlannedFiles, output: Path) -> dict[str, Any]:
    """Write the image of a frame."""
    with _open_part(settings, scene) as (renderer, provenance):
        renderer.render(scene.defaults, provenance).save(output)
    return _describe_part(renderer)


def make_layers(settings: FrameSettings, scene: PlannedFiles, output: Path) -> dict[str, Any]:
    """Write the colour and the AOV of an image (.npy), and return what its colour scale depends on."""
    with _open_part(settings, scene) as (renderer, _):
        layers = renderer.render_layers(scene.defaults)
    StoredLayers.store(output, layers)
    notes = {"marker": layers.marker, "supported": bool(layers.has_support), "basis": layers.support_note}
    return _describe_part(renderer) | notes | {"limits": find_overlay(settings.overlay or "").limits(layers)}


def _describe_part(renderer: FrameRenderer) -> dict[str, Any]:
    return {
        "size": renderer.size,
        "channels": renderer.channels,
        "whole": renderer.undivided_reason,
        "observer": renderer.observer_note,
    }


@dataclass(frozen=True)
class LayerDrawing:
    """The ``layers`` of a picture, the ``limits`` of the colour scale, and the file ``header``."""

    layers: StoredLayers
    limits: Limits
    header: Mapping[str, str]


def draw_layers(drawing: Drawing, picture: LayerDrawing, output: Path) -> None:
    """Draw the figure of the layers of a picture."""
    DrawnPicture(drawing.draw(picture.layers.read(), picture.limits), lambda: picture.header).save(output)
