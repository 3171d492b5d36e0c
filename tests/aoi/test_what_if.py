"""The table of a change, from foretold numbers that are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.predicted import Foretold, Setting, places_of, what_if_rows
from nerg_mi.aoi.scene import Surroundings, things_of
from nerg_mi.formats.areas import Areas, Region
from nerg_mi.maths.geometry import Similarity
from nerg_mi.statistics.tables import Floor

AREAS = Areas((Region.of("a", [0, 0, 0], [1, 1, 1]), Region.of("b", [2, 0, 0], [3, 1, 1])))
EYES = places_of(np.arange(15.0).reshape(5, 3))


def told(share, support=5.0, members=1):
    """Of an ensemble the members differ by 0.1 times their number from the first, at the first eye."""
    share = np.asarray(share, float)
    each = np.stack([share + 0.1 * k * (np.arange(len(share)) == 0)[:, None] for k in range(members)])
    return Foretold(share, share, share > 0, np.full(len(share), support), each)


def rows(tmp_path, changes, after, floor=None, members=1):
    (tmp_path / "c.json").write_text(json.dumps(changes))
    asked = []

    def foretell(there, eyes):
        asked.append((eyes, there.areas, there.things))
        return after

    before = told([[0.1, 0], [0.2, 0], [0.1, 0], [0.2, 0], [0.15, 0]], members=members)
    around, things = Surroundings(None, None, Similarity()), things_of(AREAS.things, {})
    setting = Setting(around, AREAS, things, StatisticsOptions())
    found = what_if_rows(tmp_path / "c.json", setting, EYES, before, foretell, floor or Floor(), 199, 0)
    return {(r["thing"], r["measure"]): r for r in found}, asked[0]


def test01_the_same_people_are_compared_with_themselves(tmp_path):
    after = told([[0.2, 0.1], [0.3, 0.1], [0.21, 0.1], [0.29, 0.1], [0.25, 0.1]])
    found, (eyes, areas, things) = rows(tmp_path, {"move": [{"area": "a", "by": [5, 0, 0]}]}, after)
    share = found["a", "share"]
    assert share["before"] == pytest.approx(0.15) and share["after"] == pytest.approx(0.25)
    assert share["difference"] == pytest.approx(0.1) and 0.08 < share["low"] < 0.1 < share["high"] < 0.12
    assert share["support"] == 5 and share["source"] == "field" and share["people"] == 5
    assert found["b", "visible"]["after"] == 1 and found["b", "visible"]["before"] == 0
    assert areas.boxes[0].lower[0] == 5 and eyes is EYES and len(things) == 2


def test02_other_observers_are_other_people(tmp_path):
    after = told([[0.5, 0.5]] * 2)
    found, (eyes, *_) = rows(tmp_path, {"observers": [[9, 9, 9], [8, 8, 8]], "shift": [0, 0, 1]}, after)
    assert eyes.positions.tolist() == [[9, 9, 10], [8, 8, 9]]
    assert found["a", "share"]["after"] == 0.5 and found["a", "share"]["before"] == pytest.approx(0.15)


def test03_a_floor_on_people(tmp_path):
    floor = Floor(9)
    found, _ = rows(tmp_path, {"shift": [0, 0, 1]}, told([[0.2, 0.1]] * 5), floor)
    assert all(r["before"] is None and r["difference"] is None for r in found.values()) and floor.blanked == 4


def test04_members_of_an_ensemble(tmp_path):
    after = told([[0.2, 0.1]] * 5, members=2)
    found, _ = rows(tmp_path, {"shift": [0, 0, 1]}, after, members=2)
    # Both move alike, of which the mean says nothing; then only one of them.
    assert found["a", "share"]["difference_spread"] == pytest.approx(0, abs=1e-12)
    assert found["a", "visible"]["difference_spread"] is None
    found, _ = rows(tmp_path, {"shift": [0, 0, 1]}, replace(after, members=after.members[[0, 0]]), members=2)
    assert found["a", "share"]["difference_spread"] == pytest.approx(0.1 / 5 / np.sqrt(2))
    assert rows(tmp_path, {"shift": [0, 0, 1]}, told([[0.2, 0.1]] * 5))[0]["a", "share"]["difference_spread"] is None


def test05_no_support(tmp_path):
    found, _ = rows(tmp_path, {"shift": [0, 0, 1]}, told([[0.2, 0.1]] * 5, np.nan))
    assert all(row["support"] is None for row in found.values())
