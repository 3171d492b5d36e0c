"""From a scene file to a picture file, with the integrator that the scene names."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.figures.style import Provenance, provenance, rasterize, save
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.video import check_video, video_frames
from nerg_mi.interruption import Interruption
from nerg_mi.rendering import bands
from nerg_mi.rendering.aovs import prepare_for
from nerg_mi.rendering.bands import Pace
from nerg_mi.rendering.files import FORMATS, DisplayRows, numbered, picture_rows, read_frames
from nerg_mi.rendering.scene import activate, files_of_scene, load_scene
from nerg_mi.threads import set_thread_count

from .options.pictures import PictureOptions
from .overlays import OVERLAY_FORMATS, Make, OnStrip, Picture, basis_texts, check_overlay, overlay_pictures
from .reporter import SILENT, Reporter

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
    start, pace = time.perf_counter(), Pace()
    done, top, picture = 0, None, Picture((0, 0), 0)
    with Interruption() as stop:

        def on_strip(part: int, total: int) -> None:
            stop.check()
            share = (done + part / total) / len(frames)
            seconds = max(time.perf_counter() - start, 1e-9)
            speed = f"{part / seconds:,.0f} samples/s" if len(frames) == 1 else f"{done} of {len(frames)} pictures"
            reporter.progress(share, f"{speed}, {seconds * (1 - share) / share:.0f} s left")

        def render(frame: Mapping[str, str], make: Make) -> Picture:
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
    write: Write, options: PictureOptions, stop: Interruption, pace: Pace, loaded: Any, camera: Any, on_strip: OnStrip
) -> Picture:
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
    return Picture((width, height), channels, whole)


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
