"""Tables of numbers, and the floor on people."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.statistics.tables import (
    BY_NAME,
    TRACKED,
    Floor,
    People,
    difference_rows,
    duration_rows,
    move_rows,
    shown,
    thing_rows,
)
from nerg_mi.statistics.visits import ALL, BINS, Cell, Sums

A, B = Cell("cohort", "a"), Cell("cohort", "b")
HOW = {"resamples": 299, "seed": 0}


def people(n, share, seed, prefix="p"):
    rng = np.random.default_rng(seed)
    time = np.full(n, 100.0)
    on = 100 * np.clip(rng.normal(share, 0.03, (n, 2)), 0, 1)
    looks = np.round(on / 2)
    names = tuple(f"{prefix}{k:02d}" for k in range(n))
    return People(names, time, on, on * 2, None, (looks > 0) * 1.0, looks, on, looks)


def test01_a_row_for_each_cell_thing_and_source():
    cells = {ALL: {TRACKED: people(12, 0.2, 0)}, A: {TRACKED: people(2, 0.2, 1)}}
    rows = thing_rows(("x", "y"), cells, Floor(), **HOW)
    assert [(r["cell"], r["value"], r["thing"]) for r in rows] == [
        ("all", "", "x"),
        ("all", "", "y"),
        ("cohort", "a", "x"),
        ("cohort", "a", "y"),
    ]
    mean = (cells[ALL][TRACKED].on_time[:, 0] / 100).mean()
    assert rows[0]["share"] == pytest.approx(mean) and rows[0]["share_low"] < mean < rows[0]["share_high"]
    assert rows[0]["visible"] is None and rows[0]["people"] == 12
    # Of two people there is no interval.
    assert rows[2]["share"] is not None and rows[2]["share_low"] is None


def test02_cells_of_few_people_are_blank_and_counted():
    floor = Floor(5)
    cells = {ALL: {TRACKED: people(12, 0.2, 0)}, A: {TRACKED: people(4, 0.2, 1)}}
    rows = thing_rows(("x", "y"), cells, floor, **HOW)
    assert rows[0]["share"] is not None
    blank = [k for k, v in rows[2].items() if v is not None]
    assert blank == ["cell", "value", "thing", "source"]
    # Of both things: the number of people, and the seven measures that rays tell.
    assert floor.blanked == 2 * (1 + 7)
    nobody = Floor(5)
    assert nobody.passes(0) and nobody.passes(5) and not nobody.passes(4) and nobody.blanked == 1


def test03_differences_are_found_where_they_are():
    cells = {A: {TRACKED: people(15, 0.2, 0, "a")}, B: {TRACKED: people(15, 0.4, 1, "b")}}
    rows = difference_rows(("x", "y"), cells, Floor(), compared=("share", "reach"), **HOW)
    shares = [r for r in rows if r["measure"] == "share"]
    assert len(rows) == 4 and all(r["found"] and 0.1 < r["low"] < r["difference"] < r["high"] < 0.3 for r in shares)
    assert not any(r["found"] for r in rows if r["measure"] == "reach")
    assert all(r["p_adjusted"] >= r["p"] for r in rows)
    assert (rows[0]["first"], rows[0]["second"]) == ("a", "b")
    blank = difference_rows(("x", "y"), cells, Floor(16), compared=("share",), **HOW)
    assert all(r["difference"] is None and r["p"] is None and not r["found"] for r in blank)


def test04_one_value_has_nothing_to_be_compared_with():
    assert difference_rows(("x", "y"), {ALL: {TRACKED: people(5, 0.2, 0)}}, Floor(), **HOW) == []


def sums():
    found = Sums.empty(("x", "y"), (ALL,), [(ALL, "Bo"), (ALL, "Ada")])
    found.time[:] = 10, 20
    found.rays[:] = 50, 100
    found.on_time[:] = [[1, 2], [3, 0]]
    found.looks[:] = [[1, 1], [2, 0]]
    found.first_sum[:], found.first_count[:] = [[4, 6], [1, 0]], [[1, 2], [1, 0]]
    found.moves[0] = [[0, 3], [1, 0]]
    found.lasted[0, 0, 2] = 3
    return found


def test05_moves_and_durations():
    rows = move_rows(sums(), Floor())
    assert [(r["from"], r["to"], r["moves"], r["share"]) for r in rows] == [("x", "y", 3, 1.0), ("y", "x", 1, 1.0)]
    assert all(r["moves"] is None for r in move_rows(sums(), Floor(3)))
    lasted = duration_rows(sums(), Floor())
    assert len(lasted) == 2 and lasted[0]["0.2 to 0.5 s"] == 3 and len(lasted[0]) == 3 + len(BINS) - 1


def test06_as_markdown_has_it():
    row = {"share": 0.1234, "share_low": 0.1, "share_high": 0.2, "dwell": 3.456, "dwell_low": None, "dwell_high": None}
    assert shown(row, BY_NAME["share"]) == "12.3 % [10.0, 20.0]" and shown(row, BY_NAME["dwell"]) == "3.46"
    assert shown(row, BY_NAME["reach"]) == ""


def test09_nobody_is_compared_with_nobody():
    cells = {A: {TRACKED: people(15, 0.2, 0, "a")}, B: {TRACKED: people(0, 0.4, 1, "b")}}
    assert difference_rows(("x", "y"), cells, Floor(), **HOW) == []
