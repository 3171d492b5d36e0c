"""Tests of `nerg_mi.aoi.tables`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.tables import (
    MEASURED,
    MEASURES,
    MEASURES_BY_NAME,
    PREDICTED,
    MinParticipantsFilter,
    ParticipantRows,
    Participants,
    aoi_rows,
    difference_rows,
    duration_rows,
    format_measure,
    transition_rows,
)
from nerg_mi.aoi.visits import ALL, BINS, Cell, VisitSums
from tests.notes import find_wrong_notes

# ---- Measures ----


# Three participants, two AOIs: Ada looks at the first only, Bo at both, Cy at none and has no recorded time.
PEOPLE = Participants(
    ("Ada", "Bo", "Cy"),
    np.array([10.0, 20.0, 0.0]),
    dwell_time=np.array([[2.0, 0], [4, 1], [0, 0]]),
    distance=np.array([[6.0, 0], [4, 3], [0, 0]]),
    visible_time=np.array([[5.0, 1], [4, 2], [0, 0]]),
    hit_probability=np.array([[1.0, 0], [1, 1], [0, 0]]),
    visits=np.array([[3.0, 0], [1, 1], [0, 0]]),
    first_visit_sum=np.array([[4.0, 0], [6, 8], [0, 0]]),
    first_visit_count=np.array([[2.0, 0], [1, 1], [0, 0]]),
)

EXPECTED = {
    "share": ([(0.2 + 0.2) / 2, (0 + 0.05) / 2], [2, 2]),
    "dwell": ([6 / 3, 1 / 3], [3, 3]),
    "hit_ratio": ([2 / 3, 1 / 3], [3, 3]),
    "time_to_first_visit": ([(2 + 6) / 2, 8], [2, 1]),
    "visits": ([4 / 3, 1 / 3], [3, 3]),
    "revisits": ([(2 + 0) / 2, 0], [2, 1]),
    "distance": ([10 / 6, 3], [2, 1]),
    "visible": ([(0.5 + 0.2) / 2, (0.1 + 0.1) / 2], [2, 2]),
    "share_when_visible": ([6 / 9, 1 / 3], [2, 2]),
    "unseen": ([0, 1 / 2], [2, 2]),
}


def test_every_measure_has_an_expected_value():
    assert set(EXPECTED) == {m.name for m in MEASURES} == set(MEASURES_BY_NAME)


@pytest.mark.parametrize("name", list(EXPECTED))
def test_values_and_participants(name):
    result = MEASURES_BY_NAME[name].estimate(PEOPLE, 199, 0)
    assert result.value == pytest.approx(EXPECTED[name][0]) and result.participants.tolist() == EXPECTED[name][1]


def test_predictions_lack_time_course_measures():
    texts = Participants(PEOPLE.names, PEOPLE.time, PEOPLE.dwell_time, PEOPLE.distance, None, np.full((3, 2), 0.5))
    expected = {m.name for m in MEASURES if m.estimate(texts, 199, 0) is not None}
    assert {"share", "dwell", "hit_ratio", "distance"} <= expected
    assert expected.isdisjoint({"time_to_first_visit", "visits", "revisits"})
    assert MEASURES_BY_NAME["hit_ratio"].estimate(texts, 199, 0).value == pytest.approx([0.5, 0.5])


def test_absent_participants_do_not_contribute():
    options = PEOPLE.align_to(["Ada", "Bo", "Cy", "Dee", "Eve"])
    assert options.is_in_cell.tolist() == [True, True, True, False, False]
    for measure in MEASURES:
        a, b = measure.estimate(PEOPLE, 199, 0), measure.estimate(options, 199, 0)
        assert np.allclose(a.value, b.value, equal_nan=True) and a.participants.tolist() == b.participants.tolist(), (
            measure.name
        )


def test_no_participants():
    none = Participants((), np.zeros(0), *(np.zeros((0, 2)) for _ in range(7)))
    for measure in MEASURES:
        result = measure.estimate(none, 199, 0)
        assert np.isnan(result.value).all() and result.participants.tolist() == [0, 0]


# ---- Participant rows ----


def sums():
    result = VisitSums.empty(
        ("x", "y"), (ALL, Cell("zone", "z")), [(ALL, "Bo"), (Cell("zone", "z"), "Bo"), (ALL, "Ada")]
    )
    result.time[:] = 10, 5, 20
    result.rays[:] = 50, 25, 100
    result.dwell_time[:] = [[1, 2], [9, 9], [3, 0]]
    result.visits[:] = [[1, 1], [1, 1], [2, 0]]
    result.visible_time[:] = [[4, 5], [9, 9], [6, 7]]
    result.first_visit_sum[:], result.first_visit_count[:] = [[4, 6], [0, 0], [1, 0]], [[1, 2], [1, 1], [1, 0]]
    return result


def test_participant_rows_are_sorted_by_name():
    rows = ParticipantRows(sums(), {"Ada": "p2", "Bo": "p1"}, True)
    assert len(rows) == 4 and list(rows) == rows[:] == [rows[k] for k in range(-4, 0)]
    assert [(r["participant"], r["aoi"]) for r in rows] == [("p1", "x"), ("p1", "y"), ("p2", "x"), ("p2", "y")]
    bo = {
        "participant": "p1",
        "aoi": "y",
        "time": 10.0,
        "samples": 50,
        "dwell": 2.0,
        "visits": 1,
        "time_to_first_visit": 3.0,
    }
    assert rows[1] == bo | {"visible": 5.0, "note": ""} and tuple(rows[1]) == rows.columns
    assert rows[3]["time_to_first_visit"] is None and rows[2]["time_to_first_visit"] == pytest.approx(1.0)
    with pytest.raises(IndexError):
        rows[4]


def test_participant_rows_without_visibility():
    assert [r["visible"] for r in ParticipantRows(sums(), {"Ada": "a", "Bo": "b"}, False)] == [None] * 4


# ---- Tables and suppression ----

A, B = Cell("cohort", "a"), Cell("cohort", "b")
HOW = {"resamples": 299, "seed": 0}


def people(n, share, seed, prefix="p"):
    rng = np.random.default_rng(seed)
    time = np.full(n, 100.0)
    on = 100 * np.clip(rng.normal(share, 0.03, (n, 2)), 0, 1)
    visits = np.round(on / 2)
    names = tuple(f"{prefix}{k:02d}" for k in range(n))
    return Participants(names, time, on, on * 2, None, (visits > 0) * 1.0, visits, on, visits)


def test_rows_by_cell_area_and_source():
    cells = {ALL: {MEASURED: people(12, 0.2, 0)}, A: {MEASURED: people(2, 0.2, 1)}}
    rows = aoi_rows(("x", "y"), cells, MinParticipantsFilter(), **HOW)
    assert [(r["cell"], r["value"], r["aoi"]) for r in rows] == [
        ("all", "", "x"),
        ("all", "", "y"),
        ("cohort", "a", "x"),
        ("cohort", "a", "y"),
    ]
    mean = (cells[ALL][MEASURED].dwell_time[:, 0] / 100).mean()
    assert rows[0]["share"] == pytest.approx(mean) and rows[0]["share_low"] < mean < rows[0]["share_high"]
    assert rows[0]["visible"] is None and rows[0]["participants"] == 12
    # Two participants give no interval.
    assert rows[2]["share"] is not None and rows[2]["share_low"] is None


def test_few_participants_are_suppressed():
    floor = MinParticipantsFilter(5)
    cells = {ALL: {MEASURED: people(12, 0.2, 0)}, A: {MEASURED: people(4, 0.2, 1)}}
    rows = aoi_rows(("x", "y"), cells, floor, **HOW)
    assert rows[0]["share"] is not None
    blank = [k for k, v in rows[2].items() if v is not None]
    assert blank == ["cell", "value", "aoi", "source", "note"]
    # Both AOIs have the number of participants and the measures of samples.
    texts = sum(measure.numerator_denominator(cells[A][MEASURED]) is not None for measure in MEASURES)
    assert floor.num_suppressed == 2 * (1 + texts) and texts >= 7
    suppressing = MinParticipantsFilter(5)
    assert (
        suppressing.admit(0) and suppressing.admit(5) and not suppressing.admit(4) and suppressing.num_suppressed == 1
    )


def test_differences_to_few_participants_are_suppressed():
    """The smaller of the two groups decides, in either order."""
    for counts in ((12, 4), (4, 12)):
        cells = {cell: {MEASURED: people(n, 0.2, n, str(n))} for cell, n in zip((A, B), counts)}
        for minimum, is_shown in ((5, False), (4, True)):
            rows = difference_rows(("x", "y"), cells, MinParticipantsFilter(minimum), measures=("share",), **HOW)
            assert rows and all((row["difference"] is not None) == is_shown for row in rows)


def test_missing_values_have_a_reason():
    """Of one participant, of predictions, of participants without a visit, and of suppressed values."""
    lone = Participants.from_sums(sums(), ALL, False)
    cells = {
        ALL: {MEASURED: people(12, 0.2, 0), PREDICTED: lone},
        A: {MEASURED: people(4, 0.2, 1)},
        B: {MEASURED: lone},
    }
    rows = aoi_rows(("x", "y"), cells, MinParticipantsFilter(4), **HOW)
    for row in rows:
        reasons = {n: why for part in row["note"].split("; ") for n in part.split(":")[0].split(", ") for why in [part]}
        for measure in MEASURES:
            missing = [row[measure.name + key] is None for key in ("", "_low", "_high")]
            assert any(missing) == (measure.name in reasons), (row, measure.name)
    assert any("suppressed" in row["note"] for row in rows) and any("interval" in row["note"] for row in rows)
    differences = difference_rows(("x", "y"), cells, MinParticipantsFilter(), measures=("share", "hit_ratio"), **HOW)
    assert differences and all(bool(r["note"]) == (None in (r["difference"], r["low"], r["p"])) for r in differences)
    (one, other) = (
        next(r for r in ParticipantRows(sums(), {"Ada": "a", "Bo": "b"}, seen) if r["visits"] == 0)
        for seen in (True, False)
    )
    assert "time_to_first_visit" in one["note"] and "visible" not in one["note"] and "visible" in other["note"]


def test_differences_are_detected():
    cells = {A: {MEASURED: people(15, 0.2, 0, "a")}, B: {MEASURED: people(15, 0.4, 1, "b")}}
    rows = difference_rows(("x", "y"), cells, MinParticipantsFilter(), measures=("share", "hit_ratio"), **HOW)
    shares = [r for r in rows if r["measure"] == "share"]
    assert len(rows) == 4 and all(
        r["significant"] and 0.1 < r["low"] < r["difference"] < r["high"] < 0.3 for r in shares
    )
    assert not any(r["significant"] for r in rows if r["measure"] == "hit_ratio")
    assert all(r["p_adjusted"] >= r["p"] for r in rows)
    assert (rows[0]["first"], rows[0]["second"]) == ("a", "b")
    blank = difference_rows(("x", "y"), cells, MinParticipantsFilter(16), measures=("share",), **HOW)
    assert all(r["difference"] is None and r["p"] is None and not r["significant"] for r in blank)


def test_single_value_has_no_differences():
    assert difference_rows(("x", "y"), {ALL: {MEASURED: people(5, 0.2, 0)}}, MinParticipantsFilter(), **HOW) == []


def sums_tables():
    result = VisitSums.empty(("x", "y"), (ALL,), [(ALL, "Bo"), (ALL, "Ada")])
    result.time[:] = 10, 20
    result.rays[:] = 50, 100
    result.dwell_time[:] = [[1, 2], [3, 0]]
    result.visits[:] = [[1, 1], [2, 0]]
    result.first_visit_sum[:], result.first_visit_count[:] = [[4, 6], [1, 0]], [[1, 2], [1, 0]]
    result.transitions[0] = [[0, 3], [1, 0]]
    result.duration_counts[0, 0, 2] = 3
    return result


def test_transitions_and_durations():
    rows = transition_rows(sums_tables(), MinParticipantsFilter())
    assert [(r["from"], r["to"], r["transitions"], r["share"]) for r in rows] == [
        ("x", "y", 3, 1.0),
        ("y", "x", 1, 1.0),
    ]
    assert all(r["transitions"] is None for r in transition_rows(sums_tables(), MinParticipantsFilter(3)))
    for make in (transition_rows, duration_rows):
        for minimum in (1, 3):
            assert not find_wrong_notes(
                [r | {"value": "x"} for r in make(sums_tables(), MinParticipantsFilter(minimum))]
            )
    lasted = duration_rows(sums_tables(), MinParticipantsFilter())
    assert len(lasted) == 2 and lasted[0]["0.2 to 0.5 s"] == 3 and len(lasted[0]) == 4 + len(BINS) - 1


def test_markdown_format():
    row = {"share": 0.1234, "share_low": 0.1, "share_high": 0.2, "dwell": 3.456, "dwell_low": None, "dwell_high": None}
    assert (
        format_measure(row, MEASURES_BY_NAME["share"]) == "12.3 % [10.0, 20.0]"
        and format_measure(row, MEASURES_BY_NAME["dwell"]) == "3.46"
    )
    assert format_measure(row, MEASURES_BY_NAME["hit_ratio"]) == ""


def test_empty_cells_are_not_compared():
    cells = {A: {MEASURED: people(15, 0.2, 0, "a")}, B: {MEASURED: people(0, 0.4, 1, "b")}}
    assert difference_rows(("x", "y"), cells, MinParticipantsFilter(), **HOW) == []
