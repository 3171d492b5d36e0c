"""Rendering a scene file to one picture or a sequence, as frames or a video, with overlays, in one go or in parts."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.figures import style
from nerg_mi.figures.overlay import Limits, Overlay, OverlayLayers, Style, find_overlay, shared_limits
from nerg_mi.figures.style import Provenance, find_colors, provenance, rasterize, save
from nerg_mi.files.atomic import check_writable, replacing, write_bytes
from nerg_mi.files.safe_read import read_npy
from nerg_mi.files.video import check_video, video_frames
from nerg_mi.interruption import Interruption
from nerg_mi.rendering import bands
from nerg_mi.rendering.bands import SamplePace, is_nerg, prepare_for, render_asked
from nerg_mi.rendering.files import FORMATS, DisplayRows, numbered, picture_rows, read_frames
from nerg_mi.rendering.scene import activate, files_of_scene, load_scene
from nerg_mi.rendering.scene_writer import pixel_of
from nerg_mi.threads import set_thread_count
from nerg_mi.transport.aovs import AOVS
from nerg_mi.transport.observer import center

from .base import SILENT, Reporter
from .options import as_base
from .scene_commands import FilmOptions, PictureOptions

if TYPE_CHECKING:
    from .parts import Parts, PlannedScene


# ---- Pictures with a quantity laid over their colour, alone or as a sequence with one scale ----

BYTES_PER_PIXEL = 400
"""Memory that drawing an overlay takes for a pixel, at most: matplotlib keeps colours in double precision."""


@dataclass(frozen=True)
class RenderedPicture:
    """``size`` (width, height) in pixels, number of ``channels``, and why it was not divided, as `PictureResult` has
    them."""

    size: tuple[int, int]
    channels: int
    whole: str | None = None


OVERLAY_FORMATS = (*style.FORMATS, ".mp4")

OnStrip = Callable[[int, int], None]
"""Is told how many samples are done, and of how many."""

Make = Callable[[Any, Any, OnStrip], RenderedPicture]
"""Makes a picture of a scene, a sensor, and a function that is told of each strip."""


_OF_OVERLAYS = (("top", None), ("cmap", None), ("decades", 0.0), ("hatching", True))

SUPPORT = 1.0
"""Support, in rays, below which an observer's gaze counts as not known: nobody was recorded within five radii of a
probe (docs/gaze-evaluation.md)."""


def check_overlay(output: Path, options: PictureOptions) -> None:
    """Raise `NergError` for options of an overlay that contradict each other."""
    if options.overlay is None:
        for name, default in _OF_OVERLAYS:
            if getattr(options, name) != default:
                flag = "--no-hatching" if name == "hatching" else f"--{name}"
                raise NergError(f"{flag} is about an overlay, and there is none; give --overlay, too")
        return
    overlay = find_overlay(options.overlay)
    if output.suffix.lower() not in OVERLAY_FORMATS:
        raise NergError(
            f'an overlay is a picture to look at, and "{output}" is none: let its name end in '
            f"{' or '.join(OVERLAY_FORMATS)} (an .exr holds the quantity itself, if the scene's aovs name it)"
        )
    if options.cmap is not None:
        find_colors(options.cmap, overlay.color_kind)


def overlay_pictures(
    path: Path,
    frames: Sequence[Mapping[str, str]],
    write: Callable[[Any], None],
    options: PictureOptions,
    render: Callable[[Mapping[str, str], Make], RenderedPicture],
    stop: Interruption,
) -> tuple[RenderedPicture, float | None]:
    """Give ``write`` a figure with the overlay of ``options`` for each of ``frames``, values of `<default>`s of the
    scene file ``path``, one after the other. Gives the last one, and the upper end of the scale of all, None where
    there is none.

    ``render``: loads the scene of a frame and lets a picture be made of it. Pictures of a sequence wait on the disk
    until the scale is known, and not at all where it is given. Raises `NergError` where the quantity is 0 everywhere.
    """
    overlay = find_overlay(options.overlay or "")
    style = style_of(options)
    limits: list[Limits] = []
    last = RenderedPicture((0, 0), 0)
    waits = shares_a_scale(overlay, len(frames), options)

    def finish(layers: OverlayLayers, ends: Limits) -> None:
        overlay.check_limits(ends)
        write(overlay.draw(layers, ends, style))
        stop.check()

    with tempfile.TemporaryDirectory() as folder:
        kept: list[tuple[Path, tuple[int, ...], Any, bool, str]] = []

        def make(loaded: Any, camera: Any, on_strip: OnStrip) -> RenderedPicture:
            check_memory(path, camera, options)
            layers = layers_of(path, loaded, camera, overlay, options.spp, options.seed, on_strip)
            limits.append(overlay.limits(layers))
            height, width = layers.mask.shape
            if waits:
                array = stacked(layers)
                file = Path(folder, str(len(kept)))
                write_bytes(file, array.data)
                kept.append((file, array.shape, layers.marker, layers.supported, layers.basis))
            else:
                finish(layers, shared_limits(limits[-1:], options.top))
            return RenderedPicture((width, height), 3)

        for frame in frames:
            last = render(frame, make)
        ends = shared_limits(limits, options.top)
        for file, shape, marker, supported, basis in kept:
            finish(unstacked(np.fromfile(file, np.float32).reshape(shape), marker, supported, basis), ends)
            file.unlink()
    return last, None if ends is None else ends[1]


def style_of(options: PictureOptions) -> Style:
    """How ``options`` have overlays drawn."""
    return Style(options.cmap, options.decades, options.hatching)


def shares_a_scale(overlay: Overlay, count: int, options: PictureOptions) -> bool:
    """Whether none of ``count`` pictures can be drawn before all are rendered."""
    return count > 1 and overlay.scaled and (options.top is None or not overlay.is_scaled_by_top)


def stacked(layers: OverlayLayers) -> np.ndarray:
    """Colour, values and mask of ``layers`` as one array (h, w, 5) of float32."""
    array = np.concatenate([layers.color, layers.values[..., None], layers.mask[..., None]], axis=-1)
    return np.ascontiguousarray(array, np.float32)


def unstacked(array: np.ndarray, marker: tuple[float, float] | None, supported: bool, basis: str) -> OverlayLayers:
    """What `stacked` was given, with its ``marker``, whether it is ``supported``, and its ``basis`` in words."""
    return OverlayLayers(array[..., :3], array[..., 3], array[..., 4] > 0.5, marker, supported, basis)


def check_memory(path: Path, camera: Any, options: PictureOptions) -> None:
    """Raise `NergError` where drawing the overlay of a picture takes more than it may."""
    width, height = map(int, camera.film().crop_size())
    needed = BYTES_PER_PIXEL * width * height / 1e9
    if needed > options.memory:
        raise NergError(
            f"an overlay of {width:,} x {height:,} pixels is drawn in one piece, for which it takes {needed:.2g} GB; "
            f'give --memory {needed:.1f}, or a smaller picture of "{path}"'
        )


def layers_of(
    path: Path, loaded: Any, camera: Any, overlay: Overlay, spp: int = 0, seed: int = 0, on_strip: OnStrip | None = None
) -> OverlayLayers:
    """What ``camera`` sees of the scene ``loaded`` from ``path`` with the quantity of ``overlay``, and who is there."""
    quantity = overlay.quantity
    asked = list(dict.fromkeys([quantity.name, "opacity", "depth"]))
    with mitsuba_says():
        found = render_asked(path, loaded, camera, asked, spp, seed, on_strip)
    if overlay.name not in found.aovs:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(found.aovs)}')
    marker = observer_pixel(loaded, camera, found.aovs["depth"])
    supported = not quantity.needs_support or is_supported(loaded, camera)
    basis = basis_words(loaded, quantity.rests_on)
    return OverlayLayers(found.color, found.aovs[overlay.name], found.mask, marker, supported, basis)


def basis_words(loaded: Any, part: str = "gaze") -> str:
    """Rays and people that a ``part`` of the scene rests on, "gaze" or "kde", in words; "" where that is not known."""
    volume = loaded.integrator().children.get(part)
    if volume is None:
        return ""
    basis = volume.kde_view().basis if part == "kde" else volume.field.basis
    return "" if basis is None else f"made of {basis.words()}"


def basis_texts(loaded: Any) -> dict[str, str]:
    """The same for the header of a picture, by the names under which `workflows.draw` finds it: "gaze.basis" and
    "kde.basis", as far as they are known."""
    if not is_nerg(loaded.integrator()):
        return {}
    parts = dict.fromkeys(aov.rests_on for aov in AOVS.values() if aov.rests_on)
    words = {f"{part}.basis": basis_words(loaded, part) for part in parts}
    return {name: text for name, text in words.items() if text}


def is_supported(loaded: Any, camera: Any) -> bool:
    """Whether anybody was recorded around the observer, that of the scene or else the ``camera``: `SUPPORT` rays at
    least. A gaze field that does not tell where it learnt counts as knowing."""
    integrator = loaded.integrator()
    gaze = integrator.gaze
    if gaze is None or gaze.field.support is None:
        return True
    eye = center(integrator.observer or camera)
    return float(np.ravel(np.array(gaze.field.support.at(gaze.to_world.point_to_local(eye))))[0]) >= SUPPORT


def observer_pixel(loaded: Any, camera: Any, depth: np.ndarray) -> tuple[float, float] | None:
    """The pixel at which the scene's observer stands, if the ``camera`` sees them."""
    observer = loaded.integrator().observer
    if observer is None or camera.class_name() != "PerspectiveCamera":
        return None
    eye = center(observer)
    found = pixel_of(camera, eye)
    if found is None:
        return None
    column, row = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(found, depth.shape[::-1]))
    away = float(np.linalg.norm(np.ravel(np.array(eye - center(camera)))))
    before = depth[row, column]
    return found if not 0 < before < away else None


# ---- From a scene file to a picture file, with the integrator that the scene names ----

VIDEO = ".mp4"

_OF_PICTURES = ("overlay", "top", "cmap", "decades", "hatching")

RESERVE = 150e6
"""Bytes kept free beside a band, for the strips in it and for the kernel that is compiled first."""


@dataclass(frozen=True)
class PictureResult:
    """The picture ``path``: ``size`` (width, height) in pixels, number of ``channels``, the variant ``mode`` and the
    ``seconds`` that made it; ``whole``: why it could not be divided though it needed more than the memory, or None.
    ``files``: all pictures, of which ``path`` is the first; ``top``: upper end of their overlay's scale, or None."""

    path: Path
    size: tuple[int, int]
    channels: int
    mode: str
    seconds: float
    whole: str | None
    files: tuple[Path, ...] = ()
    top: float | None = None


@dataclass(frozen=True)
class AskedPictures:
    """What is to be rendered: values of `<default>`s for each of ``frames``, and the ``files`` to write, or the one
    ``video``."""

    frames: Sequence[Mapping[str, str]]
    files: list[Path]
    video: bool


def asked_pictures(scene: Path, output: Path, options: PictureOptions) -> AskedPictures:
    """What `render_file` would render. Raises `NergError` for options that contradict each other, and for files that
    cannot be read or written, before any work."""
    check_writable(output, *dict.fromkeys((*FORMATS, *OVERLAY_FORMATS)))
    if not scene.exists():
        raise NergError(f'there is no scene file "{scene}"')
    check_overlay(output, options)
    video = _check_video(output, options)
    frames: Sequence[Mapping[str, str]] = [{}]
    files = [output]
    if options.frames is not None:
        frames = read_frames(options.frames)
        files = [output] if video else [numbered(output, k + 1, len(frames)) for k in range(len(frames))]
        for file in files:
            check_writable(file)
    return AskedPictures(frames, files, video)


def render_file(
    scene: str | Path, output: str | Path, options: PictureOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` and write the picture ``output``, whose folder is made.

    ``output`` ends in .exr (all channels of the film, AOVs among them, as float32) or in .png (its colour, tonemapped
    to sRGB). With ``options.overlay`` it is a .png or .svg of the colour with that quantity over it and a scale beside
    it; the scene's list of AOVs need not have it. With ``options.frames`` there is a picture for each line of that
    file, with a number added to its name, or one video where that ends in .mp4; one scale serves all overlays, for
    which all are rendered before the first is drawn, unless ``options.top`` gives it. Each file says in its header what
    it was made of (`nerg_mi.figures.style`).

    A picture that needs more than ``options.memory`` is rendered in bands of rows, as large as fit beside what the
    scene itself takes. Its pixels do not depend on that where the film has a box filter; with wider filters they differ
    by the rounding of single precision (`nerg_mi.rendering.bands`). Samplers other than `independent`, films other than
    `hdrfilm`, scalar and spectral variants and Mitsuba's differentiable integrators are rendered in one piece, and the
    message says so where that is more than ``memory``. An overlay is drawn in one piece, and refused where that needs
    more.

    Raises `NergError` for what the user can mend, and ``KeyboardInterrupt``, between two steps of less than a second,
    after Ctrl-C; the pictures of a sequence that are there then are whole.
    """
    options = options or PictureOptions()
    scene, output = Path(scene), Path(output)
    asked = asked_pictures(scene, output, options)
    frames, files, video = asked.frames, asked.files, asked.video
    reporter.progress(0.0, "reading the scene")
    mode = activate(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start, pace = time.perf_counter(), SamplePace()
    done, top, picture = 0, None, RenderedPicture((0, 0), 0)
    with Interruption() as stop:

        def on_strip(part: int, total: int) -> None:
            stop.check()
            share = (done + part / total) / len(frames)
            seconds = max(time.perf_counter() - start, 1e-9)
            speed = f"{part / seconds:,.0f} samples/s" if len(frames) == 1 else f"{done} of {len(frames)} pictures"
            reporter.progress(share, f"{speed}, {seconds * (1 - share) / share:.0f} s left")

        def render(frame: Mapping[str, str], make: Make) -> RenderedPicture:
            nonlocal done
            loaded = load_scene(scene, {**(options.defaults or {}), **frame})
            stop.check()
            camera = sensor_of(scene, loaded, options.sensor)
            prepare_for(len(frames) * samples_of(camera, options.spp), loaded)
            made = make(loaded, camera, on_strip)
            done += 1
            return made

        each = provenances(scene, frames, options, mode, video)
        with _writer(files, options, each, video) as write:
            if options.overlay is not None:
                drawn = lambda figure: write(lambda path, about: save(figure, path, about), lambda: rasterize(figure))
                picture, top = overlay_pictures(scene, frames, drawn, options, render, stop)
            else:
                for frame in frames:
                    picture = render(frame, partial(_picture, write, options, stop, pace))
        # The picture is there, and yet whoever called this does not go on.
        stop.check()
    seconds = time.perf_counter() - start
    result = PictureResult(files[0], picture.size, picture.channels, mode, seconds, picture.whole, tuple(files), top)
    reporter.message(account(result, asked, options))
    return result


def account(result: PictureResult, asked: AskedPictures, options: PictureOptions) -> str:
    """The line that says what was written."""
    files, frames = asked.files, asked.frames
    note = f" It was rendered in one piece, beyond {options.memory:g} GB, because of {result.whole}."
    width, height = result.size
    what = str(files[0]) if len(files) == 1 else f"{len(files)} pictures, {files[0]} to {files[-1]}"
    what += f", {len(frames)} pictures at {options.fps:g} a second" if asked.video else ""
    scale = "" if result.top is None else f", scale to {result.top:.4g}"
    return (
        f"Wrote {what} ({width} x {height}, {result.channels} channels, {result.mode}, {result.seconds:.1f} s{scale})."
        f"{note if result.whole else ''}"
    )


Write = Callable[[Callable[[Path, Provenance], None], Callable[[], np.ndarray]], None]
"""Writes the next picture: as a file by the first function, or as a frame of a video by the pixels that the second
gives."""


@contextmanager
def _writer(files: Sequence[Path], options: PictureOptions, each: Iterator[Provenance], video: bool) -> Iterator[Write]:
    """What takes the pictures one after the other: ``files``, or the one video that they name."""
    if not video:
        remaining = iter(files)
        yield lambda store, pixels: store(next(remaining), next(each))
        return
    with video_frames(files[0], options.fps, next(each).text()) as add:
        yield lambda to_file, pixels: add(pixels())


def provenances(
    scene: Path, frames: Sequence[Mapping[str, str]], options: PictureOptions, mode: str, video: bool
) -> Iterator[Provenance]:
    """What each picture was made of, or the one video."""
    known: dict[Path, str] = {}
    given = {name: getattr(options, name) for name in _OF_PICTURES} if options.overlay else {}
    given |= {"mode": mode, "sensor": options.sensor, "spp": options.spp}
    for frame in frames[:1] if video else frames:
        values = {**(options.defaults or {}), **({} if video else frame)}
        inputs = files_of_scene(scene, {**values, **frame})
        if video and options.frames is not None:
            inputs, given["fps"] = [*inputs, options.frames], options.fps
        yield provenance("nerg render", inputs, options.seed, given | {"defaults": values}, known)


def _check_video(output: Path, options: PictureOptions) -> bool:
    """Whether ``output`` is a video. Raises `NergError` for options that contradict that."""
    if output.suffix.lower() == VIDEO:
        if options.frames is None:
            raise NergError(f'"{output}" is a video, and there is one picture; give --frames, or another name (.png)')
        check_video(options.fps)
        return True
    if options.fps != PictureOptions().fps:
        raise NergError(f'--fps is of a video, and "{output}" is none; let its name end in {VIDEO}')
    if options.overlay is None and output.suffix.lower() not in FORMATS:
        raise NergError(f'"{output}" holds an overlay; give --overlay, or a name that ends in {" or ".join(FORMATS)}')
    return False


def _picture(
    write: Write,
    options: PictureOptions,
    stop: Interruption,
    pace: SamplePace,
    loaded: Any,
    camera: Any,
    on_strip: OnStrip,
) -> RenderedPicture:
    """Render what ``camera`` sees, and ``write`` it."""
    width, height = map(int, camera.film().crop_size())
    rows = bands.rows_for(loaded, camera, 1e9 * options.memory - resident_bytes() - RESERVE)
    whole = bands.why_whole(loaded, camera) if rows < height else None
    channels = 0

    def fill(add: Callable[[Any, int], None]) -> None:
        nonlocal channels
        pieces = bands.render_bands(
            loaded, camera, spp=options.spp, seed=options.seed, rows=rows, on_strip=on_strip, pace=pace
        )
        for band in pieces:
            bitmap = band.film.bitmap()
            channels = bitmap.channel_count()
            add(bitmap, band.rows)
            stop.check()

    def to_file(path: Path, about: Provenance) -> None:
        with picture_rows(path, width, height, about.text() | basis_texts(loaded)) as add:
            fill(add)

    def pixels() -> np.ndarray:
        display = DisplayRows(width, height)
        fill(display.add)
        return display.pixels()

    with mitsuba_says():
        write(to_file, pixels)
    return RenderedPicture((width, height), channels, whole)


def sensor_of(path: Path, scene, index: int):
    """The sensor of ``scene`` with this ``index``. Raises `NergError` where there is none, or no integrator for it."""
    if scene.integrator() is None:
        raise NergError(f'the scene "{path}" has no integrator to render with; add one, as <integrator type="nerg"/>')
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise NergError(f'"{path}" has {count} sensor(s) and number {index} was asked for: choose -s from 0 on')
    return scene.sensors()[index]


def samples_of(camera: Any, spp: int) -> int:
    """Samples of a picture of ``camera``: ``spp`` a pixel, 0 for those of its sampler."""
    width, height = map(int, camera.film().crop_size())
    return width * height * (spp or camera.sampler().sample_count())


def resident_bytes() -> int:
    """Bytes of memory that this process takes; where the system does not say, the most that it ever took."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource
        import sys

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


# ---- Rendering sequences of pictures, as frames or a video, whole or in parts ----


_LAYERS_SHARE = 0.8
"""How much of a film with a common scale is rendering; the rest is drawing."""


def render_film(
    scene: str | Path, output: str | Path, options: FilmOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` to ``output``, as `render_file` does, and to the same bytes.

    With ``options.store`` or ``options.scheduler`` each picture of a sequence is a part, which is kept and not rendered
    again: whatever ended the job, the same call goes on. A picture depends on the scene, on the files that it names, on
    its own values and on the options, and on nothing else: those whose inputs have changed are rendered again. The
    reporter hears the progress of either.
    """
    options = options or FilmOptions()
    if not options.in_parts:
        return render_file(scene, output, options, reporter)
    # A single picture needs neither time nor memory for it.
    from .parts import Parts

    scene, output = Path(scene), Path(output)
    asked = asked_pictures(scene, output, options)
    parts = Parts(options, output, reporter, options.threads)
    reporter.progress(0.0, "reading the scene")
    mode = activate(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    first, top = _rendered(scene, asked, replace(options, mode=mode), parts)
    size, channels = (int(first["size"][0]), int(first["size"][1])), int(first.get("channels", 3))
    seconds = time.perf_counter() - start
    result = PictureResult(asked.files[0], size, channels, mode, seconds, first.get("whole"), tuple(asked.files), top)
    reporter.message(account(result, asked, options))
    reporter.message(f"The parts are kept in {parts.store.folder}; nerg jobs says what they take.")
    return result


def _rendered(
    scene: Path, asked: AskedPictures, options: FilmOptions, parts: Parts
) -> tuple[Mapping[str, Any], float | None]:
    """Make all pictures. Gives the notes of the last, and the upper end of the overlays' scale."""
    from nerg_mi.tasks.task import Part, Plan

    from .parts import PlannedScene

    suffix = ".png" if asked.video else asked.files[0].suffix.lower()
    what = f"nerg render {os.path.abspath(asked.files[0])}"
    of_each = picture_options(options)
    frames = [
        Part(PlannedScene.of(scene, {**(options.defaults or {}), **frame}), f"picture {k + 1}")
        for k, frame in enumerate(asked.frames)
    ]
    overlay = None if options.overlay is None else find_overlay(options.overlay)
    if overlay is None or not shares_a_scale(overlay, len(frames), options):
        last = _write(scene, asked, options, parts, Plan(what, make_picture, of_each, frames, suffix), 0.0)
        return last, last.get("top")
    # All are rendered, then the scale of all is known, and each is drawn by it.
    layers = list(parts.run(Plan(f"{what} (values)", make_layers, of_each, frames, ".npy"), 0.0, _LAYERS_SHARE))
    limits = [None if made.notes["limits"] is None else tuple(made.notes["limits"]) for made in layers]
    ends = shared_limits(limits, options.top)
    overlay.check_limits(ends)
    drawings = []
    for k, (frame, made) in enumerate(zip(asked.frames, layers)):
        header = {}
        if not asked.video:
            header = next(provenances(scene, [frame], options, str(options.mode), False)).text()
        notes = {name: made.notes[name] for name in ("marker", "supported", "basis")}
        drawings.append(Part(LayersToDraw(made.path, ends, **notes, header=header), f"drawing {k + 1}"))
    _write(scene, asked, options, parts, Plan(what, draw_layers, of_each, drawings, suffix), _LAYERS_SHARE)
    return layers[-1].notes, None if ends is None else ends[1]


def _write(
    scene: Path, asked: AskedPictures, options: FilmOptions, parts: Parts, plan: Any, since: float
) -> Mapping[str, Any]:
    """Bring the outputs of ``plan`` to where they belong, one after the other. Gives the notes of the last."""
    last: Mapping[str, Any] = {}
    arriving = parts.run(plan, since)
    if not asked.video:
        for file, made in zip(asked.files, arriving):
            last = made.notes
            with replacing(file) as temporary:
                shutil.copyfile(made.path, temporary)
        return last
    import mitsuba as mi

    headers = provenances(scene, asked.frames, options, str(options.mode), True)
    with video_frames(asked.files[0], options.fps, next(headers).text()) as add:
        for made in arriving:
            last = made.notes
            add(np.array(mi.Bitmap(str(made.path)))[..., :3])
    return last


# ---- Parts ----


def picture_options(options: PictureOptions) -> PictureOptions:
    """The ``options`` of a single picture: a part has the values of its frame itself, and belongs to any video."""
    return replace(as_base(options, PictureOptions), defaults=None, frames=None, fps=PictureOptions().fps)


def make_picture(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture file, as `render_file` writes it."""
    made = render_file(scene.checked(), output, replace(options, defaults=scene.defaults))
    return {"size": made.size, "channels": made.channels, "whole": made.whole, "top": made.top}


def make_layers(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture's colour and overlay as they are before they are drawn (.npy), with what a scale is made of."""
    path = scene.checked()
    activate(options.mode)
    overlay = find_overlay(options.overlay or "")
    with Interruption() as stop:
        loaded = load_scene(path, scene.defaults)
        camera = sensor_of(path, loaded, options.sensor)
        check_memory(path, camera, options)
        layers = layers_of(path, loaded, camera, overlay, options.spp, options.seed, lambda *_: stop.check())
        stop.check()
    with replacing(output) as temporary, temporary.open("wb") as out:
        np.save(out, stacked(layers))
    height, width = layers.mask.shape
    return {
        "size": (width, height),
        "limits": overlay.limits(layers),
        "marker": layers.marker,
        "supported": bool(layers.supported),
        "basis": layers.basis,
    }


@dataclass(frozen=True)
class LayersToDraw:
    """``layers`` (.npy) that `make_layers` made, with its notes; ``ends`` of the scale; ``header`` of the file."""

    layers: Path
    ends: Limits
    marker: Sequence[float] | None
    supported: bool
    basis: str
    header: Mapping[str, str]


def draw_layers(options: PictureOptions, drawing: LayersToDraw, output: Path) -> None:
    """The figure of a picture's layers."""
    marker = None if drawing.marker is None else (drawing.marker[0], drawing.marker[1])
    layers = unstacked(read_npy(drawing.layers, "layers"), marker, drawing.supported, drawing.basis)
    figure = find_overlay(options.overlay or "").draw(layers, drawing.ends, style_of(options))
    save(figure, output, drawing.header)
