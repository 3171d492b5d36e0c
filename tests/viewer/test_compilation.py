"""The compiled copy of the scene's radiance field, and frames of a moving view."""

from __future__ import annotations

import os
import threading
import time

import drjit.llvm.ad as ns
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths.geometry import Box
from nerg_mi.viewer import compilation
from nerg_mi.viewer.compilation import BackgroundCompilation, find_compiled_file, is_current
from nerg_mi.viewer.page import BrowserWindow, Page
from nerg_mi.viewer.points import FRAME_SECONDS, FramePace, PinholeView

VIEW = PinholeView.look_at((0, 0, 0), (1, 0, 0), (0, 0, 1), 0.8, 1.6)


def write_field(path, seed=0):
    config = RadianceConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=4, finest=16))
    field = RadianceNetwork.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, seed)
    save_radiance(field, path, {})
    return path


def wait_until(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


# ---- Compiled copies ----


@pytest.mark.slow
@pytest.mark.nightly
def test_a_copy_is_made_in_the_background_and_kept(rgb, make_session, tmp_path, monkeypatch):
    # At a coarse resolution, since the default doubles it as long as a field of noise needs.
    monkeypatch.setattr(compilation, "_PROGRAM", compilation._PROGRAM.replace("()", "(resolution=32)"))
    (tmp_path / "fields").mkdir()
    field = write_field(tmp_path / "fields" / "room.safetensors")
    session = make_session(field, compile=True)
    assert session.compiled is None and session.scene.integrator.medium.field.voxels is None
    assert "faster pictures" in session.running_tasks
    wait_until(lambda: session.compiled is not None and session.worker.is_idle)
    copy = field.with_name("room.compiled.safetensors")
    wait_until(copy.exists)
    assert is_current(copy, field) and not session.listener.errors
    assert session.scene.integrator.medium.field.voxels is not None and session.running_tasks == []

    again = make_session(field, compile=True)
    wait_until(lambda: again.compiled is not None)
    assert again._compilation is None
    assert make_session(field, compile=False).compiled is None
    # A field that has changed since is compiled again.
    write_field(field, seed=1)
    assert not is_current(copy, field)


def test_other_files_are_not_replaced(rgb, tmp_path):
    field = write_field(tmp_path / "room.safetensors")
    beside = tmp_path / "room.compiled.safetensors"
    assert find_compiled_file(field) == beside
    beside.write_bytes(field.read_bytes())
    assert find_compiled_file(field) is None and not is_current(beside, field)
    beside.write_bytes(b"damaged")
    assert find_compiled_file(field) is None
    assert not is_current(beside, field)


def test_a_failure_is_reported_and_a_stop_is_silent(rgb, tmp_path):
    called, errors, event = [], [], threading.Event()
    report = lambda error: (errors.append(error), event.set())
    BackgroundCompilation(b"damaged", "the field", called.append, report)
    assert event.wait(60) and called == [] and isinstance(errors[0], NergError) and "the field" in str(errors[0])
    field = write_field(tmp_path / "room.safetensors")
    running = BackgroundCompilation(field.read_bytes(), "the field", called.append, errors.append)
    running.stop()
    assert called == [] and len(errors) == 1 and os.listdir(tmp_path) == ["room.safetensors"]


# ---- Frames ----


def test_width_of_frames():
    pace = FramePace()
    assert pace.choose_width(VIEW, 720) is None  # Unknown
    for seconds_per_ray, width in ((1e-9, 640), (FRAME_SECONDS / (400 * 250), 320), (6e-6, None)):
        for _ in range(5):
            pace.record(1e5 * seconds_per_ray, 100_000)
        assert pace.choose_width(VIEW, 720) == width
        assert width is None or pace.choose_width(VIEW, 300) == 240
    pace = FramePace()
    for seconds in (10.0, 1e-6, 1e-6):  # The first one contains the compilation of a kernel.
        pace.record(seconds, 1000)
    assert pace.choose_width(VIEW, 720) == 640


class _Scene:
    def __init__(self):
        self.pictures = []

    def set_background_image(self, image, **options):
        self.pictures.append(None if image is None else image.shape)


class _Client:
    client_id = 7

    def __init__(self):
        self.scene = _Scene()

    def atomic(self):
        return threading.RLock()


def test_a_moving_view_shows_frames_if_they_are_fast(room, gaze_fields, make_session):
    session = make_session(room, gaze_fields[0], width=320, compile=False)
    assert session.worker.wait_idle(120)
    page, client = Page(server=None), _Client()
    page.session = session
    window = BrowserWindow(client, status=None, view=session.home_view)
    page.windows[client.client_id] = window

    def set_speed(seconds_per_ray):
        for _ in range(5):
            session.frame_pace.record(seconds_per_ray, 1)

    set_speed(1.0)
    page._hide_picture(window, time.monotonic())
    assert session.worker.wait_idle(120) and client.scene.pictures == []
    set_speed(1e-9)
    page._hide_picture(window, time.monotonic())
    assert window.is_frame_pending
    page._hide_picture(window, time.monotonic())  # Moved again while the frame is rendered: another one follows.
    assert session.worker.wait_idle(120) and not window.is_frame_pending and window.shows_picture
    first = client.scene.pictures[0]
    assert len(client.scene.pictures) == 2 and first == (session.home_view.picture_height(320), 320, 3)
    assert window.last_picture[1].std() > 5
    # A frame that is late does not replace the pictures of a view at rest.
    set_speed(1e-9)
    page._hide_picture(window, time.monotonic())
    window.is_handled = True
    assert session.worker.wait_idle(120) and len(client.scene.pictures) == 2
    # An error ends the frame only.
    set_speed(1e-9)
    session.frame_pace.record = None
    window.is_handled = False
    page._hide_picture(window, time.monotonic())
    assert session.worker.wait_idle(120) and not window.is_frame_pending and len(session.listener.errors) == 1
