import numpy as np

from nerg_mi.alignment.constraints import surface_of_traces
from nerg_mi.alignment.icp import AtZero, groups_of, refine
from nerg_mi.alignment.similarity import ALL, errors

from . import rooms


def test_a_near_start_comes_to_the_truth_and_says_how_sure_it_is():
    rays, truth = rooms.people(1500), rooms.similarity(np.random.default_rng(6))
    surface = surface_of_traces(rooms.traces().moved(truth), 1 << 18)
    nudge = np.eye(4)
    nudge[:2, :2] = 1.03 * np.array([[np.cos(0.06), -np.sin(0.06)], [np.sin(0.06), np.cos(0.06)]])
    nudge[2, 2], nudge[:3, 3] = 1.03, (0.12, -0.1, 0.05)
    start = truth @ nudge
    scores = [
        AtZero(surface.distance, rays.hit, rays.person, "hits"),
        AtZero(surface.blocked, rays.origin, rays.person, "heads"),
    ]
    center = rooms.carried(truth, rays.origin).mean(axis=0)
    found = refine(scores, start, center, ALL)
    target = rooms.carried(truth, rays.origin)
    assert errors(start, rays.origin, target).max() > 0.1 and errors(found.matrix, rays.origin, target).max() < 0.02
    spread = np.sqrt(np.diag(found.covariance))
    assert found.covariance.shape == (7, 7) and (spread[:3] < 0.01).all() and 0 < spread[6] < 0.01


def test_groups_are_people_or_stretches_of_few():
    t, who = np.arange(0, 60, 0.5), np.zeros(120, int)
    assert len(np.unique(groups_of(who, t))) == 6
    assert len(np.unique(groups_of(np.arange(120) % 12, t))) == 12
