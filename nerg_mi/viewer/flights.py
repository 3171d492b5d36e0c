"""Camera flights of the viewer: interpolated, saved as frames, and rendered as videos."""

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

from nerg_mi.errors import NergError, format_error, is_user_error
from nerg_mi.files.atomic import write_text
from nerg_mi.files.video import check_video_output
from nerg_mi.formats.camera_path import CameraPath, format_camera_path
from nerg_mi.rendering.scene_writer import format_numbers
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene_commands import PictureOptions

from . import layers
from .controls import notify, notify_errors
from .layers import Layer, Scale
from .page import Page
from .points import PinholeView
from .scene import CAMERA_DEFAULT, TARGET_DEFAULT, ViewSettings, check_can_copy, copy_scene, get_ceiling
from .session import NORMAL_PRIORITY

# ---- Flight videos ----
#
# `render_file`, the function behind ``nerg render --frames``, renders the video in a thread of its own. That thread and
# the render thread run alternately, so that only one of them uses Dr.Jit at a time.

_SIZE_MULTIPLE = 2


def make_even(view: PinholeView, width: int) -> tuple[PinholeView, int]:
    """Round the size of ``view`` at ``width`` pixels to even numbers, as video codecs require."""
    columns = max(width // _SIZE_MULTIPLE * _SIZE_MULTIPLE, 16)
    rows = max(round(columns / view.aspect / _SIZE_MULTIPLE) * _SIZE_MULTIPLE, 16)
    return replace(view, aspect=columns / rows), columns


def make_video_options(layer: Layer, scale: Scale, frames: Path, fps: float, mode: str) -> PictureOptions:
    """Return the options with which `render_file` draws the frames of the file ``frames`` like ``layer`` with
    ``scale``."""
    overlay = layer.overlay
    options = PictureOptions(frames=frames, fps=fps, mode=mode)
    if overlay is None:
        return options
    vmax, cmap = scale.high if overlay.needs_limits else None, None if layer.kind == "shade" else scale.colors
    return replace(options, overlay=overlay.name, vmax=vmax, cmap=cmap)


class FlightVideo:
    """A video being rendered.

    Parameters
    ----------
    scene : Path
        Scene file.
    output : Path
        Video file to write.
    options : PictureOptions
        Options of `render_file`.
    on_progress : callable
        Called with the fraction done (0 to 1) and a text.
    on_end : callable
        Called at the end with the exception, or None. After `cancel` the exception is `KeyboardInterrupt`, and no file
        is written.
    """

    def __init__(
        self,
        scene: Path,
        output: Path,
        options: PictureOptions,
        on_progress: Callable[[float, str], None],
        on_end: Callable[[BaseException | None], None],
    ):
        self._arguments = scene, output, options
        self._on_progress, self._on_end = on_progress, on_end
        self._resumed, self._paused = threading.Semaphore(0), threading.Semaphore(0)
        self._is_done = self._is_cancelled = False
        self._error: BaseException | None = None

    def cancel(self) -> None:
        """Stop before the next strip of a frame."""
        self._is_cancelled = True

    def steps(self) -> Iterator[None]:
        """Yield after each strip of a frame: the task for the `Worker`."""
        threading.Thread(target=self._run, name="nerg-view-film", daemon=True).start()
        try:
            while not self._is_done:
                self._resumed.release()
                self._paused.acquire()
                yield None
        finally:
            # If the generator is closed early, let the thread run to its end.
            while not self._is_done:
                self._is_cancelled = True
                self._resumed.release()
                self._paused.acquire()
            self._on_end(self._error)

    def _run(self) -> None:
        self._resumed.acquire()
        try:
            render_file(*self._arguments, self)
        except BaseException as error:
            self._error = error
        self._is_done = True
        self._paused.release()

    # Interface of `Reporter`

    def progress(self, fraction: float, text: str = "") -> None:
        """Report the progress and let other tasks run."""
        self._on_progress(fraction, text)
        self._paused.release()
        self._resumed.acquire()
        if self._is_cancelled:
            raise KeyboardInterrupt

    def message(self, text: str) -> None:
        """Ignored: the page reports the result."""

    def warn(self, text: str) -> None:
        """Show a warning as progress."""
        self._on_progress(0.0, text)


def prepare_flight(views: list[PinholeView], width: int, **settings: Any) -> tuple[list[PinholeView], ViewSettings]:
    """Prepare a flight for rendering.

    Parameters
    ----------
    views : list of PinholeView
        The views of the flight.
    width : int
        Width of the frames in pixels.
    **settings
        Other fields of `ViewSettings`.

    Returns
    -------
    tuple of list of PinholeView and ViewSettings
        The views with even sizes, and the settings of the scene file, whose camera is the first view.
    """
    resized = [make_even(view, width) for view in views]
    first, columns = resized[0]
    return [replace(view, aspect=first.aspect, fov=first.fov) for view, _ in resized], ViewSettings(
        first, width=columns, **settings
    )


# ---- Interpolation of views ----

MAX_FRAMES = 20_000
"""Maximum number of frames of a flight."""


def interpolate_views(views: Sequence[PinholeView], seconds: float, fps: float) -> list[PinholeView]:
    """Interpolate a flight through ``views`` with a cubic spline.

    Parameters
    ----------
    views : sequence of PinholeView
        Key views, passed at equal time intervals. The flight starts and ends at rest.
    seconds : float
        Duration in seconds.
    fps : float
        Frames per second.

    Returns
    -------
    list of PinholeView
        One view per frame.

    Raises
    ------
    NergError
        There are fewer than two views, or the number of frames is out of range.
    """
    if len(views) < 2:
        raise NergError("a flight needs at least two views; add another view")
    count = round(seconds * fps) + 1
    if not 2 <= count <= MAX_FRAMES:
        raise NergError(
            f"flights have 2 to {MAX_FRAMES:,} frames, but {seconds:g} s at {fps:g} frames per second are {count:,}"
        )
    parameters = np.linspace(0, len(views) - 1, count)
    key_poses = np.array([np.concatenate([v.origin, v.origin + v.forward, v.up]) for v in views])
    poses = CubicSpline(np.arange(len(views)), key_poses, bc_type="clamped")(parameters)
    last = views[-1]
    return [PinholeView.look_at(row[:3], row[3:6], row[6:], last.fov, last.aspect) for row in poses]


def format_frames(views: Sequence[PinholeView]) -> str:
    """Format views as a CSV file for ``nerg render --frames`` with a scene written by `copy_scene`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([CAMERA_DEFAULT, TARGET_DEFAULT])
    writer.writerows([format_numbers(v.origin), format_numbers(v.target)] for v in views)
    return text.getvalue()


def make_camera_path(views: Sequence[PinholeView], width: int, fps: float) -> CameraPath:
    """Return the views as a camera path of nerfstudio, whose images are ``width`` pixels wide."""
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    for pose, view in zip(poses, views):
        axes = np.cross(view.forward, view.up), view.up, -view.forward
        pose[:3, :3], pose[:3, 3] = np.stack(axes, axis=1), view.origin
    height = max(round(width / views[0].aspect), 1)
    return CameraPath(poses, np.degrees([view.fov for view in views]), width, height, fps)


# ---- Panel ----

TITLE = "Flight"


class FlightPanel:
    """The folder of the panel for camera flights. One video is rendered at a time, for all browsers together."""

    def __init__(self, page: Page):
        self.page, self.session = page, page.session
        self._views: list[PinholeView] = []
        self._video: FlightVideo | None = None
        gui = page.server.gui
        with gui.add_folder(TITLE, expand_by_default=False):
            add_view = gui.add_button("Add view")
            clear_views = gui.add_button("Clear views")
            self._seconds = gui.add_number("Duration (s)", 6.0, min=0.1, max=3600.0, step=0.5)
            self._fps = gui.add_number("Frames per second", 25.0, min=1.0, max=120.0, step=1.0)
            save_frames = gui.add_button("Save frames (CSV)")
            save_path = gui.add_button("Save camera path (nerfstudio)")
            self._start_button = gui.add_button("Render video (MP4)")
            self._progress_bar = gui.add_progress_bar(0.0, visible=False)
            self._status = gui.add_markdown("", visible=False)
            self._cancel_button = gui.add_button("Cancel video", visible=False)
        add_view.on_click(self._add_view)
        save_frames.on_click(self._save_frames)
        save_path.on_click(self._save_path)
        self._start_button.on_click(self._start_video)
        clear_views.on_click(lambda event: self._views.clear())

        @self._cancel_button.on_click
        def _(event: Any) -> None:
            if self._video is not None:
                self._video.cancel()

    def _add_view(self, event: Any) -> None:
        self._views.append(PinholeView.from_page(event.client.camera))
        count = len(self._views)
        notify(event, TITLE, "The flight has 1 view." if count == 1 else f"The flight has {count} views.")

    def _save_frames(self, event: Any) -> None:
        with notify_errors(event, TITLE):
            text = format_frames(interpolate_views(self._views, self._seconds.value, self._fps.value))
            event.client.send_file_download("view.frames.csv", text.encode(), save_immediately=True)
            notify(event, TITLE, "To render it: nerg render view.xml -o flight.mp4 --frames view.frames.csv")

    def _save_path(self, event: Any) -> None:
        with notify_errors(event, TITLE):
            views = interpolate_views(self._views, self._seconds.value, self._fps.value)
            path = make_camera_path(views, self.session.options.width, self._fps.value)
            event.client.send_file_download(
                "camera_path.json", format_camera_path(path).encode(), save_immediately=True
            )
            notify(event, TITLE, "To render it: nerg render scene.xml -o flight.mp4 --frames camera_path.json")

    def _start_video(self, event: Any) -> None:
        """Render a video and send it to the browser that requested it."""
        session, client, display = self.session, event.client, self.session.display
        if self._video is not None:
            notify(client, TITLE, "Another video is being rendered. Cancel it or wait for it.")
            return
        folder = tempfile.TemporaryDirectory()
        try:
            check_video_output(self._fps.value)
            check_can_copy(session)
            aovs = tuple(name for name in layers.required_quantities(display.layer) if name != "color")
            views, settings = prepare_flight(
                interpolate_views(self._views, self._seconds.value, self._fps.value),
                session.options.width,
                observer=session.observer,
                aovs=aovs,
                spp=session.spp,
                falloff=session.falloff,
                ceiling=get_ceiling(session),
            )
            scene, frames, video = (Path(folder.name, name) for name in ("view.xml", "view.frames.csv", "flight.mp4"))
            write_text(scene, copy_scene(session.scene_file, settings))
            write_text(frames, format_frames(views))
        except (NergError, ImportError) as error:
            folder.cleanup()
            notify(client, TITLE, format_error(error))
            return

        def on_end(error: BaseException | None) -> None:
            try:
                if error is None:
                    client.send_file_download("flight.mp4", video.read_bytes(), save_immediately=True)
                elif isinstance(error, KeyboardInterrupt):
                    notify(client, TITLE, "The video was cancelled.")
                elif is_user_error(error):
                    notify(client, TITLE, format_error(error))
                else:
                    self.page.on_error(error)
            finally:
                folder.cleanup()
                self._video = None
                self._set_running(False)

        options = make_video_options(display.layer, session.scale(), frames, self._fps.value, session.variant)
        self._video = FlightVideo(scene, video, options, self._on_progress, on_end)
        self._set_running(True)
        self._on_progress(0.0, "The video is waiting for other tasks")
        session.worker.submit("film", NORMAL_PRIORITY, self._video.steps())

    def _on_progress(self, fraction: float, text: str) -> None:
        self._progress_bar.value = 100 * fraction
        self._status.content = text

    def _set_running(self, is_running: bool) -> None:
        for handle in (self._progress_bar, self._status, self._cancel_button):
            handle.visible = is_running
        self._start_button.disabled = is_running
