"""The page of the viewer and its window."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, is_user_error, format_error

from . import layers
from .points import LEVELS, PinholeView, StagePicture
from .server import stop_server
from .session import Session

# ---- Window ----
#
# One browser that looks: its view, what it is shown, and how quickly it draws.

SLOW, QUICK = 1 / 20, 1 / 40
"""Seconds a frame above which a browser is given fewer points, and below which more."""

_FRAMES = 8
"""It is judged by so many frames."""

REST = 0.12
"""Seconds without movement after which a picture is refined."""

_LONGEST_REST = 0.8


@dataclass(eq=False)
class BrowserWindow:
    """One browser: its ``client`` and the points in it; when it or what it shows ``moved`` last and whether that was
    ``noticed``, and when it ``looked`` elsewhere last; the ``version`` of its view, and whether it shows a ``picture``;
    ``stale``: why its points are greyed, "" where they are not; ``note``: what was done to its camera; ``free``: where
    that last stood in free air; the ``last`` picture, with its colours. ``level``: which of the proxy's numbers of
    points it is given; ``frames``: seconds between the last views of a movement."""

    client: Any
    status: Any
    cloud: Any = None
    view: PinholeView | None = None
    moved: float = 0.0
    looked: float = 0.0
    noticed: bool = False
    version: int = 0
    picture: bool = False
    stale: str = ""
    note: str = ""
    free: np.ndarray | None = None
    last: tuple[StagePicture, np.ndarray] | None = None
    lines: list[str] = field(default_factory=list)
    level: int = LEVELS - 2
    frames: list[float] = field(default_factory=list)

    def learn_pace(self, seconds: float) -> None:
        """The view before was told ``seconds`` ago: a browser tells of each frame, while its camera moves."""
        if seconds < 1:
            self.frames.append(seconds)

    @property
    def rest(self) -> float:
        """Seconds without a new view after which its camera rests: a browser that draws slowly tells of it seldom, and
        pictures that are refined meanwhile would make it slower still."""
        return float(np.clip(3 * np.median(self.frames[-_FRAMES:] or [0.0]), REST, _LONGEST_REST))

    def level_for_pace(self, at_rest: bool) -> int:
        """The level that its frames ask for; more points only ``at_rest``."""
        if len(self.frames) < _FRAMES:
            return self.level
        # The quickest quarter: a mouse that pauses is no slow browser.
        frame = float(np.percentile(self.frames, 25))
        if frame > SLOW:
            return min(self.level + 1, LEVELS - 1)
        return max(self.level - 1, 0) if at_rest and frame < QUICK else self.level


# ---- Page ----
#
# The page: each browser's camera and picture, and the observer that all of them drag.
#
# While a camera moves its browser draws points by itself; when it rests a picture of the integrator stands in their
# place, first small, then fine. Nothing here waits for rendering: a clock looks what is to be done.

TICK = 0.04
"""Seconds between two looks of the clock."""

_NEAR = 0.4
_POINT = 1.15
"""Width of a drawn point, in cells of the grid that points lie in."""


class Page:
    """A running page of ``server`` (viser) for what a `Session` finds; it is the session's listener."""

    def __init__(self, server: Any):
        self.server = server
        self.session: Session
        self.windows: dict[int, BrowserWindow] = {}
        self.problem = ""
        self._lock = threading.RLock()
        self._follow = self._count = False
        self._stop = threading.Event()
        self._observer: Any = None
        self._clock = threading.Thread(target=self._tick, name="nerg-view-clock", daemon=True)
        self.on_moved: list[Any] = []
        # The scale, or what is out of date, is another one.
        self.on_marked: list[Any] = []
        self._marked: tuple[Any, ...] = ()
        self._free: np.ndarray

    def open(self, session: Session) -> None:
        """Show ``session``, which has started."""
        self.session, self._free = session, session.observer
        scene, home = self.server.scene, session.home
        scene.set_up_direction(tuple(session.place.up))
        camera = self.server.initial_camera
        camera.position, camera.look_at = tuple(home.origin), tuple(home.origin + self._reach() * home.ahead)
        camera.up, camera.fov = tuple(session.place.up), home.fov
        self._observer = scene.add_transform_controls(
            "/observer",
            scale=0.45,
            line_width=3.0,
            depth_test=False,
            position=tuple(session.observer),
            wxyz=self._turn(),
        )
        scene.add_icosphere("/observer/eye", radius=0.08, color=(40, 160, 255))
        scene.add_label("/observer/name", "observer", position=(0.0, 0.0, 0.25), anchor="bottom-center")

        @self._observer.on_update
        async def _(event: Any) -> None:
            self._dragged(event.phase)

        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)
        self._follow = self._count = True
        self._clock.start()

    def close(self) -> None:
        """End the clock, the session's thread and the server."""
        self._stop.set()
        if self._clock.is_alive():
            self._clock.join(5)
        if hasattr(self, "session"):
            self.session.stop()
        stop_server(self.server)

    # The observer

    def place_observer(self, at: np.ndarray, heading: np.ndarray | None = None) -> None:
        """Let the observer stand at ``at`` (3,), as if dragged there. Raises `NergError` for what is no position."""
        self.session.place_observer(at, heading)
        # Who was put somewhere on purpose is dragged from there.
        self._free = self.session.observer
        self._observer.position = tuple(np.asarray(at, float))
        self._observer.wxyz = self._turn()
        self._observer_moved(True)

    def _dragged(self, phase: str) -> None:
        session, (w, x, y, z) = self.session, np.asarray(self._observer.wxyz, float)
        try:
            if not 0 < np.linalg.norm([w, x, y, z]) < np.inf:
                raise NergError("the page sent no rotation of the observer; drag them again")
            session.place_observer(self._observer.position, Rotation.from_quat([x, y, z, w]).as_matrix())
        except NergError as error:
            self._observer.position, self._observer.wxyz = tuple(session.observer), self._turn()
            self.on_error(error)
            return
        self._observer_moved(phase == "end")
        if phase == "end":
            at = session.observer
            session.clear_way("observer", at, self._free, lambda found: self._put_out(at, found))

    def _put_out(self, at: np.ndarray, found: np.ndarray) -> None:
        """The observer, who was dragged to ``at`` (3,), stands at ``found`` (3,): elsewhere if that is in something."""
        if self.session.observer is not at:
            return
        if found is at:
            self._free = at
        else:
            self.place_observer(found)

    def _observer_moved(self, at_rest: bool) -> None:
        self.problem = ""
        with self._lock:
            self._follow, self._count = True, True
            if self.session.shade.layer.is_per_observer:
                self.renew(REST if not at_rest else 0.0)
        for told in self.on_moved:
            told()

    def _show_gizmo(self) -> None:
        """The gizmo, but not to somebody alone who looks out of the observer's eye: it would fill the view."""
        views = [w.view for w in self.windows.values() if w.view is not None]
        away = [float(np.linalg.norm(view.origin - self.session.observer)) for view in views]
        visible = len(away) != 1 or away[0] > _NEAR
        if self._observer.visible != visible:
            self._observer.visible = visible

    def _turn(self) -> tuple[float, ...]:
        x, y, z, w = Rotation.from_matrix(self.session.heading).as_quat()
        return w, x, y, z

    # Pictures

    def follow(self) -> None:
        """Have the gaze on the points, and the shares, computed anew."""
        self._follow = self._count = True

    def count(self) -> None:
        """Have the shares of attention counted, since there are other areas."""
        self._count = True

    def renew(self, wait: float = 0.0) -> None:
        """Make all pictures anew, ``wait`` seconds from now, since what they show has changed."""
        with self._lock:
            for window in self.windows.values():
                self._moving(window, time.monotonic() - window.rest + wait)

    def recolor(self) -> None:
        """Colour the points anew, which are other ones where the ceiling is cut off."""
        with self._lock:
            for window in self.windows.values():
                self._draw_points(window)

    def _moving(self, window: BrowserWindow, when: float) -> None:
        """The view of ``window``, or what it shows, is another one now: its points take the picture's place."""
        window.version += 1
        window.moved, window.noticed = when, False
        self.session.cancel(window.client.client_id)
        if window.picture:
            window.picture = False
            with window.client.atomic():
                if window.cloud is not None:
                    window.cloud.visible = True
                    window.client.scene.set_background_image(None)
                elif window.last is not None:
                    # There is nothing to take its place yet.
                    window.client.scene.set_background_image(layers.greyed(window.last[1]), format="jpeg")

    def _refine(self, window: BrowserWindow) -> None:
        version, began = window.version, time.monotonic()
        window.lines = []
        client = window.client

        def deliver(picture: StagePicture, colors: np.ndarray) -> None:
            with self._lock:
                if window.version != version or client.client_id not in self.windows:
                    return
                window.last = picture, colors
                window.picture = True
                with client.atomic():
                    client.scene.set_background_image(colors, format="jpeg", jpeg_quality=92)
                    if window.cloud is not None:
                        window.cloud.visible = False
                height, width = colors.shape[:2]
                took = time.monotonic() - began
                window.lines.append(f"{width} × {height}, {picture.samples} a pixel: {took:.2f} s")

        assert window.view is not None
        session, at = self.session, window.view.origin
        session.picture(client.client_id, window.view, deliver, session.options.width, session.spp)
        free = session.home.origin if window.free is None else window.free
        session.clear_way(client.client_id, at, free, lambda found: self._move_out(window, at, found))

    def _move_out(self, window: BrowserWindow, at: np.ndarray, found: np.ndarray) -> None:
        """The camera of ``window``, which was moved to ``at`` (3,), stands at ``found`` (3,)."""
        with self._lock:
            if window.view is not None and window.view.origin is at:
                window.free = found
                if found is not at:
                    window.note = "The camera was inside of something; it stands before it now."
                    window.client.camera.position = tuple(found)

    def _mark(self, window: BrowserWindow) -> None:
        """Say what ``window`` shows, what of it is out of date, and what is computed; grey the points that are."""
        stale = self.session.stale_points
        if stale != window.stale:
            window.stale = stale
            self._draw_points(window)
        if window.picture:
            whole = window.last is not None and window.last[0].whole
            text = (window.lines[-1] if window.lines else "picture") + (" — done" if whole else " …")
        elif window.cloud is None and window.last is not None:
            text = "**Grey: an earlier picture**"
        else:
            text = f"**Grey: {stale}**" if stale else "points"
        computing = self.session.computing
        parts = [text, *([f"Computing: {', '.join(computing)}"] if computing else []), window.note]
        parts += [f"**{self.problem}**"] if self.problem else []
        content = "\n\n".join(part for part in parts if part)
        if window.status.content != content:
            window.status.content = content

    @property
    def stale(self) -> str:
        """Why the scale is that of nothing that is shown; "" where it is of a picture, or of the points."""
        if not self.session.has_scale:
            return "No scale yet: it is being computed."
        why = self.session.stale_points
        if not why or any(window.picture for window in list(self.windows.values())):
            return ""
        return f"Out of date: {why}."

    def _draw_points(self, window: BrowserWindow) -> None:
        shown = self.session.points(window.level)
        if shown is None:
            return
        if window.cloud is not None and np.array_equal(window.cloud.points, shown.points):
            window.cloud.colors = shown.colors
            return
        if window.cloud is not None:
            window.cloud.remove()
        window.cloud = window.client.scene.add_point_cloud(
            "/points",
            shown.points,
            shown.colors,
            point_size=_POINT * shown.size,
            point_shape="square",
            point_shading="flat",
            precision="float32",
            visible=not window.picture,
        )
        if not window.picture:
            window.client.scene.set_background_image(None)

    # The session's listener

    def on_proxy(self) -> None:
        """Show the points."""
        self._follow = True
        self.recolor()

    def on_baked(self) -> None:
        """Show the gaze on the points."""
        self.recolor()
        for told in self.on_moved:
            told()

    def on_shares(self) -> None:
        """Nothing to be done here: whoever shows them has asked to be told."""
        for told in self.on_moved:
            told()

    def on_range(self) -> None:
        """Have the scale beside the picture be that of the picture."""
        for told in self.on_marked:
            told()

    def on_error(self, error: BaseException) -> None:
        """Show what went wrong; a mistake of the program by its name as well."""
        text = format_error(error)
        self.problem = text if is_user_error(error) else f"{type(error).__name__}: {text} (a mistake in the program)"

    # Browsers

    def _connected(self, client: Any) -> None:
        status = client.gui.add_markdown("points …", order=-10)
        window = BrowserWindow(client, status)
        with self._lock:
            self.windows[client.client_id] = window
            self._look(window)

        @client.camera.on_update
        async def _(camera: Any) -> None:
            with self._lock:
                self._look(window)

        with self._lock:
            self._draw_points(window)

    def _look(self, window: BrowserWindow) -> None:
        view, old = PinholeView.of_page(window.client.camera), window.view
        if not np.isfinite([*view.origin, *view.ahead, *view.up, view.fov, view.aspect]).all():
            self.on_error(NergError("the page sent a camera without a position; reload it"))
            return
        # The browser tells its camera again where nothing has changed.
        names = ("origin", "ahead", "up", "fov", "aspect")
        if old is not None and all(np.allclose(getattr(view, n), getattr(old, n), atol=1e-6) for n in names):
            return
        now = time.monotonic()
        if old is not None:
            # Also after what seemed to be a rest: of a browser that is slow, each frame does.
            window.learn_pace(now - window.looked)
            self._keep_pace(window, at_rest=False)
            if window.free is None or not np.allclose(view.origin, window.free):
                window.note = ""
        window.looked = now
        window.view = view
        self._moving(window, now)

    def _keep_pace(self, window: BrowserWindow, at_rest: bool) -> None:
        """Give the browser of ``window`` as many points as it draws quickly."""
        level = window.level_for_pace(at_rest)
        if level != window.level:
            window.frames.clear()
        del window.frames[:-100]
        if level != window.level:
            window.level = level
            self._draw_points(window)

    def _disconnected(self, client: Any) -> None:
        with self._lock:
            self.windows.pop(client.client_id, None)
            self.session.cancel(client.client_id)

    def _tick(self) -> None:
        while not self._stop.wait(TICK):
            try:
                self._turn_of_clock()
            except Exception as error:
                self.on_error(error)

    def _turn_of_clock(self) -> None:
        now = time.monotonic()
        with self._lock:
            waiting = [w for w in self.windows.values() if not w.noticed and now - w.moved >= w.rest]
            if waiting:
                self._show_gizmo()
            for window in waiting:
                window.noticed = True
                self._keep_pace(window, at_rest=True)
                self._refine(window)
            if self._follow:
                self._follow = not self.session.follow_observer()
            if self._count:
                self._count = not self.session.follow_shares()
            for window in self.windows.values():
                self._mark(window)
        marked = self.stale, self.session.stale_shares
        if marked != self._marked:
            self._marked = marked
            for told in self.on_marked:
                told()

    def _reach(self) -> float:
        """How far ahead of the first camera its centre of rotation is: where the place's middle is level with it."""
        session = self.session
        away = float((session.observer - session.home.origin) @ session.home.ahead)
        return max(away, 1.0)
