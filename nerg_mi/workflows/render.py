"""Rendering of a scene file to an image, a sequence or a video, with overlays, directly or in parts."""

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

from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.figures import style
from nerg_mi.figures.overlay import Limits, Overlay, OverlayLayers, Style, find_overlay, shared_limits
from nerg_mi.figures.shading import draw_outlines, smooth_on_surfaces
from nerg_mi.figures.style import Provenance, find_colormap, make_provenance, rasterize, save
from nerg_mi.files.atomic import check_writable, replace_atomically, write_bytes
from nerg_mi.files.safe_read import read_npy
from nerg_mi.files.video import check_video_output, open_video_writer
from nerg_mi.interruption import Interruption
from nerg_mi.options import to_base
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rendering import bands
from nerg_mi.rendering.bands import Channels, ConstantWeightsTrial, SamplePace, is_nerg, render_aovs
from nerg_mi.rendering.files import IMAGE_FORMATS, DisplayRows, frame_path, open_image_rows, read_frames
from nerg_mi.rendering.scene import activate_variant, list_scene_files, load_scene
from nerg_mi.rendering.scene_writer import project_to_pixel
from nerg_mi.threads import set_thread_count
from nerg_mi.transport.aovs import AOVS
from nerg_mi.transport.extrapolation import describe_extrapolation
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center
from nerg_mi.transport.volume_medium import VolumeMedium

from .scene_commands import SMOOTHING, FilmOptions, PictureOptions

if TYPE_CHECKING:
    from .parts import PartRunner, PlannedScene


# ---- Images with an overlay, alone or as a sequence with a common colour scale ----

BYTES_PER_PIXEL = 400
"""Maximum memory per pixel for drawing an overlay: matplotlib stores colours in double precision."""


@dataclass(frozen=True)
class RenderedPicture:
    """Size (width, height) in pixels, number of channels, and why the image was not rendered in bands, see
    `PictureResult`."""

    size: tuple[int, int]
    channels: int
    undivided_reason: str | None = None


OVERLAY_FORMATS = (*style.FORMATS, ".mp4")

OnBand = Callable[[int, int], None]
"""Called with the number of completed samples and of all samples."""

Make = Callable[[Any, Any, OnBand], RenderedPicture]
"""Renders an image from a scene, a sensor, and a function that is called for each strip."""


_OVERLAY_DEFAULTS = (("vmax", None), ("cmap", None), ("log_decades", 0.0), ("hatching", True), ("smoothing", SMOOTHING))
_MIN_VISIBILITY = 1e-3
"""Visibility from which a density is divided by it."""


SUPPORT = 1.0
"""Support in rays below which the gaze of an observer counts as unknown: nothing was recorded within five radii of a
probe (docs/explanation/accuracy.md)."""


def check_overlay(output: Path, options: PictureOptions) -> None:
    """Raise `NergError` for contradictory options of an overlay."""
    if options.overlay is None:
        for name, default in _OVERLAY_DEFAULTS:
            if getattr(options, name) != default:
                mention = parameter(name, False if name == "hatching" else "")
                raise NergError(f"{mention} applies to overlays only; add {parameter('overlay')}")
        return
    overlay = find_overlay(options.overlay)
    if output.suffix.lower() not in OVERLAY_FORMATS:
        raise NergError(
            f'an overlay cannot be written to "{output}": use a name that ends in {" or ".join(OVERLAY_FORMATS)} '
            "(an .exr file holds the AOV itself, if it is in the scene's aovs)"
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
    """Draw the overlay of ``options`` for each of ``frames``, and pass the figures to ``write``.

    Parameters
    ----------
    path
        Scene file.
    frames
        Values of its `<default>`s for each frame.
    write
        Receives each figure.
    options
        Overlay, colour scale and sampling.
    render
        Loads the scene of a frame and renders an image of it.
    stop
        Raises ``KeyboardInterrupt`` after Ctrl-C.

    Returns
    -------
    tuple
        The last image, and the upper end of the colour scale, None if there is none.

    Raises
    ------
    NergError
        If the AOV is 0 everywhere.

    Notes
    -----
    Images of a sequence are stored on disk until the common colour scale is known, unless it is given.
    """
    overlay = find_overlay(options.overlay or "")
    style = overlay_style(options)
    limits: list[Limits] = []
    last = RenderedPicture((0, 0), 0)
    is_delayed = uses_shared_scale(overlay, len(frames), options)

    def finish(layers: OverlayLayers, ends: Limits) -> None:
        overlay.check_limits(ends)
        write(overlay.draw(layers, ends, style))
        stop.check()

    with tempfile.TemporaryDirectory() as folder:
        stored: list[tuple[Path, tuple[int, ...], Any, bool, str]] = []

        def make(loaded: Any, camera: Any, on_strip: OnBand) -> RenderedPicture:
            check_memory(path, camera, options)
            layers = render_layers(
                path, loaded, camera, overlay, options.spp, options.seed, on_strip, options.smoothing
            )
            limits.append(overlay.limits(layers))
            height, width = layers.mask.shape
            if is_delayed:
                array = stack_layers(layers)
                file = Path(folder, str(len(stored)))
                write_bytes(file, array.data)
                stored.append((file, array.shape, layers.marker, layers.has_support, layers.support_note))
            else:
                finish(layers, shared_limits(limits[-1:], options.vmax))
            return RenderedPicture((width, height), 3)

        for frame in frames:
            last = render(frame, make)
        ends = shared_limits(limits, options.vmax)
        for file, shape, marker, supported, basis in stored:
            finish(unstack_layers(np.fromfile(file, np.float32).reshape(shape), marker, supported, basis), ends)
            file.unlink()
    return last, None if ends is None else ends[1]


def overlay_style(options: PictureOptions) -> Style:
    """Return the style of overlays."""
    return Style(options.cmap, options.log_decades, options.hatching)


def uses_shared_scale(overlay: Overlay, count: int, options: PictureOptions) -> bool:
    """Return whether none of ``count`` images can be drawn before all are rendered."""
    return count > 1 and overlay.needs_limits and (options.vmax is None or not overlay.is_scaled_by_top)


def stack_layers(layers: OverlayLayers) -> np.ndarray:
    """Stack the images of ``layers`` into one array (h, w, 5) of float32.

    The channels are linear red, green and blue, the values of the overlaid quantity (an AOV), and the mask: 1 where the
    pixel has a surface, 0 elsewhere.
    """
    array = np.concatenate([layers.color, layers.values[..., None], layers.mask[..., None]], axis=-1)
    return np.ascontiguousarray(array, np.float32)


def unstack_layers(array: np.ndarray, marker: tuple[float, float] | None, supported: bool, basis: str) -> OverlayLayers:
    """Restore layers from an ``array`` of `stack_layers`.

    ``marker``, ``supported`` and ``basis`` become `OverlayLayers.marker`, ``has_support`` and ``support_note``, which
    are not in the array.
    """
    return OverlayLayers(array[..., :3], array[..., 3], array[..., 4] > 0.5, marker, supported, basis)


def check_memory(path: Path, camera: Any, options: PictureOptions) -> None:
    """Raise `NergError` if drawing the overlay exceeds the memory limit."""
    width, height = map(int, camera.film().crop_size())
    needed = BYTES_PER_PIXEL * width * height / 1e9
    if needed > options.memory:
        raise NergError(
            f"drawing an overlay of {width:,} x {height:,} pixels needs {needed:.2g} GB; increase "
            f'{parameter("memory")} to {needed:.1f}, or reduce the size of "{path}"'
        )


def render_layers(
    path: Path,
    loaded: Any,
    camera: Any,
    overlay: Overlay,
    spp: int = 0,
    seed: int = 0,
    on_strip: OnBand | None = None,
    smoothing: float = 0.0,
) -> OverlayLayers:
    """Render ``camera`` with the AOV of ``overlay``; also return the observer's pixel and the data behind the AOV.

    Surfaces without light are outlined. ``smoothing``: standard deviation in degrees by which a density seen by a
    perspective camera is smoothed on surfaces.
    """
    quantity = overlay.quantity
    has_outlines = shows_unlit_surfaces(loaded)
    sigma = smoothing * pixels_per_degree(camera) if quantity.display.kind == "heat" else 0.0
    aovs = [quantity.name, "opacity", "depth", *["position"] * has_outlines, *["visibility"] * (sigma > 0)]
    aovs = list(dict.fromkeys(aovs))
    with translate_mitsuba_errors():
        channels = render_aovs(path, loaded, camera, aovs, spp, seed, on_strip)
    if overlay.name not in channels.aovs:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(channels.aovs)}')
    marker = observer_pixel(loaded, camera, channels.aovs["depth"])
    supported = not quantity.needs_support or is_supported(loaded, camera)
    basis = describe_basis(loaded, quantity.data_source)
    color, values = channels.color, channels.aovs[overlay.name]
    if has_outlines:
        position = np.stack([channels.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1)
        color = draw_outlines(color, position, channels.mask)
    if sigma > 0:
        values = _smooth_density(values, channels, loaded, sigma)
        basis = describe_smoothing(basis, smoothing)
    return OverlayLayers(color, values, channels.mask, marker, supported, basis)


def _smooth_density(values: np.ndarray, channels: Channels, loaded: Any, sigma: float) -> np.ndarray:
    """Smooth a density (h, w) on surfaces, divided by the visibility before, so that shadows keep their border."""
    visible = channels.aovs["visibility"] if loaded.integrator().occlusion else 1.0
    weights = np.where(channels.mask, visible, 0.0)
    weights = np.where(weights > _MIN_VISIBILITY, weights, 0.0)
    unoccluded = np.divide(values, weights, out=np.zeros_like(weights), where=weights > 0)
    return weights * smooth_on_surfaces(unoccluded, weights, channels.aovs["depth"], sigma)


def smooth_gaze(channels: Channels, loaded: Any, camera: Any, smoothing: float = SMOOTHING) -> Channels:
    """Return the image of ``camera`` with its AOV ``gaze`` smoothed by ``smoothing`` degrees on surfaces.

    It needs the AOV ``depth``, and ``visibility`` if the scene has occlusion.
    """
    width = channels.mask.shape[1] / camera.film().crop_size()[0]
    sigma = smoothing * pixels_per_degree(camera) * width
    if not sigma > 0:
        return channels
    gaze = _smooth_density(channels.aovs["gaze"], channels, loaded, sigma)
    return replace(channels, aovs={**channels.aovs, "gaze": gaze})


def describe_smoothing(basis: str, smoothing: float = SMOOTHING) -> str:
    """Return the note ``basis`` on the data with a note on the smoothing."""
    return "; ".join(filter(None, [basis, f"smoothed by {smoothing:g}°"]))


def shows_unlit_surfaces(loaded: Any) -> bool:
    """Return whether the surfaces of a scene have neither light nor colours of photos: shapes without emitters, or hit
    points."""
    integrator = loaded.integrator()
    is_volume = integrator.medium is None or isinstance(integrator.medium, VolumeMedium)
    return is_volume and integrator.shading.nested is None and not len(loaded.emitters())


def pixels_per_degree(camera: Any) -> float:
    """Return the pixels per degree in the centre of the image of a perspective ``camera``; 0 for other cameras."""
    import mitsuba as mi

    if camera.class_name() != "PerspectiveCamera":
        return 0.0
    half = np.radians(float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0])) / 2
    return float(np.radians(1) * camera.film().size()[0] / 2 / np.tan(half))


def describe_basis(loaded: Any, part: str = "gaze") -> str:
    """Describe the rays and participants behind a ``part`` of the scene, "gaze" or "kde"; "" if unknown."""
    volume = loaded.integrator().children.get(part)
    if volume is None:
        return ""
    basis = volume.kde_view().basis if part == "kde" else volume.field.basis
    return "" if basis is None else f"data: {basis.words()}"


def describe_bases(loaded: Any) -> dict[str, str]:
    """Return these descriptions for image headers, under the keys "gaze.basis" and "kde.basis"."""
    if not is_nerg(loaded.integrator()):
        return {}
    parts = dict.fromkeys(aov.data_source for aov in AOVS.values() if aov.data_source)
    words = {f"{part}.basis": describe_basis(loaded, part) for part in parts}
    return {name: text for name, text in words.items() if text}


def is_supported(loaded: Any, camera: Any) -> bool:
    """Return whether at least `SUPPORT` rays were recorded around the observer of the scene, or else the ``camera``.

    A gaze field that does not store its support counts as supported.
    """
    integrator = loaded.integrator()
    gaze = integrator.gaze
    if gaze is None or gaze.field.support is None:
        return True
    eye = sensor_center(integrator.observer or camera)
    return float(np.ravel(np.array(gaze.field.support.evaluate(gaze.to_world.point_to_local(eye))))[0]) >= SUPPORT


def describe_observer(loaded: Any) -> str:
    """Return a sentence if the observer of a ``loaded`` scene is at a position where gaze and visibility are
    extrapolated, else ""."""
    integrator = loaded.integrator()
    if not is_nerg(integrator) or integrator.observer is None:
        return ""
    position = np.ravel(np.array(sensor_center(integrator.observer), np.float64))
    return describe_extrapolation(SceneGeometry(integrator.medium, loaded), integrator.gaze, position)


def warn_observer(loaded: Any, reporter: Reporter) -> None:
    """Warn with the sentence of `describe_observer`, if there is one."""
    if sentence := describe_observer(loaded):
        reporter.warn(sentence)


def _name_picture(index: int, count: int) -> str:
    """Return the beginning of a sentence on one picture of a sequence."""
    return f"picture {index + 1}: " if count > 1 else ""


def observer_pixel(loaded: Any, camera: Any, depth: np.ndarray) -> tuple[float, float] | None:
    """Return the pixel of the scene's observer if it is visible from ``camera``, else None."""
    observer = loaded.integrator().observer
    if observer is None or camera.class_name() != "PerspectiveCamera":
        return None
    eye = sensor_center(observer)
    pixel = project_to_pixel(camera, eye)
    if pixel is None:
        return None
    column, row = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(pixel, depth.shape[::-1]))
    away = float(np.linalg.norm(np.ravel(np.array(eye - sensor_center(camera)))))
    before = depth[row, column]
    return pixel if not 0 < before < away else None


# ---- Rendering a scene file to an image file ----

VIDEO = ".mp4"

_RECORDED_OPTIONS = ("overlay", "vmax", "cmap", "log_decades", "hatching", "smoothing")

RESERVE = 150e6
"""Bytes reserved in addition to a band: for its strips and the first kernel compilation."""


@dataclass(frozen=True)
class PictureResult:
    """A rendered image or sequence.

    Attributes
    ----------
    path
        First written file.
    size
        Width and height in pixels.
    channels
        Number of channels.
    mode
        Mitsuba variant.
    seconds
        Run time.
    undivided_reason
        Why the image was not rendered in bands although it exceeded the memory limit, or None.
    files
        All written files.
    top
        Upper end of the colour scale of overlays, or None.
    observer_note
        Why the gaze of the observer is extrapolated, in the first picture where it is; "" if it is not.
    """

    path: Path
    size: tuple[int, int]
    channels: int
    mode: str
    seconds: float
    undivided_reason: str | None
    files: tuple[Path, ...] = ()
    vmax: float | None = None
    observer_note: str = ""


@dataclass(frozen=True)
class RenderPlan:
    """Values of `<default>`s for each of ``frames``, and the ``files`` to write, or a single ``video``."""

    frames: Sequence[Mapping[str, str]]
    files: list[Path]
    video: bool


def plan_render(scene: Path, output: Path, options: PictureOptions) -> RenderPlan:
    """Return what `render_file` would render.

    Raises `NergError` for contradictory options, and for files that cannot be read or written, before any work.
    """
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
    """Render the scene file ``scene`` to the image ``output``, whose folder is created.

    Parameters
    ----------
    scene
        Scene file.
    output
        Image: .exr holds all channels including AOVs as float32, .png the sRGB colour. With ``options.overlay``, a .png
        or .svg of the colour with that AOV drawn over it and a colour scale; the AOV need not be in the scene's list.
        With ``options.frames``, one image per line of that file with a number in its name, or one video (.mp4). A
        sequence of overlays has a common colour scale, so all images are rendered before the first is drawn, unless
        ``options.vmax`` is set. The header of each file holds its provenance (`nerg_mi.figures.style`).
    options
        Sampling, overlay and memory limit.
    reporter
        Receives messages and progress.

    Raises
    ------
    NergError
        For errors that the user can correct.
    KeyboardInterrupt
        Within a second after Ctrl-C. Images of a sequence that have been written are complete.

    Notes ----- An image that exceeds ``options.memory`` is rendered in bands of rows. With a box filter its pixels do
    not depend on the bands; with wider filters they differ by rounding in single precision (`nerg_mi.rendering.bands`).
    Samplers other than `independent`, films other than `hdrfilm`, scalar and spectral variants, and Mitsuba's
    differentiable integrators are rendered in one piece, and a message tells if that exceeds the limit. An overlay is
    drawn in one piece, and rejected if that exceeds the limit.
    """
    options = options or PictureOptions()
    scene, output = Path(scene), Path(output)
    render_plan = plan_render(scene, output, options)
    frames, files, video = render_plan.frames, render_plan.files, render_plan.video
    reporter.progress(0.0, "reading the scene")
    mode = activate_variant(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start, pace = time.perf_counter(), SamplePace()
    done, top, picture, observer_note = 0, None, RenderedPicture((0, 0), 0), ""
    trial = ConstantWeightsTrial(len(frames))
    with Interruption() as stop:

        def on_strip(part: int, total: int) -> None:
            stop.check()
            share = (done + part / total) / len(frames)
            seconds = max(time.perf_counter() - start, 1e-9)
            speed = f"{part / seconds:,.0f} samples/s" if len(frames) == 1 else f"{done} of {len(frames)} pictures"
            if share >= 1:
                reporter.progress(
                    1.0, f"writing {files[-1].name}" if options.overlay is None else "drawing the overlay"
                )
            else:
                reporter.progress(share, f"rendering, {speed}, {seconds * (1 - share) / share:.0f} s left")

        def render(frame: Mapping[str, str], make: Make) -> RenderedPicture:
            nonlocal done, observer_note
            loaded = load_scene(scene, {**(options.defaults or {}), **frame})
            stop.check()
            if not observer_note:
                observer_note = describe_observer(loaded)
                if observer_note:
                    reporter.warn(_name_picture(done, len(frames)) + observer_note)
            camera = find_sensor(scene, loaded, options.sensor)
            samples = sample_count(camera, options.spp)
            constant, begin = trial.prepare(samples, loaded), time.perf_counter()
            made = make(loaded, camera, on_strip)
            trial.record(constant, samples, time.perf_counter() - begin)
            done += 1
            return made

        each = make_provenances(scene, frames, options, mode, video)
        with _writer(files, options, each, video) as write:
            if options.overlay is not None:
                drawn = lambda figure: write(
                    lambda path, metadata: save(figure, path, metadata), lambda: rasterize(figure)
                )
                picture, top = render_overlays(scene, frames, drawn, options, render, stop)
            else:
                for frame in frames:
                    picture = render(frame, partial(_picture, write, options, stop, pace))
        # The image is complete, but the caller must not continue.
        stop.check()
    seconds = time.perf_counter() - start
    result = PictureResult(
        files[0],
        picture.size,
        picture.channels,
        mode,
        seconds,
        picture.undivided_reason,
        tuple(files),
        top,
        observer_note,
    )
    reporter.message(summary_line(result, render_plan, options))
    return result


def summary_line(result: PictureResult, render_plan: RenderPlan, options: PictureOptions) -> str:
    """Return the line that reports what was written."""
    files, frames = render_plan.files, render_plan.frames
    note = f" It was rendered in one piece, above {options.memory:g} GB, because of {result.undivided_reason}."
    width, height = result.size
    what = str(files[0]) if len(files) == 1 else f"{len(files)} images, {files[0]} to {files[-1]}"
    what += f", {len(frames)} frames at {options.fps:g} per second" if render_plan.video else ""
    scale = "" if result.vmax is None else f", colour scale up to {result.vmax:.4g}"
    return (
        f"Wrote {what} ({width} x {height}, {result.channels} channels, {result.mode}, {result.seconds:.1f} s{scale})."
        f"{note if result.undivided_reason else ''}"
    )


Write = Callable[[Callable[[Path, Provenance], None], Callable[[], np.ndarray]], None]
"""Writes the next image: to a file by the first function, or as a frame of a video with the pixels of the second."""


@contextmanager
def _writer(files: Sequence[Path], options: PictureOptions, each: Iterator[Provenance], video: bool) -> Iterator[Write]:
    """Yield the function that writes images to ``files``, or to the single video."""
    if not video:
        remaining = iter(files)
        yield lambda store, pixels: store(next(remaining), next(each))
        return
    with open_video_writer(files[0], options.fps, next(each).text()) as add:
        yield lambda to_file, pixels: add(pixels())


def make_provenances(
    scene: Path, frames: Sequence[Mapping[str, str]], options: PictureOptions, mode: str, video: bool
) -> Iterator[Provenance]:
    """Yield the provenance of each image, or of the video."""
    checksums: dict[Path, str] = {}
    recorded = {name: getattr(options, name) for name in _RECORDED_OPTIONS} if options.overlay else {}
    recorded |= {"mode": mode, "sensor": options.sensor, "spp": options.spp}
    for frame in frames[:1] if video else frames:
        values = {**(options.defaults or {}), **({} if video else frame)}
        inputs = list_scene_files(scene, {**values, **frame})
        if video and options.frames is not None:
            inputs, recorded["fps"] = [*inputs, options.frames], options.fps
        yield make_provenance("nerg render", inputs, options.seed, recorded | {"defaults": values}, checksums)


def _check_video(output: Path, options: PictureOptions) -> bool:
    """Return whether ``output`` is a video. Raises `NergError` for contradictory options."""
    if output.suffix.lower() == VIDEO:
        if options.frames is None:
            raise NergError(
                f'"{output}" is a video, and there is a single image; add {parameter("frames")}, or use another '
                "name (.png)"
            )
        check_video_output(options.fps)
        return True
    if options.fps != PictureOptions().fps:
        raise NergError(
            f'{parameter("fps")} applies to videos only, and "{output}" is not one; use a name that ends in {VIDEO}'
        )
    if options.overlay is None and output.suffix.lower() not in IMAGE_FORMATS:
        raise NergError(
            f'"{output}" can only hold an overlay; add {parameter("overlay")}, or use a name that ends in '
            f"{' or '.join(IMAGE_FORMATS)}"
        )
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
    """Render ``camera`` and write the image."""
    width, height = map(int, camera.film().crop_size())
    rows = bands.fit_rows_to_memory(loaded, camera, 1e9 * options.memory - resident_bytes() - RESERVE)
    undivided_reason = bands.undividable_reason(loaded, camera) if rows < height else None
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

    def to_file(path: Path, record: Provenance) -> None:
        with open_image_rows(path, width, height, record.text() | describe_bases(loaded)) as add:
            fill(add)

    def pixels() -> np.ndarray:
        display = DisplayRows(width, height)
        fill(display.add)
        return display.pixels()

    with translate_mitsuba_errors():
        write(to_file, pixels)
    return RenderedPicture((width, height), channels, undivided_reason)


def find_sensor(path: Path, scene, index: int):
    """Return the sensor with this ``index``. Raises `NergError` if there is none, or no integrator."""
    if scene.integrator() is None:
        raise NergError(f'the scene "{path}" has no integrator; add one, such as <integrator type="nerg"/>')
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise NergError(f'"{path}" has {count} sensor(s), and index {index} is out of range: -s counts from 0')
    return scene.sensors()[index]


def sample_count(camera: Any, spp: int) -> int:
    """Return the number of samples of an image: ``spp`` per pixel, or that of the sampler if it is 0."""
    width, height = map(int, camera.film().crop_size())
    return width * height * (spp or camera.sampler().sample_count())


def resident_bytes() -> int:
    """Return the resident memory of this process in bytes, or its maximum where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource
        import sys

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


# ---- Rendering sequences in parts ----


_LAYERS_SHARE = 0.8
"""Fraction of the work that is rendering, for a sequence with a common colour scale; the rest is drawing."""


def render_film(
    scene: str | Path, output: str | Path, options: FilmOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` to ``output`` like `render_file`, with bitwise the same result.

    With ``options.store`` or ``options.scheduler`` each image of a sequence is a part, which is stored and not rendered
    again: after any interruption, the same call resumes. A part depends on the scene, on the files that it refers to,
    on its own values and on the options; parts whose inputs have changed are rendered again.
    """
    options = options or FilmOptions()
    if not options.in_parts:
        return render_file(scene, output, options, reporter)
    # Imported here, because a single image does not need it.
    from .parts import PartRunner

    scene, output = Path(scene), Path(output)
    render_plan = plan_render(scene, output, options)
    parts = PartRunner(options, output, reporter, options.threads)
    reporter.progress(0.0, "reading the scene")
    mode = activate_variant(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    first, top, observer_note = _render_in_parts(scene, render_plan, replace(options, mode=mode), parts, reporter)
    size, channels = (int(first["size"][0]), int(first["size"][1])), int(first.get("channels", 3))
    seconds = time.perf_counter() - start
    result = PictureResult(
        render_plan.files[0],
        size,
        channels,
        mode,
        seconds,
        first.get("whole"),
        tuple(render_plan.files),
        top,
        observer_note,
    )
    reporter.message(summary_line(result, render_plan, options))
    reporter.message(f"The parts are stored in {parts.store.folder}; nerg jobs shows their size.")
    return result


def _render_in_parts(
    scene: Path, render_plan: RenderPlan, options: FilmOptions, parts: PartRunner, reporter: Reporter
) -> tuple[Mapping[str, Any], float | None, str]:
    """Render all images. Returns the notes of the last part, the upper end of the colour scale, and why the gaze of
    the observer is extrapolated, of which it warns once."""
    from nerg_mi.tasks.task import Part, Plan

    from .parts import PlannedScene

    suffix = ".png" if render_plan.video else render_plan.files[0].suffix.lower()
    what = f"nerg render {os.path.abspath(render_plan.files[0])}"
    inputs = picture_options(options)
    frames = [
        Part(PlannedScene.plan(scene, {**(options.defaults or {}), **frame}), f"picture {k + 1}")
        for k, frame in enumerate(render_plan.frames)
    ]
    overlay = None if options.overlay is None else find_overlay(options.overlay)
    observer_note = ""

    def report_observer(index: int, notes: Mapping[str, Any]) -> None:
        # Parts of earlier versions have no such note.
        nonlocal observer_note
        if not observer_note and (observer_note := notes.get("observer", "")):
            reporter.warn(_name_picture(index, len(frames)) + observer_note)

    if overlay is None or not uses_shared_scale(overlay, len(frames), options):
        plan = Plan(what, make_picture, inputs, frames, suffix)
        last = _copy_outputs(scene, render_plan, options, parts, plan, 0.0, report_observer)
        return last, last.get("top"), observer_note
    # Render all, then determine the common colour scale, then draw all.
    layers = list(parts.run(Plan(f"{what} (values)", make_layers, inputs, frames, ".npy"), 0.0, _LAYERS_SHARE))
    for k, made in enumerate(layers):
        report_observer(k, made.notes)
    limits = [None if made.notes["limits"] is None else tuple(made.notes["limits"]) for made in layers]
    ends = shared_limits(limits, options.vmax)
    overlay.check_limits(ends)
    drawings = []
    for k, (frame, made) in enumerate(zip(render_plan.frames, layers)):
        header = {}
        if not render_plan.video:
            header = next(make_provenances(scene, [frame], options, str(options.mode), False)).text()
        notes = {name: made.notes[name] for name in ("marker", "supported", "basis")}
        drawings.append(Part(LayerDrawing(made.path, ends, **notes, header=header), f"drawing {k + 1}"))
    _copy_outputs(scene, render_plan, options, parts, Plan(what, draw_layers, inputs, drawings, suffix), _LAYERS_SHARE)
    return layers[-1].notes, None if ends is None else ends[1], observer_note


def _copy_outputs(
    scene: Path,
    render_plan: RenderPlan,
    options: FilmOptions,
    parts: PartRunner,
    plan: Any,
    since: float,
    on_output: Callable[[int, Mapping[str, Any]], None] = lambda index, notes: None,
) -> Mapping[str, Any]:
    """Copy the outputs of ``plan`` to the output files, in order. Returns the notes of the last part.

    ``on_output`` is called with the index and the notes of each part.
    """
    last: Mapping[str, Any] = {}
    arriving = parts.run(plan, since)
    if not render_plan.video:
        for index, (file, made) in enumerate(zip(render_plan.files, arriving)):
            last = made.notes
            on_output(index, last)
            with replace_atomically(file) as temporary:
                shutil.copyfile(made.path, temporary)
        return last
    import mitsuba as mi

    headers = make_provenances(scene, render_plan.frames, options, str(options.mode), True)
    with open_video_writer(render_plan.files[0], options.fps, next(headers).text()) as add:
        for index, made in enumerate(arriving):
            last = made.notes
            on_output(index, last)
            add(np.array(mi.Bitmap(str(made.path)))[..., :3])
    return last


# ---- Parts ----


def picture_options(options: PictureOptions) -> PictureOptions:
    """Return the ``options`` of a single image: a part has its own values, and does not depend on the video."""
    return replace(to_base(options, PictureOptions), defaults=None, frames=None, fps=PictureOptions().fps)


def make_picture(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """Write an image file like `render_file`."""
    made = render_file(scene.checked_path(), output, replace(options, defaults=scene.defaults))
    notes = {"size": made.size, "channels": made.channels, "whole": made.undivided_reason, "top": made.vmax}
    return notes | {"observer": made.observer_note}


def make_layers(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """Write the colour and the AOV of an image (.npy), and return what its colour scale depends on."""
    path = scene.checked_path()
    activate_variant(options.mode)
    overlay = find_overlay(options.overlay or "")
    with Interruption() as stop:
        loaded = load_scene(path, scene.defaults)
        camera = find_sensor(path, loaded, options.sensor)
        check_memory(path, camera, options)
        check = lambda *_: stop.check()
        observer_note = describe_observer(loaded)
        layers = render_layers(path, loaded, camera, overlay, options.spp, options.seed, check, options.smoothing)
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
        "observer": observer_note,
    }


@dataclass(frozen=True)
class LayerDrawing:
    """The ``layers`` (.npy) of `make_layers` with its notes, the ``ends`` of the colour scale, the file ``header``."""

    layers: Path
    ends: Limits
    marker: Sequence[float] | None
    supported: bool
    basis: str
    header: Mapping[str, str]


def draw_layers(options: PictureOptions, drawing: LayerDrawing, output: Path) -> None:
    """Draw the figure of the layers of an image."""
    marker = None if drawing.marker is None else (drawing.marker[0], drawing.marker[1])
    layers = unstack_layers(read_npy(drawing.layers, "layers"), marker, drawing.supported, drawing.basis)
    figure = find_overlay(options.overlay or "").draw(layers, drawing.ends, overlay_style(options))
    save(figure, output, drawing.header)
