"""The table of single people."""

from __future__ import annotations

import pytest

from nerg_mi.statistics.tables import PersonRows
from nerg_mi.statistics.visits import ALL, Cell, Sums


def sums():
    found = Sums.empty(("x", "y"), (ALL, Cell("zone", "z")), [(ALL, "Bo"), (Cell("zone", "z"), "Bo"), (ALL, "Ada")])
    found.time[:] = 10, 5, 20
    found.rays[:] = 50, 25, 100
    found.on_time[:] = [[1, 2], [9, 9], [3, 0]]
    found.looks[:] = [[1, 1], [1, 1], [2, 0]]
    found.visible[:] = [[4, 5], [9, 9], [6, 7]]
    found.first_sum[:], found.first_count[:] = [[4, 6], [0, 0], [1, 0]], [[1, 2], [1, 1], [1, 0]]
    return found


def test01_each_persons_own_in_the_order_of_their_names():
    rows = PersonRows(sums(), {"Ada": "p2", "Bo": "p1"}, True)
    assert len(rows) == 4 and list(rows) == rows[:] == [rows[k] for k in range(-4, 0)]
    assert [(r["person"], r["thing"]) for r in rows] == [("p1", "x"), ("p1", "y"), ("p2", "x"), ("p2", "y")]
    bo = {"person": "p1", "thing": "y", "time": 10.0, "rays": 50, "dwell": 2.0, "looks": 1, "first_look": 3.0}
    assert rows[1] == bo | {"visible": 5.0} and tuple(rows[1]) == rows.columns
    assert rows[3]["first_look"] is None and rows[2]["first_look"] == 1.0
    with pytest.raises(IndexError):
        rows[4]


def test02_nobody_knows_what_was_visible():
    assert [r["visible"] for r in PersonRows(sums(), {"Ada": "a", "Bo": "b"}, False)] == [None] * 4
