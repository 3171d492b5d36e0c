"""Shares of gaze on areas, of a law in a hall whose depths are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.maths.sphere import fibonacci_directions, numbers_in_cone
from nerg_mi.statistics.shares import FIRST, SumRule, gaze_shares
from nerg_mi.statistics.visits import Box, land

LOW, HIGH = np.array([-2.0, -6.0, 0.0]), np.array([2.0, 6.0, 3.0])
AHEAD = np.array([0.6, 0.8, 0.0])
EYES = np.array([[0.3, -2.0, 1.6], [-1.0, 4.0, 1.5]])
BOXES = [
    Region.of("wall", (1.9, -3, 0), (2.1, 1, 2)),
    Region.of("a spot on it", (1.9, -0.01, 1), (2.1, 0.02, 1.03)),
    Region.of("corner", (1, 5, -0.1), (2.1, 6.1, 0.7), 10),
    Region.of("air", (0.5, 1, 1), (0.7, 1.2, 1.3)),
]


class Hall:
    """Observers who look ahead, mostly; ``asked``: in how many directions each look was."""

    def __init__(self):
        self.asked: list[int] = []

    def look_from(self, eye):
        def look(d):
            self.asked.append(len(d))
            with np.errstate(divide="ignore"):
                far = np.where(d > 0, (HIGH - eye) / d, np.where(d < 0, (LOW - eye) / d, np.inf)).min(axis=1)
            # The roof is open.
            far = np.where(eye[2] + far * d[:, 2] > 2.999, np.inf, far)
            return np.exp(4 * (d @ AHEAD - 1))[None], far

        return look


def exact(eye, region=None):
    """The integral of the gaze on a box, or of what escapes, and over everything, by sums over very many directions."""
    count, numbers = 1 << 18, None
    if region is not None:
        center, radius = Box(region).ball
        away = center - eye
        # A few hundred thousand on the box, however small.
        count = 1 << 23 if radius < 0.2 else count
        numbers = numbers_in_cone(count, away / np.linalg.norm(away), np.arcsin(min(radius / np.linalg.norm(away), 1)))
    d = fibonacci_directions(count, numbers)
    (gaze,), depth = Hall().look_from(eye)(d)
    if region is None:
        return gaze[~np.isfinite(depth)].sum() / gaze.sum(), gaze.mean()
    return gaze[land([Box(region)], np.broadcast_to(eye, d.shape), d, depth).rows[0]].sum() / count


@pytest.fixture(scope="module")
def found():
    hall = Hall()
    members = [(0,), (1,), (2,), (3,), (0, 1, 2)]
    return hall, gaze_shares(hall.look_from, EYES, [Box(r) for r in BOXES], members, 0.0)


def test01_shares_are_integrals_and_errors_are_kept(found):
    hall, shares = found
    for e, eye in enumerate(EYES):
        escaped, whole = exact(eye)
        for k, region in enumerate(BOXES):
            share = exact(eye, region) / whole
            assert abs(shares.share[e, k] - share) <= 1.5 * shares.error[e, k] + 1e-6 and share < 1
            assert shares.error[e, k] < 0.02 * share + 2e-5
            assert shares.seen[e, k] == (share > 0)
        assert shares.escaped[e] == pytest.approx(escaped, rel=0.01)
    # A group is the union: the spot lies on the wall.
    assert np.allclose(shares.share[:, 4], shares.share[:, 0] + shares.share[:, 2], rtol=0.02)
    # The spot, of 3 cm at up to six metres, took no more than what the whole sphere takes.
    assert 0 < shares.share[1, 1] < 1e-4 and sum(hall.asked) < 2 * 6 * FIRST


def test02_each_eye_is_by_itself(found):
    _, shares = found
    alone = gaze_shares(Hall().look_from, EYES[1:], [Box(BOXES[0])], [(0,)], 0.0)
    assert alone.share[0, 0] == shares.share[1, 0] and alone.error[0, 0] == shares.error[1, 0]
    many = gaze_shares(Hall().look_from, np.tile(EYES, (20, 1)), [Box(BOXES[0])], [(0,)], 0.0)
    assert np.array_equal(many.share[:, 0], np.tile(shares.share[:, 0], 20))


def test03_a_closer_tolerance_takes_more_directions():
    errors, asked = [], []
    for tolerance in (0.1, 0.01, 0.001):
        hall = Hall()
        shares = gaze_shares(hall.look_from, EYES[:1], [Box(BOXES[0])], [(0,)], 0.0, SumRule(tolerance=tolerance))
        errors.append(shares.error[0, 0])
        asked.append(sum(hall.asked))
    assert errors[0] > errors[2] and asked[0] < asked[2] < 1 << 19


def test04_without_areas_eyes_or_gaze():
    shares = gaze_shares(Hall().look_from, EYES, [], [], 0.0)
    assert shares.share.shape == (2, 0) and (shares.whole > 0).all()
    assert gaze_shares(Hall().look_from, EYES[:0], [Box(BOXES[0])], [(0,)], 0.0).share.shape == (0, 1)
    dark = lambda eye: lambda d: (np.zeros((1, len(d))), np.ones(len(d)))
    assert gaze_shares(dark, EYES[:1], [Box(BOXES[0])], [(0,)], 0.0).share.tolist() == [[0.0]]
    broken = lambda eye: lambda d: (np.full((1, len(d)), np.nan), np.ones(len(d)))
    with pytest.raises(NergError, match="0.3.*2.0.*1.6"):
        gaze_shares(broken, EYES[:1], [Box(BOXES[0])], [(0,)], 0.0)
