"""Results are read as they were written, and what is none is a sentence."""

from __future__ import annotations

import json

import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze_report import read_results, write_report

ROWS = [{"method": "gaze field", "bits": 0.5, "KLD": float("nan")}, {"method": "uniform", "bits": 0.0, "KLD": 1.0}]
PERSONS = [{"method": "gaze field", "person": "Ada", "rays": 4, "bits": 0.1}]
ABOUT = {"gaze": "g.safetensors", "split": "both", "kappa": 20.0, "positions": 12}


def test_as_it_was_written(tmp_path):
    write_report(tmp_path, ROWS, PERSONS, {**ABOUT, "people": 7, "gaze_sha256": "ab"}, "# notes")
    found = read_results(tmp_path / "gaze.json")
    assert (found.gaze, found.split, found.positions, found.people, found.sha256) == (
        "g.safetensors",
        "both",
        12,
        7,
        "ab",
    )
    assert found.rows[0]["KLD"] is None and found.rows[1]["KLD"] == 1.0 and found.persons[0]["person"] == "Ada"


def test_an_earlier_file_says_less(tmp_path):
    write_report(tmp_path, ROWS, PERSONS, ABOUT, "# notes")
    found = read_results(tmp_path / "gaze.json")
    assert found.people == 1 and found.sha256 == ""


@pytest.mark.parametrize(
    "change",
    [
        [],
        {"gaze": 1},
        {"methods": []},
        {"methods": [{"bits": 1}]},
        {"methods": [{"method": "a", "bits": "1"}]},
        {"methods": {"a": 1}},
        {"positions": -1},
        {"positions": True},
        {"people": "three"},
        {"split": "x" * 999},
        {"kappa": None},
        {"persons": [{"method": "m", "person": ["a"]}]},
    ],
)
def test_what_is_none(tmp_path, change):
    path = tmp_path / "gaze.json"
    whole = {**ABOUT, "methods": ROWS[1:], "persons": PERSONS}
    path.write_text(json.dumps(change if isinstance(change, list) else {**whole, **change}))
    with pytest.raises(NergError, match='"nerg eval gaze"'):
        read_results(path)
    path.write_text(json.dumps(whole))
    assert read_results(path).people == 1
