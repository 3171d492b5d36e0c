from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays import filters
from nerg_mi.rays.filters import find_frozen, find_sessions
from tests.rays.checks.people import change, watch


def found(rays):
    return find_frozen(rays, find_sessions(rays))


@pytest.mark.parametrize("block", [100, 1 << 18])
def test_gaze_that_stands_still(monkeypatch, block):
    monkeypatch.setattr(filters, "_BLOCK", block)
    rays = watch()
    assert not found(rays).any()
    still = slice(3100, 3400)
    world = change(rays, still, direction=rays.direction[3100])
    assert np.flatnonzero(found(world)).tolist() == list(range(3100, 3400))
    # Less than a second is a fixation or a blink.
    assert not found(change(rays, slice(3100, 3140), direction=rays.direction[3100])).any()
    # The head in place of the eyes; without it, nothing is seen of that.
    as_head = change(rays, still, direction=rays.head[still])
    assert found(as_head)[3101:3399].all() and found(as_head).sum() <= 302
    assert not found(type(rays)(**{**vars(as_head), "head": None})).any()


@pytest.mark.parametrize("turns, moves", [(True, False), (False, True)])
def test_a_head_that_only_turns_or_only_moves(turns, moves):
    rays, rows = watch(), slice(3100, 3400)
    columns = {"direction": rays.direction[3100]}
    if not turns:
        columns["head"] = rays.head[3100]
    if not moves:
        columns["origin"] = rays.origin[3100]
    frozen_rays = change(rays, rows, **columns)
    assert np.flatnonzero(found(frozen_rays)).tolist() == list(range(3100, 3400))
    # Where no head is recorded, only a movement tells.
    assert found(type(rays)(**{**vars(frozen_rays), "head": None}))[3101:3399].all() == moves


@pytest.mark.parametrize("seconds, expected", [(1.0, True), (0.98, False)])
def test_a_second_is_long_enough(seconds, expected):
    rays = watch(1)
    t = np.arange(len(rays)) / 64
    rays = change(rays, slice(None), t=lambda _: t)
    count = round(seconds * 64) + 1
    assert found(change(rays, slice(640, 640 + count), direction=rays.direction[640])).any() == expected


def test_a_headset_on_a_table_is_not_frozen_gaze():
    rays = watch()
    rows = slice(3100, 3400)
    put = change(rays, rows, direction=rays.direction[3100], head=rays.head[3100], origin=rays.origin[3100])
    assert not found(put).any()


def test_people_among_each_other():
    rays = watch()
    mixed = change(rays, slice(3000, 3600), direction=rays.direction[3000])
    order = np.argsort(mixed.t, kind="stable")
    assert set(order[found(mixed.select(order))]) == set(range(3000, 3600))


def test_pauses_end_what_stands_still():
    rays = watch(1)
    still = change(rays, slice(0, 90), direction=rays.direction[0])
    paused = change(still, slice(45, None), t=lambda t: t + 0.6)
    assert found(still)[:90].all() and not found(paused).any()


def test_a_pause_as_long_as_it_may_be_and_the_next_person():
    """Neither is a run of two people, of whom each stands still for less than a second."""
    rays, rows = watch(1), slice(1470, 1530)
    still = change(rays, rows, direction=rays.direction[1470])
    assert found(still)[1470:1530].all()
    two = replace(still, person=(np.arange(len(rays)) >= 1500).astype(int), persons=("ann", "bo"))
    assert not found(two).any()
    slow = change(change(rays, slice(0, 4), direction=rays.direction[0]), slice(0, 4), t=np.array([-2, -1.5, -1, -0.5]))
    assert found(slow)[:4].all()
