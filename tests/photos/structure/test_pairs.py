"""Which pictures are compared."""

from __future__ import annotations

import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos.structure import EXHAUSTIVE, chosen_pairs


def test_few_are_all_compared():
    assert chosen_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert len(chosen_pairs(EXHAUSTIVE)) == EXHAUSTIVE * (EXHAUSTIVE - 1) // 2
    assert chosen_pairs(4, "exhaustive") == chosen_pairs(4) and chosen_pairs(0) == []


def test_many_are_compared_with_neighbours_and_landmarks():
    pairs = chosen_pairs(600)
    assert pairs == sorted(set(pairs)) and all(0 <= i < j < 600 for i, j in pairs)
    assert {(5, 6), (5, 15), (5, 21), (5, 37), (0, 590)} <= set(pairs) and (5, 16) not in pairs
    # The work grows with their number, and not with its square.
    assert len(pairs) < 600 * 16 + 60 * 60 and len(chosen_pairs(4000)) < 4000 * 19 + 60 * 60


def test_all_of_many_where_it_is_asked_for():
    assert len(chosen_pairs(150, "exhaustive")) == 150 * 149 // 2 > len(chosen_pairs(150, "sequential"))
    with pytest.raises(NergError, match="matching must be auto"):
        chosen_pairs(4, "vocabulary")
