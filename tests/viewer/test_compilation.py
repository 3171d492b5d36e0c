"""The compiled copy of the scene's radiance field, and frames of a moving view."""

from __future__ import annotations

import os
import threading
import time

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths.geometry import Box
from nerg_mi.viewer import compilation
from nerg_mi.viewer.compilation import BackgroundCompilation, find_compiled_file, is_current
from nerg_mi.viewer.layers import get_layer
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


def repeat(pace, seconds, num_rays, is_view_kept=False):
    """Record frames until a time counts, and replaces those before."""
    for _ in range(7):
        pace.record(seconds, num_rays, is_view_kept)


def test_rays_of_frames():
    pace = FramePace()
    assert pace.choose_lattice(VIEW, 720) is None  # Unknown
    for seconds_per_ray, size in ((1e-9, (640, 1)), (FRAME_SECONDS / (400 * 250), (640, 4)), (1e-5, None)):
        repeat(pace, 1e5 * seconds_per_ray, 100_000)
        assert pace.choose_lattice(VIEW, 720) == (None if size is None else VIEW.make_lattice(*size))
        assert size is None or pace.choose_lattice(VIEW, 300).width == 300
    pace = FramePace()
    for seconds in (10.0, 10.0, 1e-6):  # Programs are recorded by the second frame.
        pace.record(seconds, 1000)
    assert pace.choose_lattice(VIEW, 720) == VIEW.make_lattice(640)


def test_frames_have_all_pixels_again_once_these_are_fast():
    pace, sizes = FramePace(), [VIEW.make_lattice(640, n).num_rays for n in (1, 2, 4)]
    choose = lambda: 640 * VIEW.picture_height(640) / pace.choose_lattice(VIEW, 640).num_rays
    # Half of the time does not depend on rays.
    repeat(pace, 1.2 * FRAME_SECONDS, sizes[0])
    assert choose() == 2
    repeat(pace, 0.9 * FRAME_SECONDS, sizes[1])
    repeat(pace, 0.7 * FRAME_SECONDS, sizes[2])
    assert choose() == 2
    repeat(pace, 0.45 * FRAME_SECONDS, sizes[1])
    assert choose() == 1


def test_kept_views_have_their_own_pace():
    pace, num_rays = FramePace(), VIEW.make_lattice(640).num_rays
    repeat(pace, 0.5 * FRAME_SECONDS, num_rays)
    assert pace.choose_lattice(VIEW, 640, True).pixels_per_ray == 1
    repeat(pace, 1.5 * FRAME_SECONDS, num_rays, True)
    assert [pace.choose_lattice(VIEW, 640, is_kept).pixels_per_ray for is_kept in (False, True)] == [1, 2]


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


def test_frames_that_were_too_slow_are_timed_again(monkeypatch):
    pace, now = FramePace(), [100.0]
    monkeypatch.setattr("nerg_mi.viewer.points.time.monotonic", lambda: now[0])
    num_rays = VIEW.make_lattice(320, 2).num_rays
    for is_kept in (False, True):
        # A moving observer has slower frames than a moving camera.
        repeat(pace, 0.15, num_rays, is_kept)
        assert (pace.choose_lattice(VIEW, 640, is_kept) is not None) == is_kept
    assert not pace.start_retry(VIEW, 640)
    now[0] += 60
    assert pace.start_retry(VIEW, 640) and not pace.start_retry(VIEW, 640)
    repeat(pace, 0.05, num_rays)
    assert pace.choose_lattice(VIEW, 640) is not None


def test_a_moving_view_shows_frames_if_they_are_fast(room, gaze_fields, make_session):
    session = make_session(room, gaze_fields[0], width=320, compile=False)
    assert session.worker.wait_idle(120)
    page, client = Page(server=None), _Client()
    page.session = session
    window = BrowserWindow(client, status=None, view=session.home_view)
    page.windows[client.client_id] = window

    def set_speed(seconds_per_ray):
        session.frame_pace = FramePace()
        repeat(session.frame_pace, seconds_per_ray, 1)

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
    # Without drafts, frames are complete, however long they take.
    set_speed(1.0)
    session.has_drafts = False
    assert session.choose_lattice(window.view) == window.view.make_lattice(320)
    session.has_drafts = True
    # An error ends the frame only.
    set_speed(1e-9)
    session.frame_pace.record = None
    window.is_handled = False
    page._hide_picture(window, time.monotonic())
    assert session.worker.wait_idle(120) and not window.is_frame_pending and len(session.listener.errors) == 1


def test_drafts_of_a_moving_observer_equal_pictures_at_rest(room, gaze_fields, make_session):
    session = make_session(room, gaze_fields[0], width=64)
    assert session.worker.wait_idle(120)
    session.set_display(layer=get_layer("observer_depth"))
    view, lattice = session.home_view, session.home_view.make_lattice(64)
    make = lambda is_draft: session.worker.call(lambda: session._make_frame(view, lattice, is_draft)[1]).result()
    for k in range(4):
        session.place_observer(np.array([0.1 * k, 0.2, 0.5]))
        assert np.mean(make(True) != make(False)) < 0.01
