"""Reading areas of interest from a JSON file, or from the folder of a recording of Aria Digital Twin."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, plain
from nerg_mi.files.safe_read import is_count
from nerg_mi.formats.regions import MOST, Entry, check_name, parse_box, read_entries

from .kinds import Area, Areas, Group, MeshPart, SceneShape
from .twin_objects import files_of_twin, read_twin_objects

MESHES = (".ply", ".obj")
"""Suffixes of meshes that an area can be a part of."""

PARTS = 1000
"""So many ranges of faces, parts of a group, or categories may an area name."""

_EXAMPLE = (
    '{"name": "a", "min": [0, 0, 0], "max": [1, 2, 3]}, {"name": "b", "mesh": "sign.ply", "faces": [0, [4, 9]]}, '
    '{"name": "c", "shape": "id"}, {"name": "all", "parts": ["a", "b"]} or {"adt": "folder"}'
)


def read_areas(path: str | Path) -> Areas:
    """The areas of a JSON file, or the objects in the folder of a recording of Aria Digital Twin.

    Beside boxes (`nerg_mi.formats.regions.read_regions`) an area is a mesh or some of its faces (``mesh``: a .ply or
    .obj in the file's folder or below it, ``faces``: numbers from 0 on, or pairs of a first and a last one), a shape of
    the scene (``shape``: its id), a group of others (``parts``: names), or the objects of a recording (``adt``: its
    folder, ``categories``: those that are taken; with a name they are a group, too). Raises `NergError`.
    """
    path = Path(path)
    if path.is_dir():
        return Areas(tuple(read_twin_objects(path)))
    found: list[Area] = []
    others: list[dict[str, Any]] = []
    for entry in read_entries(path):
        if entry.is_box:
            found.append(parse_box(entry))
            continue
        named = {"name": entry.name} if isinstance(entry.name, str) else {}
        others.append({**named, **entry.given})
        try:
            found += _other(entry, path)
        except NergError as error:
            raise NergError(f"{entry.where}: {error}") from error
        if len(found) > MOST:
            raise NergError(f'"{path}" has more than {MOST} areas; choose some of the objects by "categories"')
    try:
        return Areas(tuple(found), tuple(others))
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def files_of_areas(path: str | Path, areas: Areas) -> list[Path]:
    """The files that `read_areas` and whoever loads the meshes of its ``areas`` read of ``path``."""
    path = Path(path)
    if path.is_dir():
        return files_of_twin(path)
    meshes = [area.file for area in areas.areas if isinstance(area, MeshPart)]
    twins = [file for given in areas.others if "adt" in given for file in files_of_twin(path.parent / given["adt"])]
    return list(dict.fromkeys([path, *meshes, *twins]))


def _other(entry: Entry, path: Path) -> list[Area]:
    """The areas of an entry that is no box."""
    given = entry.given
    if "adt" in given:
        return _objects(entry, path)
    name = entry.name
    if not isinstance(name, str):
        raise NergError(f"an area needs a name, as in {_EXAMPLE}")
    check_name(name)
    if "mesh" in given:
        file = _inside(given["mesh"], path)
        if file.suffix.lower() not in MESHES:
            raise NergError(
                f'the mesh "{plain(file.name, 60)}" is no .ply or .obj; convert it to one of {", ".join(MESHES)}'
            )
        return [MeshPart(name, file, None if given.get("faces") is None else _ranges(given["faces"]))]
    if "shape" in given:
        if not isinstance(given["shape"], str) or not given["shape"]:
            raise NergError('"shape" must be the id of a shape of the scene')
        return [SceneShape(name, given["shape"])]
    return [Group(name, _words(given["parts"], "parts"))]


def _objects(entry: Entry, path: Path) -> list[Area]:
    categories = entry.given.get("categories")
    chosen = None if categories is None else _words(categories, "categories")
    objects: list[Area] = list(read_twin_objects(_inside(entry.given["adt"], path), chosen))
    if entry.name is None or entry.name == "":
        return objects
    if not isinstance(entry.name, str):
        raise NergError("a name must be a text")
    check_name(entry.name)
    return [*objects, Group(entry.name, tuple(a.name for a in objects))]


def _inside(name: object, path: Path) -> Path:
    """The file or folder ``name`` beside the file of areas ``path``, or below."""
    if not isinstance(name, str) or not name or "\0" in name or len(name) > 1000:
        raise NergError(f"a file is named by a text, as in {_EXAMPLE}")
    folder = os.path.realpath(path.parent)
    found = os.path.realpath(os.path.join(folder, name))
    if os.path.isabs(name) or os.path.commonpath([folder, found]) != folder:
        raise NergError(f'"{plain(name, 80)}" lies outside of the folder of the areas; put it, or a copy, there')
    return path.parent / name


def _ranges(given: object) -> tuple[tuple[int, int], ...]:
    """Numbers of faces, or pairs of a first and a last one."""
    listed = given if isinstance(given, list) else [None]
    found = []
    for one in listed if 0 < len(listed) <= PARTS else [None]:
        ends: list[Any] = one if isinstance(one, list) else [one, one]
        if len(ends) != 2 or not all(is_count(v) for v in ends) or ends[0] > ends[1]:
            raise NergError('"faces" are numbers from 0 on, or pairs of a first and a last one, as in [0, [4, 9]]')
        found.append((int(ends[0]), int(ends[1])))
    return tuple(found)


def _words(given: object, what: str) -> tuple[str, ...]:
    if not isinstance(given, list) or not 0 < len(given) <= PARTS or not all(isinstance(w, str) for w in given):
        raise NergError(f'"{what}" must be 1 to {PARTS} names')
    return tuple(dict.fromkeys(given))
