"""People without their names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerg_mi.evaluation.gaze_report import GazeResults
from nerg_mi.report.data import Labels, rays_without_names, results_without_names
from tests.evaluation.gaze.test_evaluation import crowd

NAMES = ("Grace", "Ada", "Ada Lovelace", "X")


def named():
    rays = crowd(500)
    about = {
        "frame": rays.metadata["frame"],
        "rows_read": 600,
        "sources": [{"file": "Ada.csv", "sha256": "0"}],
        "dropped": [{"reason": "blink", "file": "Ada.csv", "count": 2, "rows": [[1, 2]]}],
        "steps": [{"step": "filter", "kept": 9, "of": 10, "persons": ["Ada"]}],
        "remark": "Ada was tired",
    }
    return replace(rays, persons=NAMES, metadata=about)


def test_people_are_numbered_by_their_rays():
    rays = named()
    count = np.bincount(rays.person)
    labels = Labels(rays)
    order = [NAMES[i] for i in np.argsort(-count, kind="stable")]
    assert [labels.of(name) for name in order] == ["person 1", "person 2", "person 3", "person 4"]
    shown = rays_without_names(rays, labels)
    assert shown.persons == ("person 1", "person 2", "person 3", "person 4")
    assert [shown.persons[p] for p in shown.person] == [labels.of(rays.persons[p]) for p in rays.person]
    assert np.array_equal(shown.origin, rays.origin)


def test_no_name_is_left():
    shown = rays_without_names(named(), Labels(named()))
    text = repr(shown.metadata) + repr(shown.persons)
    assert "Ada" not in text and "Grace" not in text and shown.metadata["dropped"][0]["file"] == "file 1"
    assert shown.metadata["steps"] == [{"step": "filter", "kept": 9, "of": 10}]


def test_names_of_files_and_evaluations():
    row = {"method": "gaze field", "person": "Ada", "bits": 1.0}
    found = GazeResults("g", "", "both", 1, 2, 20.0, (), (row, {**row, "person": "somebody else"}))
    labels = Labels(named(), [found])
    shown = results_without_names(found, labels)
    assert [r["person"] for r in shown.persons] == [labels.of("Ada"), "person 5"] and row["person"] == "Ada"
    assert labels.hide("ada_lovelace-ADA LOVELACE.npz") == (
        f"{labels.of('Ada')}_lovelace-{labels.of('Ada Lovelace')}.npz"
    )
    # A letter is hidden where it stands alone.
    assert labels.hide("X and axis") == f"{labels.of('X')} and axis"
    assert Labels(None).hide("a.b") == "a.b" and Labels(None).of("Ada") == "a person"
