"""What if: a file of changes to a scene and its observers, read and made.

.. code-block:: json

    {"move": [{"shape": "sign", "by": [0.5, 0, 0], "turn": 90}, {"area": "shelf", "by": [0, 1, 0]}],
     "remove": ["stand"], "add": [{"name": "poster", "min": [1, 0, 1], "max": [2, 0.1, 2]}],
     "swap": [{"shape": "till", "mesh": "till2.ply"}],
     "observers": [[1, 2, 1.6]], "shift": [0, 0, -0.2]}

A turn is in degrees about the vertical through the middle of what is moved, counter-clockwise seen from above. Moved
shapes keep the areas that name them; boxes, which name no shape, are moved as areas. The gaze field stays as it was
trained: it knows places and what stood there, and says of a thing at its new place what it learnt of surfaces there.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import read_json
from nerg_mi.formats.areas.kinds import Area, Areas, Group, SceneShape
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.regions import Entry, Region, check_name, is_number, parse_box
from nerg_mi.ranges import COORDINATES
from nerg_mi.surfaces.mesh import mitsuba_mesh

from .things import scene_of, shape_named, shapes_of

if TYPE_CHECKING:
    import mitsuba as mi

BYTES = 1 << 20
"""A file of changes may have so many bytes."""

MOST = 1000
"""And so many changes, or observers, of a kind."""

_KEYS = ("move", "remove", "add", "swap", "observers", "shift")
_EXAMPLE = '{"move": [{"shape": "sign", "by": [0.5, 0, 0]}], "remove": ["stand"]}'


@dataclass(frozen=True)
class Move:
    """Of a shape, or, if not, an area: first turned by degrees about its middle's vertical, then moved ``by``."""

    name: str
    is_shape: bool
    by: tuple[float, float, float]
    turn: float


@dataclass(frozen=True)
class Put:
    """What is added, or stands in place of the shape of its name: a box or a mesh."""

    name: str
    what: Region | Path


@dataclass(frozen=True)
class Changes:
    """All changes; ``observers`` (M, 3) in place of those that there were, or None; ``shift`` of these (3,)."""

    move: tuple[Move, ...] = ()
    remove: tuple[str, ...] = ()
    add: tuple[Put, ...] = ()
    swap: tuple[Put, ...] = ()
    observers: np.ndarray | None = None
    shift: np.ndarray | None = None

    @property
    def of_shapes(self) -> bool:
        """Whether the scene is another one."""
        return bool(self.remove or self.add or self.swap or any(m.is_shape for m in self.move))


def read_changes(path: str | Path) -> Changes:
    """The changes of a JSON file. Raises `NergError` for what is none of them."""
    path = Path(path)
    found = read_json(path, "file of changes", BYTES)
    unknown = next((k for k in found if k not in _KEYS), None) if isinstance(found, dict) else ""
    if not isinstance(found, dict) or not found or unknown is not None:
        said = "" if not unknown else f'; "{plain(unknown, 40)}" is none of {", ".join(_KEYS)}'
        raise NergError(f'"{path}" holds no changes; write {_EXAMPLE}{said}')
    try:
        listed = {key: _listed(found, key) for key in _KEYS[:5]}
        observers = listed["observers"]
        return Changes(
            tuple(_move(one) for one in listed["move"]),
            tuple(_word(one, "remove") for one in listed["remove"]),
            tuple(_put(one, "name", path) for one in listed["add"]),
            tuple(_put(one, "shape", path) for one in listed["swap"]),
            np.array([_three(one, "observers") for one in observers]) if observers else None,
            np.array(_three(found["shift"], "shift")) if "shift" in found else None,
        )
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def files_of_changes(path: str | Path, changes: Changes) -> list[Path]:
    """The files that ``changes`` were read from: the ``path`` and its meshes."""
    meshes = [put.what for put in (*changes.add, *changes.swap) if isinstance(put.what, Path)]
    return list(dict.fromkeys([Path(path), *meshes]))


def _listed(found: dict[str, Any], key: str) -> list[Any]:
    given = found.get(key, [])
    if not isinstance(given, list) or len(given) > MOST or (key in found and not given):
        raise NergError(f'"{key}" is a list of 1 to {MOST}, as in {_EXAMPLE}')
    return given


def _move(given: Any) -> Move:
    keys = [k for k in ("shape", "area") if isinstance(given, dict) and k in given]
    if len(keys) != 1 or set(given) - {keys[0], "by", "turn"}:
        raise NergError(f'a "move" names a "shape" or an "area", "by" what, and a "turn" in degrees, as in {_EXAMPLE}')
    turn = given.get("turn", 0)
    if not is_number(turn) or not abs(turn) <= 1e6:
        raise NergError('a "turn" must be in degrees')
    by = _three(given.get("by", [0, 0, 0]), "by")
    return Move(_word(given[keys[0]], keys[0]), keys[0] == "shape", by, float(turn))


def _put(given: Any, key: str, path: Path) -> Put:
    if not isinstance(given, dict) or not isinstance(given.get(key), str):
        raise NergError(f'what is added has a "name", and what is swapped a "shape", as in {_EXAMPLE}')
    name = _word(given[key], key)
    check_name(name)
    if "mesh" not in given:
        return Put(name, parse_box(Entry(name, given, f'"{plain(name, 40)}"')))
    mesh = _word(given["mesh"], "mesh")
    folder = os.path.realpath(path.parent)
    if os.path.isabs(mesh) or os.path.commonpath([folder, os.path.realpath(os.path.join(folder, mesh))]) != folder:
        raise NergError(f'"{plain(mesh, 80)}" lies outside of the folder of the changes; put it, or a copy, there')
    if Path(mesh).suffix.lower() not in (".ply", ".obj"):
        raise NergError(f'the mesh "{plain(mesh, 80)}" is no .ply or .obj; convert it')
    return Put(name, path.parent / mesh)


def _word(given: Any, what: str) -> str:
    if not isinstance(given, str) or not 0 < len(given) <= 1000 or "\0" in given:
        raise NergError(f'"{what}" is a name, as in {_EXAMPLE}')
    return given


def _three(given: Any, what: str) -> tuple[float, float, float]:
    numbers = isinstance(given, list) and len(given) == 3 and all(is_number(v) for v in given)
    if not numbers or not all(v in COORDINATES for v in given):
        raise NergError(f'"{what}" is three numbers x, y, z of {COORDINATES}')
    return float(given[0]), float(given[1]), float(given[2])


def changed_areas(areas: Areas, changes: Changes) -> Areas:
    """The areas after the changes: without those of shapes that are gone, boxes moved, and one for each shape that was
    added and has none. Raises `NergError` for an area to be moved that there is not, or is no box."""
    found: dict[str, Area] = {area.name: area for area in areas.areas}
    for move in changes.move:
        if move.is_shape:
            continue
        area = found.get(move.name)
        if not isinstance(area, Region):
            what = "is no box, and moves with its shape" if area is not None else "is none of the areas"
            raise NergError(f'"{plain(move.name, 40)}" cannot be moved as an area: it {what}')
        found[move.name] = _moved(area, move)
    for put in changes.add:
        found.setdefault(put.name, SceneShape(put.name, put.name))
    # Areas of what is removed go, and groups with them that have nothing else.
    lost = {a.name for a in found.values() if isinstance(a, SceneShape) and a.shape in changes.remove}
    rest: list[Area] = []
    for area in found.values():
        if isinstance(area, Group):
            parts = tuple(p for p in area.parts if p not in lost)
            lost |= set() if parts else {area.name}
            area = Group(area.name, parts)
        if area.name not in lost:
            rest.append(area)
    return Areas(tuple(rest))


def _moved(box: Region, move: Move) -> Region:
    from scipy.spatial.transform import Rotation

    about = Rotation.from_euler("z", move.turn, degrees=True)
    turn = None if box.turn is None and move.turn == 0 else (about * Rotation.from_matrix(box.matrix)).as_quat()
    by = np.array(move.by)
    return Region.of(box.name, np.array(box.lower) + by, np.array(box.upper) + by, turn)


def changed_scene(scene: mi.Scene | None, changes: Changes) -> tuple[mi.Scene, dict[str, Any]]:
    """Another scene with the changed shapes, which has those that stay in common with ``scene``, and all of its shapes
    by name. Raises `NergError` for shapes that there are not, or cannot be moved."""
    if scene is None:
        raise NergError("shapes are changed in a scene; give one (.xml), since a trained field cannot be taken apart")
    kept = shapes_of(scene)
    gone = {*changes.remove, *(put.name for put in changes.swap)}
    for name in gone:
        shape_named(kept, name)
    for name in gone:
        del kept[name]
    for move in changes.move:
        if move.is_shape:
            if move.name in gone:
                raise NergError(f'the shape "{plain(move.name, 40)}" is moved and taken away; do one of them')
            kept[move.name] = _moved_shape(shape_named(kept, move.name), move)
    for put in (*changes.add, *changes.swap):
        if put.name in kept:
            raise NergError(f'there is a shape "{plain(put.name, 40)}" already; "swap" it, or choose another name')
        kept[put.name] = _made(put)
    if not kept:
        raise NergError("no shape is left; leave one at least")
    return scene_of(kept), kept


def _moved_shape(shape: Any, move: Move) -> Any:
    import mitsuba as mi

    if not shape.is_mesh():
        raise NergError(f'the shape "{plain(move.name, 40)}" is no mesh, and only meshes are moved; "swap" it for one')
    params: Any = mi.traverse(shape)
    vertices = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    c, s = np.cos(np.radians(move.turn)), np.sin(np.radians(move.turn))
    turned = (vertices - middle) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + middle + move.by
    return mitsuba_mesh(turned, np.array(params["faces"]).reshape(-1, 3), move.name)


def _made(put: Put) -> Any:
    if isinstance(put.what, Path):
        mesh = read_mesh_file(put.what)
        return mitsuba_mesh(mesh.vertices, mesh.faces, put.name)
    corner = lambda *bits: sum(b << k for k, b in enumerate(bits))
    faces = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in (0, 1):
            at = [[0, 0, 0] for _ in range(4)]
            for n, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                at[n][axis], at[n][u], at[n][v] = side, a, b
            q = [corner(*bits) for bits in at]
            faces += [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
    return mitsuba_mesh(put.what.vertices, np.array(faces), put.name)
