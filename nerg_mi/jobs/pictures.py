"""From a scene file to a picture file, with the integrator that the scene names."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.files.atomic import check_writable
from nerg_mi.interruption import Interruption
from nerg_mi.rendering import bands
from nerg_mi.rendering.picture_file import FORMATS, picture_rows
from nerg_mi.rendering.pictures import activate, load_scene
from nerg_mi.rendering.scene_file import check_samples
from nerg_mi.threads import set_thread_count

from .options.pictures import PictureOptions
from .reporter import SILENT, Reporter

RESERVE = 150e6
"""Bytes kept free beside a band, for the strips in it and for the kernel that is compiled first."""


@dataclass(frozen=True)
class PictureResult:
    """The picture ``path``: ``size`` (width, height) in pixels, number of ``channels``, the variant ``mode`` and the
    ``seconds`` that made it; ``whole``: why it could not be divided though it needed more than the memory, or None."""

    path: Path
    size: tuple[int, int]
    channels: int
    mode: str
    seconds: float
    whole: str | None


def render_file(
    scene: str | Path, output: str | Path, options: PictureOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` and write the picture ``output``, whose folder is made.

    ``output`` ends in .exr (all channels of the film, AOVs among them, as float32) or in .png (its colour, tonemapped
    to sRGB).

    A picture that needs more than ``options.memory`` is rendered in bands of rows, as large as fit beside what the
    scene itself takes. Its pixels do not depend on that where the film has a box filter; with wider filters they differ
    by the rounding of single precision (`nerg_mi.rendering.bands`). Samplers other than `independent`, films other than
    `hdrfilm`, scalar and spectral variants and Mitsuba's differentiable integrators are rendered in one piece, and the
    message says so where that is more than ``memory``.

    Raises `NergError` for what the user can mend, and ``KeyboardInterrupt``, between two steps of less than a second,
    after Ctrl-C.
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
    mode = activate(options.mode)

    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    with Interruption() as stop:

        def on_strip(done: int, total: int) -> None:
            stop.check()
            speed = done / max(time.perf_counter() - start, 1e-9)
            reporter.progress(done / total, f"{speed:,.0f} samples/s, {(total - done) / speed:.0f} s left")

        loaded = load_scene(scene, options.defaults)
        stop.check()
        camera = _sensor(scene, loaded, options.sensor)
        width, height = map(int, camera.film().crop_size())
        rows = bands.rows_for(loaded, camera, 1e9 * options.memory - resident_bytes() - RESERVE)
        whole = bands.why_whole(loaded, camera) if rows < height else None
        channels = 0
        with mitsuba_says(), picture_rows(output, width, height) as write:
            pieces = bands.render_bands(
                loaded, camera, spp=options.spp, seed=options.seed, rows=rows, on_strip=on_strip
            )
            for band in pieces:
                bitmap = band.film.bitmap()
                channels = bitmap.channel_count()
                write(bitmap, band.rows)
                stop.check()
        # The picture is there, and yet whoever called this does not go on.
        stop.check()
    seconds = time.perf_counter() - start
    note = f" It was rendered in one piece, beyond {options.memory:g} GB, because of {whole}." if whole else ""
    reporter.message(f"Wrote {output} ({width} x {height}, {channels} channels, {mode}, {seconds:.1f} s).{note}")
    return PictureResult(output, (width, height), channels, mode, seconds, whole)


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
