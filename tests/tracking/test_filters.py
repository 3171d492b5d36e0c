"""Tests of `nerg_mi.tracking.filters`."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerg_mi.errors import NergError
from nerg_mi.tracking import filters
from nerg_mi.tracking.filters import (
    combine_splits,
    find_frozen_gaze,
    find_sessions,
    label_stays,
    purge,
    read_position_split,
    select_mask,
    split_by_person,
    split_by_position,
    split_by_time,
    thin_mask,
)
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays
from tests.tracking.people import change, some_rays, watch

# ---- Filters ----


def walk(origin, **columns):
    return some_rays(len(origin), origin=origin, **columns)


def line(x):
    return np.stack([x, 0 * x, 0 * x + 1.6], axis=1)


@pytest.mark.parametrize(
    "conditions, rows",
    [
        ({}, [0, 1, 2, 3, 4, 5]),
        ({"persons": ["bo"]}, [1, 3, 5]),
        ({"without_persons": ["bo"]}, [0, 2, 4]),
        ({"cohorts": ["new"]}, [3, 4, 5]),
        ({"persons": ["bo"], "cohorts": ["old"]}, [1]),
        ({"with_hit": True}, [1]),
        # Rays at the limits: start is inclusive and end exclusive, boxes and confidences are inclusive.
        ({"time": (0.25, 0.75)}, [1, 2]),
        ({"time": (None, 0.25)}, [0]),
        ({"time": (1.25, None)}, [5]),
        ({"time": (0.5, 0.5)}, []),
        ({"box": [2, 3, 0, 1, 0, 1.6]}, [2, 3]),
        ({"min_confidence": 1.0}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_conditions(conditions, rows):
    hit = np.full((6, 3), np.nan)
    hit[1] = 0
    person, cohort = np.arange(6) % 2, np.arange(6) // 3
    t, place = np.arange(6) * 0.25, line(np.arange(6.0))
    rays = walk(place, t=t, person=person, hit=hit, cohort=cohort, cohorts=("old", "new"))
    assert np.flatnonzero(select_mask(rays, **conditions)).tolist() == rows


@pytest.mark.parametrize(
    "conditions, message",
    [
        ({"persons": ["cy"]}, "no person is called 'cy'"),
        ({"box": [0, 1, 0, 1]}, "a box needs"),
        ({"box": [1, 0, 0, 1, 0, 1]}, "a box needs"),
        ({"cohorts": ["new"]}, "no cohorts"),
    ],
)
def test_invalid_conditions_are_refused(conditions, message):
    with pytest.raises(NergError, match=message):
        select_mask(walk(line(np.arange(3.0))), **conditions)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.5))
def test_stays_by_definition(seed, distance):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    origin = np.cumsum(rng.normal(0, 0.03, (n, 3)), axis=0)
    rays = walk(origin, t=np.cumsum(rng.choice([0.1, 2.0], n, p=[0.95, 0.05])), person=np.sort(rng.integers(0, 2, n)))
    order = rng.permutation(n)
    label = np.empty(n, int)
    label[order] = label_stays(rays.select(order), distance)
    want, number, first = [], -1, 0
    for i in range(n):
        if (
            i == 0
            or rays.person[i] != rays.person[i - 1]
            or rays.t[i] - rays.t[i - 1] > 1
            or np.linalg.norm(origin[i] - origin[first]) > distance
        ):
            first, number = i, number + 1
        want.append(number)
    assert label.tolist() == want


def test_thinning_keeps_the_requested_seconds_of_a_stop():
    rays, stop = walk(line(np.r_[np.arange(0, 5, 0.5), np.full(1001, 5.0), np.arange(5.5, 10, 0.5)])), slice(10, 1011)
    selected = thin_mask(rays, seconds=2.0)
    assert selected[:10].all() and selected[1011:].all() and 20 <= selected[stop].sum() <= 22
    where = np.flatnonzero(selected[stop])
    assert where[0] == 0 and np.ptp(np.diff(where)) <= 1  # even
    assert thin_mask(rays, seconds=1000).all()
    for wrong in ({"seconds": 0}, {"distance": 0}):
        with pytest.raises(NergError, match="positive"):
            thin_mask(rays, **wrong)


def test_stays_at_the_limits():
    t = np.array([0, 1, 2, 3.25])
    assert label_stays(walk(line(np.zeros(4)), t=t), gap=1.0).tolist() == [0, 0, 0, 1]
    assert label_stays(walk(line(np.array([0, 0.5, -0.5, 0.75])), t=t * 0), distance=0.5).tolist() == [0, 0, 0, 1]


# ---- Frozen ----


def find_frozen_rows(rays):
    return find_frozen_gaze(rays, find_sessions(rays))


@pytest.mark.parametrize("block", [100, 1 << 18])
def test_frozen_gaze(monkeypatch, block):
    monkeypatch.setattr(filters, "_BLOCK", block)
    rays = watch()
    assert not find_frozen_rows(rays).any()
    still = slice(3100, 3400)
    world = change(rays, still, direction=rays.direction[3100])
    assert np.flatnonzero(find_frozen_rows(world)).tolist() == list(range(3100, 3400))
    # Less than a second is a fixation or a blink.
    assert not find_frozen_rows(change(rays, slice(3100, 3140), direction=rays.direction[3100])).any()
    # The head's direction as gaze; without a recorded head it is not detected.
    as_head = change(rays, still, direction=rays.head[still])
    assert find_frozen_rows(as_head)[3101:3399].all() and find_frozen_rows(as_head).sum() <= 302
    assert not find_frozen_rows(replace(as_head, head=None)).any()


@pytest.mark.parametrize("turns, moves", [(True, False), (False, True)])
def test_a_head_that_only_turns_or_only_moves(turns, moves):
    rays, rows = watch(), slice(3100, 3400)
    columns = {"direction": rays.direction[3100]}
    if not turns:
        columns["head"] = rays.head[3100]
    if not moves:
        columns["origin"] = rays.origin[3100]
    frozen_rays = change(rays, rows, **columns)
    assert np.flatnonzero(find_frozen_rows(frozen_rays)).tolist() == list(range(3100, 3400))
    # Without a recorded head, only movement is detected.
    assert find_frozen_rows(replace(frozen_rays, head=None))[3101:3399].all() == moves


@pytest.mark.parametrize("seconds, expected", [(1.0, True), (0.98, False)])
def test_minimum_duration_of_frozen_gaze(seconds, expected):
    rays = watch(1)
    t = np.arange(len(rays)) / 64
    rays = change(rays, slice(None), t=lambda _: t)
    count = round(seconds * 64) + 1
    assert find_frozen_rows(change(rays, slice(640, 640 + count), direction=rays.direction[640])).any() == expected


def test_a_headset_on_a_table_is_not_frozen_gaze():
    rays = watch()
    rows = slice(3100, 3400)
    put = change(rays, rows, direction=rays.direction[3100], head=rays.head[3100], origin=rays.origin[3100])
    assert not find_frozen_rows(put).any()


def test_frozen_gaze_of_interleaved_participants():
    rays = watch()
    mixed = change(rays, slice(3000, 3600), direction=rays.direction[3000])
    order = np.argsort(mixed.t, kind="stable")
    assert set(order[find_frozen_rows(mixed.select(order))]) == set(range(3000, 3600))


def test_pauses_and_other_participants_end_frozen_gaze():
    rays, rows = watch(1), slice(1470, 1530)
    still = change(rays, rows, direction=rays.direction[1470])
    assert find_frozen_rows(still)[1470:1530].all()
    assert not find_frozen_rows(change(still, slice(1500, None), t=lambda t: t + 0.6)).any()
    two = replace(still, person=(np.arange(len(rays)) >= 1500).astype(int), persons=("ann", "bo"))
    assert not find_frozen_rows(two).any()
    # Half a second is the maximum interval.
    slow = change(change(rays, slice(0, 4), direction=rays.direction[0]), slice(0, 4), t=np.array([-2, -1.5, -1, -0.5]))
    assert find_frozen_rows(slow)[:4].all()


# ---- Sessions ----


def test_recordings_end_where_clocks_go_back_or_pause():
    t = [*range(5), *range(10, 100, 50), *range(300, 310), *np.arange(0, 40), *range(7)]
    person = [0] * 57 + [1] * 7
    result = find_sessions(some_rays(len(t), t=t, person=person))
    assert result.order is None and result.starts.tolist() == [0, 7, 17, 57, 64]
    assert result.person.tolist() == [0, 0, 0, 1] and result.is_clock_reset.tolist() == [False, False, True, False]
    assert result.label_rays().tolist() == [0] * 7 + [1] * 10 + [2] * 40 + [3] * 7


def test_recordings_of_interleaved_and_shuffled_rays():
    t, person = np.repeat(np.arange(300) * 0.02, 2), np.tile([0, 1], 300)
    result = find_sessions(some_rays(len(t), t=t, person=person))
    assert result.order.tolist() == [*range(0, 600, 2), *range(1, 600, 2)] and result.starts.tolist() == [0, 300, 600]
    assert result.rows(slice(1, 3)).tolist() == [2, 4]
    # Rows misplaced by less than a second do not start another recording.
    swapped = t.copy()
    swapped[[10, 20]] = t[[20, 10]]
    assert find_sessions(some_rays(600, t=swapped, person=person)).starts.tolist() == [0, 300, 600]
    mixed = some_rays(600, t=10 * t, person=person)
    mixed = mixed.select(np.random.default_rng(0).permutation(600))
    result = find_sessions(mixed)
    assert result.starts.tolist() == [0, 300, 600] and not result.is_clock_reset.any()
    assert (np.diff(mixed.t[result.order[:300]]) > 0).all()


def test_participants_have_single_recordings():
    one = some_rays(1, person=[1])
    assert find_sessions(one).starts.tolist() == [0, 1] and find_sessions(one).person.tolist() == [1]


# ---- Splits ----

R = 0.25


@pytest.fixture(scope="module")
def rays_splits():
    rng = np.random.default_rng(2)
    n = 20_000
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = rng.uniform([0, 0, 1.5], [6, 4, 1.7], (n, 3))
    return Rays(np.arange(n) * 0.02, np.arange(n) % 5, tuple("abcde"), origin, d, np.ones(n))


def rows(mask, probes):
    """Rays in probes made from a part, as rows of the complete set."""
    return set(np.flatnonzero(mask)[probes.indices].tolist())


def test_train_and_test_probes_share_no_ray(rays_splits):
    split = split_by_position(rays_splits, R, test_probes=30, seed=1)
    train = place_probes(rays_splits.select(split.train), R, count=400, min_rays=8)
    test = place_probes(rays_splits.select(split.test), R, queries=split.test_centres, min_rays=8)
    everywhere = place_probes(rays_splits, R, queries=split.test_centres, min_rays=8)
    assert len(test) == 30 and len(train) > 300
    a, b, c = rows(split.train, train), rows(split.test, test), rows(np.ones(len(rays_splits), bool), everywhere)
    assert a and b and not a & b and not a & c
    assert b == c  # a test probe has all of its rays
    # Training probes keep their distance: no training ray within 2R.
    distances = np.linalg.norm(rays_splits.origin[split.train][:, None] - split.test_centres[None], axis=2)
    assert distances.min() > 2 * R
    within = np.linalg.norm(rays_splits.origin[:, None] - split.test_centres[None], axis=2).min(axis=1)
    assert np.array_equal(split.test, within <= R) and np.array_equal(split.train, within > 2 * R)


def test_zones_are_separate_and_repeatable(rays_splits):
    a, b = (split_by_position(rays_splits, R, zones=4, zone_radius=0.3, seed=7) for _ in range(2))
    assert np.array_equal(a.train, b.train) and np.array_equal(a.test_centres, b.test_centres)
    gaps = np.linalg.norm(a.zone_centres[:, None, :2] - a.zone_centres[None, :, :2], axis=2)
    assert gaps[~np.eye(4, dtype=bool)].min() > 1.0
    for z in range(4):
        assert np.linalg.norm(a.test_centres[a.zone == z][:, :2] - a.zone_centres[z, :2], axis=1).max() <= 0.3


def test_split_by_person(rays_splits):
    train, test = split_by_person(rays_splits, test_fraction=0.4, seed=0)
    people = [set(rays_splits.person[side]) for side in (train, test)]
    assert not people[0] & people[1] and len(people[1]) == 2 and (train ^ test).all()
    train, test = split_by_person(rays_splits, test_persons=["b"])
    assert set(rays_splits.person[test]) == {1}


def test_purge(rays_splits):
    mask = purge(rays_splits, np.array([[3, 2, 1.6]]), 1.0)
    assert np.array_equal(mask, np.linalg.norm(rays_splits.origin - [3, 2, 1.6], axis=1) > 1.0)


def test_refusals(rays_splits):
    with pytest.raises(NergError, match="no person is called 'zoe'"):
        split_by_person(rays_splits, test_persons=["zoe"])
    with pytest.raises(NergError, match="cannot be split"):
        split_by_person(rays_splits.select(rays_splits.person == 0))
    for radius, message in ((0.01, "enlarge the radius"), (3.0, "training rays are left")):
        with pytest.raises(NergError, match=message):
            split_by_position(rays_splits, radius)
    with pytest.raises(ValueError, match="no split was given"):
        combine_splits()


def test_split_by_time_with_a_gap(rays_splits):
    train, test = split_by_time(rays_splits, test_fraction=0.25, gap=10)
    t = rays_splits.t
    assert np.isclose(t[test].min(), 0.75 * np.ptp(t), atol=0.02) and t[test].min() - t[train].max() >= 10
    # Separate clocks: the last quarter of each participant.
    single = replace(rays_splits, t=t + 5000 * rays_splits.person)
    train, test = split_by_time(single, test_fraction=0.25, gap=10, clock="person")
    for p in range(5):
        mine = single.person == p
        assert single.t[test & mine].min() - single.t[train & mine].max() >= 10 and 0.24 < test[mine].mean() < 0.26
    for wrong, message in (({"gap": 1e6}, "smaller gap"), ({"clock": "day"}, '"all" or "person"')):
        with pytest.raises(NergError, match=message):
            split_by_time(rays_splits, **wrong)


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 2**16),
    st.sampled_from(["position", "person", "time", "position person", "person time", "position person time"]),
)
def test_no_combination_shares_a_ray(rays_splits, seed, kinds):
    by_position = split_by_position(rays_splits, R, test_probes=20, seed=seed) if "position" in kinds else None
    made = {
        "position": lambda: by_position.masks,
        "person": lambda: split_by_person(rays_splits, test_fraction=0.4, seed=seed),
        "time": lambda: split_by_time(rays_splits, test_fraction=0.4, gap=2.0),
    }
    train, test = combine_splits(*(made[k]() for k in kinds.split()))
    assert train.any() and test.any() and not (train & test).any()
    if "person" in kinds:
        assert not set(rays_splits.person[train]) & set(rays_splits.person[test])
    if "time" in kinds:
        assert rays_splits.t[test].min() - rays_splits.t[train].max() >= 2
    if "position" in kinds:
        a = place_probes(rays_splits.select(train), R, placement="blue", count=300, min_rays=4)
        b = place_probes(rays_splits.select(test), R, queries=by_position.test_centres, min_rays=1)
        assert not rows(train, a) & rows(test, b)
        distances = np.linalg.norm(rays_splits.origin[train][:, None] - by_position.test_centres[None], axis=2)
        assert distances.min() > 2 * R


@pytest.mark.parametrize("count, each", [(10, [4, 3, 3]), (11, [4, 4, 3]), (12, [4, 4, 4]), (2, [1, 1, 0])])
def test_requested_number_of_test_positions(rays_splits, count, each):
    """The remainder of the division by the number of zones is assigned to the first zones."""
    split = split_by_position(rays_splits, R, zones=3, zone_radius=0.4, test_probes=count, min_rays=8)
    assert len(split.test_centres) == count and np.bincount(split.zone, minlength=3).tolist() == each


def test_position_split_is_read_from_the_metadata(rays_splits):
    """Data for the layout figure; empty without a split by position."""
    assert read_position_split(rays_splits) == {}
    by = {"position": {"radius": R, "test_centres": [[0.0, 0.0, 1.5]]}, "person": {"test": ["a"]}}
    split = rays_splits.with_step(step="filter", kept=9, of=9).with_step(step="split", side="test", kept=9, of=9, by=by)
    assert read_position_split(split) == by["position"]
    assert read_position_split(rays_splits.with_step(step="split", kept=9, of=9, by={"time": {"share": 0.2}})) == {}


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_two_participants_are_split_one_to_each_side(rays_splits, share):
    train, test = split_by_person(rays_splits.select(rays_splits.person < 2), test_fraction=share)
    assert train.any() and test.any()


def test_distances_and_times_at_the_limits():
    """Rays at R from a test centre are test rays, those at 2R are on neither side."""
    near = [[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0]]
    twice, far = [[1.0, 0, 0]], [[5.0 + 3 * k, 0, 0] for k in range(9)]
    origin = np.array([[0.0, 0, 0]] * 70 + near + twice + far)
    n = len(origin)
    rays = walk(origin, t=np.arange(n) * 1.0)
    # Only the first position has that many rays within R.
    split = split_by_position(rays, 0.5, zones=1, test_probes=1, min_rays=73, min_train=9)
    with pytest.raises(ValueError, match="only 9 training rays are left"):
        split_by_position(rays, 0.5, zones=1, test_probes=1, min_rays=73, min_train=10)
    assert split.test.tolist() == [True] * 74 + [False] * 10 and split.train.tolist() == [False] * 75 + [True] * 9
    assert purge(rays, np.zeros((1, 3)), 1.0).tolist() == split.train.tolist()
    some = rays.select(np.arange(11))
    train, test = split_by_time(some, test_fraction=0.5, gap=2.0)
    assert some.t[train].tolist() == [0, 1, 2] and some.t[test].tolist() == [5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize("missing", [0, 1])
def test_combined_splits_need_rays_on_both_sides(missing):
    a, b = np.array([True, False, False]), np.array([False, True, False])
    sides = (a, b), ((b, b) if missing == 0 else (a, a))
    with pytest.raises(ValueError, match="the splits together leave"):
        combine_splits(*sides)
