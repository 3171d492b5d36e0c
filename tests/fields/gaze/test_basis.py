"""What a field rests on, in words, and as a checkpoint has it."""

from __future__ import annotations

import pytest

from nerg_mi.fields.gaze_base import Basis, basis_of


@pytest.mark.parametrize(
    ("basis", "words"),
    [
        (Basis(81_751, 100), "81,751 rays of 100 people"),
        (Basis(1, 1), "1 ray of 1 person"),
        (Basis(300), "300 rays"),
        (Basis(300, 3, 1), "300 rays of 3 people and 1 salience image"),
        (Basis(0, None, 12), "12 salience images"),
        (Basis(0), ""),
    ],
)
def test_words(basis, words):
    assert basis.words() == words


def test_of_a_checkpoint():
    assert basis_of({"rays": 5, "people": 2, "salience_views": 0}) == Basis(5, 2)
    # Checkpoints of earlier versions do not count people, and those of views have no rays.
    assert basis_of({"rays": 5}) == Basis(5)
    assert basis_of({"rays": 0, "people": 0, "salience_views": 3}) == Basis(0, None, 3)
    assert basis_of({"made": "random"}) is None


@pytest.mark.parametrize("value", [-1, 1e300, "5", [5], True, None, 1 << 70, float("nan")])
def test_what_is_no_count_is_not_shown(value):
    assert basis_of({"rays": value}) is None and basis_of({"rays": 7, "people": value}) == Basis(7)
