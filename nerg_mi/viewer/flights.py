"""Flights of the viewer's camera: recorded, played, and filmed."""

from __future__ import annotations

import csv
import io
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from nerg_mi.errors import NergError, is_user_error, format_error
from nerg_mi.files.atomic import write_text
from nerg_mi.files.video import check_video_output
from nerg_mi.rendering.scene_writer import format_numbers
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene_commands import PictureOptions

from . import layers
from .controls import tell, telling
from .layers import Layer, Scale
from .page import Page
from .points import PinholeView
from .scene import CAMERA, TARGET, Shown, ceiling_of, check_copied, copied
from .session import URGENCY

# ---- A flight as a video, made on the render thread in turns with everything else ----
#
# The job behind ``nerg render --frames`` does it, which knows nothing of turns: it runs in a thread of its own, which
# goes on only while the render thread waits for it, so that Dr.Jit is used by one of them at a time.

_EVEN = 2


def even(view: PinholeView, width: int) -> tuple[PinholeView, int]:
    """``view`` and ``width`` with as many pixels in each row and column as a video has: even numbers of them."""
    wide = max(width // _EVEN * _EVEN, 16)
    high = max(round(wide / view.aspect / _EVEN) * _EVEN, 16)
    return replace(view, aspect=wide / high), wide


def film_options(layer: Layer, scale: Scale, frames: Path, fps: float, mode: str) -> PictureOptions:
    """How `render_file` draws the frames of the file ``frames`` as ``layer`` shows them, with the ends and colours of
    ``scale``."""
    overlay = layer.overlay
    options = PictureOptions(frames=frames, fps=fps, mode=mode)
    if overlay is None:
        return options
    top, cmap = scale.high if overlay.needs_limits else None, None if layer.kind == "shade" else scale.colors
    return replace(options, overlay=overlay.name, vmax=top, cmap=cmap)


class Film:
    """A video that is being made of the scene file ``scene``: ``steps`` is what the `Worker` runs.

    ``on_progress(share, text)`` is told how far it is; ``on_end(error)`` of its end, with what went wrong, or None;
    after `cancel` it is `KeyboardInterrupt`, and no file is left.
    """

    def __init__(
        self,
        scene: Path,
        output: Path,
        options: PictureOptions,
        on_progress: Callable[[float, str], None],
        on_end: Callable[[BaseException | None], None],
    ):
        self._given = scene, output, options
        self._on_progress, self._on_end = on_progress, on_end
        self._go, self._paused = threading.Semaphore(0), threading.Semaphore(0)
        self._over = self._cancelled = False
        self._error: BaseException | None = None

    def cancel(self) -> None:
        """Make no further frame."""
        self._cancelled = True

    def steps(self) -> Iterator[None]:
        """Each makes a strip of a picture."""
        threading.Thread(target=self._run, name="nerg-view-film", daemon=True).start()
        try:
            while not self._over:
                self._go.release()
                self._paused.acquire()
                yield None
        finally:
            # Whoever drops the steps ends the job, too: nothing else would let its thread go on.
            while not self._over:
                self._cancelled = True
                self._go.release()
                self._paused.acquire()
            self._on_end(self._error)

    def _run(self) -> None:
        self._go.acquire()
        try:
            render_file(*self._given, self)
        except BaseException as error:
            self._error = error
        self._over = True
        self._paused.release()

    # The job's reporter

    def progress(self, share: float, text: str = "") -> None:
        """Let the others have their turn."""
        self._on_progress(share, text)
        self._paused.release()
        self._go.acquire()
        if self._cancelled:
            raise KeyboardInterrupt

    def message(self, text: str) -> None:
        """What is written is the page's to say."""

    def warn(self, text: str) -> None:
        """As any other progress."""
        self._on_progress(0.0, text)


def shown_of_flight(views: list[PinholeView], width: int, **others: Any) -> tuple[list[PinholeView], Shown]:
    """The ``views`` of a flight with even sides, and what their scene file is made of: the first of them, and what
    `Shown` has besides."""
    made = [even(view, width) for view in views]
    first, wide = made[0]
    return [replace(view, aspect=first.aspect, fov=first.fov) for view, _ in made], Shown(first, width=wide, **others)


# ---- Flights ----
#
# A camera's flight through views that were kept, as the frames of a sequence that `nerg render --frames` renders.

MOST = 20_000
"""Frames of a flight at most."""


def flight(views: Sequence[PinholeView], seconds: float, fps: float) -> list[PinholeView]:
    """Views ``fps`` times a second on a smooth curve through ``views``, which it passes at equal intervals.

    A cubic spline with its ends at rest; two views are joined by a line. Raises `NergError` for less than two.
    """
    if len(views) < 2:
        raise NergError("a flight needs two views at least; keep another one")
    count = round(seconds * fps) + 1
    if not 2 <= count <= MOST:
        raise NergError(f"a flight has 2 to {MOST:,} frames, and {seconds:g} s at {fps:g} a second are {count:,}")
    at = np.linspace(0, len(views) - 1, count)
    known = np.array([np.concatenate([v.origin, v.origin + v.ahead, v.up]) for v in views])
    curve = CubicSpline(np.arange(len(views)), known, bc_type="clamped")(at)
    last = views[-1]
    return [PinholeView.of(row[:3], row[3:6], row[6:], last.fov, last.aspect) for row in curve]


def frames_csv(views: Sequence[PinholeView]) -> str:
    """The text of a file of frames for a scene that `scene.copied` wrote."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([CAMERA, TARGET])
    writer.writerows([format_numbers(v.origin), format_numbers(v.target)] for v in views)
    return text.getvalue()


# ---- Flying ----
#
# The part of the panel for a camera's flight: views that are kept, and their frames or their video.

TITLE = "Flight"


class Flying:
    """A folder of a `Page`'s panel. One video is made at a time, whoever asked for it."""

    def __init__(self, page: Page):
        self.page, self.session = page, page.session
        self._kept: list[PinholeView] = []
        self._film: Film | None = None
        gui = page.server.gui
        with gui.add_folder(TITLE, expand_by_default=False):
            keep = gui.add_button("Keep this view")
            forget = gui.add_button("Forget the views")
            self._seconds = gui.add_number("Seconds", 6.0, min=0.1, max=3600.0, step=0.5)
            self._fps = gui.add_number("Frames a second", 25.0, min=1.0, max=120.0, step=1.0)
            frames = gui.add_button("Save the frames (CSV)")
            self._make = gui.add_button("Make a video (MP4)")
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._said = gui.add_markdown("", visible=False)
            self._cancel = gui.add_button("Cancel the video", visible=False)
        keep.on_click(self._keep)
        frames.on_click(self._save_frames)
        self._make.on_click(self._begin)
        forget.on_click(lambda event: self._kept.clear())

        @self._cancel.on_click
        def _(event: Any) -> None:
            if self._film is not None:
                self._film.cancel()

    def _keep(self, event: Any) -> None:
        self._kept.append(PinholeView.of_page(event.client.camera))
        count = len(self._kept)
        tell(event, TITLE, "One view is kept." if count == 1 else f"{count} views are kept.")

    def _save_frames(self, event: Any) -> None:
        with telling(event, TITLE):
            text = frames_csv(flight(self._kept, self._seconds.value, self._fps.value))
            event.client.send_file_download("view.frames.csv", text.encode(), save_immediately=True)
            tell(event, TITLE, "nerg render view.xml -o flight.mp4 --frames view.frames.csv renders it.")

    def _begin(self, event: Any) -> None:
        """Make a video, and send it to the page that asked."""
        session, client, shade = self.session, event.client, self.session.shade
        if self._film is not None:
            tell(client, TITLE, "A video is being made already; cancel it, or wait for it.")
            return
        folder = tempfile.TemporaryDirectory()
        try:
            check_video_output(self._fps.value)
            check_copied(session)
            asked = tuple(name for name in layers.quantities(shade.layer) if name != "color")
            views, shown = shown_of_flight(
                flight(self._kept, self._seconds.value, self._fps.value),
                session.options.width,
                observer=session.observer,
                aovs=asked,
                spp=session.spp,
                falloff=session.falloff,
                ceiling=ceiling_of(session),
            )
            scene, frames, video = (Path(folder.name, name) for name in ("view.xml", "view.frames.csv", "flight.mp4"))
            write_text(scene, copied(session.scene_file, shown))
            write_text(frames, frames_csv(views))
        except (NergError, ImportError) as error:
            folder.cleanup()
            tell(client, TITLE, format_error(error))
            return

        def end(error: BaseException | None) -> None:
            try:
                if error is None:
                    client.send_file_download("flight.mp4", video.read_bytes(), save_immediately=True)
                elif isinstance(error, KeyboardInterrupt):
                    tell(client, TITLE, "The video was cancelled.")
                elif is_user_error(error):
                    tell(client, TITLE, format_error(error))
                else:
                    self.page.on_error(error)
            finally:
                folder.cleanup()
                self._film = None
                self._show(False)

        options = film_options(shade.layer, session.scale(), frames, self._fps.value, session.mode)
        self._film = Film(scene, video, options, self._progress, end)
        self._show(True)
        self._progress(0.0, "the video waits for its turn")
        session.worker.submit("film", URGENCY, self._film.steps())

    def _progress(self, share: float, text: str) -> None:
        self._bar.value = 100 * share
        self._said.content = text

    def _show(self, making: bool) -> None:
        for handle in (self._bar, self._said, self._cancel):
            handle.visible = making
        self._make.disabled = making
