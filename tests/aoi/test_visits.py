"""Tests of `nerg_mi.aoi.visits`."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import fields

import numpy as np
import pytest

from nerg_mi.aoi.placed import HitAssignment
from nerg_mi.aoi.visits import (
    ALL,
    BINS,
    Cell,
    VisitRules,
    VisitSums,
    find_visits,
    make_timeline,
    merge_sums,
    sum_visits,
)
from nerg_mi.errors import NergError
from nerg_mi.tracking.rays import Rays

# ---- Represented time and visits ----


def slow_weights(person, t, rules):
    """Reference implementation, sample by sample."""
    n = len(t)
    sitting, weight = [0] * n, [0.0] * n
    for i in range(1, n):
        goes_on = person[i] == person[i - 1] and t[i] - t[i - 1] <= rules.session_gap
        sitting[i] = sitting[i - 1] + (not goes_on)
    for i in range(n):
        steps = [
            t[j + 1] - t[j]
            for j in range(n - 1)
            if sitting[j] == sitting[i] == sitting[j + 1] and 0 < t[j + 1] - t[j] <= rules.max_gap
        ]
        usual = float(np.median(steps)) if steps else 0.0
        near = i + 1 < n and sitting[i + 1] == sitting[i] and t[i + 1] - t[i] <= rules.max_gap
        weight[i] = t[i + 1] - t[i] if near else usual
    return sitting, weight


def find_visits_by_loop(rows, t, weight, sitting, rules):
    """Reference implementation, sample by sample."""
    visits, now = [], None
    for r in rows:
        start, end = t[r], t[r] + weight[r]
        if now is not None and sitting[now[0]] == sitting[r] and start - now[2] <= rules.merge_gap + 1e-9:
            now = (now[0], now[1], end)
        else:
            if now is not None:
                visits.append(now)
            now = (r, start, end)
    return [
        result for result in [*visits, now] if result is not None and result[2] - result[1] >= rules.min_visit - 1e-9
    ]


@pytest.mark.parametrize("seed", range(4))
def test_visits_match_a_loop(seed):
    rng = np.random.default_rng(seed)
    rules = VisitRules(max_gap=0.5, session_gap=5.0, merge_gap=0.25, min_visit=0.15)
    person = np.sort(rng.integers(0, 4, 120))
    step = rng.choice([0.0, 0.1, 0.2, 0.2, 0.3, 0.7, 6.0], 120)
    t = np.concatenate([np.cumsum(step[person == p]) for p in range(4)])
    line = make_timeline(person, t, rules)
    sitting, weight = slow_weights(person, t, rules)
    assert line.session.tolist() == sitting and np.allclose(line.weight, weight)
    rows = np.flatnonzero(rng.random(120) < 0.5)
    visits = find_visits(rows, line, rules)
    expected = find_visits_by_loop(rows, t, weight, sitting, rules)
    assert visits.first.tolist() == [e[0] for e in expected]
    assert np.allclose(visits.start, [e[1] for e in expected]) and np.allclose(visits.end, [e[2] for e in expected])


def test_single_sample_represents_no_time():
    line = make_timeline(np.array([0, 1, 1]), np.array([5.0, 1.0, 1.2]), VisitRules())
    assert np.allclose(line.weight, [0, 0.2, 0.2])
    assert len(find_visits(np.array([0]), line, VisitRules())) == 0
    assert len(find_visits(np.array([0]), line, VisitRules(min_visit=0.0))) == 1
    assert len(find_visits(np.zeros(0, int), line, VisitRules())) == 0


def test_equal_times_count_once():
    line = make_timeline(np.zeros(4, int), np.array([0.0, 0.0, 0.2, 0.2]), VisitRules())
    assert np.allclose(line.weight, [0, 0.2, 0, 0.2])


def test_timeline_without_samples():
    assert len(make_timeline(np.zeros(0, int), np.zeros(0), VisitRules()).t) == 0


@pytest.mark.parametrize("t", [[0.0, np.nan], [1.0, 0.0], [0.0, np.inf]])
def test_invalid_times_are_refused(t):
    with pytest.raises(ValueError):
        make_timeline(np.zeros(2, int), np.array(t), VisitRules())


@pytest.mark.parametrize(
    "bad", [{"max_gap": 0}, {"max_gap": -1}, {"session_gap": 0.5}, {"merge_gap": np.nan}, {"min_visit": np.inf}]
)
def test_invalid_rules_are_refused(bad):
    with pytest.raises(NergError, match=next(iter(bad))):
        VisitRules(**bad)


def test_durations_at_the_limits():
    """A pause of exactly the limit continues a session, and an interruption of exactly the limit a visit."""
    rules = VisitRules(max_gap=0.5, session_gap=4.0, merge_gap=0.25, min_visit=0.25)
    line = make_timeline(np.zeros(4, int), np.array([0.0, 4.0, 8.0, 12.5]), rules)
    assert line.session.tolist() == [0, 0, 0, 1]
    line = make_timeline(np.zeros(6, int), np.arange(6) * 0.25, rules)
    at = lambda *rows: find_visits(np.array(rows), line, rules).first.tolist()
    assert at(0, 2) == [0] and at(0, 3) == [0, 3] and at(1) == [1]
    assert make_timeline(np.zeros(3, int), np.array([0.0, 0.5, 1.25]), rules).weight.tolist() == [0.5, 0.5, 0.5]


# ---- Sums, against dictionaries, and in any number of parts ----

RULES = VisitRules(max_gap=0.5, session_gap=5.0, merge_gap=0.25, min_visit=0.15)
AREAS = ("a", "b", "c")


def made(seed=0, n=150, people=3):
    """Samples, sorted by participant and time, with hits and visibility."""
    rng = np.random.default_rng(seed)
    person = rng.integers(0, people, n)
    step = rng.choice([0.1, 0.2, 0.2, 0.3, 0.7, 6.0], n)
    t = np.zeros(n)
    for p in range(people):
        subset = np.flatnonzero(person == p)
        t[subset] = np.cumsum(step[subset])
    person, t = np.sort(person), t[np.argsort(person, kind="stable")]
    d = np.tile([1.0, 0, 0], (n, 1))
    names = tuple(f"person {k}" for k in range(people))
    rays = Rays(t, person, names, rng.random((n, 3)), d, np.ones(n))
    on = rng.random((n, 3)) < (0.5, 0.2, 0.0)
    far = rng.random((n, 3)) + 1
    rows = tuple(np.flatnonzero(on[:, k]) for k in range(3))
    landed = HitAssignment(n, rows, tuple(far[r, k] for k, r in enumerate(rows)))
    return rays, landed, on, far, rng.random((n, 3)) < 0.4


def slow_sums(rays, on, far, visible, cells):
    """Reference implementation with dictionaries."""
    order = sorted(range(len(rays)), key=lambda i: (rays.person[i], rays.t[i]))
    person, t = [int(rays.person[i]) for i in order], [float(rays.t[i]) for i in order]
    sitting, weight = slow_weights(person, t, RULES)
    out = defaultdict(float)
    for cell, mask in cells:
        mine = [mask is None or bool(mask[i]) for i in order]
        begin = {}
        for k in range(len(order)):
            if not mine[k]:
                continue
            who = rays.persons[person[k]]
            begin.setdefault(sitting[k], t[k])
            out["time", cell, who] += weight[k]
            out["rays", cell, who] += 1
            for a in range(3):
                i = order[k]
                if on[i, a]:
                    out["dwell_time", cell, who, a] += weight[k]
                    out["distance", cell, who, a] += weight[k] * far[i, a]
                if on[i, a] or visible[i, a]:
                    out["visible_time", cell, who, a] += weight[k]
        every = []
        for a in range(3):
            rows = [k for k in range(len(order)) if on[order[k], a]]
            expected = set()
            for first, start, end in find_visits_by_loop(rows, t, weight, sitting, RULES):
                every.append((sitting[first], start, a, first))
                if not mine[first]:
                    continue
                who = rays.persons[person[first]]
                out["visits", cell, who, a] += 1
                bin_ = max(b for b in range(len(BINS) - 1) if end - start >= BINS[b] - 1e-9)
                out["lasted", cell, a, bin_] += 1
                if sitting[first] not in expected:
                    expected.add(sitting[first])
                    out["first_visit_sum", cell, who, a] += start - begin[sitting[first]]
                    out["first_visit_count", cell, who, a] += 1
        every.sort()
        for one, two in zip(every[:-1], every[1:]):
            if one[0] == two[0] and one[2] != two[2] and mine[two[3]]:
                out["moves", cell, one[2], two[2]] += 1
    return out


def cells_of(rays):
    # The last ones begin within sessions, and have no samples.
    late, none = (Cell("window", "late"), rays.t >= 1.5), (Cell("zone", "none"), np.zeros(len(rays), bool))
    return [(ALL, None), (Cell("window", "early"), rays.t < 4), late, none]


def test_the_first_visit_in_a_cell_counts_from_its_first_sample():
    """Ten samples of a session, of which the cell has those from 0.4 s on; the area is hit from 0.7 s on."""
    t = 0.1 * np.arange(10)
    rays = Rays(t, np.zeros(10), ("Ada",), np.zeros((10, 3)), np.tile([1.0, 0, 0], (10, 1)), np.ones(10))
    hits = HitAssignment(10, (np.arange(7, 10),), (np.ones(3),))
    cells = [(ALL, None), (Cell("window", "late"), t > 0.35)]
    sums = sum_visits(rays, hits, ("a",), cells, RULES)
    assert sums.first_visit_sum[:, 0] == pytest.approx([0.7, 0.3]) and sums.first_visit_count[:, 0].tolist() == [1, 1]


@pytest.mark.parametrize("start", [0.0, 1e4, 1.7e9])
def test_durations_at_the_edge_of_a_bin_are_in_the_upper_bin(start):
    """Every third sample at 5 Hz hits the area: visits last 0.2 s, whatever the rounding of the times. Of those that
    hit it three times out of four, visits last 0.6 s, and the gaps of 0.2 s are not merged."""
    t = start + np.arange(400) / 5
    rays = Rays(t, np.zeros(400), ("Ada",), np.zeros((400, 3)), np.tile([1.0, 0, 0], (400, 1)), np.ones(400))
    rules = VisitRules(merge_gap=0.15, min_visit=0.2)
    rows = (np.arange(0, 400, 3), np.flatnonzero(np.arange(400) % 4))
    hits = HitAssignment(400, rows, tuple(np.ones(len(r)) for r in rows))
    counts = sum_visits(rays, hits, ("a", "b"), [(ALL, None)], rules).duration_counts[0]
    assert counts[0].tolist() == [0, 0, 134, *[0] * 7] and counts[1].tolist() == [0, 0, 0, 100, *[0] * 6]


@pytest.mark.parametrize("seed", range(3))
def test_sums_match_loops(seed):
    rays, landed, on, far, visible = made(seed)
    cells = cells_of(rays)
    sums = sum_visits(rays, landed, AREAS, cells, RULES, visible)
    slow = slow_sums(rays, on, far, visible, cells)
    for r, (cell, who) in enumerate(sums.rows):
        for name in ("time", "rays"):
            assert getattr(sums, name)[r] == pytest.approx(slow[name, cell, who])
        for name in ("dwell_time", "distance", "visits", "visible_time", "first_visit_sum", "first_visit_count"):
            assert getattr(sums, name)[r] == pytest.approx([slow[name, cell, who, a] for a in range(3)]), name
    for c, (cell, _) in enumerate(cells):
        assert sums.duration_counts[c].tolist() == [
            [slow["lasted", cell, a, b] for b in range(len(BINS) - 1)] for a in range(3)
        ]
        assert sums.transitions[c].tolist() == [[slow["moves", cell, a, b] for b in range(3)] for a in range(3)]
    assert {cell for cell, _ in sums.rows} == {cell for cell, _ in cells[:-1]} and sums.transitions[0].sum() > 3
    # Area c has no visit.
    assert sums.dwell_time[:, 2].sum() == 0 and sums.visible_time[:, 2].sum() > 0


def pick(landed, rows):
    place = {int(r): k for k, r in enumerate(rows)}
    keep = [[place[int(r)] for r in index if int(r) in place] for index in landed.rows]
    far = [
        np.array([d for r, d in zip(index, ds) if int(r) in place]) for index, ds in zip(landed.rows, landed.distance)
    ]
    return HitAssignment(len(rows), tuple(np.array(k, int) for k in keep), tuple(far))


def test_partition_does_not_change_sums():
    rays, landed, _, _, visible = made(7, 300, 6)
    whole_result = sum_visits(rays, landed, AREAS, [(ALL, None)], RULES, visible)
    parts = []
    for p in range(6):
        rows = np.flatnonzero(rays.person == p)
        parts.append(sum_visits(rays.select(rows), pick(landed, rows), AREAS, [(ALL, None)], RULES, visible[rows]))
    merged = merge_sums(parts)
    assert merged.rows == whole_result.rows
    for f in fields(VisitSums):
        value = getattr(whole_result, f.name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(getattr(merged, f.name), value), f.name
    # Nested partitions give bitwise equal sums in the same order.
    again = merge_sums([merge_sums(parts[:1]), *parts[1:]])
    assert all(np.array_equal(getattr(again, n), getattr(merged, n)) for n in ("time", "dwell_time", "transitions"))


def test_returning_participant_is_counted_once():
    rays, landed, _, _, visible = made(3)
    one = sum_visits(rays, landed, AREAS, [(ALL, None)], RULES, visible)
    twice = merge_sums([one, one])
    assert twice.rows == one.rows and np.allclose(twice.time, 2 * one.time)


def test_incompatible_sums_are_refused():
    rays, landed, *_ = made()
    one = sum_visits(rays, landed, AREAS, [(ALL, None)], RULES)
    other = sum_visits(rays, landed, ("x", "b", "c"), [(ALL, None)], RULES)
    with pytest.raises(ValueError, match="different areas"):
        merge_sums([one, other])
    with pytest.raises(ValueError, match="at least one sum"):
        merge_sums([])


def test_sums_without_samples():
    rays, landed, *_ = made()
    none = sum_visits(rays.select(np.zeros(0, int)), pick(landed, []), AREAS, [(ALL, None)], RULES)
    assert none.rows == () and none.time.shape == (0,) and none.transitions.sum() == 0
    assert none.find_participants(ALL)[1] == []
