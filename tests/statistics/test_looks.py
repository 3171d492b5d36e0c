"""How long rays stand for, and what is one look."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.statistics.visits import LookRules, looks_at, timeline


def slow_weights(person, t, rules):
    """Ray by ray."""
    n = len(t)
    sitting, weight = [0] * n, [0.0] * n
    for i in range(1, n):
        goes_on = person[i] == person[i - 1] and t[i] - t[i - 1] <= rules.pause
        sitting[i] = sitting[i - 1] + (not goes_on)
    for i in range(n):
        steps = [
            t[j + 1] - t[j]
            for j in range(n - 1)
            if sitting[j] == sitting[i] == sitting[j + 1] and 0 < t[j + 1] - t[j] <= rules.gap
        ]
        usual = float(np.median(steps)) if steps else 0.0
        near = i + 1 < n and sitting[i + 1] == sitting[i] and t[i + 1] - t[i] <= rules.gap
        weight[i] = t[i + 1] - t[i] if near else usual
    return sitting, weight


def slow_looks(rows, t, weight, sitting, rules):
    """Ray by ray."""
    looks, now = [], None
    for r in rows:
        start, end = t[r], t[r] + weight[r]
        if now is not None and sitting[now[0]] == sitting[r] and start - now[2] <= rules.merge + 1e-9:
            now = (now[0], now[1], end)
        else:
            if now is not None:
                looks.append(now)
            now = (r, start, end)
    return [found for found in [*looks, now] if found is not None and found[2] - found[1] >= rules.least - 1e-9]


@pytest.mark.parametrize("seed", range(4))
def test01_against_loops(seed):
    rng = np.random.default_rng(seed)
    rules = LookRules(gap=0.5, pause=5.0, merge=0.25, least=0.15)
    person = np.sort(rng.integers(0, 4, 120))
    step = rng.choice([0.0, 0.1, 0.2, 0.2, 0.3, 0.7, 6.0], 120)
    t = np.concatenate([np.cumsum(step[person == p]) for p in range(4)])
    line = timeline(person, t, rules)
    sitting, weight = slow_weights(person, t, rules)
    assert line.sitting.tolist() == sitting and np.allclose(line.weight, weight)
    rows = np.flatnonzero(rng.random(120) < 0.5)
    looks = looks_at(rows, line, rules)
    expected = slow_looks(rows, t, weight, sitting, rules)
    assert looks.first.tolist() == [e[0] for e in expected]
    assert np.allclose(looks.start, [e[1] for e in expected]) and np.allclose(looks.end, [e[2] for e in expected])


def test02_one_ray_stands_for_no_time():
    line = timeline(np.array([0, 1, 1]), np.array([5.0, 1.0, 1.2]), LookRules())
    assert np.allclose(line.weight, [0, 0.2, 0.2])
    assert len(looks_at(np.array([0]), line, LookRules())) == 0
    assert len(looks_at(np.array([0]), line, LookRules(least=0.0))) == 1
    assert len(looks_at(np.zeros(0, int), line, LookRules())) == 0


def test03_equal_times_count_once():
    line = timeline(np.zeros(4, int), np.array([0.0, 0.0, 0.2, 0.2]), LookRules())
    assert np.allclose(line.weight, [0, 0.2, 0, 0.2])


def test04_no_rays():
    assert len(timeline(np.zeros(0, int), np.zeros(0), LookRules()).t) == 0


@pytest.mark.parametrize("t", [[0.0, np.nan], [1.0, 0.0], [0.0, np.inf]])
def test05_times_that_are_none_or_unsorted(t):
    with pytest.raises(ValueError):
        timeline(np.zeros(2, int), np.array(t), LookRules())


@pytest.mark.parametrize("bad", [{"gap": 0}, {"gap": -1}, {"pause": 0.5}, {"merge": np.nan}, {"least": np.inf}])
def test06_rules_that_are_none(bad):
    with pytest.raises(NergError, match="--"):
        LookRules(**bad)


def test07_times_on_the_bounds():
    """A pause as long as it may be joins sittings, an interruption as long as it may be looks."""
    rules = LookRules(gap=0.5, pause=4.0, merge=0.25, least=0.25)
    line = timeline(np.zeros(4, int), np.array([0.0, 4.0, 8.0, 12.5]), rules)
    assert line.sitting.tolist() == [0, 0, 0, 1]
    line = timeline(np.zeros(6, int), np.arange(6) * 0.25, rules)
    at = lambda *rows: looks_at(np.array(rows), line, rules).first.tolist()
    assert at(0, 2) == [0] and at(0, 3) == [0, 3] and at(1) == [1]
    assert timeline(np.zeros(3, int), np.array([0.0, 0.5, 1.25]), rules).weight.tolist() == [0.5, 0.5, 0.5]
