"""Tests of `nerg_mi.alignment.icp`."""

import numpy as np
import pytest

from nerg_mi.alignment.constraints import AlignmentTarget, surface_from_traces
from nerg_mi.alignment.icp import GazeEnds, HeadHeight, Twin, ZeroDistance, independent_groups, refine
from nerg_mi.alignment.similarity import FULL_BASIS, MIRROR, LocalSimilarity, residual_distances
from nerg_mi.errors import NergError

from . import rooms

# ---- Icp ----

PLACE = rooms.traces(12_000).end


def quiet(share, text):
    assert 0 <= share <= 1 and text


@pytest.mark.nightly
def test_twin_in_millimetres_and_mirrored_twin():
    truth = rooms.similarity(np.random.default_rng(1), upright=True, scale=0.001)
    twin = rooms.carried(np.linalg.inv(truth), rooms.traces(9000).end)
    target = AlignmentTarget(points=PLACE, is_upright=True)
    fit = Twin(twin).fit(target, quiet)
    off = residual_distances(fit.matrix, twin, rooms.carried(truth, twin))
    assert np.median(off) < 30 and fit.mirrored is None  # millimetres
    assert any("millimetres" in note for note in fit.notes)
    assert "the twin fits the scene to" in Twin(rooms.carried(MIRROR, twin)).fit(target, quiet).mirrored


@pytest.mark.parametrize("points, why", [(np.zeros((5, 3)), "5 usable points"), (np.ones((200, 3)), "coincide")])
def test_invalid_twins_are_refused(points, why):
    with pytest.raises(NergError, match=why):
        Twin(points).fit(AlignmentTarget(), quiet)


# ---- Refine ----


def test_refinement_converges_with_uncertainty():
    rays, truth = rooms.people(1500), rooms.similarity(np.random.default_rng(6))
    surface = surface_from_traces(rooms.traces().transform(truth), 1 << 18)
    nudge = np.eye(4)
    nudge[:2, :2] = 1.03 * np.array([[np.cos(0.06), -np.sin(0.06)], [np.sin(0.06), np.cos(0.06)]])
    nudge[2, 2], nudge[:3, 3] = 1.03, (0.12, -0.1, 0.05)
    start = truth @ nudge
    scores = [
        ZeroDistance(surface.distance, rays.hit, rays.person, "hits"),
        ZeroDistance(surface.free_space_distance, rays.origin, rays.person, "heads"),
    ]
    center = rooms.carried(truth, rays.origin).mean(axis=0)
    result = refine(scores, LocalSimilarity(start, center))
    target = rooms.carried(truth, rays.origin)
    assert (
        residual_distances(start, rays.origin, target).max() > 0.1
        and residual_distances(result.matrix, rays.origin, target).max() < 0.02
    )
    spread = np.sqrt(np.diag(result.covariance))
    assert result.covariance.shape == (7, 7) and (spread[:3] < 0.01).all() and 0 < spread[6] < 0.01


def test_groups_are_participants_or_time_blocks():
    t, who = np.arange(0, 60, 0.5), np.zeros(120, int)
    assert len(np.unique(independent_groups(who, t))) == 6
    assert len(np.unique(independent_groups(np.arange(120) % 12, t))) == 12


# ---- Scores ----

RAYS = rooms.people(400, 0.0)

GROUP = RAYS.person


@pytest.fixture(scope="module")
def surface():
    return surface_from_traces(rooms.traces(), 1 << 16)


def scores(surface):
    return [
        ZeroDistance(surface.distance, RAYS.hit, GROUP, "hits"),
        ZeroDistance(surface.free_space_distance, RAYS.origin, GROUP, "heads"),
        GazeEnds(surface, RAYS.origin, RAYS.direction, GROUP),
        HeadHeight(0.0, RAYS.origin, GROUP),
    ]


@pytest.mark.parametrize("which", range(4))
def test_derivatives_match_central_differences(surface, which):
    score = scores(surface)[which]
    rng = np.random.default_rng(0)
    chart, q = (
        LocalSimilarity(rooms.similarity(rng, scale=1.3), np.array([2.0, 1.5, 1.0]), FULL_BASIS),
        rng.normal(0, 0.3, 7),
    )
    r, by = score.residuals(chart, q)
    assert (r > 0).mean() > 0.05 and by.shape == (len(r), 7)
    for k, e in enumerate(1e-6 * np.eye(7)):
        numeric = (score.residuals(chart, q + e)[0] - score.residuals(chart, q - e)[0]) / 2e-6
        # Derivatives are ambiguous at cell edges, and for rays with two nearest positions.
        assert np.mean(np.abs(by[:, k] - numeric) > 1e-6) < 0.02


@pytest.mark.parametrize("which", range(4))
def test_residuals_vanish_at_the_correct_alignment(surface, which):
    score = scores(surface)[which]
    right = score.residuals(LocalSimilarity(np.eye(4), np.zeros(3)), np.zeros(7))[0]
    far = np.eye(4)
    far[:3, 3] = 1.5, 4.0, 3.0
    wrong = score.residuals(LocalSimilarity(far, np.zeros(3)), np.zeros(7))[0]
    assert np.median(right) < 0.7 * surface.step and np.mean(wrong) > 10 * np.mean(right)


def test_residuals_do_not_depend_on_the_scene_scale(surface):
    grown = surface_from_traces(rooms.traces().transform(np.diag([7.0, 7, 7, 1])), 1 << 16)
    for a, b in zip(scores(surface), scores(grown)):
        if isinstance(a, HeadHeight):
            continue
        shifted, scaled = np.eye(4), np.diag([7.0, 7, 7, 1])
        shifted[:3, 3], scaled[:3, 3] = 0.2, 1.4
        one, other = (
            s.residuals(LocalSimilarity(m, np.zeros(3)), np.zeros(7))[0] for s, m in ((a, shifted), (b, scaled))
        )
        np.testing.assert_allclose(one, other, atol=2e-2)
