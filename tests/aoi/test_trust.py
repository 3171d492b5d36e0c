"""Support and the spread of an ensemble, from foretold numbers that are known."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.measured import Eyes
from nerg_mi.aoi.predicted import Foretold, add_trust, support_of, tell_places, tell_support
from nerg_mi.statistics.tables import PLACES
from nerg_mi.statistics.visits import ALL, Cell
from tests.workflows.recorder import Recorder

ZONE = Cell("zone", "z")
EYES = Eyes(
    np.zeros((3, 3)),
    np.ones((3, 3)),
    ("Ada", "Ada", "Bo"),
    (frozenset([ALL]), frozenset([ALL, ZONE]), frozenset([ALL])),
)
TIMES = {ALL: {"Ada": 2.0, "Bo": 6.0}, ZONE: {"Ada": 1.0}}


def foretold(*members, support=(1.0, 8.0, 3.0)):
    each = np.array(members, float)[:, :, None]
    return Foretold(each.mean(axis=0), each.mean(axis=0), each.mean(axis=0) > 0, np.array(support), each)


def rows():
    both = [{"cell": "all", "value": ""}, {"cell": "zone", "value": "z"}]
    made = [c | {"thing": "a", "source": s, "people": 2} for c in both for s in ("tracked", "field")]
    return [row | {"share": 0.1, "dwell": 1.0, "reach": 0.5} for row in made]


def test01_spread_and_support_of_each_cell():
    found = rows()
    add_trust(found, foretold([0.1, 0.3, 0.4], [0.2, 0.2, 0.2]), EYES, TIMES, 0.3)
    tracked, field, _, zone = found
    assert tracked["support"] is tracked["share_spread"] is None
    assert field["support"] == 3 and zone["support"] == 8
    assert (field["places"], zone["places"], tracked["places"]) == (1.5, 1.0, None)
    # Ada's mean and Bo's, of the first member 0.3 over both, of the second 0.2.
    assert field["share_spread"] == pytest.approx(0.1 / np.sqrt(2))
    assert field["dwell_spread"] == pytest.approx((0.2 * 2 + 0.4 * 6 - 0.2 * 2 - 0.2 * 6) / 2 / np.sqrt(2))
    assert zone["share_spread"] == pytest.approx(0.1 / np.sqrt(2)) and 0 < zone["reach_spread"] < 1


def test02_nothing_of_one_field_or_what_is_blank():
    found = rows()
    add_trust(found, foretold([0.1, 0.3, 0.4]), EYES, TIMES, 0.3)
    assert all(row["share_spread"] is None for row in found)
    blank = [row | {"people": None, "share": None} for row in rows()]
    add_trust(blank, foretold([0.1, 0.3, 0.4], [0.2, 0.2, 0.2]), EYES, TIMES, 0.3)
    assert all(row["share_spread"] is row["support"] is None for row in blank)
    assert blank[1]["dwell_spread"] is not None


def test03_a_checkpoint_without_support_is_told_of():
    told = Recorder()
    tell_support(foretold([0.1, 0.3, 0.4]), told)
    assert told.messages == []
    none = foretold([0.1, 0.3, 0.4], support=(np.nan,) * 3)
    assert support_of(none) is None and support_of(foretold([1, 1, 1]), np.zeros(3, bool)) is None
    tell_support(none, told)
    assert "keeps no support" in told.messages[0] and "nerg train gaze" in told.messages[0]


def test_few_places_a_person_are_told():
    told = Recorder()
    tell_places(EYES, told)
    assert len(told.messages) == 1 and "1.5 places a person" in told.messages[0] and "--eyes 32 " in told.messages[0]
    count = 2 * PLACES
    many = Eyes(np.zeros((count, 3)), np.ones((count, 3)), ("Ada", "Bo") * PLACES, (frozenset([ALL]),) * count)
    tell_places(many, told)
    tell_places(Eyes(np.zeros((0, 3)), np.zeros((0, 3)), (), ()), told)
    assert len(told.messages) == 1
