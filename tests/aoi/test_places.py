"""Places on the floor where nobody was tracked."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.aoi.predicted import isovist_rows, look_around, places_of
from nerg_mi.aoi.scene import surroundings_of_files
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.statistics.visibility import Targets, isovists
from nerg_mi.statistics.visits import Box

from .place import SIGN, write_place


def test01_on_the_floor_of_a_room(tmp_path):
    around = surroundings_of_files(write_place(tmp_path, gaze=False), None, None, None, ns)
    found = look_around(around, 1.6, 0.25, 0.0)
    inside = ((found[:, :2] > (2.5, 1.0)) & (found[:, :2] < (2.9, 2.0))).all(axis=1)
    assert 330 < len(found) < 24 * 16 and not inside.any() and np.allclose(found[:, 2], 1.6)
    with pytest.raises(NergError, match="--floor"):
        look_around(around, 1.6, 0.25, -2.0)
    rows = isovist_rows(
        isovists(found[:4], around.depth, Targets.of([Box(Region.of("s", *SIGN))], 24), 0.01, 9.0),
        ("s", "g"),
        [(0,), (0,)],
    )
    assert len(rows) == 4 and rows[0]["sees s"] == rows[0]["sees g"] and 0 < rows[0]["area"] < 24.1


def test02_observers_have_names():
    eyes = places_of(np.zeros((12, 3)))
    assert eyes.person[0] == "observer 01" and len(set(eyes.person)) == 12
