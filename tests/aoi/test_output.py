"""Tests of `nerg_mi.aoi.output`."""

from __future__ import annotations

import csv

import pytest

from nerg_mi.aoi import output
from nerg_mi.aoi.charts import aois_figure
from nerg_mi.aoi.output import StatisticsResult
from nerg_mi.aoi.tables import MIN_VIEWPOINTS, ParticipantRows
from nerg_mi.aoi.visits import ALL, VisitSums
from nerg_mi.figures.style import figure_of

# ---- Results as a folder of files ----

ROW_OF_AOI = {
    "cell": "all",
    "value": "",
    "aoi": "a",
    "source": "measured",
    "participants": 4,
    "share": 0.2,
    "hit_ratio": 0.5,
    "dwell": 3.0,
}


def test_non_empty_tables_are_written(tmp_path):
    files = StatisticsResult(aois=[ROW_OF_AOI], num_suppressed=2).save(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in files)
    names = {p.name for p in files}
    assert {"aois.csv", "aois.md", "aois.png", "suppressed.txt", "about.json"} <= names
    assert not any(name.startswith(("transitions", "what_if", "participants")) for name in names)
    assert "2 values" in (tmp_path / "suppressed.txt").read_text()


def test_equal_results_give_equal_files(tmp_path):
    made = StatisticsResult(aois=[ROW_OF_AOI])
    for name in "ab":
        made.save(tmp_path / name)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


# ---- Tables as CSV, Markdown and Parquet ----

ROWS = [
    {"cell": "all", "value": "", "aoi": "a|b", "n": 3, "x": 0.125},
    {"cell": "zone", "value": "z", "aoi": "c", "n": None, "x": None},
]


def test_rows_are_written_in_all_formats(tmp_path):
    files = output.write_rows(tmp_path, "t", ROWS, *output.all_columns(ROWS))
    with files[0].open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["x"] == "0.125" and rows[1]["n"] == "" and rows[0]["aoi"] == "a|b"
    assert "| all |  | a\\|b | 3 | 0.125 |" in files[1].read_text()
    pq = pytest.importorskip("pyarrow.parquet")
    assert pq.read_table(files[2]).to_pylist() == ROWS


def test_parquet_is_skipped_without_pyarrow(tmp_path, monkeypatch):
    monkeypatch.setattr(output, "find_spec", lambda name: None)
    files = output.write_rows(tmp_path, "t", ROWS, *output.all_columns(ROWS))
    assert [f.suffix for f in files] == [".csv", ".md"]


def test_aoi_table_omits_unknown_measures():
    row = {"cell": "cohort", "value": "x", "aoi": "a", "source": "measured", "participants": None, "share": 0.5}
    head, cells = output.aoi_columns([row])
    assert head == ["cell", "AOI", "source", "participants", "share of time"]
    assert cells(row) == ["cohort x", "a", "measured", "", "50.0 %"] and output.format_cell({"cell": "all"}) == "all"


def test_predictions_show_spread_and_support():
    row = {
        "cell": "all",
        "value": "",
        "aoi": "a",
        "source": "predicted",
        "participants": 5,
        "share": 0.5,
        "share_low": 0.4,
    }
    row |= {"share_high": 0.6, "share_spread": 0.021, "support": 1234.0}
    head, cells = output.aoi_columns([row, row | {"source": "measured"}])
    assert head[-1] == "support [samples]"
    assert cells(row)[-2:] == ["50.0 % [40.0, 60.0] ± 2.1", "1,234"]
    assert (
        cells(row | {"support": None})[-1] == "not in the checkpoint" and cells(row | {"source": "measured"})[-1] == ""
    )
    assert cells(row | {"share": 0.0004, "share_low": 0, "share_high": 0.001})[-2] == "0.04 % [0.00, 0.10] ± 2.10"


def test_hit_ratio_from_few_viewpoints_is_marked():
    row = {
        "cell": "all",
        "value": "",
        "aoi": "a",
        "source": "predicted",
        "participants": 5,
        "share": 0.1,
        "hit_ratio": 0.45,
    }
    row |= {"dwell": 2.0, "support": 9.0}
    for places, low in ((2.56, True), (MIN_VIEWPOINTS - 0.01, True), (MIN_VIEWPOINTS, False), (None, False)):
        one = row | {"viewpoints": places}
        texts = output.aoi_columns([one])[1](one)
        said = [text for text in texts if "biased low" in str(text)]
        assert said == ([f"45.0 % (biased low: {places:.1f} viewpoints per participant)"] if low else [])
        share, extent, dwell = figure_of(aois_figure([one])).axes
        assert ("biased low" in extent.get_xlabel()) == low and "low" not in share.get_xlabel() + dwell.get_xlabel()
        assert (extent.lines[0].get_markerfacecolor() == "white") == low


def test_what_if_table():
    row = {"aoi": "a", "measure": "share", "participants": 5, "before": 0.5, "after": 0.25, "difference": -0.25}
    row |= {"low": -0.3, "high": -0.2, "p": 0.0005, "p_adjusted": 0.001, "difference_spread": None, "support": None}
    new = row | {"aoi": "b", "measure": "visible", "before": None, "difference": None, "low": None, "p": None}
    rows = [row | {"source": "predicted"}, new | {"source": "predicted", "p_adjusted": None, "support": 12.5}]
    head, cells = output.what_if_columns(rows)
    assert head[3:6] == ["before [%]", "after [%]", "difference [points]"] and len(head) == len(cells(rows[0])) == 9
    texts = ["50.00", "25.00", "-25.00 [-30.00, -20.00]", "0.0005", "0.001", "not in the checkpoint"]
    assert cells(rows[0]) == ["a", "attention share", 5, *texts]
    assert cells(rows[1]) == ["b", "visible share", 5, "", "25.00", "", "", "", "12.5"]
    spread = [r | {"difference_spread": 0.01} for r in rows]
    head, cells = output.what_if_columns(spread)
    assert head[6] == "± ensemble" and cells(spread[0])[6] == "1.00"


def test_differences_have_units():
    row = {"cell": "zone", "first": "front", "second": "back", "aoi": "a", "measure": "share", "difference": -0.06}
    row |= {"low": -0.08, "high": -0.04, "p": 0.001, "p_adjusted": 0.0014, "significant": True}
    head, cells = output.difference_columns([row])
    texts = ["zone", "front", "back", "a", "share of time", "-6.00 points [-8.00, -4.00]", "0.001", "0.0014", "yes"]
    assert head[5] == "second - first" and cells(row) == texts
    blank = row | {
        "measure": "dwell",
        "difference": 1.5,
        "low": None,
        "p": None,
        "p_adjusted": None,
        "significant": False,
    }
    assert cells(blank)[4:] == ["dwell time", "+1.50 s", "", "", ""]


def test_the_verdict_names_the_largest_share_and_what_differs():
    rows = [ROW_OF_AOI, ROW_OF_AOI | {"aoi": "b", "share": 0.3, "share_low": 0.25, "share_high": 0.36}]
    rows.append(ROW_OF_AOI | {"aoi": "c", "share": 0.9, "cell": "zone", "value": "front"})
    difference = {"cell": "zone", "first": "front", "second": "back", "aoi": "a", "measure": "share"}
    difference |= {"difference": -0.06, "low": -0.08, "high": -0.04, "p": 0.001, "p_adjusted": 0.001}
    differences = [difference | {"significant": True}, difference | {"aoi": "b", "significant": False}]
    largest, count, one = StatisticsResult(aois=rows, differences=differences).verdict.splitlines()
    assert largest.startswith("b ") and "30.0 % [25.0, 36.0]" in largest
    assert count.startswith("1 of 2 tested") and one.startswith("a, share of time: -6.00 points") and "front" in one


def test_the_verdict_of_edge_cases():
    assert StatisticsResult().verdict == "There are no areas."
    verdict = lambda *rows, **more: StatisticsResult(aois=[ROW_OF_AOI | row for row in rows], **more).verdict
    low = ROW_OF_AOI["share"] / 2
    # A group has no smaller share than its parts; equal ones are named together.
    assert verdict({}, {"aoi": "all", "share": 1.0}, {"aoi": "b", "share": low}, groups=["all"]).startswith("a has")
    assert verdict({}, {"aoi": "b"}, {"aoi": "c", "share": low}).startswith("a and b have")
    assert "largest" not in verdict({}) and verdict({}).startswith("a has")
    # One person has no interval, nobody looked, and all values are suppressed.
    alone = {"share_low": None, "share_high": None}
    assert "no interval" in verdict(alone, {"aoi": "b", "share": low})
    assert verdict({"share": 0.0}, {"aoi": "b", "share": 0.0}).startswith("No measured gaze")
    assert verdict({"share": None}).startswith("No measured share")
    difference = {"cell": "zone", "first": "x", "second": "y", "aoi": "a", "measure": "share", "difference": 0.1}
    difference |= {"low": None, "high": None, "p": None, "p_adjusted": None, "significant": False}
    assert "0 of 0 tested" in verdict({}, differences=[difference]) and "1 could not" in verdict(
        {}, differences=[difference]
    )


def test_many_participants_are_written_in_batches(tmp_path, monkeypatch):
    sums = VisitSums.empty(("x", "y"), (ALL,), [(ALL, f"p{k}") for k in range(5)])
    # The first batch has no visits.
    sums.visits[3:], sums.first_visit_sum[3:], sums.first_visit_count[3:] = 1, 2.5, 1
    rows = ParticipantRows(sums, {f"p{k}": f"p{k}" for k in range(5)}, False)
    monkeypatch.setattr(output, "_PARQUET_BATCH", 3)
    monkeypatch.setattr(output, "MAX_MARKDOWN_ROWS", 4)
    files = output.write_rows(tmp_path, "people", rows, *output.all_columns(rows))
    with files[0].open() as file:
        texts = list(csv.DictReader(file))
    assert len(texts) == 10 and texts[0]["time_to_first_visit"] == "" and texts[9]["time_to_first_visit"] == "2.5"
    text = files[1].read_text().splitlines()
    assert len(text) == 8 and "4 of 10 rows" in text[-1] and "people.csv" in text[-1]
    pq = pytest.importorskip("pyarrow.parquet")
    assert pq.read_table(files[2]).to_pylist() == list(rows)
