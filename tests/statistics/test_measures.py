"""The numbers that are told, from sums that are written out."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.statistics.tables import BY_NAME, MEASURES, People

# Three people, two things: Ada looks at the first alone, Bo at both, Cy at none and has no time.
PEOPLE = People(
    ("Ada", "Bo", "Cy"),
    np.array([10.0, 20.0, 0.0]),
    on_time=np.array([[2.0, 0], [4, 1], [0, 0]]),
    distance=np.array([[6.0, 0], [4, 3], [0, 0]]),
    visible=np.array([[5.0, 1], [4, 2], [0, 0]]),
    reached=np.array([[1.0, 0], [1, 1], [0, 0]]),
    looks=np.array([[3.0, 0], [1, 1], [0, 0]]),
    first_sum=np.array([[4.0, 0], [6, 8], [0, 0]]),
    first_count=np.array([[2.0, 0], [1, 1], [0, 0]]),
)

EXPECTED = {
    "share": ([(0.2 + 0.2) / 2, (0 + 0.05) / 2], [2, 2]),
    "dwell": ([6 / 3, 1 / 3], [3, 3]),
    "reach": ([2 / 3, 1 / 3], [3, 3]),
    "first_look": ([(2 + 6) / 2, 8], [2, 1]),
    "looks": ([4 / 3, 1 / 3], [3, 3]),
    "returns": ([(2 + 0) / 2, 0], [2, 1]),
    "distance": ([10 / 6, 3], [2, 1]),
    "visible": ([(0.5 + 0.2) / 2, (0.1 + 0.1) / 2], [2, 2]),
    "given_visible": ([6 / 9, 1 / 3], [2, 2]),
    "unseen": ([0, 1 / 2], [2, 2]),
}


def test01_every_measure_is_written_out_here():
    assert set(EXPECTED) == {m.name for m in MEASURES} == set(BY_NAME)


@pytest.mark.parametrize("name", list(EXPECTED))
def test02_values_and_people(name):
    found = BY_NAME[name].estimate(PEOPLE, 199, 0)
    assert found.value == pytest.approx(EXPECTED[name][0]) and found.people.tolist() == EXPECTED[name][1]


def test03_a_field_tells_less():
    told = People(PEOPLE.names, PEOPLE.time, PEOPLE.on_time, PEOPLE.distance, None, np.full((3, 2), 0.5))
    known = {m.name for m in MEASURES if m.estimate(told, 199, 0) is not None}
    assert known == {"share", "dwell", "reach", "distance"}
    assert BY_NAME["reach"].estimate(told, 199, 0).value == pytest.approx([0.5, 0.5])


def test04_those_who_are_not_there_count_for_nothing():
    more = PEOPLE.aligned(["Ada", "Bo", "Cy", "Dee", "Eve"])
    assert more.there.tolist() == [True, True, True, False, False]
    for measure in MEASURES:
        a, b = measure.estimate(PEOPLE, 199, 0), measure.estimate(more, 199, 0)
        assert np.allclose(a.value, b.value, equal_nan=True) and a.people.tolist() == b.people.tolist(), measure.name


def test05_nobody():
    none = People((), np.zeros(0), *(np.zeros((0, 2)) for _ in range(7)))
    for measure in MEASURES:
        found = measure.estimate(none, 199, 0)
        assert np.isnan(found.value).all() and found.people.tolist() == [0, 0]
