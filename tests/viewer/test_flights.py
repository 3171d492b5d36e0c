"""Tests of `nerg_mi.viewer.flights`."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.files import read_frames
from nerg_mi.viewer.flights import (
    FlightPanel,
    FlightVideo,
    format_frames,
    interpolate_views,
    make_camera_path,
    make_even,
    make_video_options,
    prepare_flight,
)
from nerg_mi.viewer.layers import Scale, get_layer
from nerg_mi.viewer.points import PinholeView
from nerg_mi.viewer.scene import copy_scene
from nerg_mi.viewer.serve import open_viewer
from nerg_mi.viewer.session import Worker
from nerg_mi.workflows.scene_commands import ViewOptions
from tests.viewer.browser import require

# ---- Flight videos ----

HOME = PinholeView.look_at((-2, 0, 1), (2, 0, 0), (0, 0, 1), 0.8, 1.37)


@pytest.fixture
def make_video(room, tmp_path):
    """Return a function that renders a video of a few frames of the room, and the list of its progress."""

    def make(seconds=0.5):
        further = PinholeView.look_at((-1, 0, 1), (2, 0, 0), (0, 0, 1), 0.8, 1.37)
        flight = interpolate_views([HOME, further], seconds, 10)
        views, shown = prepare_flight(flight, 49, observer=None, aovs=("depth",), spp=1, falloff=0.05)
        (tmp_path / "view.xml").write_text(copy_scene(room, shown))
        (tmp_path / "view.frames.csv").write_text(format_frames(views), newline="")
        fractions, ended = [], []
        options = make_video_options(get_layer("color"), Scale(), tmp_path / "view.frames.csv", 10, "llvm_ad_rgb")
        film = FlightVideo(
            tmp_path / "view.xml",
            tmp_path / "f.mp4",
            options,
            lambda share, text: fractions.append(share),
            ended.append,
        )
        return film, fractions, ended

    return make


def test01_video_contains_all_frames(make_video, tmp_path):
    av = pytest.importorskip("av")
    film, fractions, ended = make_video()
    worker, turns = Worker(ended.append), []

    def other_task():
        while not film._is_done:
            turns.append(len(fractions))
            yield

    worker.submit("others", 1, other_task())
    worker.submit("film", 1, film.steps())
    try:
        assert worker.wait_idle(120) and ended == [None]
    finally:
        worker.stop()
    assert len(set(turns)) > 3, "others have their turns while it is made"
    assert fractions == sorted(fractions) and fractions[-1] == pytest.approx(1)
    with av.open(str(tmp_path / "f.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == (36, 48, 3)
    assert np.abs(frames[-1] - frames[0]).mean() > 3


def test02_cancelled_video_leaves_no_file(make_video, tmp_path):
    pytest.importorskip("av")
    film, fractions, ended = make_video(5.0)
    steps = film.steps()
    for _ in range(4):
        next(steps)
    film.cancel()
    for _ in steps:
        pass
    assert [type(error) for error in ended] == [KeyboardInterrupt] and len(fractions) < 10
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.xml", "view.frames.csv", "view.xml"]


def test03_closing_the_generator_ends_the_thread(make_video):
    pytest.importorskip("av")
    film, _, ended = make_video(5.0)
    steps = film.steps()
    next(steps)
    steps.close()
    assert [type(error) for error in ended] == [KeyboardInterrupt]


def test04_missing_pyav_is_reported(make_video, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    film, _, ended = make_video()
    for _ in film.steps():
        pass
    assert "nerg-mi[video]" in str(ended[0])


@pytest.mark.parametrize("aspect, width", [(1.5, 720), (1.783, 481), (0.6, 33), (3.0, 2)])
def test05_frame_sizes_are_even(aspect, width):
    view, wide = make_even(PinholeView.look_at((0, 0, 0), (1, 0, 0), (0, 0, 1), 0.8, aspect), width)
    assert wide % 2 == 0 and view.picture_height(wide) % 2 == 0 and min(wide, view.picture_height(wide)) >= 16


def test06_video_options_of_a_layer():
    frames = Path("frames.csv")
    gaze = make_video_options(get_layer("gaze"), Scale(0, 0.4, "magma"), frames, 25, "llvm_ad_rgb")
    assert (gaze.overlay, gaze.vmax, gaze.cmap) == ("gaze", 0.4, "magma")
    assert make_video_options(get_layer("visibility"), Scale(), frames, 25, "llvm_ad_rgb").vmax is None
    assert make_video_options(get_layer("color"), Scale(), frames, 25, "llvm_ad_rgb").overlay is None
    depth = make_video_options(get_layer("depth"), Scale(1, 7), frames, 25, "llvm_ad_rgb")
    assert (depth.overlay, depth.vmax, depth.cmap) == ("depth", 7, "inferno")


# ---- Interpolated views and frames ----


def view(x, ahead=(0, 1, 0)):
    return PinholeView.look_at((x, 0, 1), np.add((x, 0, 1), ahead), (0, 0, 1), 0.9, 1.5)


def test07_flight_passes_through_key_views():
    key_views = [view(0), view(1), view(3, (1, 0, 0))]
    flight_views = interpolate_views(key_views, 2.0, 10)
    assert len(flight_views) == 21
    for at, one in zip((0, 10, 20), key_views):
        assert np.allclose(flight_views[at].origin, one.origin) and np.allclose(
            flight_views[at].forward, one.forward, atol=1e-9
        )
    steps = np.diff([v.origin[0] for v in flight_views])
    assert (steps > 0).all() and steps[0] < steps[5], "it starts from rest"


def test08_frames_file_round_trip(tmp_path):
    (tmp_path / "f.csv").write_text(format_frames(interpolate_views([view(0), view(1)], 1.0, 4)), newline="")
    frames = read_frames(tmp_path / "f.csv")
    assert len(frames) == 5 and list(frames[0]) == ["view_camera", "view_target"]
    origin, target = (np.array([float(v) for v in frames[-1][name].split(",")]) for name in frames[-1])
    assert np.allclose((target - origin) / np.linalg.norm(target - origin), view(1).forward, atol=1e-8)


def test11_camera_path_has_the_rays_of_the_views():
    one = PinholeView.look_at((1, 2, 3), (4, 3, 1), (0, 0, 1), 0.8, 1.5)
    path = make_camera_path([view(0), one], 30, 24)
    assert (path.width, path.height, path.fps) == (30, 20, 24)
    assert np.allclose(path.to_world[1, :3, 3], one.origin) and np.allclose(path.fov, np.degrees([0.9, 0.8]))
    # OpenGL cameras look along -z, with x to the right and y up.
    right = np.cross(one.forward, one.up)
    assert np.allclose(path.to_world[1, :3, :3], np.stack([right, one.up, -one.forward], axis=1))


@pytest.mark.parametrize("views, seconds, fps", [([], 1, 25), ([view(0)], 1, 25), ([view(0), view(1)], 1e6, 120)])
def test09_invalid_flights_are_refused(views, seconds, fps):
    with pytest.raises(NergError, match="flight"):
        interpolate_views(views, seconds, fps)


# ---- Panel ----


class Client:
    def __init__(self):
        self.notes, self.files = [], {}

    def add_notification(self, title, body, **kwargs):
        self.notes.append(body)

    def send_file_download(self, name, data, **kwargs):
        self.files[name] = data


def test10_video_is_sent_to_the_browser(room):
    require("viser")
    pytest.importorskip("av")
    client = Client()
    with open_viewer([room], ViewOptions(port=0, width=32, spp=1)) as running:
        part = FlightPanel(running.page)
        part._start_video(SimpleNamespace(client=client))
        assert "two views" in client.notes[-1] and part._video is None
        home = running.page.session.home_view
        part._views = [
            home,
            PinholeView.look_at(home.origin + 0.3, home.origin + home.forward, home.up, home.fov, home.aspect),
        ]
        part._seconds.value, part._fps.value = 0.2, 10
        part._start_video(SimpleNamespace(client=client))
        assert running.page.session.worker.wait_idle(120)
        assert running.page.problem == "" and part._video is None and not part._cancel_button.visible
    assert client.files["flight.mp4"][4:8] == b"ftyp"
