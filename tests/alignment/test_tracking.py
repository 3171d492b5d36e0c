from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment.constraints import Target
from nerg_mi.alignment.similarity import MIRROR, errors
from nerg_mi.alignment.tracking import Tracking
from nerg_mi.errors import NergError

from . import rooms

RAYS = rooms.people(1200)


def quiet(share, text):
    assert 0 <= share <= 1 and text


@pytest.mark.nightly
def test_the_tracking_alone_finds_its_place_and_a_mirrored_one_is_named():
    truth = rooms.similarity(np.random.default_rng(7), upright=True)
    target = Target(traces=rooms.traces(25_000).moved(truth))
    fit = Tracking(RAYS).fit(target, quiet)
    off = errors(fit.matrix, RAYS.origin, rooms.carried(truth, RAYS.origin))
    assert np.median(off) < 0.03 and fit.mirrored is None and np.median(fit.centimetres) < 6
    assert fit.about["heads_in_solids"] < 0.02 and np.median(fit.degrees) < 3
    flipped = replace(
        RAYS,
        origin=rooms.carried(MIRROR, RAYS.origin),
        direction=RAYS.direction * (-1, 1, 1),
        hit=rooms.carried(MIRROR, RAYS.hit),
    )
    assert "an axis of the tracking negated" in Tracking(flipped).fit(target, quiet).mirrored


def test_a_start_is_refined_to_any_rotation():
    truth = rooms.similarity(np.random.default_rng(8))
    nudge = np.eye(4)
    nudge[:3, 3] = 0.08, -0.06, 0.05
    fit = Tracking(RAYS, truth @ nudge).fit(Target(traces=rooms.traces(25_000).moved(truth), upright=False), quiet)
    assert np.median(errors(fit.matrix, RAYS.origin, rooms.carried(truth, RAYS.origin))) < 0.02


@pytest.mark.parametrize(
    "changes, known, why",
    [
        ({}, {"upright": False}, "say which way is up"),
        ({}, {"floor": None}, "give it with --floor"),
        ({"hit": None}, {}, "without hit points do not tell how large"),
    ],
)
def test_rays_that_leave_it_open_are_refused(changes, known, why):
    with pytest.raises(NergError, match=why):
        Tracking(replace(RAYS, **changes)).fit(Target(traces=rooms.traces(5000), **known), quiet)


def test_no_rays_are_no_evidence():
    with pytest.raises(NergError, match="no rays to align"):
        Tracking(RAYS.select(np.zeros(len(RAYS), bool))).fit(Target(traces=rooms.traces(5000)), quiet)
