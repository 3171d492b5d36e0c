"""What a field foretells, against sums over directions that are written out."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.measured import Eyes
from nerg_mi.aoi.predicted import eyes_of_some, foretell, foretold_people
from nerg_mi.aoi.scene import Surroundings
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import Similarity
from nerg_mi.statistics.visits import ALL, Box, Cell
from nerg_mi.workflows.base import SILENT
from tests.workflows.recorder import Recorder


class Law(Surroundings):
    """A gaze that is known: twice as dense ahead (x > 0) as behind, and seven units of support."""

    def look_from(self, eye):
        return lambda d: (np.where(d[:, 0] > 0, 2.0, 1.0)[None], None)

    def support(self, eye):
        return 7.0


AROUND = Law(None, None, Similarity())
EYES = Eyes(
    np.array([[0.0, 0, 0], [0, 0, 0.2], [0, 0, 0]]),
    np.tile([1.0, 0, 0], (3, 1)),
    ("Ada", "Ada", "Bo"),
    (frozenset([ALL]), frozenset([ALL]), frozenset([ALL, Cell("zone", "z")])),
)


def test01_shares_are_integrals():
    # A cube of which the eye sees a face of 2 x 2 at x = 1: a sixth of the sphere; of the hemisphere's gaze 2/3.
    things = [Box(Region.of("ahead", [1, -1, -1], [2, 1, 1])), Box(Region.of("behind", [-2, -1, -1], [-1, 1, 1]))]
    found = foretell(AROUND, EYES, things, [(0,), (1,), (0, 1)], 0.0, 120.0, 24, 1 << 15, SILENT)
    assert np.allclose(found.share[0], [2 / 9, 1 / 9, 3 / 9], rtol=2e-3)
    # The mean distance to a square face, over its solid angle, by quadrature in its plane.
    u = (np.arange(400) + 0.5) / 200 - 1
    y, z = np.meshgrid(u, u)
    r2 = 1 + y**2 + z**2
    mean = (r2**-1.5 * np.sqrt(r2)).sum() / (r2**-1.5).sum()
    assert found.distance[0, 0] / found.share[0, 0] == pytest.approx(mean, rel=2e-3)
    assert found.visible.tolist() == [[True, False, True]] * 3 and found.support.tolist() == [7, 7, 7]


def test02_people():
    things = [Box(Region.of("ahead", [1, -1, -1], [2, 1, 1]))]
    found = foretell(AROUND, EYES, things, [(0,)], 0.0, 120.0, 24, 4096, SILENT)
    people = foretold_people(found, EYES, ALL, {"Ada": 3.0, "Bo": 6.0}, 0.3)
    assert people.names == ("Ada", "Bo")
    share = found.share[:2].mean(axis=0)
    assert people.on_time[0] == pytest.approx(3 * share)
    # Ten glances, five from each place.
    missed = np.prod([(1 - s) ** 5 for s in found.share[:2, 0]])
    assert people.reached[0, 0] == pytest.approx(1 - missed)
    (bo,) = foretold_people(found, EYES, Cell("zone", "z"), {"Bo": 6.0}, 0.3).names
    assert bo == "Bo" and foretold_people(found, EYES, Cell("zone", "other"), {"Bo": 6.0}, 0.3) is None


class Two(Law):
    """Two members who look to opposite sides, ten times as long at one as at the other."""

    def look_from(self, eye):
        return lambda d: (np.array([np.where(s * d[:, 0] > 0, 10.0, 1.0) for s in (1, -1)]), None)


def test03_members_of_an_ensemble():
    things = [Box(Region.of("ahead", [1, -1, -1], [2, 1, 1])), Box(Region.of("behind", [-2, -1, -1], [-1, 1, 1]))]
    found = foretell(Two(None, None, Similarity()), EYES, things, [(0,), (1,)], 0.0, 120.0, 24, 1 << 15, SILENT)
    # A sixth of the sphere each: evenly of both, and 10/11 or 1/11 of a hemisphere's third by one.
    assert found.members.shape == (2, 3, 2) and np.allclose(found.share[0], 1 / 6, rtol=3e-3)
    assert np.allclose(found.members[:, 0], [[10 / 33, 1 / 33], [1 / 33, 10 / 33]], rtol=3e-3)
    assert foretell(AROUND, EYES, things, [(0,), (1,)], 0.0, 120.0, 24, 64, SILENT).members.shape == (1, 3, 2)


def test04_of_very_many_people_some_are_asked():
    names = tuple(f"{k // 2:04d}" for k in range(400))
    many = Eyes(np.arange(1200.0).reshape(400, 3), np.ones((400, 3)), names, (frozenset([ALL]),) * 400)
    told = Recorder()
    some = eyes_of_some(many, 50, told)
    assert len(set(some.person)) == 50 and len(some.person) == 100 and len(some.positions) == len(some.cells) == 100
    assert all((some.positions[k] == many.positions[names.index(n) + k % 2]).all() for k, n in enumerate(some.person))
    back = np.arange(400)[::-1]
    turned = eyes_of_some(Eyes(many.positions[back], many.ahead, names[::-1], many.cells), 50, SILENT)
    assert set(turned.person) == set(some.person) and eyes_of_some(many, 200, SILENT) is many
    assert "50 of 200 people" in told.messages[0]
