"""From a scene file to a picture file, with the integrator that the scene names."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.files.atomic import check_writable
from nerg_mi.interruption import Interruption
from nerg_mi.rendering import bands
from nerg_mi.rendering.frames_file import numbered, read_frames
from nerg_mi.rendering.picture_file import FORMATS, picture_rows
from nerg_mi.rendering.pictures import activate, load_scene
from nerg_mi.rendering.scene_file import check_samples
from nerg_mi.threads import set_thread_count

from .options.pictures import PictureOptions
from .overlays import Make, OnStrip, Picture, check_overlay, overlay_pictures
from .reporter import SILENT, Reporter

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


def render_file(
    scene: str | Path, output: str | Path, options: PictureOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` and write the picture ``output``, whose folder is made.

    ``output`` ends in .exr (all channels of the film, AOVs among them, as float32) or in .png (its colour, tonemapped
    to sRGB). With ``options.overlay`` it is a .png of the colour with that quantity over it and a scale beside it; the
    scene's list of AOVs need not have it. With ``options.frames`` there is a picture for each line of that file, with a
    number added to its name; one scale serves all overlays, for which all are rendered before the first is written.

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
    check_writable(output, *FORMATS)
    if not options.memory > 0:
        raise NergError(f"the memory to render in is {options.memory} GB: give it more than 0.")
    if options.spp:
        check_samples(options.spp, "the picture")
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}".')
    check_overlay(output, options)
    frames: Sequence[Mapping[str, str]] = [{}]
    files = [output]
    if options.frames is not None:
        frames = read_frames(options.frames)
        files = [numbered(output, k + 1, len(frames)) for k in range(len(frames))]
        for file in files:
            check_writable(file)
    mode = activate(options.mode)

    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    done, top = 0, None
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
            made = make(loaded, _sensor(scene, loaded, options.sensor), on_strip)
            done += 1
            return made

        if options.overlay is not None:
            picture, top = overlay_pictures(scene, frames, files, options, render, stop)
        else:
            made = [render(frame, partial(_picture, file, options, stop)) for frame, file in zip(frames, files)]
            picture = made[-1]
        # The picture is there, and yet whoever called this does not go on.
        stop.check()
    seconds = time.perf_counter() - start
    note = f" It was rendered in one piece, beyond {options.memory:g} GB, because of {picture.whole}."
    width, height = picture.size
    what = str(output) if options.frames is None else f"{len(files)} pictures, {files[0]} to {files[-1]}"
    scale = "" if top is None else f", scale to {top:.4g}"
    reporter.message(
        f"Wrote {what} ({width} x {height}, {picture.channels} channels, {mode}, {seconds:.1f} s{scale})."
        f"{note if picture.whole else ''}"
    )
    return PictureResult(files[0], picture.size, picture.channels, mode, seconds, picture.whole, tuple(files), top)


def _picture(
    output: Path, options: PictureOptions, stop: Interruption, loaded: Any, camera: Any, on_strip: OnStrip
) -> Picture:
    """Render what ``camera`` sees, and write it to ``output``."""
    width, height = map(int, camera.film().crop_size())
    rows = bands.rows_for(loaded, camera, 1e9 * options.memory - resident_bytes() - RESERVE)
    whole = bands.why_whole(loaded, camera) if rows < height else None
    channels = 0
    with mitsuba_says(), picture_rows(output, width, height) as write:
        pieces = bands.render_bands(loaded, camera, spp=options.spp, seed=options.seed, rows=rows, on_strip=on_strip)
        for band in pieces:
            bitmap = band.film.bitmap()
            channels = bitmap.channel_count()
            write(bitmap, band.rows)
            stop.check()
    return Picture((width, height), channels, whole)


def _sensor(path: Path, scene, index: int):
    """The sensor of ``scene`` with this ``index``."""
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise NergError(f'"{path}" has {count} sensor(s) and number {index} was asked for: choose -s from 0 on.')
    return scene.sensors()[index]


def resident_bytes() -> int:
    """Bytes of memory that this process takes; where the system does not say, the most that it ever took."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource
        import sys

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
