"""Areas of interest in JSON files: boxes, parts of meshes, shapes of a scene, groups, and objects of Aria Digital
Twin."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.files.safe_read import is_count, is_regular_file, read_bytes, read_json, translate_read_errors
from nerg_mi.ranges import MAX_COORDINATE

# ---- Regions ----
#
# Areas of interest that are boxes with names, as JSON: drawn in the viewer, counted by a report, written by hand.
#
# What else may stand in such a file (parts of meshes, shapes of a scene, groups, the objects of a recording) is read by
# `nerg_mi.formats.areas`.

MAX_BYTES = 4 << 20  # a file of areas may have so many bytes
MAX_AREAS = 1000  # and so many areas
Quaternion = tuple[float, float, float, float]  # x, y, z, w
NON_BOX_KEYS = ("mesh", "shape", "parts", "adt")  # keys of which an area has one that is no box
_LETTERS = 80
_EXAMPLE = '{"shelf": [[0, 0, 0], [1, 2, 3]]}'


@dataclass(frozen=True)
class Region:
    """A box between two corners, in scene units; turned about its middle by the unit quaternion ``turn``, if any."""

    name: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    rotation: Quaternion | None = None

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper], float)
        if corners.shape == (2, 3) and not (np.abs(corners) <= MAX_COORDINATE).all():
            raise NergError(
                f'the area "{sanitize(self.name, 40)}" reaches to {np.abs(corners).max():g}; its corners must be finite, '
                f"and at most {MAX_COORDINATE:g}"
            )
        if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
            raise NergError(
                f'the area "{sanitize(self.name, 40)}" needs a lower and an upper corner of three numbers, each '
                "less in the lower one"
            )
        check_area_name(self.name)
        if self.rotation is not None:
            size = math.hypot(*self.rotation) if len(self.rotation) == 4 else math.nan
            if not abs(size - 1) < 1e-3:
                raise NergError(f'the turn of the area "{sanitize(self.name, 40)}" is no rotation; give a unit quaternion')

    @classmethod
    def create(
        cls, name: str, lower: Iterable[float], upper: Iterable[float], rotation: Iterable[float] | float | None = None
    ) -> Region:
        """The same of any numbers. ``turn``: a quaternion (x, y, z, w) of any length but zero, or degrees about z,
        counter-clockwise seen from above. Raises `NergError` where they are not three each, or no rotation."""
        low, high = [float(v) for v in lower], [float(v) for v in upper]
        if len(low) != 3 or len(high) != 3:
            raise NergError(f'the area "{sanitize(name, 40)}" needs a lower and an upper corner of three numbers')
        return cls(name, (low[0], low[1], low[2]), (high[0], high[1], high[2]), _turn(rotation, name))

    @property
    def corners(self) -> np.ndarray:
        """(2, 3)."""
        return np.array([self.lower, self.upper], float)

    @property
    def center(self) -> np.ndarray:
        """(3,)."""
        return self.corners.mean(axis=0)

    @property
    def rotation_matrix(self) -> np.ndarray:
        """Rotation (3, 3) whose columns are the box's own axes."""
        if self.rotation is None:
            return np.eye(3)
        x, y, z, w = np.array(self.rotation, float) / math.hypot(*self.rotation)
        return quaternions_to_matrices(np.array([[w, x, y, z]]))[0]

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """``points`` (..., 3) turned back about the middle, where this is the box between `corners`."""
        return points if self.rotation is None else (points - self.center) @ self.rotation_matrix + self.center

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `to_own`."""
        return points if self.rotation is None else (points - self.center) @ self.rotation_matrix.T + self.center

    @property
    def vertices(self) -> np.ndarray:
        """The box's own eight corners (8, 3); bit k of a row's number chooses the upper one along axis k."""
        upper = (np.arange(8)[:, None] >> np.arange(3) & 1).astype(bool)
        return self.to_world(np.where(upper, self.corners[1], self.corners[0]))

    @property
    def bounds(self) -> np.ndarray:
        """Corners (2, 3) of the smallest upright box around it."""
        return self.corners if self.rotation is None else np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def contains(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether ``points`` (..., 3) lie in it, or no farther than ``margin`` from it along each of its axes."""
        lower, upper = self.corners
        with np.errstate(invalid="ignore"):
            points = self.to_local(np.asarray(points, float))
        return np.all((points >= lower - margin) & (points <= upper + margin), axis=-1)


def check_area_name(name: str) -> None:
    """Raise `NergError` for a name that no area may have."""
    if not name.strip() or len(name) > _LETTERS or not name.isprintable():
        raise NergError(f'an area needs a name of 1 to {_LETTERS} printable characters, got "{sanitize(name, 40)}"')


def _turn(turn: Iterable[float] | float | None, name: str) -> Quaternion | None:
    if turn is None:
        return None
    if isinstance(turn, (int, float)):
        half = math.radians(float(turn)) / 2 if math.isfinite(turn) else math.nan
        numbers = [0.0, 0.0, math.sin(half), math.cos(half)]
    else:
        numbers = [float(v) for v in turn]
    size = math.hypot(*numbers)
    if len(numbers) != 4 or not 1e-6 < size < 1e6:
        raise NergError(f'the turn of the area "{sanitize(name, 40)}" is degrees about z, or four numbers x, y, z, w')
    x, y, z, w = numbers if isinstance(turn, (int, float)) else (v / size for v in numbers)
    return (x, y, z, w)


def read_regions(path: str | Path) -> list[Region]:
    """The areas of a JSON file that are boxes, in its order; others are passed over (`nerg_mi.formats.areas`).

    Either as `to_json` writes them, ``{"regions": [{"name": "shelf", "min": [x, y, z], "max": [x, y, z]}]}`` with
    anything beside, or names and boxes alone: ``{"shelf": [[x, y, z], [x, y, z]]}``, or ``{"shelf": {"min": [...],
    "max": [...]}}``. A box may have a ``turn`` about its middle: degrees about z, or a quaternion x, y, z, w. Raises
    `NergError` for what is neither, and where none is a box.
    """
    entries = read_area_entries(path)
    boxes = [parse_box(e) for e in entries if e.is_box]
    if not boxes:
        raise NergError(f'"{path}" has no area that is a box; draw one in the viewer, or write {_EXAMPLE}')
    return boxes


@dataclass(frozen=True)
class AreaEntry:
    """What a file says of an area: its ``name`` and what it is ``given`` as; ``where``: for errors."""

    name: object
    definition: Any
    location: str

    @property
    def is_box(self) -> bool:
        """Whether it is a box, or nothing that is known."""
        return not (isinstance(self.definition, dict) and any(key in self.definition for key in NON_BOX_KEYS))


def read_area_entries(path: str | Path) -> list[AreaEntry]:
    """What a file of areas has, not looked at yet. Raises `NergError` for what is no such file, and for names that come
    twice."""
    found = read_json(path, "file of areas", MAX_BYTES)
    if isinstance(found, dict) and isinstance(found.get("regions"), list):
        listed = [(one.get("name"), one) if isinstance(one, dict) else (None, one) for one in found["regions"]]
    elif isinstance(found, dict):
        listed = list(found.items())
    else:
        raise NergError(f'"{path}" names no areas; write {_EXAMPLE} in the coordinates of the place')
    if not 0 < len(listed) <= MAX_AREAS:
        raise NergError(f'"{path}" has {len(listed)} areas, and 1 to {MAX_AREAS} are read; write {_EXAMPLE}')
    names = [name for name, _ in listed if isinstance(name, str)]
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" has two areas of one name; rename one of them')
    return [AreaEntry(name, given, f'"{path}", area {k + 1}') for k, (name, given) in enumerate(listed)]


def parse_box(entry: AreaEntry) -> Region:
    """The box of an entry. Raises `NergError` for what is none."""
    name, given, where = entry.name, entry.definition, entry.location
    corners: Any = (given.get("min"), given.get("max")) if isinstance(given, dict) else given
    turn: Any = given.get("turn") if isinstance(given, dict) else None
    try:
        lower, upper = (list(corner) for corner in corners)
        numbers = [*lower, *upper, *(turn if isinstance(turn, list) else [] if turn is None else [turn])]
        if not isinstance(name, str) or not all(is_number(v) for v in numbers):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise NergError(f"{where} needs a name, and two corners of three numbers each, as in {_EXAMPLE}") from error
    try:
        return Region.create(name, lower, upper, turn)
    except (NergError, OverflowError) as error:
        raise NergError(f"{where}: {error}") from error


def is_number(value: object) -> bool:
    """Whether a value of a JSON file is one."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def format_areas(regions: Sequence[Region], other_areas: Sequence[dict[str, Any]] = ()) -> str:
    """``regions`` as the text of a JSON file, with ``others`` as they stood in one after them."""
    return json.dumps({"regions": [*map(box_to_json, regions), *other_areas]}, indent=1) + "\n"


def box_to_json(region: Region) -> dict[str, Any]:
    """A box as it stands in a file."""
    turn = {} if region.rotation is None else {"turn": list(region.rotation)}
    return {"name": region.name, "min": list(region.lower), "max": list(region.upper), **turn}


# ---- What an area of interest can be, besides a box (`nerg_mi.formats.areas.Region`) ----

MAX_GROUP_DEPTH = 100  # so deep may groups be nested that stand before their parts


@dataclass(frozen=True)
class MeshPart:
    """The mesh in ``file``, or those of its faces whose numbers lie in one of the ranges ``faces``, ends included."""

    name: str
    file: Path
    faces: tuple[tuple[int, int], ...] | None = None

    def select_faces(self, count: int) -> np.ndarray:
        """Which of ``count`` faces are of it, (count,) bool. Raises `NergError` for ranges beyond them."""
        if self.faces is None:
            return np.ones(count, bool)
        found = np.zeros(count, bool)
        for first, last in self.faces:
            if last >= count:
                raise NergError(
                    f'the area "{self.name}" asks for face {last} of "{self.file}", which has {count:,} (from 0 on)'
                )
            found[first : last + 1] = True
        return found


@dataclass(frozen=True)
class SceneShape:
    """The shape of the scene whose id is ``shape``."""

    name: str
    shape: str


@dataclass(frozen=True)
class AreaGroup:
    """Several others, by their names: whoever looks at one of its ``parts`` looks at it."""

    name: str
    parts: tuple[str, ...]


Area = Region | MeshPart | SceneShape | AreaGroup


@dataclass(frozen=True)
class AreaSet:
    """The areas of a file, in its order, whose names are different.

    ``others``: those that are no boxes, as they stand in the file. Raises `NergError` for groups of what there is not,
    and for groups that hold themselves.
    """

    areas: tuple[Area, ...]
    non_boxes: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        names = [a.name for a in self.areas]
        twice = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
        if twice is not None:
            raise NergError(f'two areas are called "{twice}"; rename one of them')
        for area in self.areas:
            if not isinstance(area, AreaGroup):
                continue
            unknown = next((p for p in area.parts if p not in names), None)
            if unknown is not None:
                raise NergError(f'the group "{area.name}" has a part "{unknown}", and there is no such area')
        self.element_indices()

    @property
    def names(self) -> tuple[str, ...]:
        """Of all."""
        return tuple(a.name for a in self.areas)

    @property
    def boxes(self) -> list[Region]:
        """Those that are boxes."""
        return [a for a in self.areas if isinstance(a, Region)]

    @property
    def elements(self) -> tuple[Region | MeshPart | SceneShape, ...]:
        """Those that are no groups."""
        return tuple(a for a in self.areas if not isinstance(a, AreaGroup))

    @property
    def meshes(self) -> list[Path]:
        """Files of those that are parts of meshes."""
        return [a.file for a in self.areas if isinstance(a, MeshPart)]

    @property
    def box_indices(self) -> dict[str, tuple[int, ...]]:
        """Those that are boxes, or groups of boxes alone, by name: the numbers of the `boxes` that each consists of."""
        number = {k: n for n, k in enumerate(k for k, thing in enumerate(self.elements) if isinstance(thing, Region))}
        every = self.element_indices().items()
        return {name: tuple(number[k] for k in of) for name, of in every if all(k in number for k in of)}

    def element_indices(self) -> dict[str, tuple[int, ...]]:
        """Of each area, which of the `things` it consists of, by their numbers."""
        by_name = {a.name: a for a in self.areas}
        known = {a.name: frozenset([k]) for k, a in enumerate(self.elements)}
        for area in self.areas:
            _resolve(area, by_name, known, ())
        return {a.name: tuple(sorted(known[a.name])) for a in self.areas}


def _resolve(area: Area, by_name: dict[str, Area], known: dict[str, frozenset[int]], above: tuple[str, ...]) -> None:
    """Add to what is ``known`` of which things areas consist those of ``area`` and of its parts, each looked at once.
    Raises `NergError` for a group that holds itself."""
    if area.name in above or len(above) > MAX_GROUP_DEPTH:
        raise NergError(f'the group "{area.name}" holds itself, or groups are nested deeper than {MAX_GROUP_DEPTH}')
    if area.name in known or not isinstance(area, AreaGroup):
        return
    for part in area.parts:
        _resolve(by_name[part], by_name, known, (*above, area.name))
    known[area.name] = frozenset().union(*(known[part] for part in area.parts))


# ---- Twin objects ----
#
# The objects of a recording of Aria Digital Twin: a turned box each, in the frame of rays.
#
# ``3d_bounding_box.csv`` has the boxes in the objects' own frames, ``scene_objects.csv`` where these are, and
# ``instances.json`` what they are called (the format of facebookresearch/projectaria_tools, ADT's data format). The
# twin's world has y up; that of rays z: (x, y, z) becomes (x, -z, y), as `nerg rays import --preset aria` does for its
# recordings. Poses with a time are those of objects that were carried about: these have no one place, and are left out.

ADT_BOXES_FILE, ADT_POSES_FILE, ADT_NAMES_FILE = "3d_bounding_box.csv", "scene_objects.csv", "instances.json"
MAX_TABLE_BYTES = 256 << 20  # a table may have so many bytes
_THIN = 1e-3  # metres: a box that is thinner is made so thick
_UID, _TIME = "object_uid", "timestamp[ns]"
_SIDES = [f"p_local_obj_{axis}{end}[m]" for end in ("min", "max") for axis in "xyz"]
_PLACE = [f"t_wo_{axis}[m]" for axis in "xyz"]
_TURN = [f"q_wo_{axis}" for axis in "xyzw"]
# From the twin's world, whose y is up, to that of rays.
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def list_twin_files(folder: Path) -> list[Path]:
    """Those files that `read_twin_objects` reads of a recording's ``folder`` and that are there."""
    return [folder / name for name in (ADT_BOXES_FILE, ADT_POSES_FILE, ADT_NAMES_FILE) if (folder / name).is_file()]


def read_twin_objects(folder: Path, categories: Collection[str] | None = None) -> list[Region]:
    """The objects that stand still, sorted by name; of ``categories`` alone, if any. Equal names are numbered.

    Raises `NergError` for a folder without these files, damaged ones, and where no object is left.
    """
    sides, places = _rows(folder / ADT_BOXES_FILE, _SIDES), _rows(folder / ADT_POSES_FILE, [*_PLACE, *_TURN])
    about = _names(folder / ADT_NAMES_FILE)
    if categories is not None:
        known = sorted({category for _, category in about.values()})
        unknown = next((c for c in categories if c not in known), None)
        if unknown is not None:
            listed = ", ".join(sanitize(k, 40) for k in known[:30])
            raise NergError(f'"{folder}" has no objects of the category "{sanitize(unknown, 40)}"; there are {listed}')
    found = []
    for uid in sides:
        name, category = about.get(uid, (uid, ""))
        if uid in places and (categories is None or category in categories):
            found.append((name, uid))
    if not found:
        raise NergError(f'"{folder}" has no object that stands still with a box and a place; name other areas')
    if len(found) > MAX_AREAS:
        raise NergError(
            f'"{folder}" has {len(found):,} objects, and {MAX_AREAS} areas are read; choose some by "categories"'
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
    return Region.create(name, middle - half, middle + half, turn.as_quat())


def _rows(path: Path, columns: list[str]) -> dict[str, np.ndarray]:
    """Numbers of the rows without a time, by object."""
    raw = read_bytes(path, "table of objects", MAX_TABLE_BYTES)
    found: dict[str, np.ndarray] = {}
    moving: set[str] = set()
    with translate_read_errors(path, "table of objects", "download it again", extra_errors=(csv.Error,)):
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
                raise ValueError(f"the object {sanitize(row[uid], 40)} has numbers that are none")
            if columns == _SIDES and not (values[:3] <= values[3:]).all():
                raise ValueError(f"the box of the object {sanitize(row[uid], 40)} ends before it begins")
            if columns != _SIDES and not 0.5 < np.linalg.norm(values[3:]) < 2:
                raise ValueError(f"the turn of the object {sanitize(row[uid], 40)} is no rotation")
            found[row[uid]] = values
    return {key: values for key, values in found.items() if key not in moving}


def _names(path: Path) -> dict[str, tuple[str, str]]:
    """Name and category of objects; none where there is no such file."""
    if not is_regular_file(path, "file of instances"):
        return {}
    found = read_json(path, "file of instances")
    if not isinstance(found, dict):
        raise NergError(f'"{path}" names no objects; download it again')
    names = {}
    for uid, about in found.items():
        told = about if isinstance(about, dict) else {}
        name, category = told.get("instance_name", uid), told.get("category", "")
        if not isinstance(name, str) or not isinstance(category, str):
            raise NergError(f'"{path}" has a name of the object {sanitize(uid, 40)} that is no text; download it again')
        clean = "".join(c if c.isprintable() else "?" for c in name).strip() or uid
        names[uid] = clean[:70], category
    return names


# ---- Reading areas of interest from a JSON file, or from the folder of a recording of Aria Digital Twin ----

MESH_SUFFIXES = (".ply", ".obj")  # suffixes of meshes that an area can be a part of
MAX_PARTS = 1000  # so many ranges of faces, parts of a group, or categories may an area name

_READING_EXAMPLE = (
    '{"name": "a", "min": [0, 0, 0], "max": [1, 2, 3]}, {"name": "b", "mesh": "sign.ply", "faces": [0, [4, 9]]}, '
    '{"name": "c", "shape": "id"}, {"name": "all", "parts": ["a", "b"]} or {"adt": "folder"}'
)


def read_areas(path: str | Path) -> AreaSet:
    """The areas of a JSON file, or the objects in the folder of a recording of Aria Digital Twin.

    Beside boxes (`nerg_mi.formats.areas.read_regions`) an area is a mesh or some of its faces (``mesh``: a .ply or
    .obj in the file's folder or below it, ``faces``: numbers from 0 on, or pairs of a first and a last one), a shape of
    the scene (``shape``: its id), a group of others (``parts``: names), or the objects of a recording (``adt``: its
    folder, ``categories``: those that are taken; with a name they are a group, too). Raises `NergError`.
    """
    path = Path(path)
    if path.is_dir():
        return AreaSet(tuple(read_twin_objects(path)))
    found: list[Area] = []
    others: list[dict[str, Any]] = []
    for entry in read_area_entries(path):
        if entry.is_box:
            found.append(parse_box(entry))
            continue
        named = {"name": entry.name} if isinstance(entry.name, str) else {}
        others.append({**named, **entry.definition})
        try:
            found += _other(entry, path)
        except NergError as error:
            raise NergError(f"{entry.location}: {error}") from error
        if len(found) > MAX_AREAS:
            raise NergError(f'"{path}" has more than {MAX_AREAS} areas; choose some of the objects by "categories"')
    try:
        return AreaSet(tuple(found), tuple(others))
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def list_area_files(path: str | Path, areas: AreaSet) -> list[Path]:
    """The files that `read_areas` and whoever loads the meshes of its ``areas`` read of ``path``."""
    path = Path(path)
    if path.is_dir():
        return list_twin_files(path)
    twins = [file for given in areas.non_boxes if "adt" in given for file in list_twin_files(path.parent / given["adt"])]
    return list(dict.fromkeys([path, *areas.meshes, *twins]))


def _other(entry: AreaEntry, path: Path) -> list[Area]:
    """The areas of an entry that is no box."""
    given = entry.definition
    if "adt" in given:
        return _objects(entry, path)
    name = entry.name
    if not isinstance(name, str):
        raise NergError(f"an area needs a name, as in {_READING_EXAMPLE}")
    check_area_name(name)
    if "mesh" in given:
        file = resolve_mesh_path(given["mesh"], path)
        return [MeshPart(name, file, None if given.get("faces") is None else _ranges(given["faces"]))]
    if "shape" in given:
        if not isinstance(given["shape"], str) or not given["shape"]:
            raise NergError('"shape" must be the id of a shape of the scene')
        return [SceneShape(name, given["shape"])]
    return [AreaGroup(name, _words(given["parts"], "parts"))]


def _objects(entry: AreaEntry, path: Path) -> list[Area]:
    categories = entry.definition.get("categories")
    chosen = None if categories is None else _words(categories, "categories")
    objects: list[Area] = list(read_twin_objects(_inside(entry.definition["adt"], path), chosen))
    if entry.name is None or entry.name == "":
        return objects
    if not isinstance(entry.name, str):
        raise NergError("a name must be a text")
    check_area_name(entry.name)
    return [*objects, AreaGroup(entry.name, tuple(a.name for a in objects))]


def resolve_mesh_path(name: object, path: Path, file_kind: str = "areas") -> Path:
    """The mesh ``name`` (.ply, .obj) beside the file ``path`` of ``what``, or below. Raises `NergError` for other
    names."""
    file = _inside(name, path, file_kind)
    if file.suffix.lower() not in MESH_SUFFIXES:
        raise NergError(
            f'the mesh "{sanitize(file.name, 60)}" is no .ply or .obj; convert it to one of {", ".join(MESH_SUFFIXES)}'
        )
    return file


def _inside(name: object, path: Path, what: str = "areas") -> Path:
    """The file or folder ``name`` beside the file ``path`` of ``what``, or below."""
    if not isinstance(name, str) or not 0 < len(name) <= 1000 or "\0" in name:
        raise NergError('a file is named by a text, as in {"name": "a", "mesh": "sign.ply"}')
    folder = os.path.realpath(path.parent)
    found = os.path.realpath(os.path.join(folder, name))
    if os.path.isabs(name) or os.path.commonpath([folder, found]) != folder:
        raise NergError(f'"{sanitize(name, 80)}" lies outside of the folder of the {what}; put it, or a copy, there')
    return path.parent / name


def _ranges(given: object) -> tuple[tuple[int, int], ...]:
    """Numbers of faces, or pairs of a first and a last one."""
    listed = given if isinstance(given, list) else [None]
    found = []
    for one in listed if 0 < len(listed) <= MAX_PARTS else [None]:
        ends: list[Any] = one if isinstance(one, list) else [one, one]
        if len(ends) != 2 or not all(is_count(v) for v in ends) or ends[0] > ends[1]:
            raise NergError('"faces" are numbers from 0 on, or pairs of a first and a last one, as in [0, [4, 9]]')
        found.append((int(ends[0]), int(ends[1])))
    return tuple(found)


def _words(given: object, what: str) -> tuple[str, ...]:
    if not isinstance(given, list) or not 0 < len(given) <= MAX_PARTS or not all(isinstance(w, str) for w in given):
        raise NergError(f'"{what}" must be 1 to {MAX_PARTS} names')
    return tuple(dict.fromkeys(given))
