"""Readers of what statistics are asked about: areas of every kind, the objects of a twin, changes, cohorts."""

from __future__ import annotations

import json
from pathlib import Path

from tests.fuzz.describe import Reader


def _make_areas(folder: Path) -> None:
    areas = [
        {"name": "shelf", "min": [0, 0, 0], "max": [1, 2, 3], "turn": 30},
        {"name": "lamp", "min": [0, 0, 0], "max": [1, 1, 1], "turn": [0, 0.6, 0, 0.8]},
        {"name": "sign", "mesh": "sign.ply", "faces": [0, [4, 9]]},
        {"name": "till", "shape": "till_0"},
        {"name": "all", "parts": ["shelf", "pair"]},
        {"name": "pair", "parts": ["till", "sign"]},
    ]
    (folder / "areas.json").write_text(json.dumps({"regions": areas}))


def _read_areas(folder: Path) -> object:
    from nerg_mi.formats.areas import read_areas

    areas = read_areas(folder / "areas.json")
    assert all(of for of in areas.solids.values())
    for box in areas.boxes:
        box.holds(areas.boxes[0].vertices if areas.boxes else [[0.0, 0, 0]])
    return areas.members()


def _make_twin(folder: Path) -> None:
    from tests.formats.test_areas import write_twin

    write_twin(folder / "twin")


def _read_twin(folder: Path) -> object:
    from nerg_mi.formats.areas import read_areas

    return read_areas(folder / "twin").boxes


def _make_changes(folder: Path) -> None:
    changes = {
        "move": [{"shape": "sign", "by": [0.5, 0, 0], "turn": 90}, {"area": "shelf", "by": [0, 1, 0]}],
        "remove": ["stand"],
        "add": [{"name": "poster", "min": [1, 0, 1], "max": [2, 0.1, 2]}],
        "swap": [{"shape": "till", "mesh": "till2.ply"}],
        "observers": [[1, 2, 1.6]],
        "shift": [0, 0, -0.2],
    }
    (folder / "changes.json").write_text(json.dumps(changes))


def _read_changes(folder: Path) -> object:
    from nerg_mi.aoi.scene import changed_areas, read_changes
    from nerg_mi.formats.areas import AreaSet, Region

    return changed_areas(AreaSet((Region.of("shelf", [0, 0, 0], [1, 1, 1]),)), read_changes(folder / "changes.json"))


def _make_cohorts(folder: Path) -> None:
    (folder / "cohorts.csv").write_text('person,cohort\nAda,"young, tall"\nBo,old\n')


def _read_cohorts(folder: Path) -> object:
    from nerg_mi.aoi.scene import read_cohorts

    return read_cohorts(folder / "cohorts.csv")


AREAS = [
    Reader("areas of every kind", _make_areas, {"areas.json": ("json",)}, _read_areas),
    Reader(
        "objects of a twin",
        _make_twin,
        {"twin/3d_bounding_box.csv": ("text",), "twin/scene_objects.csv": ("text",), "twin/instances.json": ("json",)},
        _read_twin,
    ),
    Reader("changes", _make_changes, {"changes.json": ("json",)}, _read_changes),
    Reader("cohorts", _make_cohorts, {"cohorts.csv": ("text",)}, _read_cohorts),
]
