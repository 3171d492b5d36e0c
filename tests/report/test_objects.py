"""Shares of attention on boxes, counted again another way; intervals by a bootstrap that is one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nerg_mi.evaluation.gaze.verdict import widening
from nerg_mi.formats.regions import Region
from nerg_mi.report.glances import Eyes, Glances
from nerg_mi.report.objects import attention_on, mean_over_people

UNIT = Region.of("unit", np.zeros(3), np.ones(3))


def glances(person, rng):
    P, D = len(person), 50
    share = rng.random((P, D))
    met = rng.random((P, D)) < 0.8
    points = rng.uniform(-1, 2, (P, D, 3))
    return Glances(Eyes(np.zeros((P, 3)), np.array(person)), points, met, share / share.sum(axis=1, keepdims=True))


def test_shares_of_people_count_alike():
    rng = np.random.default_rng(0)
    seen = glances([3, 3, 3, 5, 9, 9, 9, 9], rng)
    points, person = rng.uniform(-1, 2, (300, 3)), rng.choice([3, 5, 9], 300)
    points[::7] = np.nan
    (found,) = attention_on([UNIT], seen, 0.1, (points, person))

    def inside(p):
        return all(-0.1 <= c <= 1.1 for c in p)

    field, rays = {}, {}
    for p, who in enumerate(seen.eyes.person):
        total = sum(s for s, m, x in zip(seen.share[p], seen.met[p], seen.points[p]) if m and inside(x))
        field.setdefault(int(who), []).append(total)
    for x, who in zip(points, person):
        rays.setdefault(int(who), []).append(inside(x))
    mean = lambda each: sum(sum(v) / len(v) for v in each.values()) / len(each)
    assert found.field.mean == pytest.approx(mean(field)) and found.recorded.mean == pytest.approx(mean(rays))
    assert (found.saw, found.looked, found.people) == (3, 3, 3)


def test_who_could_see_it():
    person = np.array([0, 0, 1, 2])
    points = np.full((4, 5, 3), 5.0)
    points[1, 2] = 0.5  # the second place of person 0 sees the box
    points[3, 0] = 0.5  # where person 2 is something is in the box, but no surface
    met = np.ones((4, 5), bool)
    met[3, 0] = False
    seen = Glances(Eyes(np.zeros((4, 3)), person), points, met, np.full((4, 5), 0.2))
    away = np.full((4, 3), 9.0)
    (found,) = attention_on([UNIT], seen, 0.0, (away, np.array([0, 1, 2, 3])))
    assert (found.saw, found.looked, found.people) == (1, 0, 4)
    # Somebody who looks at it could see it.
    away[1:3] = 0.5
    (found,) = attention_on([UNIT], seen, 0.0, (away, np.array([0, 1, 2, 3])))
    assert (found.saw, found.looked) == (2, 2)


def test_nobody_recorded():
    rng = np.random.default_rng(1)
    (found,) = attention_on([UNIT], glances([0], rng), 0.0)
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
