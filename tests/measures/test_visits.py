"""Tests of `nerg_mi.measures.visits`."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import fields, replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.measures.visits import (
    ALL,
    BINS,
    BoxAoi,
    Cell,
    HitAssignment,
    VisitRules,
    VisitSums,
    assign_hits,
    concatenate_hits,
    find_visits,
    make_timeline,
    merge_directions,
    merge_members,
    merge_sums,
    sample_cone,
    sum_visits,
)
from nerg_mi.rays.rays import Rays

# ---- Hits, against loops over rays and planes ----


def box(name, lower, upper, turn=None):
    return BoxAoi(Region.create(name, lower, upper, turn))


def brute(region, o, d):
    """Interval of a ray in a box, by clipping at six planes in the frame of the box."""
    turn = region.rotation_matrix.T
    o, d = turn @ (np.array(o, float) - region.center), turn @ np.array(d, float)
    half = (region.corners[1] - region.corners[0]) / 2
    near, far = -np.inf, np.inf
    for axis in range(3):
        if d[axis] == 0:
            if abs(o[axis]) > half[axis]:
                return None
            continue
        a, b = (-half[axis] - o[axis]) / d[axis], (half[axis] - o[axis]) / d[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return (near, far) if near < far and far > 0 else None


def some_rays(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-3, 3, (n, 3))
    d = rng.normal(size=(n, 3))
    return o, d / np.linalg.norm(d, axis=1, keepdims=True), rng.uniform(0.2, 6, n)


def test_hits_of_boxes():
    aois = [box("a", [-1, -1, -1], [1, 0.5, 1]), box("b", [0, 0, 0], [2, 1, 1], 35), box("c", [1.5, -2, -1], [2, 2, 0])]
    o, d, depth = some_rays()
    result = assign_hits(aois, o, d, depth, 0.03).to_matrix()
    expected = np.zeros_like(result)
    for i in range(len(o)):
        for k, aoi in enumerate(aois):
            span = brute(aoi.region, o[i], d[i])
            if span is None:
                continue
            near, far = span
            expected[i, k] = near - 0.03 <= depth[i] < far + 0.03
    assert np.array_equal(result, expected) and 20 < expected.sum() and not expected.all(axis=1).all()
    inside = np.array([aoi.region.contains(o) for aoi in aois]).T
    assert (inside & expected).any() and (inside & ~expected).any()


def test_hit_distances():
    aois = [box("a", [1, -1, -1], [2, 1, 1]), box("around", [-1, -1, -1], [3, 1, 1])]
    o, d = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    landed = assign_hits(aois, o, d, np.array([1.7]))
    assert [v.tolist() for v in landed.distance] == [[1.0], [1.7]]
    # Rays that end behind a box or nowhere, from outside and from inside.
    assert [len(v) for v in assign_hits(aois, o, d, np.array([2.5])).rows] == [0, 1]
    assert [len(v) for v in assign_hits(aois, o, d, np.array([3.5])).rows] == [0, 0]
    assert [len(v) for v in assign_hits(aois, o, d, np.array([np.inf])).rows] == [0, 0]


def test_aois_are_solid_without_surfaces():
    front, behind, in_front = (
        box("f", [1, -1, -1], [2, 1, 1]),
        box("b", [3, -1, -1], [4, 1, 1]),
        box("i", [1.5, 0, 0], [2.5, 1, 1]),
    )
    o, d = np.array([[0, 0.5, 0.5], [0, -0.5, -0.5], [0, 5.0, 0]]), np.tile([1.0, 0, 0], (3, 1))
    result = assign_hits([front, behind, in_front], o, d, None).to_matrix()
    # Overlapping AOIs are both hit; an AOI that starts behind the end of another is occluded.
    assert result.tolist() == [[True, False, True], [True, False, False], [False, False, False]]


def test_grazed_and_rear_boxes_are_missed():
    aoi = box("a", [1, 0, 0], [2, 1, 1])
    o = np.array([[0.0, 1, 0.5], [3, 0.5, 0.5], [0, 0.5, 0.5]])
    d = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert assign_hits([aoi], o, d, np.array([1.5, 0.5, 1.5])).to_matrix()[1:, 0].tolist() == [False, True]


def test_areas_merge_their_members():
    aois = [box("a", [1, -1, -1], [2, 1, 1]), box("b", [1.5, 0, -1], [4, 1, 1])]
    o, d = np.array([[0, 0.5, 0.0], [0, -0.5, 0], [3, 0.5, -5]]), np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    landed = merge_members(assign_hits(aois, o, d, np.array([1.6, 1.0, 5.0])), [(0,), (1,), (0, 1)])
    assert [rows.tolist() for rows in landed.rows] == [[0, 1], [0, 2], [0, 1, 2]]
    assert landed.distance[2].tolist() == [1.0, 1.0, 4.0]


def test_hits_are_concatenated_and_merged():
    aois = [box("a", [1, -1, -1], [2, 1, 1])]
    o, d = np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]])
    one, two = assign_hits(aois, o, d, None), assign_hits(aois, o, d[::-1], None)
    assert concatenate_hits([one, two]).rows[0].tolist() == [0, 3]
    assert merge_directions([one, two]).rows[0].tolist() == [0, 1]


@pytest.mark.parametrize("degrees", [0.5, 2.0, 10.0])
def test_cone_has_no_wide_gaps(degrees):
    d = np.array([[0, 0, 1.0], [0, 0, -1], [0.6, 0, 0.8], [0.36, -0.48, -0.8]])
    directions = np.stack(sample_cone(d, degrees))
    assert len(directions) == 19 and np.allclose(np.linalg.norm(directions, axis=2), 1)
    angle = np.degrees(np.arccos(np.clip((directions * d).sum(axis=2), -1, 1)))
    assert np.allclose(angle[0], 0, atol=1e-5) and np.allclose(angle[1:7], degrees / 2, rtol=1e-3)
    assert np.allclose(angle[7:], degrees, rtol=1e-3)
    rng = np.random.default_rng(0)
    for k in range(len(d)):
        u = np.cross(d[k], [1, 0.3, 0.2])
        u /= np.linalg.norm(u)
        v = np.cross(d[k], u)
        r, turn = np.radians(degrees) * np.sqrt(rng.random(500)), 2 * np.pi * rng.random(500)
        within = np.cos(r)[:, None] * d[k] + np.sin(r)[:, None] * (
            np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
        )
        nearest = np.degrees(np.arccos(np.clip(within @ directions[:, k].T, -1, 1)).min(axis=1))
        assert nearest.max() < 0.5 * degrees


def test_sample_points_cover_a_box():
    aoi = box("a", [0, 0, 0], [2, 1, 0.5], 20)
    points, normals = aoi.sample_points(70)
    subset = aoi.region.to_local(points)
    lower, upper = aoi.region.corners
    on_face = np.isclose(subset, lower) | np.isclose(subset, upper)
    assert (on_face.sum(axis=1) == 1).all() and ((subset > lower - 1e-9) & (subset < upper + 1e-9)).all()
    assert np.allclose(((points - aoi.region.center) * normals).sum(axis=1) > 0, True)
    assert 40 < len(points) < 110


# ---- Represented time and visits ----


def slow_weights(person, t, rules):
    """Reference implementation, sample by sample."""
    n = len(t)
    sitting, weight = [0] * n, [0.0] * n
    for i in range(1, n):
        goes_on = person[i] == person[i - 1] and t[i] - t[i - 1] <= rules.session_pause
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
    rules = VisitRules(max_gap=0.5, session_pause=5.0, merge_gap=0.25, min_visit=0.15)
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
    "bad", [{"max_gap": 0}, {"max_gap": -1}, {"session_pause": 0.5}, {"merge_gap": np.nan}, {"min_visit": np.inf}]
)
def test_invalid_rules_are_refused(bad):
    with pytest.raises(NergError, check=lambda error: error.parameters):
        VisitRules(**bad)


def test_durations_at_the_limits():
    """A pause of exactly the limit continues a session, and an interruption of exactly the limit a visit."""
    rules = VisitRules(max_gap=0.5, session_pause=4.0, merge_gap=0.25, min_visit=0.25)
    line = make_timeline(np.zeros(4, int), np.array([0.0, 4.0, 8.0, 12.5]), rules)
    assert line.session.tolist() == [0, 0, 0, 1]
    line = make_timeline(np.zeros(6, int), np.arange(6) * 0.25, rules)
    at = lambda *rows: find_visits(np.array(rows), line, rules).first.tolist()
    assert at(0, 2) == [0] and at(0, 3) == [0, 3] and at(1) == [1]
    assert make_timeline(np.zeros(3, int), np.array([0.0, 0.5, 1.25]), rules).weight.tolist() == [0.5, 0.5, 0.5]


# ---- Sums, against dictionaries, and in any number of parts ----

RULES = VisitRules(max_gap=0.5, session_pause=5.0, merge_gap=0.25, min_visit=0.15)
AREAS = ("a", "b", "c")


def made(seed=0, n=150, people=3):
    """Unsorted samples with hits and visibility."""
    rng = np.random.default_rng(seed)
    person = rng.integers(0, people, n)
    step = rng.choice([0.1, 0.2, 0.2, 0.3, 0.7, 6.0], n)
    t = np.zeros(n)
    for p in range(people):
        subset = np.flatnonzero(person == p)
        t[subset] = rng.permutation(np.cumsum(step[subset]))
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
            out["squared_time", cell, who] += weight[k] ** 2
            out["rays", cell, who] += 1
            for a in range(3):
                i = order[k]
                if on[i, a]:
                    out["dwell_time", cell, who, a] += weight[k]
                    out["hit_rays", cell, who, a] += 1
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
                out["first_start", cell, who, a] = min(out.get(("first_start", cell, who, a), np.inf), start)
                out["last_end", cell, who, a] = max(out.get(("last_end", cell, who, a), -np.inf), end)
                bin_ = max(b for b in range(len(BINS) - 1) if end - start >= BINS[b])
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


@pytest.mark.parametrize("seed", range(3))
def test_sums_match_loops(seed):
    rays, landed, on, far, visible = made(seed)
    cells = cells_of(rays)
    sums = sum_visits(rays, landed, AREAS, cells, RULES, visible)
    slow = slow_sums(rays, on, far, visible, cells)
    for r, (cell, who) in enumerate(sums.rows):
        for name in ("time", "squared_time", "rays"):
            assert getattr(sums, name)[r] == pytest.approx(slow[name, cell, who])
        for name in (
            "dwell_time",
            "hit_rays",
            "distance",
            "visits",
            "visible_time",
            "first_visit_sum",
            "first_visit_count",
        ):
            assert getattr(sums, name)[r] == pytest.approx([slow[name, cell, who, a] for a in range(3)]), name
        for name, none in (("first_start", np.inf), ("last_end", -np.inf)):
            expected = [slow.get((name, cell, who, a), none) for a in range(3)]
            assert getattr(sums, name)[r] == pytest.approx(expected), name
    for c, (cell, _) in enumerate(cells):
        assert sums.duration_counts[c].tolist() == [
            [slow["lasted", cell, a, b] for b in range(len(BINS) - 1)] for a in range(3)
        ]
        assert sums.transitions[c].tolist() == [[slow["moves", cell, a, b] for b in range(3)] for a in range(3)]
    assert {cell for cell, _ in sums.rows} == {cell for cell, _ in cells[:-1]} and sums.transitions[0].sum() > 3
    # Area c has no visit.
    assert (
        sums.dwell_time[:, 2].sum() == 0
        and np.isinf(sums.first_start[:, 2]).all()
        and sums.visible_time[:, 2].sum() > 0
    )


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
    assert all(
        np.array_equal(getattr(again, n), getattr(merged, n))
        for n in ("time", "dwell_time", "transitions", "first_start")
    )


def test_returning_participant_is_counted_once():
    rays, landed, _, _, visible = made(3)
    one = sum_visits(rays, landed, AREAS, [(ALL, None)], RULES, visible)
    twice = merge_sums([one, one])
    assert (
        twice.rows == one.rows
        and np.allclose(twice.time, 2 * one.time)
        and np.array_equal(twice.first_start, one.first_start)
    )


def test_incompatible_sums_are_refused():
    rays, landed, *_ = made()
    one = sum_visits(rays, landed, AREAS, [(ALL, None)], RULES)
    other = sum_visits(rays, landed, ("x", "b", "c"), [(ALL, None)], RULES)
    with pytest.raises(ValueError, match="different areas"):
        merge_sums([one, other])
    with pytest.raises(ValueError, match="at least one sum"):
        merge_sums([])


def test_last_visit_ends_with_its_last_sample():
    """The end of the last visit is that of its last sample, also across two parts."""
    t = np.arange(8) * 0.25
    d = np.tile([1.0, 0, 0], (8, 1))
    rays = Rays(t, np.zeros(8, int), ("ann",), d, d, np.ones(8))
    on = np.array([1, 2, 5, 6])
    landed = HitAssignment(8, (on,), (np.ones(4),))
    early = sum_visits(rays, landed, ("a",), [(ALL, None)], VisitRules())
    assert early.visits[0, 0] == 2
    assert (early.first_start[0, 0], early.last_end[0, 0]) == pytest.approx((0.25, 1.75))
    late = sum_visits(replace(rays, t=t + 100), landed, ("a",), [(ALL, None)], VisitRules())
    for parts in ([early, late], [late, early]):
        assert merge_sums(parts).first_start[0, 0] == pytest.approx(0.25)
        assert merge_sums(parts).last_end[0, 0] == pytest.approx(101.75)


def test_sums_without_samples():
    rays, landed, *_ = made()
    none = sum_visits(rays.select(np.zeros(0, int)), pick(landed, []), AREAS, [(ALL, None)], RULES)
    assert none.rows == () and none.time.shape == (0,) and none.transitions.sum() == 0
    assert none.find_participants(ALL)[1] == []
