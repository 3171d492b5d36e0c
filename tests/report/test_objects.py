"""Shares of attention on boxes, counted again another way; intervals by a bootstrap that is one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nerg_mi.evaluation.gaze_report import widening
from nerg_mi.report.data import attention_on, mean_over_people
from nerg_mi.statistics.shares import Shares
from nerg_mi.statistics.visits import Landed


def of_field(share, seen=None):
    share = np.array(share, float)[:, None]
    seen = share > 0 if seen is None else np.array(seen)[:, None]
    none = np.zeros(len(share))
    return Shares(share, 0 * share, seen, share, none, none + 1, share[None])


def on_rows(rows, count):
    return Landed(count, (np.array(rows, int),), (np.ones(len(rows)),))


def test_shares_of_people_count_alike():
    rng = np.random.default_rng(0)
    who, person = np.array([3, 3, 3, 5, 9, 9, 9, 9]), rng.choice([3, 5, 9], 300)
    share, rows = rng.random(len(who)), np.flatnonzero(rng.random(300) < 0.3)
    (found,) = attention_on(["unit"], of_field(share), who, (on_rows(rows, 300), person))
    field, rays = {}, {}
    for value, one in zip(share, who.tolist()):
        field.setdefault(one, []).append(value)
    for k, one in enumerate(person.tolist()):
        rays.setdefault(one, []).append(k in rows)
    mean = lambda each: sum(sum(v) / len(v) for v in each.values()) / len(each)
    assert found.field.mean == pytest.approx(mean(field)) and found.recorded.mean == pytest.approx(mean(rays))
    assert (found.saw, found.looked, found.people) == (3, 3, 3)


def test_who_could_see_it():
    # The second place of person 0 sees the box; no gaze goes there.
    field, who, person = of_field([0, 0, 0, 0], [False, True, False, False]), np.array([0, 0, 1, 2]), np.arange(4)
    (found,) = attention_on(["unit"], field, who, (on_rows([], 4), person))
    assert (found.saw, found.looked, found.people) == (1, 0, 4)
    # Somebody who looks at it could see it.
    (found,) = attention_on(["unit"], field, who, (on_rows([1, 2], 4), person))
    assert (found.saw, found.looked) == (2, 2)


def test_nobody_recorded():
    (found,) = attention_on(["unit"], of_field([0.25]), np.zeros(1, int))
    assert found.recorded is None and found.people is None and math.isnan(found.field.low)


def test_the_interval_is_that_of_a_bootstrap_over_people():
    rng = np.random.default_rng(2)
    values = rng.beta(2, 9, 40)
    found = mean_over_people(values)
    means = [rng.choice(values, 40).mean() for _ in range(20_000)]
    assert found.mean == pytest.approx(values.mean())
    assert found.high - found.mean == pytest.approx(1.96 * np.std(means) * widening(40), rel=0.02)
    assert found.mean - found.low == pytest.approx(found.high - found.mean)


def test_shares_stay_shares_and_few_people_have_no_interval():
    assert mean_over_people(np.array([0.0, 0.0, 0.0, 0.9])).low == 0.0
    assert mean_over_people(np.array([1.0, 1.0, 1.0, 0.1])).high == 1.0
    assert math.isnan(mean_over_people(np.array([0.2, 0.3])).low)
