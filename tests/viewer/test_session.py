"""Tests of `nerg_mi.viewer.session`."""

from __future__ import annotations

import inspect
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.nested_scene import SceneDocument
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.mitsuba_mesh import make_mesh, read_triangles
from nerg_mi.viewer import session as module
from nerg_mi.viewer import shares as sums
from nerg_mi.viewer.layers import get_layer
from nerg_mi.viewer.page import Page
from nerg_mi.viewer.session import Listener, Session
from nerg_mi.viewer.shares import AttentionShare
from nerg_mi.viewer.tracks import ALL_PARTICIPANTS, MAX_GAP, Tracks
from nerg_mi.viewer.worker import Worker
from tests.refusals import mentions

# ---- Listener ----

EVENTS = [name for name in vars(Listener) if name.startswith("on_")]


@pytest.mark.parametrize("name", EVENTS)
def test_page_implements_listener(name):
    assert inspect.signature(getattr(Page, name)) == inspect.signature(getattr(Listener, name))


# ---- Session ----


def settle(session):
    assert session.worker.wait_idle(120)
    while not (session.update_points() and session.update_shares()):
        assert session.worker.wait_idle(120)
        assert not session.listener.errors
    assert not session.listener.errors


def test01_points_and_visibility(make_session, room):
    session = make_session(room)
    settle(session)
    assert session.listener.proxies == 2 and session.listener.baked >= 1
    # Without an observer: half way to what the camera looks at.
    home = session.home_view
    depth = nerg.trace(session.scene, home.origin, home.forward[None], ["depth"]).depth[0]
    default = session.worker.call(session._default_observer).result()
    np.testing.assert_allclose(default, home.origin + 0.5 * float(depth) * home.forward, rtol=1e-4)
    hidden = session.point_values["visibility"] < 0.5
    behind = (session.proxy.points[:, 0] > 2.2) & (np.abs(session.proxy.points[:, 1]) < 0.2)
    assert hidden[behind].all() and 0.5 < (~hidden).mean() < 1
    before = session.point_values["visibility"]
    session.place_observer(np.array([3.0, 0, 0.5]))
    assert not session.update_points()
    settle(session)
    assert (
        not np.array_equal(before, session.point_values["visibility"])
        and not (session.point_values["visibility"] < 0.5)[behind].any()
    )


def test02_stale_results_are_reported(make_session, room, gaze_fields):
    session = make_session(room, gaze_fields[0])
    assert (
        session.stale_points_reason == "the points do not show gaze"
        and session.are_shares_stale
        and not session.has_scale
    )
    assert "points on surfaces" in session.running_tasks
    settle(session)
    assert (
        session.stale_points_reason == ""
        and not session.are_shares_stale
        and session.has_scale
        and session.running_tasks == []
    )
    fresh = session.points().colors.astype(int)
    session.place_observer(np.array([3.0, 0, 0.5]))
    assert session.stale_points_reason == "gaze of a previous observer position" and session.are_shares_stale
    grey = session.points().colors.astype(int)
    assert np.ptp(grey, axis=1).max() == 0 < np.ptp(fresh, axis=1).max()
    started, finish = threading.Event(), threading.Event()

    def wait():
        started.set()
        finish.wait(60)
        yield

    session.worker.submit("people", 0, wait())
    assert started.wait(60)
    session.update_points()
    session.update_shares()
    assert session.running_tasks == ["gaze on the points", "attention shares", "recordings"]
    finish.set()
    settle(session)
    assert session.stale_points_reason == "" and not session.are_shares_stale
    # Colours do not count as the range of the depth.
    session.set_display(layer=get_layer("depth"))
    assert session.stale_points_reason == "the points do not show depth" and not session.has_scale
    session.set_display(layer=get_layer("color"))
    assert session.stale_points_reason == "" and session.has_scale
    session.set_display(layer=get_layer("gaze"))
    session.set_falloff(0.2)
    assert session.stale_points_reason == "gaze of previous settings" and session.are_shares_stale
    settle(session)
    session.regions = [Region.create("a", (1, -1, 0), (2, 1, 1))]
    assert session.stale_points_reason == "" and session.are_shares_stale


@pytest.mark.parametrize(
    "at", [(np.nan, 0, 1), (0, np.inf, 1), (0, 0, -np.inf), (1e39, 0, 0), (0, 1), (0, 1, 2, 3)], ids=str
)
def test03_invalid_position_is_refused(at):
    session = Session.__new__(Session)
    session.lock, session.observer = threading.RLock(), np.zeros(3)
    with pytest.raises(NergError, match="invalid observer position"):
        session.place_observer(np.array(at))
    with pytest.raises(NergError, match="invalid observer position"):
        session.place_observer(np.ones(3), np.full((3, 3), np.nan))
    assert (session.observer == 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.1])
def test04_invalid_falloff_is_refused(value):
    with pytest.raises(NergError, match="fall-off must be 0"):
        Session.__new__(Session).set_falloff(value)


def test05_new_picture_replaces_old_one(make_session, room):
    session = make_session(room, spp=4)
    settle(session)
    first, second = [], []
    session.refine_picture("a", session.home_view, lambda p, c: first.append(p), 400, 256)
    session.refine_picture("a", session.home_view, lambda p, c: second.append((p, c)), 48, 4)
    settle(session)
    assert not first or not first[-1].is_final
    picture, colors = second[-1]
    assert picture.is_final and picture.samples == 4 and colors.shape == (32, 48, 3) and colors.dtype == np.uint8
    session.refine_picture("a", session.home_view, lambda p, c: first.append(p), 400, 256)
    session.cancel("a")
    assert session.worker.wait_idle(60) and not any(p.is_final for p in first)


def test06_each_layer_has_its_range(make_session, room):
    cut = '<float name="ceiling" value="9"/><vector name="up" value="0, 0.1, 1"/><string name="aovs"'
    room.write_text(room.read_text().replace('<string name="aovs"', cut))
    session = make_session(room)
    assert session.ceiling == 9 and np.allclose(session.ceiling_up, np.array([0, 0.1, 1]) / np.hypot(0.1, 1))
    settle(session)
    session.set_display(layer=get_layer("depth"))
    session.refine_picture("a", session.home_view, lambda p, c: None, 48, 1)
    settle(session)
    scale = session.scale()
    assert 0.5 < scale.low < 2 and 2 < scale.high < 10
    session.set_display(limits=(1.0, 4.0))
    assert (session.scale().low, session.scale().high) == (1.0, 4.0)
    session.set_falloff(0.25)
    assert float(np.ravel(np.array(session.scene.integrator.falloff))[0]) == pytest.approx(0.25)


@pytest.mark.nightly
@pytest.mark.slow
def test07_shares_equal_api(make_session, store):
    session = make_session(store, observer=(4.6, 3.0, 1.6))
    session.regions = [
        Region.create("drinks", (4.4, 4.65, 0), (4.9, 5.0, 1.45)),
        Region.create("floor", (4, 2, -0.1), (5, 3, 0)),
    ]
    settle(session)
    session.set_falloff(0.05)
    settle(session)
    scene = nerg.Scene.load(store)
    for region in session.regions:
        true = nerg.attention(scene, region.corners, observers=[(4.6, 3.0, 1.6)]).share[0]
        # Hardly any gaze falls on the floor.
        share = session.shares[region.name]
        assert share.is_final and share.share == pytest.approx(float(true), rel=0.01, abs=share.error)
    assert "rays of" in session.basis and "participants" in session.basis
    shown = session.points()
    assert shown.colors.shape == shown.points.shape == session.proxy.points.shape
    fewer = session.points(2)
    assert np.array_equal(fewer.colors, shown.colors[: len(fewer.colors)]) and fewer.size > shown.size
    session.ceiling = 1.0
    assert 0 < len(session.points().points) < len(shown.points) and session.points().points[:, 2].max() <= 1.0
    session.ceiling = None
    counted = session.listener.shares
    assert session.update_shares() and session.listener.shares == counted
    session.regions = session.regions[:1]
    assert not session.update_shares()
    settle(session)
    assert set(session.shares) == {"drinks"}


def test08_panorama_is_centred_on_heading(make_session, room):
    session = make_session(room)
    settle(session)
    session.set_display(layer=get_layer("visibility"))
    shown = []
    session.render_panorama(shown.append, 64)
    settle(session)
    (sphere,) = shown
    assert sphere.shape == (32, 64, 3)
    # The box is 1 m in front and half a metre above the eye: 27 degrees. Next to it and above there is nothing.
    hatched = {tuple(c) for c in np.unique(sphere[:10].reshape(-1, 3), axis=0)}
    assert len(hatched) == 2
    is_hatched = lambda part: {tuple(c) for c in part.reshape(-1, 3)} <= hatched
    assert not is_hatched(sphere[12:16, 28:36]) and is_hatched(sphere[:15, :20]) and is_hatched(sphere[:15, 44:])


def test09_invalid_input_is_reported(make_session, room, tmp_path):
    with pytest.raises(NergError, match="no file"):
        make_session(Path("nowhere.xml"))
    with pytest.raises(NergError, check=mentions("observer")):
        make_session(room, observer=(1.0, 2.0))
    for wrong in (float("nan"), float("-inf"), 1e30):
        with pytest.raises(NergError, match="invalid observer position"):
            make_session(room, observer=(1.0, 2.0, wrong))


def test10_gaze_field_can_be_switched(make_session, room, gaze_fields):
    session = make_session(room, *gaze_fields, observer=(0.5, 0.0, 1.0))
    assert session.gaze_name == "emit_capture" and session.display.layer.title == "gaze"
    settle(session)
    first, points, shared, falloff = (
        session.point_values["gaze"],
        session.proxy.points,
        dict(session.shares),
        session.falloff,
    )
    assert first.max() > 0 and shared
    session.set_falloff(0.25)
    session.set_display(layer=get_layer("capture"))
    # Also while the gaze of the other field is being computed.
    session.update_points()
    session.select_gaze("emit")
    assert session.display.layer.title == "gaze", "a layer that this one has not"
    assert float(np.ravel(np.array(session.scene.integrator.falloff))[0]) == pytest.approx(0.25)
    settle(session)
    assert session.proxy.points is points and not np.allclose(session.point_values["gaze"], first, rtol=0.1)
    assert session.shares != shared
    # It equals the gaze of the file loaded separately.
    session.select_gaze("emit_capture")
    session.set_falloff(falloff)
    settle(session)
    assert np.allclose(session.point_values["gaze"], first, rtol=1e-4, atol=1e-6)


def test11_failed_shares_are_reported_once(make_session, room, gaze_fields, monkeypatch):
    def refuse(*_):
        raise NergError("no")
        yield

    monkeypatch.setattr(module, "iter_attention_shares", refuse)
    session = make_session(room, gaze_fields[0])
    assert session.worker.wait_idle(120)
    while not session.update_shares():
        assert session.worker.wait_idle(120)
    assert [str(e) for e in session.listener.errors] == ["no"]
    session.place_observer(np.array([0.0, 1, 1]))
    assert not session.update_shares()


def test22_observer_outside_is_noted(make_session, room, gaze_fields):
    session = make_session(room, gaze_fields[0])
    settle(session)
    assert session.observer_note == "" and all(share.is_final for share in session.shares.values())
    session.place_observer(np.array([99.0, 99, 1.6]))
    with warnings.catch_warnings():
        # The note is enough: pictures and points follow each step of the observer.
        warnings.simplefilter("error")
        settle(session)
    assert "99, 99, 1.6" in session.observer_note and "extrapolated" in session.observer_note


# ---- Attention shares ----

AT = np.array([0.2, 0.1, 0.6])


@pytest.fixture
def scene(room, gaze_fields, tmp_path):
    path = tmp_path / "with.xml"
    path.write_text(SceneDocument.read(room).with_gaze(gaze_fields[0]).to_xml())
    return nerg.Scene.load(path)


def test12_areas_and_meshes_in_steps(scene, monkeypatch):
    regions = [
        Region.create("left", (0, 0.5, -0.1), (2, 2, 0.4)),
        Region.create("right", (0, -2, -0.1), (2, -0.5, 0.4)),
    ]
    monkeypatch.setattr(sums, "SHAPES_PER_STEP", 1)
    steps = list(sums.iter_attention_shares(scene, AT, regions, ["floor", "box"]))
    assert [sorted(step) for step in steps] == 2 * [["left", "right"], ["floor"], ["box"]]
    one = nerg.attention(scene, regions[0].corners, observers=AT[None])
    left, preliminary = steps[3]["left"], steps[0]["left"]
    assert left.share == pytest.approx(float(one.share[0]), abs=left.error) and left.share > 0
    assert left.is_final and left.error <= preliminary.error


def test21_meshes_are_seen_from_both_sides(scene):
    """Faces in either order, from outside and from inside."""
    vertices, faces = read_triangles(next(s for s in scene.mitsuba.shapes() if s.id() == "box"))
    lower, upper = vertices.min(0), vertices.max(0)
    shares = []
    for eye in (AT, (lower + upper) / 2):
        for f in (faces, faces[:, ::-1]):
            other = nerg.make_scene(
                gaze=scene.integrator.children["gaze"].filename, shapes={"box": make_mesh(vertices, f, "box")}
            )
            *_, step = sums.iter_attention_shares(other, np.asarray(eye), [], ["box"])
            shares.append(step["box"].share)
    assert shares[0] == pytest.approx(shares[1]) and shares[0] > 0
    assert shares[2:] == pytest.approx([1, 1], abs=1e-3)


def test27_final_shares_are_within_their_accuracy():
    assert [AttentionShare(*one).is_final for one in ((0.5, 0.01), (0.5, 0.011), (0.0, 5e-4), (0.0, 1e-3))] == [
        True,
        False,
        True,
        False,
    ]


def test13_no_areas_and_no_shapes(scene):
    assert list(sums.iter_attention_shares(scene, AT, [], [])) == []


# ---- Recordings ----

SAME = Similarity(np.eye(4))


def make_walk(align=SAME, cohorts=True):
    """Ada walks along x for 10 s with a gap of 3 s; Ben stands still for 2 s. The samples are unsorted."""
    t = np.concatenate([np.arange(0, 4, 0.1), np.arange(7, 10, 0.1), np.arange(0, 2, 0.1)])
    person = np.concatenate([np.zeros(70, int), np.ones(20, int)])
    origin = np.stack([np.where(person == 0, t, 5.0), np.zeros(90), np.full(90, 1.6)], axis=1)
    direction = np.tile([0.0, 1.0, 0.0], (90, 1))
    mixed = np.random.default_rng(3).permutation(90)
    fields = dict(cohort=person[mixed], cohorts=("grown", "small")) if cohorts else {}
    rays = Rays(t[mixed], person[mixed], ("Ada", "Ben"), origin[mixed], direction[mixed], np.ones(90), **fields)
    return Tracks(rays, align)


def test14_gap_interrupts_path():
    segments, person = make_walk().segments()
    assert len(segments) == 39 + 29 + 19 and segments.shape[1:] == (2, 3)
    ada = segments[person == 0]
    assert np.allclose(ada[:, 1, 0] - ada[:, 0, 0], 0.1, atol=1e-4)
    assert np.allclose(segments[person == 1][..., 0], 5)


def test26_paths_of_rare_samples_are_joined():
    t = np.array([0.0, 5, 10, 15, 100])
    rays = Rays(t, np.zeros(5, int), ("Ada",), np.zeros((5, 3)), np.tile([0.0, 1, 0], (5, 1)), np.ones(5))
    assert len(Tracks(rays, Similarity()).segments()[0]) == 3


def test15_poses_at_a_time():
    tracks = make_walk()
    assert tracks.time_range == (0.0, pytest.approx(9.9)) and tracks.participants == ["Ada", "Ben"]
    poses = {p.participant: p for p in tracks.poses_at(1.0)}
    assert set(poses) == {"Ada", "Ben"} and np.allclose(poses["Ada"].position, [1, 0, 1.6], atol=1e-6)
    assert np.allclose(poses["Ada"].direction, [0, 1, 0])
    assert [p.participant for p in tracks.poses_at(8.0)] == ["Ada"]
    assert tracks.poses_at(5.45 + 0 * MAX_GAP) == [] and tracks.poses_at(99.0) == []


def test16_cohorts():
    tracks = make_walk()
    assert tracks.groups == [ALL_PARTICIPANTS, "grown", "small"]
    assert [p.participant for p in tracks.poses_at(1.0, "small")] == ["Ben"]
    assert len(tracks.segments("small")[0]) == 19
    assert make_walk(cohorts=False).groups == [ALL_PARTICIPANTS]


def test17_alignment_is_applied():
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, [10, 0, 0]
    (ada,) = make_walk(Similarity(matrix)).poses_at(8.0)
    assert np.allclose(ada.position, [10, 16, 3.2], atol=1e-6) and np.allclose(ada.direction, [-1, 0, 0], atol=1e-6)


def test25_probes_and_sampled_rays_are_aligned():
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[:3, 3] = 10, 0, 0
    count = 100
    at = np.tile([1.0, 2.0, 1.6], (count, 1))
    person = np.arange(count) % 2
    rays = Rays(
        np.arange(count) * 0.1, person, ("Ada", "Ben"), at, np.tile([0.0, 1.0, 0.0], (count, 1)), np.ones(count)
    )
    tracks = Tracks(rays, Similarity(matrix))
    positions, counts = tracks.place_probes()
    assert np.allclose(positions, [12, 4, 3.2], atol=1e-6) and (counts > 0).all()
    origins, directions, person = tracks.sample(max_rays=10)
    assert np.allclose(origins, [12, 4, 3.2], atol=1e-6) and np.allclose(directions, [0, 1, 0], atol=1e-6)
    assert person.tolist() == [0] * 5 + [1] * 5


# ---- Render thread ----


@pytest.fixture
def worker():
    errors = []
    made = Worker(errors.append)
    made.errors = errors
    yield made
    made.stop()


def steps(name, count, log, gate=None):
    for k in range(count):
        if gate is not None:
            assert gate.wait(10)
        log.append((name, k, threading.get_ident()))
        yield


def test18_steps_run_on_one_thread(worker):
    log = []
    worker.submit("a", 1, steps("a", 3, log))
    worker.submit("b", 1, steps("b", 3, log))
    assert worker.wait_idle(10)
    assert sorted(entry[:2] for entry in log) == [(n, k) for n in "ab" for k in range(3)]
    assert len({entry[2] for entry in log}) == 1 and log[0][2] != threading.get_ident()


@pytest.fixture
def start_blocked_task(worker):
    """Return a function that starts a task which blocks in its first step; it returns the log of steps and an event to
    continue."""

    def begin(name, urgency, count):
        log, gate, started = [], threading.Event(), threading.Event()

        def task():
            for k in range(count):
                started.set()
                assert gate.wait(10)
                log.append((name, k))
                yield

        worker.submit(name, urgency, task())
        assert started.wait(10)
        return log, gate.set

    return begin


def test19_higher_priority_runs_between_steps(worker, start_blocked_task):
    log, go_on = start_blocked_task("slow", 5, 4)
    worker.submit("urgent", 0, (log.append(("urgent", k)) for k in range(2)))
    go_on()
    assert worker.wait_idle(10)
    assert log == [("slow", 0), ("urgent", 0), ("urgent", 1), ("slow", 1), ("slow", 2), ("slow", 3)]


def test20_new_task_replaces_task_of_same_name(worker, start_blocked_task):
    log, go_on = start_blocked_task("picture", 3, 100)
    worker.submit("picture", 3, (log.append(("new", k)) for k in range(3)))
    go_on()
    assert worker.wait_idle(10)
    assert log == [("picture", 0), ("new", 0), ("new", 1), ("new", 2)]


def test21_cancelled_task_ends(worker, start_blocked_task):
    log, go_on = start_blocked_task("picture", 3, 100)
    worker.cancel("picture")
    go_on()
    assert worker.wait_idle(10) and worker.is_idle
    assert worker.call(lambda: 7).result(10) == 7
    assert log == [("picture", 0)]


def test22_equal_priority_takes_turns(worker):
    log, gate = [], threading.Event()
    worker.submit("first", 2, steps("first", 3, log, gate))
    worker.submit("second", 2, steps("second", 3, log, gate))
    gate.set()
    assert worker.wait_idle(10)
    assert [name for name, *_ in log] == ["first", "second"] * 3


def test23_error_ends_one_task_only(worker):
    def bad():
        yield
        raise ValueError("no such thing")

    worker.submit("bad", 0, bad())
    worker.submit("good", 1, (None for _ in range(2)))
    assert worker.wait_idle(10)
    (error,) = worker.errors
    assert isinstance(error, ValueError)
    with pytest.raises(KeyError):
        worker.call(lambda: {}["x"]).result(10)
    assert len(worker.errors) == 1


def test24_stopped_worker_starts_nothing():
    worker = Worker(lambda error: None)
    worker.stop()
    worker.submit("late", 0, iter([1]))
    assert worker.is_idle
