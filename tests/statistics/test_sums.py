"""Sums of blocks, against dictionaries filled ray by ray, and in any number of parts."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import fields, replace

import numpy as np
import pytest

from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.visits import ALL, BINS, Cell, Landed, LookRules, Sums, merge, partial_sums

from .test_looks import slow_looks, slow_weights

RULES = LookRules(gap=0.5, pause=5.0, merge=0.25, least=0.15)
AREAS = ("a", "b", "c")


def made(seed=0, n=150, people=3):
    """Rays in disorder, what they are on, and what could be seen."""
    rng = np.random.default_rng(seed)
    person = rng.integers(0, people, n)
    step = rng.choice([0.1, 0.2, 0.2, 0.3, 0.7, 6.0], n)
    t = np.zeros(n)
    for p in range(people):
        own = np.flatnonzero(person == p)
        t[own] = rng.permutation(np.cumsum(step[own]))
    d = np.tile([1.0, 0, 0], (n, 1))
    names = tuple(f"person {k}" for k in range(people))
    rays = Rays(t, person, names, rng.random((n, 3)), d, np.ones(n))
    on = rng.random((n, 3)) < (0.5, 0.2, 0.0)
    far = rng.random((n, 3)) + 1
    rows = tuple(np.flatnonzero(on[:, k]) for k in range(3))
    landed = Landed(n, rows, tuple(far[r, k] for k, r in enumerate(rows)))
    return rays, landed, on, far, rng.random((n, 3)) < 0.4


def slow_sums(rays, on, far, visible, cells):
    """Ray by ray, look by look, in dictionaries."""
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
            out["time2", cell, who] += weight[k] ** 2
            out["rays", cell, who] += 1
            for a in range(3):
                i = order[k]
                if on[i, a]:
                    out["on_time", cell, who, a] += weight[k]
                    out["on_rays", cell, who, a] += 1
                    out["distance", cell, who, a] += weight[k] * far[i, a]
                if on[i, a] or visible[i, a]:
                    out["visible", cell, who, a] += weight[k]
        every = []
        for a in range(3):
            rows = [k for k in range(len(order)) if on[order[k], a]]
            known = set()
            for first, start, end in slow_looks(rows, t, weight, sitting, RULES):
                every.append((sitting[first], start, a, first))
                if not mine[first]:
                    continue
                who = rays.persons[person[first]]
                out["looks", cell, who, a] += 1
                out["first", cell, who, a] = min(out.get(("first", cell, who, a), np.inf), start)
                out["last", cell, who, a] = max(out.get(("last", cell, who, a), -np.inf), end)
                bin_ = max(b for b in range(len(BINS) - 1) if end - start >= BINS[b])
                out["lasted", cell, a, bin_] += 1
                if sitting[first] not in known:
                    known.add(sitting[first])
                    out["first_sum", cell, who, a] += start - begin[sitting[first]]
                    out["first_count", cell, who, a] += 1
        every.sort()
        for one, two in zip(every[:-1], every[1:]):
            if one[0] == two[0] and one[2] != two[2] and mine[two[3]]:
                out["moves", cell, one[2], two[2]] += 1
    return out


def cells_of(rays):
    return [(ALL, None), (Cell("window", "early"), rays.t < 4), (Cell("zone", "none"), np.zeros(len(rays), bool))]


@pytest.mark.parametrize("seed", range(3))
def test01_against_loops(seed):
    rays, landed, on, far, visible = made(seed)
    cells = cells_of(rays)
    sums = partial_sums(rays, landed, AREAS, cells, RULES, visible)
    slow = slow_sums(rays, on, far, visible, cells)
    for r, (cell, who) in enumerate(sums.rows):
        for name in ("time", "time2", "rays"):
            assert getattr(sums, name)[r] == pytest.approx(slow[name, cell, who])
        for name in ("on_time", "on_rays", "distance", "looks", "visible", "first_sum", "first_count"):
            assert getattr(sums, name)[r] == pytest.approx([slow[name, cell, who, a] for a in range(3)]), name
        for name, none in (("first", np.inf), ("last", -np.inf)):
            expected = [slow.get((name, cell, who, a), none) for a in range(3)]
            assert getattr(sums, name)[r] == pytest.approx(expected), name
    for c, (cell, _) in enumerate(cells):
        assert sums.lasted[c].tolist() == [[slow["lasted", cell, a, b] for b in range(len(BINS) - 1)] for a in range(3)]
        assert sums.moves[c].tolist() == [[slow["moves", cell, a, b] for b in range(3)] for a in range(3)]
    assert {cell for cell, _ in sums.rows} == {ALL, Cell("window", "early")} and sums.moves[0].sum() > 3
    # Nobody looks at c.
    assert sums.on_time[:, 2].sum() == 0 and np.isinf(sums.first[:, 2]).all() and sums.visible[:, 2].sum() > 0


def pick(landed, rows):
    place = {int(r): k for k, r in enumerate(rows)}
    keep = [[place[int(r)] for r in of if int(r) in place] for of in landed.rows]
    far = [np.array([d for r, d in zip(of, ds) if int(r) in place]) for of, ds in zip(landed.rows, landed.distance)]
    return Landed(len(rows), tuple(np.array(k, int) for k in keep), tuple(far))


def test02_in_parts_it_is_the_same():
    rays, landed, _, _, visible = made(7, 300, 6)
    whole = partial_sums(rays, landed, AREAS, [(ALL, None)], RULES, visible)
    parts = []
    for p in range(6):
        rows = np.flatnonzero(rays.person == p)
        parts.append(partial_sums(rays.select(rows), pick(landed, rows), AREAS, [(ALL, None)], RULES, visible[rows]))
    merged = merge(parts)
    assert merged.rows == whole.rows
    for f in fields(Sums):
        value = getattr(whole, f.name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(getattr(merged, f.name), value), f.name
    # And so in parts of parts, to the bit, in the same order.
    again = merge([merge(parts[:1]), *parts[1:]])
    assert all(np.array_equal(getattr(again, n), getattr(merged, n)) for n in ("time", "on_time", "moves", "first"))


def test03_somebody_who_comes_twice_is_one_person():
    rays, landed, _, _, visible = made(3)
    one = partial_sums(rays, landed, AREAS, [(ALL, None)], RULES, visible)
    twice = merge([one, one])
    assert twice.rows == one.rows and np.allclose(twice.time, 2 * one.time) and np.array_equal(twice.first, one.first)


def test04_others_cannot_be_added():
    rays, landed, *_ = made()
    one = partial_sums(rays, landed, AREAS, [(ALL, None)], RULES)
    other = partial_sums(rays, landed, ("x", "b", "c"), [(ALL, None)], RULES)
    with pytest.raises(ValueError, match="other areas"):
        merge([one, other])
    with pytest.raises(ValueError, match="nothing"):
        merge([])


def test03b_the_last_visit_ends_when_its_last_ray_does():
    """Not when that begins, nor when the look before it ended; of two parts it is the later one."""
    t = np.arange(8) * 0.25
    d = np.tile([1.0, 0, 0], (8, 1))
    rays = Rays(t, np.zeros(8, int), ("ann",), d, d, np.ones(8))
    on = np.array([1, 2, 5, 6])
    landed = Landed(8, (on,), (np.ones(4),))
    early = partial_sums(rays, landed, ("a",), [(ALL, None)], LookRules())
    assert early.looks[0, 0] == 2 and early.first[0, 0] == 0.25 and early.last[0, 0] == 1.75
    late = partial_sums(replace(rays, t=t + 100), landed, ("a",), [(ALL, None)], LookRules())
    for parts in ([early, late], [late, early]):
        assert merge(parts).first[0, 0] == 0.25 and merge(parts).last[0, 0] == 101.75


def test05_no_rays_at_all():
    rays, landed, *_ = made()
    none = partial_sums(rays.select(np.zeros(0, int)), pick(landed, []), AREAS, [(ALL, None)], RULES)
    assert none.rows == () and none.time.shape == (0,) and none.moves.sum() == 0
    assert none.persons_of(ALL)[1] == []
