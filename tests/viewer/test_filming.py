"""A flight as a video: in turns with other tasks, cancelled, and with what is shown."""

from __future__ import annotations

import builtins
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.viewer.flights import Film, even, film_options, flight, frames_csv, shown_of_flight
from nerg_mi.viewer.layers import Scale, layer_of
from nerg_mi.viewer.points import View
from nerg_mi.viewer.scene import copied
from nerg_mi.viewer.session import Worker

HOME = View.of((-2, 0, 1), (2, 0, 0), (0, 0, 1), 0.8, 1.37)


@pytest.fixture
def film_of(room, tmp_path):
    """A function that makes a film of a few frames of the room, and the list of what it told."""

    def make(seconds=0.5):
        further = View.of((-1, 0, 1), (2, 0, 0), (0, 0, 1), 0.8, 1.37)
        kept = flight([HOME, further], seconds, 10)
        views, shown = shown_of_flight(kept, 49, observer=None, aovs=("depth",), spp=1, falloff=0.05)
        (tmp_path / "view.xml").write_text(copied(room, shown))
        (tmp_path / "view.frames.csv").write_text(frames_csv(views), newline="")
        told, ended = [], []
        options = film_options(layer_of("color"), Scale(), tmp_path / "view.frames.csv", 10, "llvm_ad_rgb")
        film = Film(
            tmp_path / "view.xml", tmp_path / "f.mp4", options, lambda share, text: told.append(share), ended.append
        )
        return film, told, ended

    return make


def test01_frames_are_those_of_the_flight(film_of, tmp_path):
    av = pytest.importorskip("av")
    film, told, ended = film_of()
    worker, turns = Worker(ended.append), []

    def others():
        while not film._over:
            turns.append(len(told))
            yield

    worker.submit("others", 1, others())
    worker.submit("film", 1, film.steps())
    try:
        assert worker.wait_idle(120) and ended == [None]
    finally:
        worker.stop()
    assert len(set(turns)) > 3, "others have their turns while it is made"
    assert told == sorted(told) and told[-1] == pytest.approx(1)
    with av.open(str(tmp_path / "f.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == (36, 48, 3)
    assert np.abs(frames[-1] - frames[0]).mean() > 3


def test02_cancelled_it_leaves_nothing(film_of, tmp_path):
    pytest.importorskip("av")
    film, told, ended = film_of(5.0)
    steps = film.steps()
    for _ in range(4):
        next(steps)
    film.cancel()
    for _ in steps:
        pass
    assert [type(error) for error in ended] == [KeyboardInterrupt] and len(told) < 10
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.xml", "view.frames.csv", "view.xml"]


def test03_dropped_steps_end_it_too(film_of):
    pytest.importorskip("av")
    film, _, ended = film_of(5.0)
    steps = film.steps()
    next(steps)
    steps.close()
    assert [type(error) for error in ended] == [KeyboardInterrupt]


def test04_without_pyav_it_says_so(film_of, monkeypatch):
    usual = builtins.__import__

    def without(name, *args, **more):
        if name == "av":
            raise ImportError(name)
        return usual(name, *args, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    film, _, ended = film_of()
    for _ in film.steps():
        pass
    assert "nerg-mi[video]" in str(ended[0])


@pytest.mark.parametrize("aspect, width", [(1.5, 720), (1.783, 481), (0.6, 33), (3.0, 2)])
def test05_sides_are_even(aspect, width):
    view, wide = even(View.of((0, 0, 0), (1, 0, 0), (0, 0, 1), 0.8, aspect), width)
    assert wide % 2 == 0 and view.height(wide) % 2 == 0 and min(wide, view.height(wide)) >= 16


def test06_it_is_drawn_as_the_layer_is():
    frames = Path("frames.csv")
    gaze = film_options(layer_of("gaze"), Scale(0, 0.4, "magma"), frames, 25, "llvm_ad_rgb")
    assert (gaze.overlay, gaze.top, gaze.cmap) == ("gaze", 0.4, "magma")
    assert film_options(layer_of("visibility"), Scale(), frames, 25, "llvm_ad_rgb").top is None
    assert film_options(layer_of("color"), Scale(), frames, 25, "llvm_ad_rgb").overlay is None
    depth = film_options(layer_of("depth"), Scale(1, 7), frames, 25, "llvm_ad_rgb")
    assert (depth.overlay, depth.top, depth.cmap) == ("depth", 7, "inferno")
