"""Tests of `nerg_mi.evaluation.position_scores`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.evaluation.baselines import PRIOR, TunedBaseline
from nerg_mi.evaluation.position_scores import (
    AWAY,
    RECORDED,
    choose_tunings,
    find_best,
    format_verdicts,
    iter_region_levels,
    score_kinds,
)
from nerg_mi.maths.sphere import sample_uniform_directions
from nerg_mi.tracking.rays import Rays


def people(count: int, each: int, x: float) -> Rays:
    """Participants who stand around ``x`` on the x axis and look along z."""
    rng, n = np.random.default_rng(int(x) + count), count * each
    origin = np.column_stack([x + 0.1 * rng.random(n), np.zeros(n), np.full(n, 1.6)])
    names = tuple(f"p{k}" for k in range(count))
    return Rays(
        np.arange(n) * 1.0, np.repeat(np.arange(count), each), names, origin, np.tile([0, 0, 1.0], (n, 1)), np.ones(n)
    )


def constant(density: float):
    return lambda positions, directions: np.full((len(positions), directions.shape[-2]), density)


def tuning(**densities) -> dict[str, TunedBaseline]:
    """Baselines by name, and a prior of 0.05 1/sr."""
    methods = {PRIOR: constant(0.05), **densities}
    return {name: TunedBaseline(method) for name, method in methods.items()}


def test_each_kind_has_the_better_settings_of_a_baseline():
    """Settings of both kinds of folds compete at both kinds of positions."""
    train = people(3, 50, 0.0)
    near, far = people(4, 40, 0.0), people(4, 40, 2.0)
    held_out = Rays(
        np.concatenate([near.t, far.t]),
        np.concatenate([near.person, far.person]),
        near.persons,
        np.concatenate([near.origin, far.origin]),
        np.concatenate([near.direction, far.direction]),
        np.ones(320),
    )
    # Half as good where nobody stood
    field = lambda positions, directions: np.where(positions[:, :1] > 1, 0.2, 0.4)
    near_only = lambda positions, directions: np.where(positions[:, :1] > 1, 0.01, 0.2)
    tunings = [tuning(good=constant(0.1), bad=constant(0.01)), tuning(good=near_only, bad=constant(0.005))]
    rows = score_kinds(train, held_out, field, tunings)
    assert rows == score_kinds(train, held_out, field, tunings[::-1])
    assert [(row["kind"], row["method"]) for row in rows] == [
        (kind, name) for kind in (RECORDED, AWAY) for name in ("gaze field", "good", PRIOR, "bad")
    ]
    assert rows[3]["bits"] == pytest.approx(np.log2(0.01 / 0.05))
    for kind in (RECORDED, AWAY):
        best = find_best(rows, kind)
        assert best is not None and best["method"] == "good" and best["people"] == 4 and best["rays"] == 160
        # Every participant gains as much, so that the interval is empty.
        assert best["bits.gap"] == best["bits.gap.low"] == best["bits.gap.high"] == pytest.approx(1)
    assert rows[0]["bits"] == pytest.approx(3) and rows[4]["bits"] == pytest.approx(2)
    assert [line.split(" (")[0] for line in format_verdicts(rows)] == [RECORDED, AWAY]
    alone = [{key: value for key, value in row.items() if key not in ("bits.gap.low", "bits.gap.high")} for row in rows]
    assert all("no interval" in line for line in format_verdicts(alone))


def test_people_have_equal_weights_in_the_choice_of_settings():
    """One of two participants has most of the rays; the settings that are best for her alone are not chosen."""
    origin, direction = np.zeros((10, 3)), np.tile([0, 0, 1.0], (10, 1, 1))
    person = np.array([0] * 9 + [1])
    of_many = lambda positions, directions: np.where(person == 0, 0.2, 0.001)[:, None]
    tunings = [tuning(method=of_many), tuning(method=constant(0.1))]
    assert choose_tunings(tunings, origin, direction, person)["method"] is tunings[1]["method"]
    of_one = choose_tunings(tunings, origin, direction, np.zeros(10, int))
    assert of_one["method"] is tunings[0]["method"]


def test_intervals_are_those_of_participants():
    train, held_out = people(2, 30, 0.0), people(3, 30, 0.0)
    # The participants' own densities differ; the origins tell who it is.
    of_person = {tuple(o): 0.1 * 2.0**p for o, p in zip(held_out.origin, held_out.person)}
    field = lambda positions, directions: np.array([[of_person[tuple(p)]] for p in positions])
    rows = score_kinds(train, held_out, field, [{PRIOR: TunedBaseline(constant(0.1))}])
    assert find_best(rows, AWAY) is None and len(rows) == 2
    assert rows[0]["bits"] == pytest.approx(1)
    # 0, 1 and 2 bits: a standard error of 1/sqrt(3), times 4.30 of Student's t
    assert rows[0]["bits.high"] - rows[0]["bits"] == pytest.approx(4.3027 / np.sqrt(3), rel=1e-3)
    # Two participants have no interval.
    assert "bits.low" not in score_kinds(train, people(2, 30, 0.0), constant(0.1), [tuning()])[0]


def test_levels_of_regions_are_those_of_each_ray_at_its_origin():
    """The smallest region with a ray of a von Mises-Fisher density is a cap around its mean, which differs by kind."""
    train, near, far = people(3, 50, 0.0), people(2, 60, 0.0), people(2, 60, 2.0)
    directions = sample_uniform_directions(240, np.random.default_rng(0))
    held_out = Rays(
        np.arange(240.0),
        np.concatenate([near.person, far.person]),
        near.persons,
        np.concatenate([near.origin, far.origin]),
        directions,
        np.ones(240),
    )
    axis = lambda origins: np.where(origins[:, :1] > 1, [[1.0, 0, 0]], [[0, 0, 1.0]])
    cosine = lambda origins, directions: np.sum(axis(origins) * directions, axis=1)
    field = lambda origins, directions: np.exp(4 * cosine(origins, directions))
    levels = {kind: (values, rays) for kind, values, rays in iter_region_levels(train, held_out, field)}
    assert list(levels) == [RECORDED, AWAY]
    for values, rays in levels.values():
        mass = -np.expm1(4 * (cosine(rays.origin, rays.direction) - 1)) / -np.expm1(-8.0)
        assert len(values) == 120 and np.ptp(mass) > 0.8
        np.testing.assert_allclose(values, mass, atol=0.02)
