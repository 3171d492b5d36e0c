"""What an area can be, and how groups resolve."""

from __future__ import annotations

import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Areas, Group, Region

A, B = Region.of("a", [0, 0, 0], [1, 1, 1]), Region.of("b", [2, 0, 0], [3, 1, 1])


def test01_members_count_once():
    areas = Areas((Group("all", ("pair", "a")), A, B, Group("pair", ("a", "b"))))
    assert areas.members() == {"all": (0, 1), "a": (0,), "b": (1,), "pair": (0, 1)}
    assert areas.things == (A, B) and areas.names == ("all", "a", "b", "pair")


def test02_two_of_one_name():
    with pytest.raises(NergError, match='two areas are called "a"'):
        Areas((A, A))


def test03_many_groups_of_groups_are_resolved_at_once():
    # Each of the two holds all that came before: without care, two to the power of their number of ways.
    groups = [Group("g0", ("a", "b"))] + [Group(f"g{k}", (f"g{k - 1}", "a")) for k in range(1, 7)]
    assert Areas((A, B, *groups)).members()["g6"] == (0, 1)
