"""Tests of `nerg_mi.tracking.events`."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.event_settings import FIXATIONS, KINDS, EventRules
from nerg_mi.tracking.events import (
    angles_about,
    average_fixations,
    detect_events,
    detect_fixations_idt,
    label_fixations,
    measure_velocities,
)
from nerg_mi.tracking.rays import Rays, merge_rays
from tests.tracking.people import some_rays

# ---- Fixations ----


def gaze(azimuth, elevation=0.0, dt=0.02, **columns):
    """Rays of a person whose gaze turns by degrees at steps of ``dt`` seconds."""
    a, e = np.broadcast_arrays(np.radians(np.asarray(azimuth, float)), np.radians(elevation))
    d = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)
    return some_rays(len(d), **{"t": np.arange(len(d)) * dt, "direction": d, **columns})


def detect_fixations_ivt(rays, velocity=100.0, min_duration=0.06, gap=0.1):
    """Fixations by velocity alone: I-VT."""
    only = {"merge_gap": 0.0, "pursuit_velocity": 1e6}
    rules = EventRules(velocity_threshold=velocity, min_fixation=min_duration, max_step=gap, **only)
    return label_fixations(rays, rules)[0]


# Ten rays at 0 degrees, a saccade of two, ten at 20, one at 40, ten at 60: 50 Hz.
SEQUENCE = [*[0] * 10, 8, 16, *[20] * 10, 40, *[60] * 10]

WANT = np.array([*[0] * 10, -1, -1, *[1] * 10, -1, *[2] * 10])


def test_ivt_by_hand():
    label = detect_fixations_ivt(gaze(SEQUENCE), velocity=100)
    # A ray belongs to the run that its step leads to: the first of a run follows a fast step.
    assert label.tolist() == WANT.tolist()
    # 8 degrees in 0.02 s are 400 per second: a higher limit joins the first two.
    assert len(set(detect_fixations_ivt(gaze(SEQUENCE), velocity=450)) - {-1}) == 2
    # Nine steps of 0.02 s are 0.18 s.
    assert (detect_fixations_ivt(gaze(SEQUENCE), velocity=100, min_duration=0.19) == -1).all()


def test_idt_by_hand():
    assert detect_fixations_idt(gaze(SEQUENCE), dispersion=1.0).tolist() == WANT.tolist()
    # Within five degrees, 16 joins 20.
    assert detect_fixations_idt(gaze(SEQUENCE), dispersion=5.0).tolist() == [*WANT[:11], 1, *WANT[12:]]
    # A slow drift of half a degree per ray: I-VT finds no end, I-DT ends it every seven rays (3 degrees).
    drift = gaze(0.5 * np.arange(28))
    assert (
        detect_fixations_idt(drift, dispersion=3.01).tolist() == [k // 7 for k in range(28)]
        and (detect_fixations_ivt(drift) == 0).all()
    )
    # Horizontal and vertical ranges are added.
    both = gaze(0.5 * np.arange(28), 0.5 * np.arange(28))
    assert detect_fixations_idt(both, dispersion=3.05, min_duration=0.04).tolist() == [k // 4 for k in range(28)]


@pytest.mark.parametrize("degrees, parts", [(2.9, 1), (3.1, 2)])
def test_dispersion_at_the_zenith(degrees, parts):
    """Dispersion also works for vertical gaze, which has no horizontal axis of its own."""
    up = gaze(np.zeros(10), 90 - np.r_[np.zeros(5), np.full(5, degrees)])
    assert len(set(detect_fixations_idt(up, dispersion=3.0, min_duration=0.04))) == parts


@pytest.mark.parametrize("elevation", [0.0, 60.0, -85.0])
def test_dispersion_is_measured_on_the_sphere(elevation):
    # For steep gaze a degree of azimuth is shorter: 3 degrees of arc are one fixation, 4 are not.
    arc = lambda degrees: gaze(np.linspace(0, degrees / np.cos(np.radians(elevation)), 12), elevation)
    assert (detect_fixations_idt(arc(2.0), dispersion=3.0) == 0).all() and len(
        set(detect_fixations_idt(arc(6.0), dispersion=3.0, min_duration=0.04))
    ) > 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_idt_by_definition(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 120))
    azimuth = np.cumsum(rng.choice([0.2, 6.0], n, p=[0.9, 0.1]) * rng.choice([-1, 1], n))
    label = detect_fixations_idt(gaze(azimuth), dispersion=2.1)  # no sum of steps
    # The loop of Salvucci and Goldberg, for gaze that only turns horizontally.
    want, s, number = np.full(n, -1), 0, 0
    while s < n:
        e = s + 5  # 0.1 s
        if e >= n:
            break
        if np.ptp(azimuth[s : e + 1]) <= 2.1:
            while e + 1 < n and np.ptp(azimuth[s : e + 2]) <= 2.1:
                e += 1
            want[s : e + 1] = number
            number, s = number + 1, e + 1
        else:
            s += 1
    assert label.tolist() == want.tolist()


def test_one_ray_per_fixation():
    rays = gaze([*[0, 2] * 5, *[40] * 10])
    hit, head = np.full((20, 3), np.nan), np.tile([1.0, 0, 0], (20, 1))
    hit[:4] = rays.origin[:4] + 2 * rays.direction[:4]
    head[1], head[2], head[10:] = [0, 1, 0], [np.nan] * 3, np.nan
    rays = replace(rays, hit=hit, head=head)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a fixation without a hit must not warn
        one, seconds = average_fixations(rays, detect_fixations_idt(rays))
    assert len(one) == 2 and np.allclose(seconds, 0.18) and np.allclose(one.t, [0.09, 0.29])
    assert np.allclose(np.degrees(np.arctan2(one.direction[:, 1], one.direction[:, 0])), [1, 40])
    assert np.allclose(one.hit[0], hit[:4].mean(axis=0)) and np.isnan(one.hit[1]).all()
    want = np.array([8.0, 1, 0])
    assert np.allclose(one.head[0], want / np.linalg.norm(want)) and np.isnan(one.head[1]).all()
    with pytest.raises(NergError, match="no fixation") as error:
        average_fixations(rays, np.full(20, -1))
    assert set(error.value.parameters) == {"velocity_threshold", "min_fixation"}
    with pytest.raises(NergError, match="2.5 degrees") as error:
        average_fixations(rays, np.full(20, -1), dispersion=2.5)
    assert "dispersion_threshold" in error.value.parameters
    with pytest.raises(NergError, match="0.2 s apart.* 0.1 s") as error:
        average_fixations(
            replace(rays, t=10 * rays.t).select(np.random.default_rng(0).permutation(20)), np.full(20, -1)
        )
    assert set(error.value.parameters) == {"max_step"}
    with pytest.raises(NergError, match="dispersion must be positive"):
        detect_fixations_idt(rays, dispersion=0)


@pytest.mark.parametrize("find", [detect_fixations_ivt, detect_fixations_idt])
@pytest.mark.parametrize("gap", [0.02, -0.1, 0.0, -1000.0])
def test_fixations_do_not_span_participants(find, gap):
    """The first ray of a participant may follow the last one of another at any time, in the same direction."""
    t = np.arange(20) * 0.02
    still = gaze([0] * 40, person=np.r_[np.zeros(20), np.ones(20)], t=np.r_[t, t + t[-1] + gap])
    assert find(still).tolist() == [0] * 20 + [1] * 20
    # Each stay is too short by itself; joined they would not be.
    assert (find(still, min_duration=0.5) == -1).all()


@pytest.mark.parametrize("find", [detect_fixations_ivt, detect_fixations_idt])
def test_fixations_do_not_depend_on_the_order_of_rays(find):
    still = gaze([0] * 40, person=np.arange(40) // 20, t=np.tile(np.arange(20) * 0.02 + (np.arange(20) >= 10), 2))
    order = np.random.default_rng(0).permutation(40)
    assert find(still).tolist() == [0] * 10 + [1] * 10 + [2] * 10 + [3] * 10
    assert np.array_equal(find(still.select(order)), find(still)[order])


@pytest.mark.parametrize("find", [detect_fixations_ivt, detect_fixations_idt])
@pytest.mark.parametrize(
    "count, dt, limits, expected",
    [
        (9, 0.09, {}, 0),
        (9, 0.11, {}, -1),  # a pause of a tenth of a second ends a fixation
        (9, 0.11, {"gap": 0.12}, 0),
        (9, 0.125, {"gap": 0.125}, 0),  # one as long as it may be does not
        (3, 0.125, {"min_duration": 0.25, "gap": 0.2}, 0),  # as short as a fixation may be
        (3, 0.125, {"min_duration": 0.251, "gap": 0.2}, -1),
    ],
)
def test_pauses_and_durations_at_the_limits(find, count, dt, limits, expected):
    assert (find(gaze([0] * count, dt=dt), **limits) == expected).all()


# ---- Events ----

RATE = 100.0


def directions(azimuth, elevation=0.0) -> np.ndarray:
    a, e = np.broadcast_arrays(np.radians(azimuth), np.radians(elevation))
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)


def scene(azimuth, head=None, elevation=0.0, **columns) -> Rays:
    """Gaze at 100 Hz that turns by degrees, with a head that turns by degrees."""
    d = directions(np.asarray(azimuth, float), elevation)
    heads = {} if head is None else {"head": directions(np.broadcast_to(np.asarray(head, float), len(d)))}
    return some_rays(len(d), **{"t": np.arange(len(d)) / RATE, "direction": d, **heads, **columns})


def spread(*parts) -> np.ndarray:
    """Angles whose steps are constant: (degrees per second, number of steps), starting at 0."""
    steps = np.concatenate([np.full(n, speed / RATE) for speed, n in parts])
    return np.r_[0, np.cumsum(steps)]


@pytest.mark.parametrize(
    "gaze_parts, head_parts, kinds",
    [
        ([(0, 30)], [(0, 30)], ["fixation"]),
        ([(0, 30)], [(40, 30)], ["vor_fixation"]),
        ([(0, 30), (300, 4), (0, 30)], None, ["fixation", "saccade", "fixation"]),
        ([(0, 30), (300, 4), (0, 30)], [(0, 64)], ["fixation", "saccade", "fixation"]),
        # A head that turns by 150 degrees a second, and carries gaze along.
        ([(0, 30), (150, 10), (0, 30)], [(0, 30), (150, 10), (0, 30)], ["fixation", "visual_scanning", "fixation"]),
        # Gaze ahead of the head.
        ([(0, 30), (300, 5), (0, 30)], [(0, 30), (150, 10), (0, 25)], ["fixation", "saccade", "vor_fixation"]),
        ([(20, 30)], [(0, 30)], ["smooth_pursuit"]),
        ([(20, 30)], [(20, 30)], ["smooth_pursuit"]),
        ([(4, 60)], [(0, 60)], ["fixation"]),  # too slow
        ([(20, 9)], [(0, 9)], ["fixation"]),  # too small
        ([(60, 5), (-60, 5)] * 3, [(0, 30)], ["fixation"]),  # back and forth
        # A slow interruption of 0.02 s, as of repeated samples; one of 0.05 s is too short for a fixation.
        ([(0, 30), (300, 2), (0, 2), (300, 2), (0, 30)], None, ["fixation", "saccade", "fixation"]),
        ([(0, 30), (300, 2), (0, 5), (300, 2), (0, 30)], None, ["fixation", "saccade", "saccade", "fixation"]),
    ],
)
def test_kinds(gaze_parts, head_parts, kinds):
    rays = scene(spread(*gaze_parts), None if head_parts is None else spread(*head_parts))
    events = detect_events(rays)
    assert events.kind.tolist() == kinds
    assert events.count() == {kind: kinds.count(kind) for kind in KINDS if kind in kinds}


def test_events_by_hand():
    rays = scene(spread((0, 30), (250, 4), (0, 20)))
    events = detect_events(rays)
    np.testing.assert_allclose(events.onset, [0, 0.30, 0.34])
    np.testing.assert_allclose(events.duration, [0.30, 0.04, 0.20])
    np.testing.assert_allclose(events.amplitude, [0, 10, 0], atol=1e-6)
    np.testing.assert_allclose(events.peak_velocity, [0, 250, 0], atol=1e-4)
    assert events.first.tolist() == [0, 30, 34] and events.last.tolist() == [30, 34, 54]
    np.testing.assert_allclose(events.direction[[0, 2]], directions([0.0, 10.0]), atol=1e-9)
    assert np.isnan(events.direction[1]).all() and np.isnan(events.point).all()


def test_somebody_who_walks_past_a_point():
    """The direction to a fixed point turns: a fixation if hit points tell, otherwise a pursuit."""
    n = 60
    origin = np.c_[np.arange(n) * 0.01, np.zeros(n), np.full(n, 1.6)]
    point = np.array([0.3, 1.0, 1.2])
    d = (point - origin) / np.linalg.norm(point - origin, axis=1, keepdims=True)
    rays = some_rays(n, t=np.arange(n) / RATE, origin=origin, direction=d, hit=np.tile(point, (n, 1)))
    events = detect_events(rays)
    assert events.kind.tolist() == ["fixation"]
    np.testing.assert_allclose(events.point, [point])
    assert detect_events(replace(rays, hit=None)).kind.tolist() == ["smooth_pursuit"]
    # A point that moves is pursued.
    moving = point + np.c_[np.arange(n) * 0.02, np.zeros((n, 2))]
    d = (moving - origin) / np.linalg.norm(moving - origin, axis=1, keepdims=True)
    assert detect_events(replace(rays, direction=d, hit=moving)).kind.tolist() == ["smooth_pursuit"]


def test_pauses():
    """A blink, a loss, and another recording after more than a minute."""
    t = np.arange(80) / RATE
    t[20:] += 0.2
    t[40:] += 3
    t[60:] += 100
    events = detect_events(scene(np.zeros(80), t=t))
    assert events.kind.tolist() == ["fixation", "blink", "fixation", "loss", "fixation", "fixation"]
    np.testing.assert_allclose(events.duration[[1, 3]], [0.21, 3.01])
    assert detect_events(scene(np.zeros(80), t=t), EventRules(max_blink=0.1)).count()["loss"] == 2


@pytest.mark.parametrize(
    "rate, lengths, kinds",
    [
        (5, [1, 2, 3], ["loss", "loss"]),  # the interval is no pause, and a blink cannot be told from a lost sample
        (10, [2, 3, 4, 6], ["loss", "blink", "blink", "loss"]),
        (30, [2, 4, 14, 16], ["blink", "blink", "loss"]),
        (500, [40, 60, 240, 260], ["blink", "blink", "loss"]),
    ],
)
@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_pauses_depend_on_the_sampling_interval(rate, lengths, kinds, jitter):
    """Pauses of so many intervals, each after a second of samples, with times that vary by a part of the interval."""
    steps = np.concatenate([[*np.ones(rate), length] for length in [*lengths, 1]])
    t = (np.cumsum(steps) + np.random.default_rng(0).uniform(0, jitter, len(steps))) / rate
    rays = scene(np.zeros(len(t)), t=t)
    select_pauses = lambda rays: [k for k in detect_events(rays).kind.tolist() if k in ("blink", "loss")]
    assert select_pauses(rays) == kinds
    # Other participants and recordings have their own intervals.
    late, fast = replace(rays, t=t + 1000), scene(np.zeros(400), t=np.arange(400) / 100, person=np.ones(400))
    assert select_pauses(merge_rays([rays, late, fast])) == 2 * kinds


def test_events_do_not_span_participants_or_depend_on_the_order():
    azimuth = np.random.default_rng(0).normal(0, 1, 300).cumsum()
    rays = scene(azimuth, 0.5 * azimuth, person=np.arange(300) % 2)
    events = detect_events(rays)
    assert (rays.person[events.first] == rays.person[events.last]).all() and set(rays.person[events.first]) == {0, 1}
    shuffled = np.random.default_rng(1).permutation(300)
    again = detect_events(rays.select(shuffled))
    assert again.kind.tolist() == events.kind.tolist() and (shuffled[again.first] == events.first).all()
    np.testing.assert_allclose(again.amplitude, events.amplitude)


def test_no_rays_and_single_rays():
    rays = scene(np.zeros(3))
    assert len(detect_events(rays.select(np.zeros(3, bool)))) == 0 and len(detect_events(rays.select([0]))) == 0


def test_velocities_of_the_eye_in_the_head():
    """Independent: with heads that turn about the vertical only, the eye in the head is the difference of azimuths."""
    rng = np.random.default_rng(2)
    gaze, head = rng.normal(0, 0.5, (2, 200)).cumsum(axis=1)
    v = measure_velocities(scene(gaze, head))
    np.testing.assert_allclose(v.gaze, np.abs(np.diff(gaze)) * RATE, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(v.head, np.abs(np.diff(head)) * RATE, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(v.eye, np.abs(np.diff(gaze - head)) * RATE, rtol=1e-3, atol=1e-2)
    # Gaze that is fixed in a head of which only the direction is known is at rest in it.
    turn = Rotation.from_rotvec(np.radians([3.0, -5.0, 4.0])[None] * np.arange(40)[:, None] / 40)
    heads = turn.apply([1.0, 0, 0])
    step = Rotation.concatenate([Rotation.align_vectors(b[None], a[None])[0] for a, b in zip(heads, heads[1:])])
    d = [np.array([0.8, 0.6, 0])]
    for rotation in step:
        d.append(rotation.apply(d[-1]))
    rays = some_rays(40, t=np.arange(40) / RATE, direction=np.array(d), head=heads)
    assert np.abs(measure_velocities(rays).eye).max() < 0.01


@given(st.floats(-170, 170), st.floats(-80, 80), st.floats(-40, 40), st.floats(-40, 40))
@settings(max_examples=30, deadline=None)
def test_angles_about(azimuth, elevation, a, e):
    """Turning the head's axes by hand gives back the angles."""
    ahead = directions([azimuth], elevation)
    turn = Rotation.from_euler("ZY", [azimuth, -elevation], degrees=True)
    # Right is clockwise from above.
    direction = turn.apply(directions([-a], e))
    np.testing.assert_allclose(angles_about(direction, ahead), [[a, e]], atol=1e-9)
    np.testing.assert_allclose(angles_about(ahead, ahead), 0, atol=1e-9)


def test_rules_are_validated():
    with pytest.raises(NergError, match="max_blink"):
        EventRules(max_blink=-1.0)


# ---- Directions of heads have no eye movements, and all exports have the same fixations ----


@pytest.mark.parametrize("kind", ["head", "mixed"])
def test_directions_of_heads_have_no_fixations(kind):
    heads = gaze(SEQUENCE).with_tracking(kind)
    for detect in (detect_fixations_ivt, detect_fixations_idt, detect_events, label_fixations):
        with pytest.raises(NergError, match="heads"):
            detect(heads)
    assert len(detect_events(heads.with_tracking("eye"))) == len(detect_events(gaze(SEQUENCE)))


def test_labels_are_those_of_the_events():
    n = 12
    head = np.tile([1.0, 0, 0], (2 * n, 1))
    rays = gaze([*np.zeros(n), *np.full(n, 20.0)], head=head)
    mixed = rays.select(np.random.default_rng(0).permutation(len(rays)))  # in any order
    label, kinds = label_fixations(mixed)
    events = detect_events(mixed)
    count = events.count()
    assert label.max() + 1 == len(kinds) == sum(count.get(kind, 0) for kind in FIXATIONS) == 2
    mean, duration = average_fixations(mixed, label)
    order = np.argsort(mean.t)
    np.testing.assert_allclose(np.degrees(np.arctan2(mean.direction[order, 1], mean.direction[order, 0])), [0, 20])
    np.testing.assert_allclose(duration, np.sort(events.duration[np.isin(events.kind, FIXATIONS)]))
    by_dispersion, kinds = label_fixations(rays, EventRules(min_fixation=0.1), dispersion=1.0)
    assert np.array_equal(by_dispersion, detect_fixations_idt(rays, 1.0, 0.1)) and len(kinds) == 2
    assert EventRules().describe()["velocity"] == pytest.approx(100) and EventRules().describe(2.0)["dispersion"] == 2
