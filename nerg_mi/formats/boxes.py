"""Boxes of areas of interest (AOIs), in JSON files and as objects of Aria Digital Twin."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.files.safe_read import is_regular_file, read_json, translate_read_errors
from nerg_mi.files.tables import open_csv
from nerg_mi.files.values import normalize_name, parse_float
from nerg_mi.ranges import MAX_COORDINATE

# ---- Boxes ----
#
# Named boxes in JSON files, which are drawn in the viewer, used in reports, or written by hand. `nerg_mi.aoi.areas` has
# the other kinds of areas.

MAX_BYTES = 4 << 20  # maximum size of a file of areas in bytes
MAX_AREAS = 1000  # maximum number of areas
Quaternion = tuple[float, float, float, float]  # x, y, z, w
NON_BOX_KEYS = ("mesh", "shape", "parts", "adt")  # an area with one of these keys is not a box
_MAX_NAME_LENGTH = 80
EXAMPLE = '{"shelf": [[0, 0, 0], [1, 2, 3]]}'
_GEOMETRY_KEY = re.compile("rot(ation|ate)?|orientation|quat(ernion)?|angle|yaw|heading|transform|matrix|scale", re.I)
"""Keys of other programs for what ``turn``, ``min`` and ``max`` state; further keys of any other name are allowed."""


@dataclass(frozen=True)
class Region:
    """A box between two corners, in scene units, optionally rotated about its centre by the unit quaternion
    ``rotation``.
    """

    name: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    rotation: Quaternion | None = None

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper], float)
        if corners.shape == (2, 3) and not (np.abs(corners) <= MAX_COORDINATE).all():
            raise NergError(
                f'the area "{sanitize(self.name, 40)}" has a coordinate of {np.abs(corners).max():g}; the corners '
                "must be finite, "
                f"and at most {MAX_COORDINATE:g}"
            )
        if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
            raise NergError(
                f'the area "{sanitize(self.name, 40)}" needs a lower and an upper corner of three numbers; each '
                "number of the lower corner must be the smaller one"
            )
        object.__setattr__(self, "name", normalize_name(self.name))
        check_area_name(self.name)
        if self.rotation is not None:
            norm = math.hypot(*self.rotation) if len(self.rotation) == 4 else math.nan
            if not abs(norm - 1) < 1e-3:
                raise NergError(f'the rotation of the area "{sanitize(self.name, 40)}" is not a unit quaternion')

    @classmethod
    def create(
        cls, name: str, lower: Iterable[float], upper: Iterable[float], rotation: Iterable[float] | float | None = None
    ) -> Region:
        """Create a box from any sequences of numbers.

        Parameters
        ----------
        name
            Name of the area.
        lower, upper
            Corners (3,) in scene units.
        rotation
            Quaternion (x, y, z, w) of any non-zero length, or degrees about z, counter-clockwise seen from above.

        Raises
        ------
        NergError
            If a corner does not have three numbers, or the rotation is invalid.
        """
        low, high = [float(v) for v in lower], [float(v) for v in upper]
        if len(low) != 3 or len(high) != 3:
            raise NergError(f'the area "{sanitize(name, 40)}" needs a lower and an upper corner of three numbers')
        return cls(name, (low[0], low[1], low[2]), (high[0], high[1], high[2]), _parse_rotation(rotation, name))

    @property
    def corners(self) -> np.ndarray:
        """Lower and upper corner (2, 3)."""
        return np.array([self.lower, self.upper], float)

    @property
    def center(self) -> np.ndarray:
        """Centre (3,)."""
        return self.corners.mean(axis=0)

    @property
    def rotation_matrix(self) -> np.ndarray:
        """Rotation matrix (3, 3) whose columns are the axes of the box."""
        if self.rotation is None:
            return np.eye(3)
        x, y, z, w = np.array(self.rotation, float) / math.hypot(*self.rotation)
        return quaternions_to_matrices(np.array([[w, x, y, z]]))[0]

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Rotate ``points`` (..., 3) into the frame in which the box is axis-aligned between `corners`."""
        return points if self.rotation is None else (points - self.center) @ self.rotation_matrix + self.center

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Rotate ``points`` (..., 3) from the frame of the box to the scene; the inverse of `to_local`."""
        return points if self.rotation is None else (points - self.center) @ self.rotation_matrix.T + self.center

    @property
    def vertices(self) -> np.ndarray:
        """The eight vertices (8, 3); bit k of the row index selects the upper corner along axis k."""
        upper = (np.arange(8)[:, None] >> np.arange(3) & 1).astype(bool)
        return self.to_world(np.where(upper, self.corners[1], self.corners[0]))

    @property
    def bounds(self) -> np.ndarray:
        """Corners (2, 3) of the axis-aligned bounding box."""
        return (
            self.corners if self.rotation is None else np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        )

    def contains(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return whether ``points`` (..., 3) are inside the box, or within ``margin`` of it along each of its axes."""
        lower, upper = self.corners
        with np.errstate(invalid="ignore"):
            points = self.to_local(np.asarray(points, float))
        return np.all((points >= lower - margin) & (points <= upper + margin), axis=-1)


def check_area_name(name: str) -> None:
    """Raise `NergError` for an invalid name of an area."""
    if not name.strip() or len(name) > _MAX_NAME_LENGTH or not name.isprintable():
        raise NergError(
            f'an area needs a name of 1 to {_MAX_NAME_LENGTH} printable characters, got "{sanitize(name, 40)}"'
        )


def _parse_rotation(rotation: Iterable[float] | float | None, name: str) -> Quaternion | None:
    if rotation is None:
        return None
    if isinstance(rotation, (int, float)):
        half_angle = math.radians(float(rotation)) / 2 if math.isfinite(rotation) else math.nan
        numbers = [0.0, 0.0, math.sin(half_angle), math.cos(half_angle)]
    else:
        numbers = [float(v) for v in rotation]
    norm = math.hypot(*numbers)
    if len(numbers) != 4 or not 1e-6 < norm < 1e6:
        raise NergError(
            f'the rotation of the area "{sanitize(name, 40)}" must be degrees about z, or a quaternion x, y, z, w'
        )
    x, y, z, w = numbers if isinstance(rotation, (int, float)) else (v / norm for v in numbers)
    return (x, y, z, w)


@dataclass(frozen=True)
class AreaEntry:
    """An unparsed area of a file: its ``name``, its JSON ``definition``, and its ``location`` for error messages."""

    name: object
    definition: Any
    location: str

    @property
    def is_box(self) -> bool:
        """Whether the entry is a box, which is the default if no key of another kind is present."""
        return not (isinstance(self.definition, dict) and any(key in self.definition for key in NON_BOX_KEYS))


def read_area_entries(path: str | Path) -> list[AreaEntry]:
    """Read the entries of a file of areas without parsing them. Raises `NergError` for another file, and for
    duplicate names.
    """
    return list_entries(read_json(path, "file of areas", MAX_BYTES), f'"{path}"')


def list_entries(document: object, source: str) -> list[AreaEntry]:
    """Return the entries of the JSON ``document`` of ``source``."""
    if isinstance(document, dict) and isinstance(document.get("regions"), list):
        pairs = [(item.get("name"), item) if isinstance(item, dict) else (None, item) for item in document["regions"]]
    elif isinstance(document, dict):
        pairs = list(document.items())
    else:
        raise NergError(f"{source} contains no areas; write {EXAMPLE} in the coordinates of the scene")
    if not 0 < len(pairs) <= MAX_AREAS:
        raise NergError(f"{source} has {len(pairs)} areas; 1 to {MAX_AREAS} are supported; write {EXAMPLE}")
    pairs = [(normalize_name(name) if isinstance(name, str) else name, item) for name, item in pairs]
    names = [name for name, _ in pairs if isinstance(name, str)]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise NergError(f'{source} has two areas with the name "{sanitize(repeated, 60)}"; rename one of them')
    return [AreaEntry(name, definition, f"{source}, area {k + 1}") for k, (name, definition) in enumerate(pairs)]


def parse_box(entry: AreaEntry) -> Region:
    """Parse an entry as a box. Raises `NergError` for an invalid box."""
    name, definition, location = entry.name, entry.definition, entry.location
    corners: Any = (definition.get("min"), definition.get("max")) if isinstance(definition, dict) else definition
    rotation: Any = definition.get("turn") if isinstance(definition, dict) else None
    keys = definition if isinstance(definition, dict) else ()
    unread = next((key for key in keys if _GEOMETRY_KEY.fullmatch(key)), None)
    if unread is not None:
        raise NergError(
            f'{location} has the key "{unread}", which is not read; a box has "min", "max" and "turn" (degrees about '
            "z, or a quaternion x, y, z, w)"
        )
    turns = rotation if isinstance(rotation, list) else [] if rotation is None else [rotation]
    if not all(is_number(v) for v in turns):
        raise NergError(
            f'{location} has the "turn" {sanitize(json.dumps(rotation), 60)}; it must be an angle in degrees about z, '
            "or a quaternion x, y, z, w"
        )
    try:
        lower, upper = (list(corner) for corner in corners)
        if not isinstance(name, str) or not all(is_number(v) for v in [*lower, *upper]):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise NergError(f"{location} needs a name, and two corners of three numbers each, as in {EXAMPLE}") from error
    try:
        return Region.create(name, lower, upper, rotation)
    except (NergError, OverflowError) as error:
        raise NergError(f"{location}: {error}") from error


def is_number(value: object) -> bool:
    """Return whether a JSON value is a number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def box_to_json(region: Region) -> dict[str, Any]:
    """Convert a box to a JSON object."""
    rotation = {} if region.rotation is None else {"turn": list(region.rotation)}
    return {"name": region.name, "min": list(region.lower), "max": list(region.upper), **rotation}


# ---- Objects of Aria Digital Twin ----
#
# Each object of a recording is a rotated box in the coordinate system of the gaze samples. ``3d_bounding_box.csv``
# contains the boxes in object coordinates, ``scene_objects.csv`` the poses of the objects, and ``instances.json`` their
# names (data format of ADT, facebookresearch/projectaria_tools). The world of the twin has y up and that of the gaze
# samples has z up: (x, y, z) becomes (x, -z, y), as in `nerg rays import --preset aria`. Poses with a timestamp belong
# to objects that were moved. They have no single position and are left out.

ADT_BOXES_FILE, ADT_POSES_FILE, ADT_NAMES_FILE = "3d_bounding_box.csv", "scene_objects.csv", "instances.json"
MAX_TABLE_BYTES = 256 << 20  # maximum size of a table in bytes
_MIN_THICKNESS = 1e-3  # minimum thickness of a box in metres
_UID, _TIME = "object_uid", "timestamp[ns]"
_BOX_COLUMNS = [f"p_local_obj_{axis}{end}[m]" for end in ("min", "max") for axis in "xyz"]
_POSITION_COLUMNS = [f"t_wo_{axis}[m]" for axis in "xyz"]
_QUATERNION_COLUMNS = [f"q_wo_{axis}" for axis in "xyzw"]
# Rotation from the world of the twin (y up) to that of the gaze samples (z up).
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def list_twin_files(folder: Path) -> list[Path]:
    """Return the existing files of ``folder`` that `read_twin_objects` reads."""
    return [folder / name for name in (ADT_BOXES_FILE, ADT_POSES_FILE, ADT_NAMES_FILE) if (folder / name).is_file()]


def read_twin_objects(folder: Path, categories: Collection[str] | None = None) -> list[Region]:
    """Read the static objects of a recording as boxes, sorted by name. Equal names are numbered.

    Parameters
    ----------
    folder
        Folder of the recording.
    categories
        Categories to read; None for all.

    Raises
    ------
    NergError
        For missing or damaged files, and if no object remains.
    """
    boxes, poses = (
        _read_rows(folder / ADT_BOXES_FILE, _BOX_COLUMNS),
        _read_rows(folder / ADT_POSES_FILE, [*_POSITION_COLUMNS, *_QUATERNION_COLUMNS]),
    )
    labels = _read_names(folder / ADT_NAMES_FILE)
    if categories is not None:
        existing = sorted({category for _, category in labels.values()})
        unknown = next((c for c in categories if c not in existing), None)
        if unknown is not None:
            listed = ", ".join(sanitize(k, 40) for k in existing[:30])
            raise NergError(
                f'"{folder}" has no objects of the category "{sanitize(unknown, 40)}"; existing categories: {listed}'
            )
    objects = []
    for uid in boxes:
        name, category = labels.get(uid, (uid, ""))
        if uid in poses and (categories is None or category in categories):
            objects.append((name, uid))
    if not objects:
        raise NergError(f'"{folder}" has no static object with a box and a pose; use other areas')
    if len(objects) > MAX_AREAS:
        raise NergError(
            f'"{folder}" has {len(objects):,} objects; the limit is {MAX_AREAS}; select some with "categories"'
        )
    objects.sort()
    count = {name: sum(n == name for n, _ in objects) for name, _ in objects}
    seen: dict[str, int] = {}
    regions = []
    for name, uid in objects:
        seen[name] = seen.get(name, 0) + 1
        unique_name = name if count[name] == 1 else f"{name} {seen[name]}"
        regions.append(_make_region(unique_name[:80], boxes[uid], poses[uid]))
    return regions


def _make_region(name: str, box: np.ndarray, pose: np.ndarray) -> Region:
    from scipy.spatial.transform import Rotation

    lower, upper = box[:3], np.maximum(box[3:], box[:3] + _MIN_THICKNESS)
    rotation = Rotation.from_matrix(_Z_UP_FROM_Y_UP) * Rotation.from_quat(pose[3:])
    center = _Z_UP_FROM_Y_UP @ pose[:3] + rotation.apply((lower + upper) / 2)
    half = (upper - lower) / 2
    return Region.create(name, center - half, center + half, rotation.as_quat())


def _read_rows(path: Path, columns: list[str]) -> dict[str, np.ndarray]:
    """Read the numbers of the rows without a timestamp, by object."""
    rows: dict[str, np.ndarray] = {}
    moving: set[str] = set()
    with translate_read_errors(path, "table of objects", "download it again", extra_errors=(csv.Error,)):
        table = open_csv(path, "table of objects", MAX_TABLE_BYTES)
        head = next((row for row in table if row), [])
        missing = [c for c in (_UID, _TIME, *columns) if c not in head]
        if missing:
            raise ValueError(f'it has no column "{missing[0]}"')
        uid, time, columns_at = head.index(_UID), head.index(_TIME), [head.index(c) for c in columns]
        for row in table:
            if not row:
                continue
            if len(row) != len(head):
                raise ValueError(f"line {table.line_num} has {len(row)} cells, the header {len(head)}")
            if int(row[time]) >= 0:
                moving.add(row[uid])
                continue
            values = np.array([parse_float(row[k]) for k in columns_at])
            if not (np.abs(values) < 1e6).all():
                raise ValueError(f"the object {sanitize(row[uid], 40)} has invalid numbers")
            if columns == _BOX_COLUMNS and not (values[:3] <= values[3:]).all():
                raise ValueError(f"the box of the object {sanitize(row[uid], 40)} has a maximum below its minimum")
            if columns != _BOX_COLUMNS and not 0.5 < np.linalg.norm(values[3:]) < 2:
                raise ValueError(f"the rotation of the object {sanitize(row[uid], 40)} is not a unit quaternion")
            rows[row[uid]] = values
    return {key: values for key, values in rows.items() if key not in moving}


def _read_names(path: Path) -> dict[str, tuple[str, str]]:
    """Read the name and category of each object; empty if the file does not exist."""
    if not is_regular_file(path, "file of instances"):
        return {}
    document = read_json(path, "file of instances")
    if not isinstance(document, dict):
        raise NergError(f'"{path}" contains no objects; download it again')
    names = {}
    for uid, entry in document.items():
        fields = entry if isinstance(entry, dict) else {}
        name, category = fields.get("instance_name", uid), fields.get("category", "")
        if not isinstance(name, str) or not isinstance(category, str):
            raise NergError(
                f'"{path}" has a name of the object {sanitize(uid, 40)} that is not a string; download it again'
            )
        clean = "".join(c if c.isprintable() else "?" for c in name).strip() or uid
        names[uid] = clean[:70], category
    return names
