import numpy as np
import pytest

from nerg_mi.alignment.constraints import surface_of_traces
from nerg_mi.alignment.icp import AtZero, GazeEnds, HeadHeight
from nerg_mi.alignment.similarity import ALL, Chart

from . import rooms

RAYS = rooms.people(400, 0.0)
GROUP = RAYS.person


@pytest.fixture(scope="module")
def surface():
    return surface_of_traces(rooms.traces(), 1 << 16)


def scores(surface):
    return [
        AtZero(surface.distance, RAYS.hit, GROUP, "hits"),
        AtZero(surface.blocked, RAYS.origin, GROUP, "heads"),
        GazeEnds(surface, RAYS.origin, RAYS.direction, GROUP),
        HeadHeight(0.0, RAYS.origin, GROUP),
    ]


@pytest.mark.parametrize("which", range(4))
def test_derivatives_are_those_of_central_differences(surface, which):
    score = scores(surface)[which]
    rng = np.random.default_rng(0)
    chart, q = Chart(rooms.similarity(rng, scale=1.3), np.array([2.0, 1.5, 1.0]), ALL), rng.normal(0, 0.3, 7)
    r, by = score.residuals(chart, q)
    assert (r > 0).mean() > 0.05 and by.shape == (len(r), 7)
    for k, e in enumerate(1e-6 * np.eye(7)):
        numeric = (score.residuals(chart, q + e)[0] - score.residuals(chart, q - e)[0]) / 2e-6
        # Where a point lies on an edge of a cell, or a ray has two nearest places, there are two slopes.
        assert np.mean(np.abs(by[:, k] - numeric) > 1e-6) < 0.02


@pytest.mark.parametrize("which", range(4))
def test_all_is_well_in_the_right_place_and_not_elsewhere(surface, which):
    score = scores(surface)[which]
    right = score.residuals(Chart(np.eye(4), np.zeros(3)), np.zeros(7))[0]
    far = np.eye(4)
    far[:3, 3] = 1.5, 4.0, 3.0
    wrong = score.residuals(Chart(far, np.zeros(3)), np.zeros(7))[0]
    assert np.median(right) < 0.7 * surface.step and np.mean(wrong) > 10 * np.mean(right)


def test_residuals_are_metres_of_the_tracking_whatever_the_scale_of_the_place(surface):
    grown = surface_of_traces(rooms.traces().moved(np.diag([7.0, 7, 7, 1])), 1 << 16)
    for a, b in zip(scores(surface), scores(grown)):
        if isinstance(a, HeadHeight):
            continue
        shifted, scaled = np.eye(4), np.diag([7.0, 7, 7, 1])
        shifted[:3, 3], scaled[:3, 3] = 0.2, 1.4
        one, other = (s.residuals(Chart(m, np.zeros(3)), np.zeros(7))[0] for s, m in ((a, shifted), (b, scaled)))
        np.testing.assert_allclose(one, other, atol=2e-2)
