"""What an evaluation of gaze writes: cells by hand, files that are valid, and pictures of what was asked for."""

from __future__ import annotations

import csv
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.evaluation import gaze_report
from nerg_mi.evaluation.gaze_report import markdown, side_by_side, write_report
from nerg_mi.maths.sphere import fibonacci_directions

ROWS = [
    {
        "method": "field",
        "KLD": 0.51234,
        "KLD.low": 0.4,
        "KLD.high": 0.65,
        "CC": 0.9,
        "MAE": 0.012345,
        "KLD.less": -0.25,
        "NSS": math.nan,
    },
    {"method": "uniform", "KLD": 1.5, "CC": 0.0, "MAE": 0.05, "integral": 1.0},
    {"method": "split half", "KLD": 0.25},
]


def test_a_table_by_hand():
    assert markdown(ROWS, ("method", "KLD", "CC", "MAE", "NSS", "integral", "AUC")).splitlines() == [
        "| method | KLD | CC | MAE | NSS | integral |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        "| field | 0.512 [0.400, 0.650] | 0.900 | 0.0123 |  |  |",
        "| uniform | 1.500 | 0.000 | 0.0500 |  | 1.000 |",
        "| split half | 0.250 |  |  |  |  |",
    ]
    people = markdown([{"method": "a", "person": "ann", "rays": 12}], ("method", "person", "rays"))
    assert people.splitlines()[1:] == ["| --- | --- | ---: |", "| a | ann | 12 |"]


def test_files(tmp_path):
    persons = [{"method": "field", "person": "ann", "rays": 3, "KLD": 0.5, "NSS": math.nan}]
    files = write_report(tmp_path, ROWS, persons, {"seed": 4}, "notes")
    page = files[0].read_text()
    # Our method is compared with the last of the baselines, which the people's own agreement is none of.
    assert (
        page.startswith("notes\n")
        and "| field less uniform | -0.250 |" in page
        and "| field | ann | 3 | 0.500 |  |" in page
    )
    with open(files[1], newline="") as f:
        rows = list(csv.DictReader(f))
    assert [r["method"] for r in rows] == ["field", "uniform", "split half"] and float(rows[0]["MAE"]) == 0.012345
    about = json.loads(files[3].read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert about["seed"] == 4 and about["methods"][0]["NSS"] is None and about["persons"][0]["NSS"] is None
    assert about["methods"][0]["KLD"] == 0.51234 and about["persons"][0]["rays"] == 3


def test_pictures_are_on_the_scale_of_the_truth(tmp_path, monkeypatch):
    d = fibonacci_directions(500)
    centres = np.arange(15.0).reshape(5, 3)
    truth = np.exp(3 * d @ np.array([1.0, 0, 0])) * np.arange(1, 6)[:, None]
    counts = np.array([[3, 0, 4], [1, 1, 1], [1, 1, 1], [1, 1, 1], [900, 600, 0]])
    test, drawn = SimpleNamespace(centres=centres, directions=d, truth=truth, counts=counts), []
    monkeypatch.setattr(gaze_report, "save", lambda figure, path, about: drawn.append(figure))
    asked = []

    def twice(positions, directions):
        asked.append(positions)
        return 2 * np.exp(3 * directions[:, 0]) * np.ones((len(positions), 1))

    side_by_side(test, {"twice": twice}, tmp_path / "a.png", count=2, height=8)
    images = [a for a in drawn[0].axes if a.images]
    # Each row has a scale of its own, which says what its colours mean.
    scales = [a for a in drawn[0].axes if a not in images]
    assert [a.get_ylabel() for a in scales] == ["1/sr", "1/sr"]
    assert [tuple(a.get_ylim()) for a in scales] == [images[k].images[0].get_clim() for k in (0, 2)]
    assert np.array_equal(asked[0], centres[[0, 4]]) and [a.get_title() for a in images] == ["truth", "twice", "", ""]
    assert images[0].get_ylabel() == "0.0, 1.0, 2.0 m\n7 rays of 2 people"
    assert images[2].get_ylabel() == "12.0, 13.0, 14.0 m\n1,500 rays of 2 people"
    for a, b in (images[:2], images[2:]):
        # One scale a row.
        assert a.images[0].get_clim() == b.images[0].get_clim() and a.images[0].get_clim()[0] == 0
        shown = [np.asarray(x.images[0].get_array()) for x in (a, b)]
        row = 1 if a is images[0] else 5
        # The truth's nearest directions are off by up to a tenth of a radian.
        assert shown[0].shape == (8, 16) and np.allclose(2 * shown[0], row * shown[1], rtol=0.6)
