import numpy as np
import pytest

from nerg_mi.alignment.constraints import Target
from nerg_mi.alignment.icp import Twin
from nerg_mi.alignment.similarity import MIRROR, errors
from nerg_mi.errors import NergError

from . import rooms

PLACE = rooms.traces(12_000).end


def quiet(share, text):
    assert 0 <= share <= 1 and text


@pytest.mark.nightly
def test_a_twin_in_millimetres_is_placed_and_a_mirrored_one_named():
    truth = rooms.similarity(np.random.default_rng(1), upright=True, scale=0.001)
    twin = rooms.carried(np.linalg.inv(truth), rooms.traces(9000).end)
    target = Target(points=PLACE, upright=True)
    fit = Twin(twin).fit(target, quiet)
    off = errors(fit.matrix, twin, rooms.carried(truth, twin))
    assert np.median(off) < 30 and fit.mirrored is None  # millimetres
    assert any("millimetres" in note for note in fit.notes)
    assert "x axis negated the twin fits" in Twin(rooms.carried(MIRROR, twin)).fit(target, quiet).mirrored


@pytest.mark.parametrize("points, why", [(np.zeros((5, 3)), "5 usable points"), (np.ones((200, 3)), "are one")])
def test_a_twin_that_is_none_is_refused(points, why):
    with pytest.raises(NergError, match=why):
        Twin(points).fit(Target(points=PLACE), quiet)
