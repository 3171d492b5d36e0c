"""What need not be read: never what holds a ray that is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.dataset import EVERYTHING, Conditions, bucket_of

from .test_manifest import PART
from .test_writing import crowd


@pytest.mark.parametrize(
    "given, holds",
    [
        ({}, True),
        ({"time": (1.0, None)}, True),  # its last
        ({"time": (1.1, None)}, False),
        ({"time": (None, 0.0)}, False),  # its first is at the end, which is not meant any more
        ({"time": (-5, 0.1)}, True),
        ({"box": [1, 2, 1, 2, 1, 2]}, True),  # touches it
        ({"box": [1.01, 2, 0, 2, 0, 2]}, False),
        ({"box": [-2, -0.1, 0, 2, 0, 2]}, False),
        ({"with_hit": True}, True),
        ({"min_confidence": 0.9}, True),
    ],
)
def test_parts_by_their_account(given, holds):
    assert Conditions(**given).may_hold(PART, 16) is holds
    bounds = {"t": (0.0, 1.0), **{f"origin_{axis}": (0.0, 1.0) for axis in "xyz"}}
    assert Conditions(**given).may_hold_group(bounds) is holds and Conditions(**given).may_hold_group({})


def test_parts_by_people():
    name = next(f"ab{k}" for k in range(1000) if bucket_of(f"ab{k}", 16) == PART.bucket)
    assert Conditions(persons=[name, "zoe"]).may_hold(PART, 16)  # between its first, a, and its last, b
    other = next(f"ab{k}" for k in range(1000) if bucket_of(f"ab{k}", 16) != PART.bucket)
    assert not Conditions(persons=[other]).may_hold(PART, 16)
    assert Conditions(persons=["bo"]).may_hold_group({"person": ("ann", "bo")})
    assert not Conditions(persons=["c", "a"]).may_hold_group({"person": ("ann", "bo")})


def test_rays_of_a_block():
    rays = crowd()
    kept = Conditions(persons=["ann", "somebody else"], time=(10, 20)).select(rays)
    assert set(kept.person) == {rays.persons.index("ann")} and kept.t.min() >= 10 and kept.t.max() < 20
    mask = (rays.person == rays.persons.index("ann")) & (rays.t >= 10) & (rays.t < 20)
    assert np.array_equal(kept.t, rays.t[mask])
    assert len(Conditions(without_persons=["nobody"]).select(rays)) == len(rays)
    assert len(Conditions(cohorts=["x"]).select(rays)) == 0
    assert EVERYTHING.select(rays) is rays and not EVERYTHING.any and Conditions(with_hit=True).any


def test_a_box_that_is_none():
    with pytest.raises(NergError, match="a box is"):
        Conditions(box=[0, 1]).check()
