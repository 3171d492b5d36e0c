"""The objects of a recording of Aria Digital Twin: a turned box each, in the frame of rays.

``3d_bounding_box.csv`` has the boxes in the objects' own frames, ``scene_objects.csv`` where these are, and
``instances.json`` what they are called (the format of facebookresearch/projectaria_tools, ADT's data format). The
twin's world has y up; that of rays z: (x, y, z) becomes (x, -z, y), as `nerg rays import --preset aria` does for its
recordings. Poses with a time are those of objects that were carried about: these have no one place, and are left out.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.safe_read import read_bytes, read_json, reading
from nerg_mi.formats.regions import MOST, Region

BOXES, POSES, NAMES = "3d_bounding_box.csv", "scene_objects.csv", "instances.json"

TABLE_BYTES = 256 << 20
"""A table may have so many bytes."""

_THIN = 1e-3  # metres: a box that is thinner is made so thick

_UID, _TIME = "object_uid", "timestamp[ns]"
_SIDES = [f"p_local_obj_{axis}{end}[m]" for end in ("min", "max") for axis in "xyz"]
_PLACE = [f"t_wo_{axis}[m]" for axis in "xyz"]
_TURN = [f"q_wo_{axis}" for axis in "xyzw"]
# From the twin's world, whose y is up, to that of rays.
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def files_of_twin(folder: Path) -> list[Path]:
    """Those files that `read_twin_objects` reads of a recording's ``folder`` and that are there."""
    return [folder / name for name in (BOXES, POSES, NAMES) if (folder / name).is_file()]


def read_twin_objects(folder: Path, categories: Collection[str] | None = None) -> list[Region]:
    """The objects that stand still, sorted by name; of ``categories`` alone, if any. Equal names are numbered.

    Raises `NergError` for a folder without these files, damaged ones, and where no object is left.
    """
    sides, places = _rows(folder / BOXES, _SIDES), _rows(folder / POSES, [*_PLACE, *_TURN])
    about = _names(folder / NAMES)
    if categories is not None:
        known = sorted({category for _, category in about.values()})
        unknown = next((c for c in categories if c not in known), None)
        if unknown is not None:
            listed = ", ".join(plain(k, 40) for k in known[:30])
            raise NergError(f'"{folder}" has no objects of the category "{plain(unknown, 40)}"; there are {listed}')
    found = []
    for uid in sides:
        name, category = about.get(uid, (uid, ""))
        if uid in places and (categories is None or category in categories):
            found.append((name, uid))
    if not found:
        raise NergError(f'"{folder}" has no object that stands still with a box and a place; name other areas')
    if len(found) > MOST:
        raise NergError(
            f'"{folder}" has {len(found):,} objects, and {MOST} areas are read; choose some by "categories"'
        )
    found.sort()
    count = {name: sum(n == name for n, _ in found) for name, _ in found}
    seen: dict[str, int] = {}
    regions = []
    for name, uid in found:
        seen[name] = seen.get(name, 0) + 1
        shown = name if count[name] == 1 else f"{name} {seen[name]}"
        regions.append(_box(shown[:80], sides[uid], places[uid]))
    return regions


def _box(name: str, sides: np.ndarray, place: np.ndarray) -> Region:
    from scipy.spatial.transform import Rotation

    lower, upper = sides[:3], np.maximum(sides[3:], sides[:3] + _THIN)
    turn = Rotation.from_matrix(_UP) * Rotation.from_quat(place[3:])
    middle = _UP @ place[:3] + turn.apply((lower + upper) / 2)
    half = (upper - lower) / 2
    return Region.of(name, middle - half, middle + half, turn.as_quat())


def _rows(path: Path, columns: list[str]) -> dict[str, np.ndarray]:
    """Numbers of the rows without a time, by object."""
    raw = read_bytes(path, "table of objects", TABLE_BYTES)
    found: dict[str, np.ndarray] = {}
    moving: set[str] = set()
    with reading(path, "table of objects", "download it again", also=(csv.Error,)):
        table = csv.reader(io.StringIO(raw.decode()))
        head = next(table, [])
        missing = [c for c in (_UID, _TIME, *columns) if c not in head]
        if missing:
            raise ValueError(f'it has no column "{missing[0]}"')
        uid, time, where = head.index(_UID), head.index(_TIME), [head.index(c) for c in columns]
        for row in table:
            if not row:
                continue
            if len(row) != len(head):
                raise ValueError(f"line {table.line_num} has {len(row)} cells, the header {len(head)}")
            if int(row[time]) >= 0:
                moving.add(row[uid])
                continue
            values = np.array([float(row[k]) for k in where])
            if not (np.abs(values) < 1e6).all():
                raise ValueError(f"the object {plain(row[uid], 40)} has numbers that are none")
            if columns == _SIDES and not (values[:3] <= values[3:]).all():
                raise ValueError(f"the box of the object {plain(row[uid], 40)} ends before it begins")
            if columns != _SIDES and not 0.5 < np.linalg.norm(values[3:]) < 2:
                raise ValueError(f"the turn of the object {plain(row[uid], 40)} is no rotation")
            found[row[uid]] = values
    return {key: values for key, values in found.items() if key not in moving}


def _names(path: Path) -> dict[str, tuple[str, str]]:
    """Name and category of objects; none where there is no such file."""
    if not path.is_file():
        return {}
    found = read_json(path, "file of instances")
    if not isinstance(found, dict):
        raise NergError(f'"{path}" names no objects; download it again')
    names = {}
    for uid, about in found.items():
        told = about if isinstance(about, dict) else {}
        name, category = told.get("instance_name", uid), told.get("category", "")
        if not isinstance(name, str) or not isinstance(category, str):
            raise NergError(f'"{path}" has a name of the object {plain(uid, 40)} that is no text; download it again')
        clean = "".join(c if c.isprintable() else "?" for c in name).strip() or uid
        names[uid] = clean[:70], category
    return names
