"""Readers of what a report is made of: evaluations, and boxes of objects."""

from __future__ import annotations

import json
from pathlib import Path

from tests.fuzz.describe import Reader


def _make_results(folder: Path) -> None:
    from nerg_mi.evaluation.gaze_report import write_report
    from tests.evaluation.test_gaze_report import scored

    person = {"method": "gaze field", "person": "Ada", "rays": 9, "bits": 0.1, "CC": 0.5, "KLD": 0.2}
    about = {
        "gaze": "g.safetensors",
        "split": "both",
        "kappa": 20.0,
        "positions": 60,
        "people": 30,
        "gaze_sha256": "ab",
    }
    write_report(folder, scored((0.9, 0.85, 0.3), reach=0.02), [person], about, "# notes")


def _read_results(folder: Path) -> None:
    from nerg_mi.evaluation.gaze_report import read_results
    from nerg_mi.report.data import Run
    from nerg_mi.report.sections import page

    found = read_results(folder / "gaze.json")
    page(Run("Gaze", {}, "A place.", "none", results=(found,)))


def _make_boxes(folder: Path) -> None:
    boxes = {"shelf": [[0, 0, 0], [1, 2, 3]], "till": {"min": [4, 0, 0], "max": [5, 1, 1.2]}}
    (folder / "objects.json").write_text(json.dumps(boxes))


def _read_regions(folder: Path) -> None:
    from nerg_mi.formats.areas import read_regions

    for box in read_regions(folder / "objects.json"):
        box.holds(box.corners)


REPORTS = [
    Reader("evaluation of gaze", _make_results, {"gaze.json": ("json",)}, _read_results),
    Reader("boxes of objects", _make_boxes, {"objects.json": ("json",)}, _read_regions),
]
