"""The page of the viewer: its browsers, their cameras and pictures, and the shared observer."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, clean_text, format_error, is_user_error

from . import layers
from .points import NUM_LEVELS, PinholeView, StagePicture
from .server import stop_server
from .session import Session

# ---- State of one browser ----

SLOW_FRAME, FAST_FRAME = 1 / 20, 1 / 40
"""Seconds per frame: above the first a browser gets fewer points, below the second it gets more."""

_MIN_FRAMES = 8
"""Number of frames needed to judge the speed of a browser."""

REST_SECONDS = 0.12
"""Seconds without camera movement after which the picture is refined."""

_MAX_REST_SECONDS = 0.8


@dataclass(eq=False)
class BrowserWindow:
    """The state of one connected browser.

    Parameters
    ----------
    client : viser.ClientHandle
        The connection.
    status : viser.GuiMarkdownHandle
        The status text at the top of the panel.
    cloud : viser.PointCloudHandle or None
        The displayed points.
    view : PinholeView or None
        The camera.
    change_time : float
        Time (`time.monotonic`) of the last change of the camera or of the displayed contents.
    last_view_time : float
        Time of the last change of the camera alone.
    is_handled : bool
        Whether the refinement after the last change has started.
    version : int
        Counts the changes; a picture of an earlier version is dropped.
    shows_picture : bool
        Whether the browser displays a picture instead of the points.
    is_frame_pending : bool
        Whether a frame of a movement is being rendered.
    frame_version : int
        The ``version`` of the last frame.
    outdated_since : float
        Time from which on the displayed picture has been one of earlier contents; infinite if it is current.
    stale_reason : str
        Why the points are grey; "" if they are up to date.
    message : str
        A message about the camera.
    free_position : ndarray or None
        The last camera position (3,) in free space.
    last_picture : tuple or None
        The last picture and its colours (height, width, 3) uint8.
    timings : list of str
        One line for each stage of the current picture.
    level : int
        Index of the number of points that the browser gets (`PointProxy.levels`).
    frame_times : list of float
        Seconds between the last camera updates of a movement.
    """

    client: Any
    status: Any
    cloud: Any = None
    view: PinholeView | None = None
    change_time: float = 0.0
    last_view_time: float = 0.0
    is_handled: bool = False
    version: int = 0
    shows_picture: bool = False
    is_frame_pending: bool = False
    frame_version: int = -1
    outdated_since: float = math.inf
    stale_reason: str = ""
    message: str = ""
    free_position: np.ndarray | None = None
    last_picture: tuple[StagePicture, np.ndarray] | None = None
    timings: list[str] = field(default_factory=list)
    level: int = NUM_LEVELS - 2
    frame_times: list[float] = field(default_factory=list)

    def record_frame(self, seconds: float) -> None:
        """Record that the previous camera update was ``seconds`` ago; browsers send one per frame."""
        if seconds < 1:
            self.frame_times.append(seconds)

    @property
    def rest_seconds(self) -> float:
        """Seconds without a camera update after which the camera counts as resting.

        A slow browser sends updates rarely, and a refinement between them would slow it down further.
        """
        return float(np.clip(3 * np.median(self.frame_times[-_MIN_FRAMES:] or [0.0]), REST_SECONDS, _MAX_REST_SECONDS))

    def choose_level(self, is_at_rest: bool) -> int:
        """Choose the point level from the frame times; it increases the number of points only ``is_at_rest``."""
        if len(self.frame_times) < _MIN_FRAMES:
            return self.level
        # The fastest quarter: pauses of the mouse are not slow frames.
        frame = float(np.percentile(self.frame_times, 25))
        if frame > SLOW_FRAME:
            return min(self.level + 1, NUM_LEVELS - 1)
        return max(self.level - 1, 0) if is_at_rest and frame < FAST_FRAME else self.level


# ---- Page ----
#
# While a camera moves, its browser shows frames of low resolution, or draws points where frames take too long. When it
# rests, a rendered picture replaces them, first at low resolution, then at full resolution. No callback waits for
# rendering: a clock thread starts pending work.

TICK_SECONDS = 0.04
"""Interval of the clock, in seconds."""

_MAX_OUTDATED_SECONDS = 0.5
"""Seconds after which a picture of earlier contents gives way to the points, if no frame replaces it."""

_GIZMO_DISTANCE = 0.4
_POINT_SCALE = 1.15
"""Width of a drawn point, as a multiple of the size of the grid cells."""


class Page:
    """The page of a viser server; it is the listener of a `Session`.

    Parameters
    ----------
    server : viser.ViserServer
        The running server (`start_server`).
    """

    def __init__(self, server: Any):
        self.server = server
        self.session: Session
        self.windows: dict[int, BrowserWindow] = {}
        self.problem = ""
        self._lock = threading.RLock()
        self._is_points_update_pending = self._is_shares_update_pending = False
        self._stopped = threading.Event()
        self._observer: Any = None
        self._clock = threading.Thread(target=self._run_clock, name="nerg-view-clock", daemon=True)
        self.update_callbacks: list[Any] = []
        # Called when the colour scale or the set of outdated contents has changed.
        self.scale_callbacks: list[Any] = []
        self._stale_state: tuple[Any, ...] = ()
        self._free_position: np.ndarray

    def open(self, session: Session) -> None:
        """Display a started ``session``."""
        self.session, self._free_position = session, session.observer
        scene, home = self.server.scene, session.home_view
        scene.set_up_direction(tuple(session.source.up))
        camera = self.server.initial_camera
        camera.position, camera.look_at = tuple(home.origin), tuple(home.origin + self._orbit_distance() * home.forward)
        camera.up, camera.fov = tuple(session.source.up), home.fov
        self._observer = scene.add_transform_controls(
            "/observer",
            scale=0.45,
            line_width=3.0,
            depth_test=False,
            position=tuple(session.observer),
            wxyz=self._observer_quaternion(),
        )
        scene.add_icosphere("/observer/eye", radius=0.08, color=(40, 160, 255))
        scene.add_label("/observer/name", "observer", position=(0.0, 0.0, 0.25), anchor="bottom-center")

        @self._observer.on_update
        async def _(event: Any) -> None:
            self._on_drag(event.phase)

        self.server.on_client_connect(self._on_connect)
        self.server.on_client_disconnect(self._on_disconnect)
        self._is_points_update_pending = self._is_shares_update_pending = True
        self._clock.start()

    def close(self) -> None:
        """Stop the clock, the session's thread and the server."""
        self._stopped.set()
        if self._clock.is_alive():
            self._clock.join(5)
        if hasattr(self, "session"):
            self.session.stop()
        stop_server(self.server)

    # The observer

    def place_observer(self, position: np.ndarray, heading: np.ndarray | None = None) -> None:
        """Move the observer to ``position`` (3,), with the rotation ``heading`` (3, 3), as a user would drag it.

        Raises
        ------
        NergError
            The position or rotation is not finite or too far away.
        """
        self.session.place_observer(position, heading)
        # The next drag starts from this position, even if it is inside a solid.
        self._free_position = self.session.observer
        self._observer.position = tuple(np.asarray(position, float))
        self._observer.wxyz = self._observer_quaternion()
        self._on_observer_moved(True)

    def _on_drag(self, phase: str) -> None:
        session, (w, x, y, z) = self.session, np.asarray(self._observer.wxyz, float)
        try:
            if not 0 < np.linalg.norm([w, x, y, z]) < np.inf:
                raise NergError("the page sent an invalid rotation of the observer; drag the observer again")
            session.place_observer(self._observer.position, Rotation.from_quat([x, y, z, w]).as_matrix())
        except NergError as error:
            self._observer.position, self._observer.wxyz = tuple(session.observer), self._observer_quaternion()
            self.on_error(error)
            return
        self._on_observer_moved(phase == "end")
        if phase == "end":
            at = session.observer
            session.keep_in_free_space(
                "observer", at, self._free_position, lambda corrected: self._move_observer_out(at, corrected)
            )

    def _move_observer_out(self, target: np.ndarray, position: np.ndarray) -> None:
        """Move the observer, who was dragged to ``target`` (3,), to the free ``position`` (3,) if the two differ."""
        if self.session.observer is not target:
            return
        if position is target:
            self._free_position = target
        else:
            self.place_observer(position)

    def _on_observer_moved(self, is_at_rest: bool) -> None:
        self.problem = ""
        with self._lock:
            self._is_points_update_pending, self._is_shares_update_pending = True, True
            if self.session.display.layer.depends_on_observer:
                self.restart_pictures(REST_SECONDS if not is_at_rest else 0.0)
        for callback in self.update_callbacks:
            callback()

    def _update_gizmo_visibility(self) -> None:
        """Show the gizmo unless the only browser looks from the observer's position, where it would fill the view."""
        views = [w.view for w in self.windows.values() if w.view is not None]
        distances = [float(np.linalg.norm(view.origin - self.session.observer)) for view in views]
        visible = len(distances) != 1 or distances[0] > _GIZMO_DISTANCE
        if self._observer.visible != visible:
            self._observer.visible = visible

    def _observer_quaternion(self) -> tuple[float, ...]:
        x, y, z, w = Rotation.from_matrix(self.session.heading).as_quat()
        return w, x, y, z

    # Pictures

    def request_points(self) -> None:
        """Request new gaze values on the points, and new attention shares."""
        self._is_points_update_pending = self._is_shares_update_pending = True

    def request_shares(self) -> None:
        """Request new attention shares, after a change of the areas."""
        self._is_shares_update_pending = True

    def restart_pictures(self, delay: float = 0.0) -> None:
        """Restart all pictures, ``delay`` seconds from now, after a change of the displayed contents."""
        with self._lock:
            for window in self.windows.values():
                self._hide_picture(window, time.monotonic() - window.rest_seconds + delay)

    def redraw_points(self) -> None:
        """Redraw the points, after a change of their colours or of the ceiling."""
        with self._lock:
            for window in self.windows.values():
                self._draw_points(window)

    def _hide_picture(self, window: BrowserWindow, change_time: float) -> None:
        """Replace the picture of ``window`` by frames or by the points, since its view or the displayed contents have
        changed."""
        window.version += 1
        window.change_time, window.is_handled = change_time, False
        window.outdated_since = min(window.outdated_since, time.monotonic())
        self.session.cancel(window.client.client_id)
        if not self._start_frame(window):
            self._show_points(window)

    def _show_points(self, window: BrowserWindow) -> None:
        """Display the points instead of an outdated picture."""
        if window.shows_picture:
            window.shows_picture = False
            with window.client.atomic():
                if window.cloud is not None:
                    window.cloud.visible = True
                    window.client.scene.set_background_image(None)
                elif window.last_picture is not None:
                    # There are no points yet: grey out the old picture.
                    window.client.scene.set_background_image(layers.grey_out(window.last_picture[1]), format="jpeg")

    def _start_frame(self, window: BrowserWindow) -> bool:
        """Start to render a frame of a moving ``window``; return whether frames are fast enough."""
        view, version = window.view, window.version
        lattice = None if view is None else self.session.choose_lattice(view)
        if view is None or lattice is None:
            return False
        if window.is_frame_pending:
            return True

        def deliver(picture: StagePicture | None, colors: np.ndarray | None) -> None:
            with self._lock:
                window.is_frame_pending = False
                is_open = window.client.client_id in self.windows
                # The pictures of a view at rest are better than its frame.
                if picture is None or colors is None or window.is_handled or not is_open:
                    return
                rays = "" if lattice.pixels_per_ray == 1 else f", a ray for {lattice.pixels_per_ray} pixels"
                size = f"{lattice.width} × {lattice.height}{rays}"
                window.timings = [f"{size}: {picture.seconds:.2f} s a frame"]
                self._show_picture(window, picture, colors, 80)
                window.frame_version = version
                if window.version != version:
                    window.outdated_since = time.monotonic()
                    self._start_frame(window)

        window.is_frame_pending = True
        self.session.render_frame(window.client.client_id, view, deliver, lattice)
        return True

    def _show_picture(
        self, window: BrowserWindow, picture: StagePicture, colors: np.ndarray, jpeg_quality: int
    ) -> None:
        window.last_picture = picture, colors
        window.shows_picture, window.outdated_since = True, math.inf
        with window.client.atomic():
            window.client.scene.set_background_image(colors, format="jpeg", jpeg_quality=jpeg_quality)
            if window.cloud is not None and window.cloud.visible:
                window.cloud.visible = False

    def _start_refinement(self, window: BrowserWindow) -> None:
        version, start = window.version, time.monotonic()
        window.timings = []
        client = window.client

        def deliver(picture: StagePicture, colors: np.ndarray) -> None:
            with self._lock:
                if window.version != version or client.client_id not in self.windows:
                    return
                self._show_picture(window, picture, colors, 92)
                height, width = colors.shape[:2]
                seconds = time.monotonic() - start
                window.timings.append(f"{width} × {height}, {picture.samples} a pixel: {seconds:.2f} s")

        assert window.view is not None
        session, origin = self.session, window.view.origin
        width, min_width = session.settings.width, 0
        if window.frame_version == version and window.last_picture is not None:
            min_width = window.last_picture[1].shape[1]
        session.refine_picture(client.client_id, window.view, deliver, width, session.spp, min_width)
        free_position = session.home_view.origin if window.free_position is None else window.free_position
        session.keep_in_free_space(
            client.client_id, origin, free_position, lambda corrected: self._move_camera_out(window, origin, corrected)
        )

    def _move_camera_out(self, window: BrowserWindow, target: np.ndarray, position: np.ndarray) -> None:
        """Move the camera of ``window`` from ``target`` (3,) to the free ``position`` (3,) if the two differ."""
        with self._lock:
            if window.view is not None and window.view.origin is target:
                window.free_position = position
                if position is not target:
                    window.message = "The camera was inside a solid and was moved in front of it."
                    window.client.camera.position = tuple(position)

    def _update_status(self, window: BrowserWindow) -> None:
        """Update the status text of ``window``, and grey out its points if they are outdated."""
        stale = self.session.stale_points_reason
        if stale != window.stale_reason:
            window.stale_reason = stale
            self._draw_points(window)
        if window.shows_picture:
            is_final = window.last_picture is not None and window.last_picture[0].is_final
            text = (window.timings[-1] if window.timings else "picture") + (" — done" if is_final else " …")
        elif window.cloud is None and window.last_picture is not None:
            text = "**Grey: outdated picture**"
        else:
            text = f"**Grey: {stale}**" if stale else "points"
        computing = self.session.running_tasks
        parts = [text, *([f"Computing: {', '.join(computing)}"] if computing else []), window.message]
        parts += [f"**{self.problem}**"] if self.problem else []
        content = "\n\n".join(part for part in parts if part)
        if window.status.content != content:
            window.status.content = content

    @property
    def stale_scale_reason(self) -> str:
        """Why the colour scale is outdated; "" if it belongs to the displayed picture or points."""
        if not self.session.has_scale:
            return "The colour scale is being computed."
        reason = self.session.stale_points_reason
        if not reason or any(window.shows_picture for window in list(self.windows.values())):
            return ""
        return f"Outdated: {reason}."

    def _draw_points(self, window: BrowserWindow) -> None:
        points = self.session.points(window.level)
        if points is None:
            return
        if window.cloud is not None and np.array_equal(window.cloud.points, points.points):
            window.cloud.colors = points.colors
            return
        if window.cloud is not None:
            window.cloud.remove()
        window.cloud = window.client.scene.add_point_cloud(
            "/points",
            points.points,
            points.colors,
            point_size=_POINT_SCALE * points.size,
            point_shape="square",
            point_shading="flat",
            precision="float32",
            visible=not window.shows_picture,
        )
        if not window.shows_picture:
            window.client.scene.set_background_image(None)

    # The session's listener

    def on_proxy(self) -> None:
        """Draw the new points."""
        self._is_points_update_pending = True
        self.redraw_points()

    def on_baked(self) -> None:
        """Draw the new gaze values on the points."""
        self.redraw_points()
        for callback in self.update_callbacks:
            callback()

    def on_shares(self) -> None:
        """Notify the panels about new attention shares."""
        for callback in self.update_callbacks:
            callback()

    def on_range(self) -> None:
        """Notify the panels about a new colour range."""
        for callback in self.scale_callbacks:
            callback()

    def on_error(self, error: BaseException) -> None:
        """Show an error in the status text, with its type if it is a bug."""
        text = clean_text(format_error(error))
        self.problem = text if is_user_error(error) else f"{type(error).__name__}: {text} (a bug in nerg_mi)"

    # Browsers

    def _on_connect(self, client: Any) -> None:
        status = client.gui.add_markdown("points …", order=-10)
        window = BrowserWindow(client, status)
        with self._lock:
            self.windows[client.client_id] = window
            self._update_view(window)

        @client.camera.on_update
        async def _(camera: Any) -> None:
            with self._lock:
                self._update_view(window)

        with self._lock:
            self._draw_points(window)

    def _update_view(self, window: BrowserWindow) -> None:
        view, old = PinholeView.from_page(window.client.camera), window.view
        if not np.isfinite([*view.origin, *view.forward, *view.up, view.fov, view.aspect]).all():
            self.on_error(NergError("the page sent an invalid camera position; reload the page"))
            return
        # The browser also sends its camera when nothing has changed.
        names = ("origin", "forward", "up", "fov", "aspect")
        if old is not None and all(np.allclose(getattr(view, n), getattr(old, n), atol=1e-6) for n in names):
            return
        now = time.monotonic()
        if old is not None:
            # Also after an apparent rest: in a slow browser, each frame seems to be one.
            window.record_frame(now - window.last_view_time)
            self._adapt_level(window, is_at_rest=False)
            if window.free_position is None or not np.allclose(view.origin, window.free_position):
                window.message = ""
        window.last_view_time = now
        window.view = view
        self._hide_picture(window, now)

    def _adapt_level(self, window: BrowserWindow, is_at_rest: bool) -> None:
        """Adapt the number of points to the speed of the browser of ``window``."""
        level = window.choose_level(is_at_rest)
        if level != window.level:
            window.frame_times.clear()
        del window.frame_times[:-100]
        if level != window.level:
            window.level = level
            self._draw_points(window)

    def _on_disconnect(self, client: Any) -> None:
        with self._lock:
            self.windows.pop(client.client_id, None)
            self.session.cancel(client.client_id)

    def _run_clock(self) -> None:
        while not self._stopped.wait(TICK_SECONDS):
            try:
                self._tick()
            except Exception as error:
                self.on_error(error)

    def _tick(self) -> None:
        now = time.monotonic()
        with self._lock:
            waiting = [w for w in self.windows.values() if not w.is_handled and now - w.change_time >= w.rest_seconds]
            if waiting:
                self._update_gizmo_visibility()
            for window in waiting:
                window.is_handled = True
                self._adapt_level(window, is_at_rest=True)
                self._start_refinement(window)
            if self._is_points_update_pending:
                self._is_points_update_pending = not self.session.update_points()
            if self._is_shares_update_pending:
                self._is_shares_update_pending = not self.session.update_shares()
            for window in self.windows.values():
                # Another task may keep a frame waiting.
                if now - window.outdated_since > _MAX_OUTDATED_SECONDS:
                    self._show_points(window)
                self._update_status(window)
        stale_state = self.stale_scale_reason, self.session.are_shares_stale
        if stale_state != self._stale_state:
            self._stale_state = stale_state
            for callback in self.scale_callbacks:
                callback()

    def _orbit_distance(self) -> float:
        """Distance from the initial camera to its centre of rotation, which is level with the observer; at least 1."""
        session = self.session
        away = float((session.observer - session.home_view.origin) @ session.home_view.forward)
        return max(away, 1.0)
