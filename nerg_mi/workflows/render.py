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

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.figures import style
from nerg_mi.figures.overlay import Limits, Overlay, OverlayLayers, Style, find_overlay, shared_limits
from nerg_mi.figures.style import Provenance, find_colormap, make_provenance, rasterize, save
from nerg_mi.files.atomic import check_writable, replace_atomically, write_bytes
from nerg_mi.files.safe_read import read_npy
from nerg_mi.files.video import check_video_output, open_video_writer
from nerg_mi.interruption import Interruption
from nerg_mi.rendering import bands
from nerg_mi.rendering.bands import SamplePace, is_nerg, prepare_long_render, render_aovs
from nerg_mi.rendering.files import IMAGE_FORMATS, DisplayRows, frame_path, open_image_rows, read_frames
from nerg_mi.rendering.scene import activate_variant, list_scene_files, load_scene
from nerg_mi.rendering.scene_writer import project_to_pixel
from nerg_mi.threads import set_thread_count
from nerg_mi.transport.aovs import AOVS
from nerg_mi.transport.observer import sensor_center

from .base import SILENT, Reporter
from .options import to_base
from .scene_commands import FilmOptions, PictureOptions

if TYPE_CHECKING:
    from .parts import PartRunner, PlannedScene


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

OnBand = Callable[[int, int], None]
"""Is told how many samples are done, and of how many."""

Make = Callable[[Any, Any, OnBand], RenderedPicture]
"""Makes a picture of a scene, a sensor, and a function that is told of each strip."""


_OF_OVERLAYS = (("top", None), ("cmap", None), ("decades", 0.0), ("hatching", True))

SUPPORT = 1.0
"""Support, in rays, below which an observer's gaze counts as not known: nobody was recorded within five radii of a
probe (docs/explanation/accuracy.md)."""


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
        find_colormap(options.cmap, overlay.colormap_kind)


def render_overlays(
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
    style = overlay_style(options)
    limits: list[Limits] = []
    last = RenderedPicture((0, 0), 0)
    waits = uses_shared_scale(overlay, len(frames), options)

    def finish(layers: OverlayLayers, ends: Limits) -> None:
        overlay.check_limits(ends)
        write(overlay.draw(layers, ends, style))
        stop.check()

    with tempfile.TemporaryDirectory() as folder:
        kept: list[tuple[Path, tuple[int, ...], Any, bool, str]] = []

        def make(loaded: Any, camera: Any, on_strip: OnBand) -> RenderedPicture:
            check_memory(path, camera, options)
            layers = render_layers(path, loaded, camera, overlay, options.spp, options.seed, on_strip)
            limits.append(overlay.limits(layers))
            height, width = layers.mask.shape
            if waits:
                array = stack_layers(layers)
                file = Path(folder, str(len(kept)))
                write_bytes(file, array.data)
                kept.append((file, array.shape, layers.marker, layers.has_support, layers.support_note))
            else:
                finish(layers, shared_limits(limits[-1:], options.vmax))
            return RenderedPicture((width, height), 3)

        for frame in frames:
            last = render(frame, make)
        ends = shared_limits(limits, options.vmax)
        for file, shape, marker, supported, basis in kept:
            finish(unstack_layers(np.fromfile(file, np.float32).reshape(shape), marker, supported, basis), ends)
            file.unlink()
    return last, None if ends is None else ends[1]


def overlay_style(options: PictureOptions) -> Style:
    """How ``options`` have overlays drawn."""
    return Style(options.cmap, options.log_decades, options.hatching)


def uses_shared_scale(overlay: Overlay, count: int, options: PictureOptions) -> bool:
    """Whether none of ``count`` pictures can be drawn before all are rendered."""
    return count > 1 and overlay.needs_limits and (options.vmax is None or not overlay.is_scaled_by_top)


def stack_layers(layers: OverlayLayers) -> np.ndarray:
    """Colour, values and mask of ``layers`` as one array (h, w, 5) of float32."""
    array = np.concatenate([layers.color, layers.values[..., None], layers.mask[..., None]], axis=-1)
    return np.ascontiguousarray(array, np.float32)


def unstack_layers(array: np.ndarray, marker: tuple[float, float] | None, supported: bool, basis: str) -> OverlayLayers:
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


def render_layers(
    path: Path, loaded: Any, camera: Any, overlay: Overlay, spp: int = 0, seed: int = 0, on_strip: OnBand | None = None
) -> OverlayLayers:
    """What ``camera`` sees of the scene ``loaded`` from ``path`` with the quantity of ``overlay``, and who is there."""
    quantity = overlay.quantity
    asked = list(dict.fromkeys([quantity.name, "opacity", "depth"]))
    with translate_mitsuba_errors():
        found = render_aovs(path, loaded, camera, asked, spp, seed, on_strip)
    if overlay.name not in found.aovs:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(found.aovs)}')
    marker = observer_pixel(loaded, camera, found.aovs["depth"])
    supported = not quantity.needs_support or is_supported(loaded, camera)
    basis = describe_basis(loaded, quantity.data_source)
    return OverlayLayers(found.color, found.aovs[overlay.name], found.mask, marker, supported, basis)


def describe_basis(loaded: Any, part: str = "gaze") -> str:
    """Rays and people that a ``part`` of the scene rests on, "gaze" or "kde", in words; "" where that is not known."""
    volume = loaded.integrator().children.get(part)
    if volume is None:
        return ""
    basis = volume.kde_view().basis if part == "kde" else volume.field.basis
    return "" if basis is None else f"made of {basis.words()}"


def describe_bases(loaded: Any) -> dict[str, str]:
    """The same for the header of a picture, by the names under which `workflows.draw` finds it: "gaze.basis" and
    "kde.basis", as far as they are known."""
    if not is_nerg(loaded.integrator()):
        return {}
    parts = dict.fromkeys(aov.data_source for aov in AOVS.values() if aov.data_source)
    words = {f"{part}.basis": describe_basis(loaded, part) for part in parts}
    return {name: text for name, text in words.items() if text}


def is_supported(loaded: Any, camera: Any) -> bool:
    """Whether anybody was recorded around the observer, that of the scene or else the ``camera``: `SUPPORT` rays at
    least. A gaze field that does not tell where it learnt counts as knowing."""
    integrator = loaded.integrator()
    gaze = integrator.gaze
    if gaze is None or gaze.field.support is None:
        return True
    eye = sensor_center(integrator.observer or camera)
    return float(np.ravel(np.array(gaze.field.support.at(gaze.to_world.point_to_local(eye))))[0]) >= SUPPORT


def observer_pixel(loaded: Any, camera: Any, depth: np.ndarray) -> tuple[float, float] | None:
    """The pixel at which the scene's observer stands, if the ``camera`` sees them."""
    observer = loaded.integrator().observer
    if observer is None or camera.class_name() != "PerspectiveCamera":
        return None
    eye = sensor_center(observer)
    found = project_to_pixel(camera, eye)
    if found is None:
        return None
    column, row = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(found, depth.shape[::-1]))
    away = float(np.linalg.norm(np.ravel(np.array(eye - sensor_center(camera)))))
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
    vmax: float | None = None


@dataclass(frozen=True)
class RenderPlan:
    """What is to be rendered: values of `<default>`s for each of ``frames``, and the ``files`` to write, or the one
    ``video``."""

    frames: Sequence[Mapping[str, str]]
    files: list[Path]
    video: bool


def plan_render(scene: Path, output: Path, options: PictureOptions) -> RenderPlan:
    """What `render_file` would render. Raises `NergError` for options that contradict each other, and for files that
    cannot be read or written, before any work."""
    check_writable(output, *dict.fromkeys((*IMAGE_FORMATS, *OVERLAY_FORMATS)))
    if not scene.exists():
        raise NergError(f'there is no scene file "{scene}"')
    check_overlay(output, options)
    video = _check_video(output, options)
    frames: Sequence[Mapping[str, str]] = [{}]
    files = [output]
    if options.frames is not None:
        frames = read_frames(options.frames)
        files = [output] if video else [frame_path(output, k + 1, len(frames)) for k in range(len(frames))]
        for file in files:
            check_writable(file)
    return RenderPlan(frames, files, video)


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
    asked = plan_render(scene, output, options)
    frames, files, video = asked.frames, asked.files, asked.video
    reporter.progress(0.0, "reading the scene")
    mode = activate_variant(options.mode)
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
            camera = find_sensor(scene, loaded, options.sensor)
            prepare_long_render(len(frames) * sample_count(camera, options.spp), loaded)
            made = make(loaded, camera, on_strip)
            done += 1
            return made

        each = make_provenances(scene, frames, options, mode, video)
        with _writer(files, options, each, video) as write:
            if options.overlay is not None:
                drawn = lambda figure: write(lambda path, about: save(figure, path, about), lambda: rasterize(figure))
                picture, top = render_overlays(scene, frames, drawn, options, render, stop)
            else:
                for frame in frames:
                    picture = render(frame, partial(_picture, write, options, stop, pace))
        # The picture is there, and yet whoever called this does not go on.
        stop.check()
    seconds = time.perf_counter() - start
    result = PictureResult(files[0], picture.size, picture.channels, mode, seconds, picture.whole, tuple(files), top)
    reporter.message(summary_line(result, asked, options))
    return result


def summary_line(result: PictureResult, asked: RenderPlan, options: PictureOptions) -> str:
    """The line that says what was written."""
    files, frames = asked.files, asked.frames
    note = f" It was rendered in one piece, beyond {options.memory:g} GB, because of {result.whole}."
    width, height = result.size
    what = str(files[0]) if len(files) == 1 else f"{len(files)} pictures, {files[0]} to {files[-1]}"
    what += f", {len(frames)} pictures at {options.fps:g} a second" if asked.video else ""
    scale = "" if result.vmax is None else f", scale to {result.vmax:.4g}"
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
    with open_video_writer(files[0], options.fps, next(each).text()) as add:
        yield lambda to_file, pixels: add(pixels())


def make_provenances(
    scene: Path, frames: Sequence[Mapping[str, str]], options: PictureOptions, mode: str, video: bool
) -> Iterator[Provenance]:
    """What each picture was made of, or the one video."""
    known: dict[Path, str] = {}
    given = {name: getattr(options, name) for name in _OF_PICTURES} if options.overlay else {}
    given |= {"mode": mode, "sensor": options.sensor, "spp": options.spp}
    for frame in frames[:1] if video else frames:
        values = {**(options.defaults or {}), **({} if video else frame)}
        inputs = list_scene_files(scene, {**values, **frame})
        if video and options.frames is not None:
            inputs, given["fps"] = [*inputs, options.frames], options.fps
        yield make_provenance("nerg render", inputs, options.seed, given | {"defaults": values}, known)


def _check_video(output: Path, options: PictureOptions) -> bool:
    """Whether ``output`` is a video. Raises `NergError` for options that contradict that."""
    if output.suffix.lower() == VIDEO:
        if options.frames is None:
            raise NergError(f'"{output}" is a video, and there is one picture; give --frames, or another name (.png)')
        check_video_output(options.fps)
        return True
    if options.fps != PictureOptions().fps:
        raise NergError(f'--fps is of a video, and "{output}" is none; let its name end in {VIDEO}')
    if options.overlay is None and output.suffix.lower() not in IMAGE_FORMATS:
        raise NergError(f'"{output}" holds an overlay; give --overlay, or a name that ends in {" or ".join(IMAGE_FORMATS)}')
    return False


def _picture(
    write: Write,
    options: PictureOptions,
    stop: Interruption,
    pace: SamplePace,
    loaded: Any,
    camera: Any,
    on_strip: OnBand,
) -> RenderedPicture:
    """Render what ``camera`` sees, and ``write`` it."""
    width, height = map(int, camera.film().crop_size())
    rows = bands.fit_rows_to_memory(loaded, camera, 1e9 * options.memory - resident_bytes() - RESERVE)
    whole = bands.undividable_reason(loaded, camera) if rows < height else None
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
        with open_image_rows(path, width, height, about.text() | describe_bases(loaded)) as add:
            fill(add)

    def pixels() -> np.ndarray:
        display = DisplayRows(width, height)
        fill(display.add)
        return display.pixels()

    with translate_mitsuba_errors():
        write(to_file, pixels)
    return RenderedPicture((width, height), channels, whole)


def find_sensor(path: Path, scene, index: int):
    """The sensor of ``scene`` with this ``index``. Raises `NergError` where there is none, or no integrator for it."""
    if scene.integrator() is None:
        raise NergError(f'the scene "{path}" has no integrator to render with; add one, as <integrator type="nerg"/>')
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise NergError(f'"{path}" has {count} sensor(s) and number {index} was asked for: choose -s from 0 on')
    return scene.sensors()[index]


def sample_count(camera: Any, spp: int) -> int:
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
    from .parts import PartRunner

    scene, output = Path(scene), Path(output)
    asked = plan_render(scene, output, options)
    parts = PartRunner(options, output, reporter, options.threads)
    reporter.progress(0.0, "reading the scene")
    mode = activate_variant(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    first, top = _rendered(scene, asked, replace(options, mode=mode), parts)
    size, channels = (int(first["size"][0]), int(first["size"][1])), int(first.get("channels", 3))
    seconds = time.perf_counter() - start
    result = PictureResult(asked.files[0], size, channels, mode, seconds, first.get("whole"), tuple(asked.files), top)
    reporter.message(summary_line(result, asked, options))
    reporter.message(f"The parts are kept in {parts.store.folder}; nerg jobs says what they take.")
    return result


def _rendered(
    scene: Path, asked: RenderPlan, options: FilmOptions, parts: PartRunner
) -> tuple[Mapping[str, Any], float | None]:
    """Make all pictures. Gives the notes of the last, and the upper end of the overlays' scale."""
    from nerg_mi.tasks.task import Part, Plan

    from .parts import PlannedScene

    suffix = ".png" if asked.video else asked.files[0].suffix.lower()
    what = f"nerg render {os.path.abspath(asked.files[0])}"
    get_or_compute_each = picture_options(options)
    frames = [
        Part(PlannedScene.plan(scene, {**(options.defaults or {}), **frame}), f"picture {k + 1}")
        for k, frame in enumerate(asked.frames)
    ]
    overlay = None if options.overlay is None else find_overlay(options.overlay)
    if overlay is None or not uses_shared_scale(overlay, len(frames), options):
        last = _write(scene, asked, options, parts, Plan(what, make_picture, get_or_compute_each, frames, suffix), 0.0)
        return last, last.get("top")
    # All are rendered, then the scale of all is known, and each is drawn by it.
    layers = list(parts.run(Plan(f"{what} (values)", make_layers, get_or_compute_each, frames, ".npy"), 0.0, _LAYERS_SHARE))
    limits = [None if made.notes["limits"] is None else tuple(made.notes["limits"]) for made in layers]
    ends = shared_limits(limits, options.vmax)
    overlay.check_limits(ends)
    drawings = []
    for k, (frame, made) in enumerate(zip(asked.frames, layers)):
        header = {}
        if not asked.video:
            header = next(make_provenances(scene, [frame], options, str(options.mode), False)).text()
        notes = {name: made.notes[name] for name in ("marker", "supported", "basis")}
        drawings.append(Part(LayerDrawing(made.path, ends, **notes, header=header), f"drawing {k + 1}"))
    _write(scene, asked, options, parts, Plan(what, draw_layers, get_or_compute_each, drawings, suffix), _LAYERS_SHARE)
    return layers[-1].notes, None if ends is None else ends[1]


def _write(
    scene: Path, asked: RenderPlan, options: FilmOptions, parts: PartRunner, plan: Any, since: float
) -> Mapping[str, Any]:
    """Bring the outputs of ``plan`` to where they belong, one after the other. Gives the notes of the last."""
    last: Mapping[str, Any] = {}
    arriving = parts.run(plan, since)
    if not asked.video:
        for file, made in zip(asked.files, arriving):
            last = made.notes
            with replace_atomically(file) as temporary:
                shutil.copyfile(made.path, temporary)
        return last
    import mitsuba as mi

    headers = make_provenances(scene, asked.frames, options, str(options.mode), True)
    with open_video_writer(asked.files[0], options.fps, next(headers).text()) as add:
        for made in arriving:
            last = made.notes
            add(np.array(mi.Bitmap(str(made.path)))[..., :3])
    return last


# ---- Parts ----


def picture_options(options: PictureOptions) -> PictureOptions:
    """The ``options`` of a single picture: a part has the values of its frame itself, and belongs to any video."""
    return replace(to_base(options, PictureOptions), defaults=None, frames=None, fps=PictureOptions().fps)


def make_picture(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture file, as `render_file` writes it."""
    made = render_file(scene.checked_path(), output, replace(options, defaults=scene.defaults))
    return {"size": made.size, "channels": made.channels, "whole": made.whole, "top": made.vmax}


def make_layers(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture's colour and overlay as they are before they are drawn (.npy), with what a scale is made of."""
    path = scene.checked_path()
    activate_variant(options.mode)
    overlay = find_overlay(options.overlay or "")
    with Interruption() as stop:
        loaded = load_scene(path, scene.defaults)
        camera = find_sensor(path, loaded, options.sensor)
        check_memory(path, camera, options)
        layers = render_layers(path, loaded, camera, overlay, options.spp, options.seed, lambda *_: stop.check())
        stop.check()
    with replace_atomically(output) as temporary, temporary.open("wb") as out:
        np.save(out, stack_layers(layers))
    height, width = layers.mask.shape
    return {
        "size": (width, height),
        "limits": overlay.limits(layers),
        "marker": layers.marker,
        "supported": bool(layers.has_support),
        "basis": layers.support_note,
    }


@dataclass(frozen=True)
class LayerDrawing:
    """``layers`` (.npy) that `make_layers` made, with its notes; ``ends`` of the scale; ``header`` of the file."""

    layers: Path
    ends: Limits
    marker: Sequence[float] | None
    supported: bool
    basis: str
    header: Mapping[str, str]


def draw_layers(options: PictureOptions, drawing: LayerDrawing, output: Path) -> None:
    """The figure of a picture's layers."""
    marker = None if drawing.marker is None else (drawing.marker[0], drawing.marker[1])
    layers = unstack_layers(read_npy(drawing.layers, "layers"), marker, drawing.supported, drawing.basis)
    figure = find_overlay(options.overlay or "").draw(layers, drawing.ends, overlay_style(options))
    save(figure, output, drawing.header)
