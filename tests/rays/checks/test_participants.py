"""Participants who are rows."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays.rays import FRAME

from .people import walk, warnings_of


@pytest.mark.parametrize("of_each, is_counter", [(1, True), (2, True), (10, False), (6000, False)])
def test_one_participant_a_row(of_each, is_counter):
    rays = walk(hit=False)
    person = np.arange(len(rays)) // of_each
    rays = replace(rays, person=person, persons=tuple(map(str, range(person.max() + 1))))
    assert ("does their column count rows" in warnings_of(rays)) == is_counter
    thinned = replace(rays, metadata={"frame": dict(FRAME), "steps": [{"step": "thin", "kept": 6000, "of": 9000}]})
    assert "does their column" not in warnings_of(thinned)
