"""Tests of `nerg_mi.alignment.profile`, and of the intervals of samples without hit points."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment import profile
from nerg_mi.alignment.constraints import AlignmentTarget
from nerg_mi.alignment.icp import ZeroDistance, refine
from nerg_mi.alignment.profile import TURN, Profile, evaluate_by_group, find_arc
from nerg_mi.alignment.similarity import LocalSimilarity, residual_distances, turn_between, vertical_rotation
from nerg_mi.alignment.tracking import Tracking
from nerg_mi.errors import NergError
from nerg_mi.formats.alignments import Interval
from nerg_mi.maths.transforms import similarity_scale, transform_points
from tests.alignment import rooms

RAYS = replace(rooms.people(200), hit=None)


def quiet(share, text):
    assert 0 <= share <= 1 and text


def rotations(degrees):
    matrices = np.tile(np.eye(4), (len(degrees), 1, 1))
    matrices[:, :3, :3] = [vertical_rotation(np.radians(d)) for d in degrees]
    return matrices


@pytest.mark.parametrize(
    "plausible, expected",
    [
        ([], (-10, 10)),
        ([10, 20], (-10, 30)),
        ([-10, 160, 170], (-20, 180)),
        ([-170, 180], (-190, 10)),
        ([-150], (-160, 10)),
        (range(-170, 181, 10), (-180, 180)),
    ],
)
def test_arc_is_the_smallest_that_contains_the_plausible_turns(plausible, expected):
    degrees = np.r_[0, np.setdiff1d(np.arange(-170, 181, 10), 0)]
    mask = np.isin(degrees, [0, *plausible])
    np.testing.assert_allclose(np.degrees(find_arc(np.radians(degrees), mask)), expected, atol=1e-9)


def test_no_profiled_turn_leaves_no_arc():
    assert find_arc(np.zeros(1), np.ones(1, bool)) == (0.0, 0.0)


def test_plausible_turns_have_an_objective_near_the_smallest_in_enough_resamples():
    """Turns with the parabola (turn / 10 degrees)^2, alike in every group, and one that few groups prefer."""
    degrees = np.r_[0.0, np.setdiff1d(np.arange(-60, 61, 5), 0)]
    costs = np.tile(((degrees / 10) ** 2)[:, None], 20) / 20
    axis = np.r_[-1, np.full(len(degrees) - 1, TURN)]
    result = Profile(rotations(degrees), costs, axis, (degrees / 5).astype(int))
    heads = np.array([[2.0, 0, 1]])
    # The first turns whose objective exceeds the margin of 1.1 are 15 degrees away.
    interval = result.find_interval(heads, 1.1)
    assert interval.turn == pytest.approx((-15, 15)) and interval.scale == pytest.approx((1, 1))
    assert interval.shift == pytest.approx(4 * np.sin(np.radians(5)))
    assert not result.find_plausible(0.2)[1:].any()
    # Groups that disagree widen the interval: of 20 groups, half prefer 60 degrees.
    costs[degrees == 60] = np.where(np.arange(20) % 2, -0.5, 0.5)
    assert result.find_interval(heads, 0.01).turn[1] > 60
    assert replace(result, is_local=True).find_interval(heads, 0.01).turn == pytest.approx((-5, 5))


def test_the_seed_draws_the_resamples():
    degrees = np.r_[0.0, np.arange(5, 61, 5)]
    costs = np.random.default_rng(0).normal(0.01 * degrees[:, None], 0.3, (len(degrees), 20))
    axis = np.r_[-1, np.full(len(degrees) - 1, TURN)]
    result, heads = Profile(rotations(degrees), costs, axis, (degrees / 5).astype(int)), np.array([[2.0, 0, 1]])
    turns = [result.find_interval(heads, 3.0, seed).turn for seed in range(20)]
    assert len(set(turns)) > 1 and turns[0] == result.find_interval(heads, 3.0).turn


def test_reason_names_what_is_undetermined_and_the_remedy():
    assert Interval((-4, 5), (0.99, 1.01), 0.3).rejection_reason() == ""
    reason = Interval((-50, 130), (0.5, 1.5), 3.0).rejection_reason()
    assert set(NergError(reason).parameters) == {"turn", "scale", "shift", "pairs"}
    for text in ("-50", "+130", "0.5", "1.5", "3 m"):
        assert text in reason
    assert "scale" not in NergError(Interval((-50, 130), (1, 1), 0.3).rejection_reason()).parameters


def test_objective_of_the_groups_sums_to_that_of_the_refinement():
    truth = rooms.similarity(np.random.default_rng(3), upright=True)
    target = AlignmentTarget(traces=rooms.traces(8000).transform(truth))
    group = np.arange(len(RAYS)) % 5
    scores = [
        ZeroDistance(target.surface.distance, RAYS.origin, group, "a"),
        ZeroDistance(target.surface.free_space_distance, RAYS.origin[::3], group[::3], "b", 0.3),
    ]
    fit = refine(scores, LocalSimilarity(truth, np.zeros(3)), max_evaluations=1)
    costs = evaluate_by_group(scores, truth)
    assert len(costs) == 5 and costs.sum() == pytest.approx(fit.cost)


@pytest.fixture
def coarse(monkeypatch):
    """Few profiled turns and scales."""
    monkeypatch.setattr(profile, "_TURNS", np.radians([5, 45, 90, 180]))
    monkeypatch.setattr(profile, "_LOG_SCALES", np.log([1.1, 2, 4, 10]))


@pytest.fixture(scope="module")
def square():
    """An empty square room, which every quarter turn maps to itself, in the frame of `rooms.similarity`."""
    rng = np.random.default_rng(5)
    start, along = rng.uniform(0, (4, 4, 2.5), (20_000, 3)), rooms.directions(20_000, rng)
    with np.errstate(divide="ignore"):
        length = np.where(along > 0, ((4, 4, 2.5) - start) / along, -start / along).min(axis=1)
    heads = rng.uniform((0.3, 0.3, 1.5), (3.7, 3.7, 1.7), (len(RAYS), 3))
    truth = rooms.similarity(rng, upright=True)
    traces = rooms.SceneTraces(start, start + along * length[:, None], np.ones(len(start), bool))
    return replace(RAYS, origin=heads), truth, traces.transform(truth)


def test_turns_of_a_symmetric_room_are_in_the_interval(square, coarse):
    rays, truth, traces = square
    fit = Tracking(rays).fit(AlignmentTarget(traces=traces, scale=similarity_scale(truth)), quiet)
    assert fit.interval.turn[1] - fit.interval.turn[0] > 180 and "turn" in fit.interval.rejection_reason()
    off = np.degrees(turn_between(fit.matrix, truth))
    assert any(fit.interval.turn[0] <= off + full <= fit.interval.turn[1] for full in (-360, 0, 360))
    # Residuals of free heads are no evidence.
    assert not len(fit.residuals_cm) and fit.covariance is None


def test_given_turn_leaves_scale_and_shift_free(square, coarse):
    rays, truth, traces = square
    turn = turn_between(np.eye(4), truth)
    fit = Tracking(rays).fit(AlignmentTarget(traces=traces, turn=turn), quiet)
    assert turn_between(fit.matrix, truth) == pytest.approx(0, abs=1e-9) and fit.interval.turn == (0, 0)
    low, high = fit.interval.scale
    # A small scale leaves all heads in the room; a large one does not.
    assert low < 0.9 * similarity_scale(truth) < similarity_scale(truth) < high
    shifted = AlignmentTarget(traces=traces, turn=turn, shift=truth[:3, 3])
    fit = Tracking(rays).fit(shifted, quiet)
    np.testing.assert_allclose(transform_points(fit.matrix, np.zeros(3)), truth[:3, 3], atol=1e-9)


def test_initial_alignment_takes_the_given_values(square, coarse):
    rays, truth, traces = square
    start = truth @ np.diag([1.1, 1.1, 1.1, 1])
    target = AlignmentTarget(traces=traces, scale=similarity_scale(truth), turn=turn_between(np.eye(4), truth))
    fit = Tracking(rays, start).fit(target, quiet)
    assert similarity_scale(fit.matrix) == pytest.approx(similarity_scale(truth))
    assert np.median(residual_distances(fit.matrix, rays.origin, transform_points(truth, rays.origin))) < 0.5
