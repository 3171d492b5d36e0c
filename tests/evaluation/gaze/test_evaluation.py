"""Evaluation of gaze: truth from persons, scores against closed forms, what is held out."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import gaze, metrics
from nerg_mi.evaluation.gaze import position_blind, uniform
from nerg_mi.evaluation.gaze_report import markdown
from nerg_mi.probes.probes import place_probes
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import hold_out


def crowd(n=3000, people=4, seed=0):
    """People along a corridor who look at a point of the wall x = 1.5, each at another height."""
    rng = np.random.default_rng(seed)
    origin = np.stack([rng.uniform(-1, 0, n), rng.uniform(-5, 5, n), rng.uniform(1.5, 1.7, n)], axis=1)
    person = rng.integers(0, people, n)
    hit = np.stack([np.full(n, 1.5), rng.normal(0, 0.2, n), 1 + 0.3 * person + rng.normal(0, 0.1, n)], axis=1)
    way = hit - origin
    return Rays(
        np.arange(n),
        person,
        tuple("abcdefgh"[:people]),
        origin,
        way / np.linalg.norm(way, axis=1, keepdims=True),
        np.ones(n),
        hit,
    )


@pytest.fixture(scope="module")
def rays():
    return crowd()


@pytest.fixture(scope="module")
def test_set(rays):
    return gaze.make_test(rays, np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6], [40, 0, 0]]), 0.6, 20.0, 512, min_rays=20)


def test_truth_is_the_probes(rays, test_set):
    assert len(test_set.centres) == 2
    probes = place_probes(
        rays, 0.6, queries=test_set.centres, cap=1024, min_rays=1, kappa_rule="fixed", kappa=20.0, centre="query"
    )
    np.testing.assert_allclose(test_set.truth, probes.density(test_set.directions), rtol=1e-4, atol=1e-6)
    assert (test_set.counts.sum(axis=1) == probes.counts).all() and set(test_set.persons) == set("abcd")


def test_scores_of_the_truth_and_of_nothing(test_set):
    rows = gaze.evaluate_gaze(
        test_set,
        {"truth": lambda p, d: test_set.truth if d.ndim == 2 else np.ones(d.shape[:2]), "uniform": uniform()},
        uniform(),
        20,
    )
    best, flat = rows
    assert (
        best["KLD"] < 1e-6 and best["CC"] == pytest.approx(1) and best["SIM"] == pytest.approx(1) and best["MAE"] == 0
    )
    assert flat["CC"] == 0 and flat["AUC"] == 0.5 and flat["sAUC"] == 0.5 and flat["NSS"] == 0
    assert (
        flat["bits"] == 0
        and flat["loglik"] == pytest.approx(-np.log(4 * np.pi))
        and flat["integral"] == pytest.approx(1)
    )
    assert flat["KLD"] == pytest.approx(float(metrics.kld(test_set.truth, np.ones((2, 512)), eps=1e-6).mean()))
    assert (
        best["KLD.less"] == pytest.approx(best["KLD"] - flat["KLD"])
        and best["KLD.less.low"] < best["KLD.less"] < best["KLD.less.high"]
    )
    assert flat["bits.low"] == 0 and flat["KLD.low"] < flat["KLD"] < flat["KLD.high"]
    for end in ("", ".low", ".high"):
        assert flat[f"KLD.gap{end}"] == best[f"KLD.less{end}"]
    assert not any(".gap" in key for key in best)


def test_other_rays_are_of_positions_farther_than_two_radii_where_there_are_any(rays):
    """A to C stand in a row; B is within 2R of A, C of none."""
    centres = np.array([[-0.5, 0, 1.6], [-0.5, 1, 1.6], [-0.5, 4, 1.6]])
    of = lambda a: {tuple(v) for v in a.reshape(-1, 3)}
    found = gaze.make_test(rays, centres, 0.6, 20.0, 64, min_rays=20)
    (a, b, c), others = map(of, found.at), [of(o) for o in found.others]
    assert a.isdisjoint(c) and b.isdisjoint(c)
    assert others[0] <= c and others[1] <= c and others[2] <= a | b and others[2] & a and others[2] & b
    # Where all are nearer, any other one, and its own where it is alone.
    found = gaze.make_test(rays, centres[:2], 0.6, 20.0, 64, min_rays=20)
    a, b = map(of, found.at)
    assert of(found.others[0]) <= b and of(found.others[1]) <= a
    found = gaze.make_test(rays, centres[:1], 0.6, 20.0, 64, min_rays=20)
    assert np.array_equal(found.others, found.at)


def by_hand(persons: int) -> gaze.GazeTest:
    """One position and sixteen directions, of which each person sees one of their own; the rays are of them in turn."""
    d = np.eye(16, 3)
    parts = 16 / (4 * np.pi) * np.eye(16)[None, :persons]
    who = np.arange(4 * persons)[None] % persons
    at, counts, names = np.zeros((1, 4 * persons, 3)), np.full((1, persons), 4.0), tuple("abcdefgh"[:persons])
    return gaze.GazeTest(np.zeros((1, 3)), d, parts.mean(axis=1), parts, counts, names, at, who, at)


def test_intervals_are_a_bootstrap_over_persons():
    """Of three persons all 27 draws can be made: the error of what one of them sees is the share of the others."""
    test = by_hand(3)
    sees = lambda k: lambda p, d: test.parts[:, k] if d.ndim == 2 else np.ones(d.shape[:2])
    row, _ = gaze.evaluate_gaze(test, {"first": sees(0), "second": sees(1)}, uniform(), resamples=1000)
    draws = list(itertools.product(range(3), repeat=3))
    mae = [2 * (1 - draw.count(0) / 3) / (4 * np.pi) for draw in draws]
    assert row["MAE"] == pytest.approx(np.mean(mae))
    assert row["MAE.high"] - row["MAE"] == pytest.approx(1.96 * np.std(mae), rel=0.1)
    assert row["MAE"] - row["MAE.low"] == pytest.approx(1.96 * np.std(mae), rel=0.1)
    # Of a difference: over the same draws.
    less = [2 * (draw.count(1) - draw.count(0)) / 3 / (4 * np.pi) for draw in draws]
    assert row["MAE.less.high"] - row["MAE.less"] == pytest.approx(1.96 * np.std(less), rel=0.1)
    assert row["MAE.less"] - row["MAE.less.low"] == pytest.approx(1.96 * np.std(less), rel=0.1)


@pytest.mark.parametrize("persons, known", [(2, False), (3, True), (4, True)])
def test_fewer_than_three_persons_have_no_interval(persons, known):
    for row in gaze.evaluate_gaze(by_hand(persons), {"a": uniform(), "b": uniform()}, uniform(), resamples=5):
        assert all((f"{k}.low" in row) == known and (f"{k}.high" in row) == known for k in gaze.SCORES)


def test_ray_scores_by_hand():
    maps = np.array([[0.0, 1.0, 2.0, 5.0]]) / (4 * np.pi * 2)
    at, others = maps[:, [3, 1]], maps[:, [0, 0, 1, 3]]
    scores = gaze.ray_scores(maps, at, others, np.zeros((1, 2)))
    np.testing.assert_allclose(scores["AUC"], [[3.5 / 4, 1.5 / 4]])
    np.testing.assert_allclose(scores["sAUC"], [[3.5 / 4, 2.5 / 4]])
    np.testing.assert_allclose(scores["loglik"], np.log(at), rtol=1e-6)
    np.testing.assert_allclose(scores["bits"], np.log2(at), rtol=1e-6)
    values = np.array([0, 1, 2, 5.0])
    np.testing.assert_allclose(scores["NSS"], [[(5 - 2) / values.std(), (1 - 2) / values.std()]])


def test_persons_are_scored_each_by_their_own(rays, test_set):
    blind = position_blind(rays, kappa=50)
    rows = gaze.person_rows(test_set, {"blind": blind}, blind, min_rays=10)
    assert [r["person"] for r in rows] == list(test_set.persons) and sum(
        r["rays"] for r in rows
    ) == test_set.counts.sum()
    assert all(r["bits"] == pytest.approx(0) for r in rows)
    # The heights of what they look at differ, and so does how well one density for all fits.
    assert np.ptp([r["KLD"] for r in rows]) > 0.01


def test_nothing_is_on_both_sides(rays):
    _, account = hold_out(rays, 0.3, zones=2, positions=8, min_rays=8, people=0.5)
    for split in gaze.SPLITS:
        train, scored, centres = gaze.held_out_rays(rays, account, split)
        named = lambda r: {rays.persons[i] for i in np.unique(r.person)}
        assert named(train).isdisjoint(account["people"])
        assert named(scored) == (named(train) if split == "pos" else set(account["people"]))
        assert np.linalg.norm(train.origin[:, None] - np.array(account["centres"])[None], axis=2).min() > 0.6
    _, without = hold_out(rays, 0.3, zones=2, positions=8, min_rays=8)
    with pytest.raises(ValueError, match="--test-people"):
        gaze.held_out_rays(rays, without, "both")
    with pytest.raises(ValueError, match="both, pos, people"):
        gaze.held_out_rays(rays, account, "time")


def test_positions_without_rays_are_refused(rays):
    with pytest.raises(ValueError, match="lower min_rays"):
        gaze.make_test(rays, np.array([[40.0, 0, 0]]), 0.5)


def test_maps_that_no_memory_holds_are_refused(rays, monkeypatch):
    monkeypatch.setattr(gaze, "_MOST_BYTES", 1e5)
    with pytest.raises(NergError, match="--directions"):
        gaze.make_test(rays, np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6]]), 0.6, 20.0, 512, min_rays=20)


def test_markdown_has_intervals_and_gaps():
    text = markdown(
        [
            {"method": "a", "KLD": 0.5, "KLD.low": 0.4, "KLD.high": 0.6, "MAE": 0.01234},
            {"method": "b", "KLD": float("nan")},
        ]
    )
    assert text.splitlines()[0] == "| method | KLD | MAE |"
    assert text.splitlines()[2:] == ["| a | 0.500 [0.400, 0.600] | 0.0123 |", "| b |  |  |"]


def test_halves_of_the_people_are_compared_where_both_were(rays, test_set):
    row = gaze.split_half(
        rays, np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6], [40, 0, 0]]), 0.6, 20.0, uniform(), min_rays=20
    )
    assert row["method"] == "split half" and 0 < row["CC"] < 1 and row["KLD"] > 0
    nobody = np.array([[40.0, 0, 0]])
    assert gaze.split_half(rays, nobody, 0.6, 20.0, uniform(), min_rays=20) is None
    two = gaze.split_half(rays.select(rays.person < 2), test_set.centres, 0.6, 20.0, uniform(), min_rays=20)
    assert two is not None and two["KLD"] > 0
    alone = rays.select(rays.person == 0)
    assert gaze.split_half(alone, test_set.centres, 0.6, 20.0, uniform(), min_rays=20) is None
    with pytest.raises(ValueError, match="kappa is negative"):
        # What is wrong is said, and not taken for "nobody was there".
        gaze.split_half(rays, test_set.centres, 0.6, -1.0, uniform(), min_rays=20)
