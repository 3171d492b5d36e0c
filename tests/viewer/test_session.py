"""What is viewed: the observer's gaze, numbers and pictures, on one thread."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.viewer import session as session_module
from nerg_mi.viewer.layers import layer_of
from nerg_mi.viewer.session import Session
from nerg_mi.workflows.view import ViewOptions, place_to_view


class Heard:
    """A listener that counts."""

    def __init__(self):
        self.proxies = self.baked = self.shares = self.ranges = 0
        self.errors = []

    def on_proxy(self):
        self.proxies += 1

    def on_baked(self):
        self.baked += 1

    def on_shares(self):
        self.shares += 1

    def on_range(self):
        self.ranges += 1

    def on_error(self, error):
        self.errors.append(error)


@pytest.fixture
def session_of(tmp_path):
    made = []

    def make(path, *others, **options) -> Session:
        chosen = ViewOptions(**options)
        session = Session(lambda: place_to_view([path, *others], tmp_path, chosen), chosen, Heard())
        made.append(session)
        session.start()
        return session

    yield make
    for session in made:
        session.stop()


def settle(session):
    assert session.worker.wait_idle(120)
    while not (session.follow_observer() and session.follow_shares()):
        assert session.worker.wait_idle(120)
        assert not session.listener.errors
    assert not session.listener.errors


def test01_points_and_what_is_seen_of_them(session_of, room):
    session = session_of(room)
    settle(session)
    assert session.listener.proxies == 2 and session.listener.baked >= 1
    hidden = session.baked["visibility"] < 0.5
    behind = (session.proxy.points[:, 0] > 2.2) & (np.abs(session.proxy.points[:, 1]) < 0.2)
    assert hidden[behind].all() and 0.5 < (~hidden).mean() < 1
    before = session.baked["visibility"]
    session.place_observer(np.array([3.0, 0, 0.5]))
    assert not session.follow_observer()
    settle(session)
    assert (
        not np.array_equal(before, session.baked["visibility"])
        and not (session.baked["visibility"] < 0.5)[behind].any()
    )


def test01_what_is_out_of_date_is_known(session_of, room, gaze_fields):
    session = session_of(room, gaze_fields[0])
    assert session.stale_points == "the points do not show gaze" and session.stale_shares and not session.has_scale
    assert "points on surfaces" in session.computing
    settle(session)
    assert session.stale_points == "" and not session.stale_shares and session.has_scale and session.computing == []
    fresh = session.points().colors.astype(int)
    session.place_observer(np.array([3.0, 0, 0.5]))
    assert session.stale_points == "gaze of an earlier observer" and session.stale_shares
    grey = session.points().colors.astype(int)
    assert np.ptp(grey, axis=1).max() == 0 < np.ptp(fresh, axis=1).max()
    started, finish = threading.Event(), threading.Event()

    def wait():
        started.set()
        finish.wait(60)
        yield

    session.worker.submit("film", 0, wait())
    assert started.wait(60)
    session.follow_observer()
    session.follow_shares()
    assert session.computing == ["gaze on the points", "shares of attention", "video"]
    finish.set()
    settle(session)
    assert session.stale_points == "" and not session.stale_shares
    # Colours under the scale of a depth are no depth.
    session.set_shade(layer=layer_of("depth"))
    assert session.stale_points == "the points do not show depth" and not session.has_scale
    session.set_shade(layer=layer_of("color"))
    assert session.stale_points == "" and session.has_scale
    session.set_shade(layer=layer_of("gaze"))
    session.set_falloff(0.2)
    assert session.stale_points == "gaze of earlier settings" and session.stale_shares
    settle(session)
    session.regions = [Region.of("a", (1, -1, 0), (2, 1, 1))]
    assert session.stale_points == "" and session.stale_shares


@pytest.mark.parametrize(
    "at", [(np.nan, 0, 1), (0, np.inf, 1), (0, 0, -np.inf), (1e39, 0, 0), (0, 1), (0, 1, 2, 3)], ids=str
)
def test01_an_observer_has_a_position(at):
    session = Session.__new__(Session)
    session.lock, session.observer = threading.RLock(), np.zeros(3)
    with pytest.raises(NergError, match="an observer cannot stand at"):
        session.place_observer(np.array(at))
    with pytest.raises(NergError, match="an observer cannot stand at"):
        session.place_observer(np.ones(3), np.full((3, 3), np.nan))
    assert (session.observer == 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.1])
def test01_a_fall_off_is_a_length(value):
    with pytest.raises(NergError, match="fall-off is a length"):
        Session.__new__(Session).set_falloff(value)


def test02_a_picture_is_replaced_by_the_next(session_of, room):
    session = session_of(room, spp=4)
    settle(session)
    first, second = [], []
    session.picture("a", session.home, lambda p, c: first.append(p), 400, 256)
    session.picture("a", session.home, lambda p, c: second.append((p, c)), 48, 4)
    settle(session)
    assert not first or not first[-1].whole
    picture, colors = second[-1]
    assert picture.whole and picture.samples == 4 and colors.shape == (32, 48, 3) and colors.dtype == np.uint8
    session.picture("a", session.home, lambda p, c: first.append(p), 400, 256)
    session.cancel("a")
    assert session.worker.wait_idle(60) and not any(p.whole for p in first)


def test03_layers_have_ranges_of_their_own(session_of, room):
    cut = '<float name="ceiling" value="9"/><vector name="up" value="0, 0.1, 1"/><string name="aovs"'
    room.write_text(room.read_text().replace('<string name="aovs"', cut))
    session = session_of(room)
    assert session.ceiling == 9 and np.allclose(session.cut_up, np.array([0, 0.1, 1]) / np.hypot(0.1, 1))
    settle(session)
    session.set_shade(layer=layer_of("depth"))
    session.picture("a", session.home, lambda p, c: None, 48, 1)
    settle(session)
    scale = session.scale()
    assert 0.5 < scale.low < 2 and 2 < scale.high < 10
    session.set_shade(fixed=(1.0, 4.0))
    assert (session.scale().low, session.scale().high) == (1.0, 4.0)
    session.set_falloff(0.25)
    assert float(np.ravel(np.array(session.scene.integrator.falloff))[0]) == pytest.approx(0.25)


@pytest.mark.nightly
@pytest.mark.slow
def test04_shares_are_those_of_the_library(session_of, store):
    session = session_of(store, observer=(4.6, 3.0, 1.6))
    session.regions = [
        Region.of("drinks", (4.4, 4.65, 0), (4.9, 5.0, 1.45)),
        Region.of("floor", (4, 2, -0.1), (5, 3, 0)),
    ]
    settle(session)
    session.set_falloff(0.05)
    settle(session)
    scene = nerg.Scene.load(store)
    for region in session.regions:
        true = nerg.attention(scene, region.corners, observers=[(4.6, 3.0, 1.6)]).share[0]
        assert session.shares[region.name] == pytest.approx(float(true), rel=0.03)
    assert "rays of" in session.basis and "people" in session.basis
    shown = session.points()
    assert shown.colors.shape == shown.points.shape == session.proxy.points.shape
    fewer = session.points(2)
    assert np.array_equal(fewer.colors, shown.colors[: len(fewer.colors)]) and fewer.size > shown.size
    session.ceiling = 1.0
    assert 0 < len(session.points().points) < len(shown.points) and session.points().points[:, 2].max() <= 1.0
    session.ceiling = None
    counted = session.listener.shares
    assert session.follow_shares() and session.listener.shares == counted
    session.regions = session.regions[:1]
    assert not session.follow_shares()
    settle(session)
    assert set(session.shares) == {"drinks"}


def test05_the_sphere_is_level_and_ahead_in_its_middle(session_of, room):
    session = session_of(room)
    settle(session)
    session.set_shade(layer=layer_of("visibility"))
    shown = []
    session.sphere(shown.append, 64)
    settle(session)
    (sphere,) = shown
    assert sphere.shape == (32, 64, 3)
    # The box is 1 m ahead, and half a metre higher than the eye: 27 degrees. Beside it and above there is nothing.
    hatched = {tuple(c) for c in np.unique(sphere[:10].reshape(-1, 3), axis=0)}
    assert len(hatched) == 2
    is_hatched = lambda part: {tuple(c) for c in part.reshape(-1, 3)} <= hatched
    assert not is_hatched(sphere[12:16, 28:36]) and is_hatched(sphere[:15, :20]) and is_hatched(sphere[:15, 44:])


def test06_what_cannot_be_shown_is_told(session_of, room, tmp_path):
    with pytest.raises(NergError, match="no file"):
        session_of(Path("nowhere.xml"))
    with pytest.raises(NergError, match="three numbers"):
        session_of(room, observer=(1.0, 2.0))
    for wrong in (float("nan"), float("-inf"), 1e30):
        with pytest.raises(NergError, match="--observer must lie in"):
            session_of(room, observer=(1.0, 2.0, wrong))


def test07_variants_are_shown_in_turn(session_of, room, gaze_fields):
    session = session_of(room, *gaze_fields, observer=(0.5, 0.0, 1.0))
    assert session.gaze_name == "emit_capture" and session.shade.layer.title == "gaze"
    settle(session)
    first, points, shared, falloff = session.baked["gaze"], session.proxy.points, dict(session.shares), session.falloff
    assert first.max() > 0 and shared
    session.set_falloff(0.25)
    session.set_shade(layer=layer_of("capture"))
    # Even while the gaze of the other is being computed.
    session.follow_observer()
    session.set_gaze("emit")
    assert session.shade.layer.title == "gaze", "a layer that this one has not"
    assert float(np.ravel(np.array(session.scene.integrator.falloff))[0]) == pytest.approx(0.25)
    settle(session)
    assert session.proxy.points is points and not np.allclose(session.baked["gaze"], first, rtol=0.1)
    assert session.shares != shared
    # It is that of the file by itself.
    session.set_gaze("emit_capture")
    session.set_falloff(falloff)
    settle(session)
    assert np.allclose(session.baked["gaze"], first, rtol=1e-4, atol=1e-6)


def test08_what_cannot_be_counted_is_told_once(session_of, room, gaze_fields, monkeypatch):
    def refuse(*_):
        raise NergError("no")
        yield

    monkeypatch.setattr(session_module, "shares_in_steps", refuse)
    session = session_of(room, gaze_fields[0])
    assert session.worker.wait_idle(120)
    while not session.follow_shares():
        assert session.worker.wait_idle(120)
    assert [str(e) for e in session.listener.errors] == ["no"]
    session.place_observer(np.array([0.0, 1, 1]))
    assert not session.follow_shares()
