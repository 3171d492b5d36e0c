"""The field of a radiance training in the browser, while it trains.

`TrainingPage` is an observer of the training (`nerg_mi.train.radiance_monitor`). It renders on the thread of the
training, between two steps, because Dr.Jit and the weights belong to that thread; the threads of the server only record
who is connected. The time of pictures is limited to a fraction of the time of the training.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.figures.training import HELD_OUT_COLOR, TRAINING_COLOR
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import PhotoView
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.train.radiance_monitor import PICTURE_STRIDE
from nerg_mi.train.radiance_trainer import RadianceTrainer

from .layers import grey_out
from .points import PinholeView
from .server import RequestGuard, require_viser, start_server, stop_server

MAX_FRACTION = 0.1
"""Maximum fraction of the time of the training that the page takes."""

MIN_INTERVAL, REFRESH_INTERVAL = 1.0, 3.0
"""Minimum seconds between two pictures, and between two pictures of a camera at rest."""

PICTURE_SECONDS = 0.4
"""Target for the time of a picture, which sets its width."""

_STATUS_INTERVAL = 0.25  # seconds between two updates of the text
_REST_SECONDS = 0.15  # without movement, after which a camera is at rest
_MIN_SAMPLES, _MAX_SAMPLES = 2**17, 2**21
_MIN_WIDTH, _MAX_WIDTH = 64, 640
_MAX_ASPECT = 8.0  # of the browser's window
_MAX_CAMERAS = 200
_SERIES = (("held-out views [dB]", "psnr", HELD_OUT_COLOR), ("training views [dB]", "psnr_train", TRAINING_COLOR))


@contextmanager
def open_training_page(port: int = 8080, reporter: Reporter = SILENT) -> Iterator[TrainingPage]:
    """Serve a page to this machine for the duration of the block; yields the observer of the training.

    Raises `NergError` if the ``port`` is in use (0: any free one), or viser is not installed.
    """
    require_viser()
    server = start_server(RequestGuard("127.0.0.1"), port, "nerg train radiance")
    try:
        page = TrainingPage(server)
        reporter.message(f"open {page.address} to see the field while it trains")
        yield page
    finally:
        stop_server(server)


def make_camera_view(view: PinholeView, width: int) -> PhotoView:
    """Return the camera of ``view`` for a picture of ``width`` pixels, with a black photo."""
    height = view.picture_height(width)
    focal = 0.5 * height / math.tan(0.5 * view.fov)
    to_world = np.eye(4)
    to_world[:3, :3] = np.stack([np.cross(view.forward, view.up), view.up, -view.forward], axis=1)
    to_world[:3, 3] = view.origin
    camera = PosedCamera(Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height), to_world)
    return PhotoView("page", camera, np.zeros((height, width, 3), np.uint8))


@dataclass(eq=False)
class _Visitor:
    """A connected browser: its camera ``view``, and the picture that it shows, None if that is outdated."""

    client: Any
    view: PinholeView | None = None
    change_time: float = 0.0
    picture: np.ndarray | None = None
    picture_time: float = -math.inf


class TrainingPage:
    """The page of a viser ``server`` that shows a training, and observer of this training."""

    def __init__(self, server: Any):
        self.server, self.visitors = server, dict[int, _Visitor]()
        self.address = f"http://127.0.0.1:{server.get_port()}/"
        self.seconds = 0.0
        self._lock = threading.Lock()
        self._status = server.gui.add_markdown("The photos are being read.")
        self._chart: Any = None
        self._num_rows, self._next_update, self._picture_text = 0, 0.0, ""
        self._seconds_per_sample: float | None = None

    # The training

    def on_start(self, trainer: RadianceTrainer, dataset: Dataset) -> None:
        """Add the cameras of the photos, and accept visitors."""
        cameras = [view.camera for view in (*dataset.held_out[:1], *dataset.train)]
        centers = np.array([camera.center for camera in cameras])
        spread = float(np.linalg.norm(centers.std(axis=0))) or 0.2 * trainer.box.side
        scene, first, up = self.server.scene, cameras[0], np.mean([c.to_world[:3, 1] for c in cameras], axis=0)
        scene.set_up_direction(tuple(up / max(float(np.linalg.norm(up)), 1e-9)))
        for camera in (self.server.initial_camera, *(c.camera for c in self.server.get_clients().values())):
            camera.position, camera.look_at = tuple(first.center), tuple(first.center + spread * first.axis)
            camera.fov = _get_fov(first)
        frustums = [
            handle
            for name, views, color in (
                ("train", dataset.train, TRAINING_COLOR),
                ("held_out", dataset.held_out, HELD_OUT_COLOR),
            )
            for handle in self._add_frustums(name, views, color, 0.05 * spread)
        ]
        checkbox = self.server.gui.add_checkbox("Cameras", True, hint="Orange: held-out photos")

        @checkbox.on_update
        def _(event: Any) -> None:
            for frustum in frustums:
                frustum.visible = checkbox.value

        self.server.on_client_connect(self._on_connect)
        self.server.on_client_disconnect(lambda client: self.visitors.pop(client.client_id, None))

    def _add_frustums(self, name: str, views: Sequence[PhotoView], color: str, size: float) -> Iterator[Any]:
        rgb = tuple(int(color[k : k + 2], 16) for k in (1, 3, 5))
        for number in np.unique(np.linspace(0, len(views) - 1, min(len(views), _MAX_CAMERAS)).round().astype(int)):
            camera = views[number].camera
            lens = camera.intrinsics
            # viser's cameras have y down and z forward.
            x, y, z, w = Rotation.from_matrix(camera.to_world[:3, :3] @ np.diag([1, -1, -1])).as_quat()
            yield self.server.scene.add_camera_frustum(
                f"/cameras/{name}/{number}",
                fov=_get_fov(camera),
                aspect=lens.width / lens.height,
                scale=size,
                thickness=1.5,
                thickness_units="screen",
                color=rgb,
                wxyz=(w, x, y, z),
                position=tuple(camera.center),
            )

    def on_step(self, trainer: RadianceTrainer, history: Sequence[dict]) -> None:
        """Update the page if its last update is long enough ago."""
        start = time.monotonic()
        if start < self._next_update and trainer.progress < 1:
            return
        self._show_status(trainer, history)
        visitor = self._choose_visitor(start)
        if visitor is not None and trainer.progress < 1:
            self._render(trainer, visitor)
        seconds = time.monotonic() - start
        self.seconds += seconds
        interval = _STATUS_INTERVAL if visitor is None else MIN_INTERVAL
        self._next_update = start + max(interval, seconds / MAX_FRACTION)

    # The panel

    def _show_status(self, trainer: RadianceTrainer, history: Sequence[dict]) -> None:
        error = f", held-out views {history[-1]['psnr']:.2f} dB" if history else ""
        state = f"step {trainer.steps}, {trainer.seconds:.0f} s{error}"
        if trainer.progress >= 1:
            text = f"**The training has ended** ({state}). The field is being scored and written; then the page closes."
        else:
            text = f"**Training, {trainer.progress:.0%}**: {state}\n\n{self._picture_text}"
        self._status.content = text
        if len(history) > self._num_rows:
            self._num_rows = len(history)
            columns = [
                [row["seconds"] for row in history],
                *([row.get(key) for row in history] for _, key, _ in _SERIES),
            ]
            data = tuple(np.array(column, float) for column in columns)
            if self._chart is None:
                self._chart = self._add_chart(data)
            else:
                self._chart.data = data

    def _add_chart(self, data: tuple[np.ndarray, ...]) -> Any:
        lines = ({"label": label, "stroke": color, "width": 2, "points": {"show": True}} for label, _, color in _SERIES)
        return self.server.gui.add_uplot(
            data,
            ({"label": "time [s]"}, *lines),
            title="PSNR of evaluated views",
            scales={"x": {"time": False}},
            axes=({"label": "training time [s]"}, {"label": "PSNR [dB]"}),
            aspect=1.2,
            padding=(12, 12, 0, 0),
        )

    # Visitors and their pictures

    def _on_connect(self, client: Any) -> None:
        visitor = self.visitors[client.client_id] = _Visitor(client)

        # Asynchronous, so that updates are handled in their order.
        @client.camera.on_update
        async def _(camera: Any) -> None:
            self._update_view(visitor)

        self._update_view(visitor)

    def _update_view(self, visitor: _Visitor) -> None:
        """Record the camera of ``visitor``. If it has moved, mark its picture as outdated."""
        view, old = PinholeView.from_page(visitor.client.camera), visitor.view
        is_valid = np.isfinite(_to_numbers(view)).all() and 1 / _MAX_ASPECT < view.aspect < _MAX_ASPECT
        if not is_valid or (old is not None and np.allclose(_to_numbers(view), _to_numbers(old), atol=1e-6)):
            return
        with self._lock:
            visitor.view, visitor.change_time = view, time.monotonic()
            picture, visitor.picture = visitor.picture, None
            if picture is not None:
                visitor.client.scene.set_background_image(grey_out(picture), format="jpeg")

    def _choose_visitor(self, now: float) -> _Visitor | None:
        """Return the visitor at rest whose picture is the oldest, if that is outdated."""
        resting = [
            v for v in list(self.visitors.values()) if v.view is not None and now - v.change_time >= _REST_SECONDS
        ]
        waiting = [v for v in resting if v.picture is None or now - v.picture_time >= REFRESH_INTERVAL]
        return min(waiting, key=lambda v: v.picture_time, default=None)

    def _render(self, trainer: RadianceTrainer, visitor: _Visitor) -> None:
        """Show ``visitor`` the averaged weights."""
        start, view, stride = time.monotonic(), visitor.view, max(PICTURE_STRIDE, trainer.stride)
        assert view is not None
        per_sample = self._seconds_per_sample
        if per_sample is None:
            # Steps also compute derivatives, so that the first estimate is too high.
            per_sample = trainer.clock.seconds / max(trainer.clock.evaluations, 1)
        max_samples = float(np.clip(PICTURE_SECONDS / max(per_sample, 1e-12), _MIN_SAMPLES, _MAX_SAMPLES))
        scale = math.sqrt(max_samples / trainer.estimate_samples(make_camera_view(view, _MIN_WIDTH), stride))
        camera_view = make_camera_view(view, int(np.clip(_MIN_WIDTH * scale, _MIN_WIDTH, _MAX_WIDTH)))
        color = np.clip(trainer.render(camera_view, stride=stride).color, 0, 1)
        picture = (255 * color + 0.5).astype(np.uint8)
        visitor.picture_time = time.monotonic()
        seconds = visitor.picture_time - start
        self._seconds_per_sample = seconds / trainer.estimate_samples(camera_view, stride)
        height, width = picture.shape[:2]
        self._picture_text = f"Picture: {width} × {height}, {seconds:.1f} s."
        with self._lock:
            if visitor.view is view:
                visitor.picture = picture
                visitor.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)


def _get_fov(camera: PosedCamera) -> float:
    """Return the vertical field of view in radians of an undistorted lens."""
    return 2 * math.atan(0.5 * camera.intrinsics.height / camera.intrinsics.fy)


def _to_numbers(view: PinholeView) -> list[float]:
    return [*view.origin, *view.forward, *view.up, view.fov, view.aspect]
