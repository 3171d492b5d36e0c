"""Areas of interest (AOIs) in JSON files and in memory: boxes, parts of meshes, shapes of a scene, groups, and objects
of Aria Digital Twin.

An entry of ``regions`` has a ``name`` and

- ``min`` and ``max``, the corners of a box, and optionally ``turn``, its rotation about its centre: degrees about z,
  counter-clockwise seen from above, or a quaternion x, y, z, w;
- or ``mesh``, a file in the folder of the JSON file or below, and optionally ``faces``: numbers from 0, or pairs of
  a first and a last one;
- or ``shape``, the id of a shape of the scene, or a pattern with ``*`` or ``?``: each shape that matches is an area
  under its own id, and together they form a group. ``--aois "mesh:book*"`` takes the shapes that match, without a file;
- or ``parts``, the names of the entries of a group;
- or ``adt``, the folder of an Aria Digital Twin recording, and optionally ``categories``, such as ``["chair"]``: its
  static objects, each a rotated box in the frame of samples that were imported with ``--preset aria``. With a
  ``name`` they also form a group. ``--aois FOLDER`` takes all of one recording.

Coordinates are those of the environment.
"""

from __future__ import annotations

import fnmatch
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from nerg_mi.environment.contents import from_trimesh, is_trimesh
from nerg_mi.environment.rendering_files import write_mesh
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.atomic import check_writable, make_folder, replace_atomically, write_text
from nerg_mi.files.dataframes import rows_to_dataframe, rows_to_html
from nerg_mi.files.names import make_portable_names
from nerg_mi.files.safe_read import is_count
from nerg_mi.files.values import FilePath, normalize_name, to_numbers
from nerg_mi.formats.boxes import (
    EXAMPLE,
    MAX_AREAS,
    AreaEntry,
    Region,
    box_to_json,
    check_area_name,
    list_entries,
    list_twin_files,
    parse_box,
    read_area_entries,
    read_twin_objects,
)
from nerg_mi.formats.meshes import MeshFile

SHAPES_PREFIX = "mesh:"  # of a pattern of shapes in place of a file
MAX_GROUP_DEPTH = 100  # maximum nesting depth of groups
MESH_SUFFIXES = (".ply", ".obj")  # suffixes of meshes with areas
MAX_PARTS = 1000  # maximum number of face ranges, parts of a group, or categories of an area


@dataclass(frozen=True)
class MeshPart:
    """The mesh in ``file``, or ``mesh`` in memory, or its faces whose indices are in one of the inclusive ranges
    ``faces``.
    """

    name: str
    file: Path | None
    faces: tuple[tuple[int, int], ...] | None = None
    mesh: MeshFile | None = field(default=None, compare=False, repr=False)

    def select_faces(self, count: int) -> np.ndarray:
        """Return a mask (count,) of the faces that belong to the area. Raises `NergError` for face indices beyond
        ``count``.
        """
        if self.faces is None:
            return np.ones(count, bool)
        mask = np.zeros(count, bool)
        for first, last in self.faces:
            if last >= count:
                raise NergError(
                    f'the area "{self.name}" uses face {last} of "{self.file or self.name}", which has {count:,} '
                    "faces (indices start at 0)"
                )
            mask[first : last + 1] = True
        return mask


@dataclass(frozen=True)
class SceneShape:
    """The shape of the scene with the id ``shape``, or those whose ids match it (`Areas.match_shapes`)."""

    name: str
    shape: str

    @property
    def is_pattern(self) -> bool:
        """Whether ``shape`` stands for several shapes."""
        return "*" in self.shape or "?" in self.shape


@dataclass(frozen=True)
class AreaGroup:
    """A group of areas: a gaze sample on one of its ``parts`` counts for the group."""

    name: str
    parts: tuple[str, ...]


Area: TypeAlias = Region | MeshPart | SceneShape | AreaGroup

_KINDS = {Region: "box", MeshPart: "mesh", SceneShape: "shape", AreaGroup: "group"}


@dataclass(frozen=True, repr=False)
class Areas:
    """Areas of interest (AOIs) in the order of their file, with unique names.

    Raises `NergError` for a group with an unknown part, and for a group that contains itself.

    Attributes
    ----------
    areas : tuple of Region, MeshPart, SceneShape or AreaGroup
        The areas.
    path : Path or None
        Their file, or folder of Aria Digital Twin; None if they are not from a file.
    files : tuple of Path
        All files that they were read from, with the meshes.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> areas = nerg.Areas.load({"shelf": [[0, 0, 0], [1, 2, 3]], "sign": {"shape": "sign"}})
    >>> areas
    <Areas in memory: 1 box, 1 shape>
    >>> nerg.Areas.load(areas.save(folder / "areas.json")) == areas
    True
    """

    areas: tuple[Area, ...]
    path: Path | None = field(default=None, compare=False)
    files: tuple[Path, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        names = [a.name for a in self.areas]
        duplicate = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
        if duplicate is not None:
            raise NergError(f'two areas have the name "{duplicate}"; rename one of them')
        for area in self.areas:
            if not isinstance(area, AreaGroup):
                continue
            unknown = next((p for p in area.parts if p not in names), None)
            if unknown is not None:
                raise NergError(f'the group "{area.name}" has the part "{unknown}", but there is no such area')
        self.element_indices()

    @classmethod
    def load(cls, source: FilePath | Mapping[str, Any], name: str = "areas") -> Areas:
        """Load areas from a file, or make them from a dict.

        Parameters
        ----------
        source : path or mapping
            A JSON file (see the module), the folder of a recording of Aria Digital Twin, whose static objects become
            boxes, areas by name: boxes (two corners in any order), meshes of trimesh, and dicts as in the file; or
            ``"mesh:PATTERN"``, the shapes of the scene whose ids match, as in ``"mesh:book*"``.
        name : str
            Name of the argument in messages.

        Returns
        -------
        Areas
            The areas.

        Raises
        ------
        NergError
            The file or an area is invalid.
        """
        if isinstance(source, Mapping):
            label = "the dict of areas"
            definitions = {str(key): _define_area(str(key), area) for key, area in source.items()}
            return _parse_areas(list_entries(definitions, label), Path(name), label)
        if not isinstance(source, (str, os.PathLike)):
            raise NergError(
                f"{parameter(name)} must be a dict of areas by name or a file, given as a string or a path, got "
                f"{type(source).__name__}"
            )
        if (text := str(source)).startswith(SHAPES_PREFIX):
            pattern = text.removeprefix(SHAPES_PREFIX)
            return cls((SceneShape(pattern, normalize_name(pattern)),))
        path = Path(source)
        if path.is_dir():
            return cls(tuple(read_twin_objects(path)), path, tuple(list_twin_files(path)))
        read = _parse_areas(read_area_entries(path), path, f'"{path}"')
        return replace(read, path=path, files=(path, *read.files))

    @classmethod
    def open(cls, areas: FilePath | AnyAreas, name: str = "areas") -> Areas:
        """Return areas as they are, and others as `load` does."""
        return areas if isinstance(areas, Areas) else cls.load(areas, name)

    @classmethod
    def open_boxes(cls, areas: FilePath | AnyAreas, name: str = "areas") -> list[Region]:
        """Return the boxes among areas. Raises `NergError` if there are none, and as `load`."""
        opened = cls.open(areas, name)
        if not opened.boxes:
            label = parameter(name) if opened.path is None else f'"{opened.path}"'
            raise NergError(f"{label} contains no box; draw one in the viewer, or write {EXAMPLE}")
        return opened.boxes

    def match_shapes(self, ids: Iterable[str]) -> Areas:
        """Return areas in which each shape of the scene with one of ``ids`` that matches a pattern is an area.

        Those of an entry with another name than its pattern also form a group. A pattern that is an id is no pattern.
        Raises `NergError` for a pattern that nothing matches, and as the class.
        """
        ids, areas = list(ids), list[Area]()
        for area in self.areas:
            if not isinstance(area, SceneShape) or not area.is_pattern or area.shape in ids:
                areas.append(area)
                continue
            matches = tuple(fnmatch.filter(ids, area.shape))
            if not matches:
                remedy = f"its shapes are {', '.join(ids[:20])}" if ids else "use a scene with shapes"
                raise NergError(f'no shape of the scene matches "{sanitize(area.shape, 40)}"; {remedy}')
            areas += [SceneShape(name, name) for name in matches if name not in [a.name for a in areas]]
            if area.name != area.shape:
                areas.append(AreaGroup(area.name, matches))
        return replace(self, areas=tuple(areas))

    def save(self, path: FilePath) -> Path:
        """Write a JSON file atomically. Meshes in memory or outside of its folder are written to the folder
        ``NAME.meshes`` next to it. Returns the file; raises `NergError` if it cannot be written."""
        path = Path(path)
        check_writable(path, ".json")
        names = make_portable_names(area.name for area in self.areas)
        placed = [
            _place_mesh(area, path, name) if isinstance(area, MeshPart) else area
            for area, name in zip(self.areas, names)
        ]
        write_text(path, format_areas(placed, path.parent))
        return path

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all areas."""
        return tuple(a.name for a in self.areas)

    @property
    def boxes(self) -> list[Region]:
        """The areas that are boxes."""
        return [a for a in self.areas if isinstance(a, Region)]

    @property
    def elements(self) -> tuple[Region | MeshPart | SceneShape, ...]:
        """The areas that are not groups."""
        return tuple(a for a in self.areas if not isinstance(a, AreaGroup))

    @property
    def meshes(self) -> list[Path]:
        """Files of the areas that are parts of meshes."""
        return [a.file for a in self.areas if isinstance(a, MeshPart) and a.file is not None]

    @property
    def box_indices(self) -> dict[str, tuple[int, ...]]:
        """For each area that is a box or a group of boxes only, by name: the indices into `boxes` of its boxes."""
        number = {
            k: n for n, k in enumerate(k for k, element in enumerate(self.elements) if isinstance(element, Region))
        }
        memberships = self.element_indices().items()
        return {
            name: tuple(number[k] for k in members)
            for name, members in memberships
            if all(k in number for k in members)
        }

    def element_indices(self) -> dict[str, tuple[int, ...]]:
        """Return, for each area by name, the indices into `elements` of its elements."""
        by_name = {a.name: a for a in self.areas}
        resolved = {a.name: frozenset([k]) for k, a in enumerate(self.elements)}
        for area in self.areas:
            _resolve_group(area, by_name, resolved, ())
        return {a.name: tuple(sorted(resolved[a.name])) for a in self.areas}

    @property
    def folder(self) -> Path:
        """The folder that names of mesh files are relative to."""
        return Path() if self.path is None else self.path.parent

    def list_rows(self) -> list[dict[str, Any]]:
        """Return the rows of `to_dataframe`."""
        bounds = [_find_bounds(element) for element in self.elements]
        rows = []
        for area, members in zip(self.areas, self.element_indices().values()):
            groups = [group.name for group in self.areas if isinstance(group, AreaGroup) and area.name in group.parts]
            row = {"name": area.name, "kind": _KINDS[type(area)], "group": ", ".join(groups)}
            boxes = [corners for corners in (bounds[k] for k in members) if corners is not None]
            if len(boxes) == len(members):
                lower, upper = np.min(boxes, axis=(0, 1)).tolist(), np.max(boxes, axis=(0, 1)).tolist()
                row |= dict(zip(("x_min", "y_min", "z_min", "x_max", "y_max", "z_max"), [*lower, *upper]))
            rows.append(row)
        return rows

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return the areas as a data frame.

        Parameters
        ----------
        library : str, optional
            ``pandas``, ``polars`` or ``pyarrow``. Default: the first of these that is installed.

        Returns
        -------
        data frame
            One row per area: ``name``, ``kind`` (box, mesh, shape or group), ``group`` (the groups that it is a part
            of), and the extents ``x_min`` to ``z_max`` in scene units, which are missing for shapes and for meshes in
            files.

        Raises
        ------
        NergError
            The library is not installed.
        """
        return rows_to_dataframe(self.list_rows(), library)

    def __repr__(self) -> str:
        kinds = [_KINDS[type(area)] for area in self.areas]
        plural = lambda kind, count: kind if count == 1 else f"{kind}es" if kind in ("box", "mesh") else f"{kind}s"
        counts = [f"{kinds.count(kind)} {plural(kind, kinds.count(kind))}" for kind in dict.fromkeys(kinds)]
        return f"<Areas {'in memory' if self.path is None else self.path.name}: {', '.join(counts) or 'none'}>"

    def _repr_html_(self) -> str:
        return rows_to_html(self.list_rows())


AnyAreas: TypeAlias = Areas | Mapping[str, Any]
"""Areas in memory, or a dict of them by name."""


def _resolve_group(
    area: Area, by_name: dict[str, Area], resolved: dict[str, frozenset[int]], ancestors: tuple[str, ...]
) -> None:
    """Add the elements of ``area`` and its parts to ``resolved``; each area is visited once.

    Raises `NergError` for a group that contains itself.
    """
    if area.name in ancestors or len(ancestors) > MAX_GROUP_DEPTH:
        raise NergError(f'the group "{area.name}" contains itself, or groups are nested deeper than {MAX_GROUP_DEPTH}')
    if area.name in resolved or not isinstance(area, AreaGroup):
        return
    for part in area.parts:
        _resolve_group(by_name[part], by_name, resolved, (*ancestors, area.name))
    resolved[area.name] = frozenset().union(*(resolved[part] for part in area.parts))


def _find_bounds(area: Region | MeshPart | SceneShape) -> np.ndarray | None:
    """Return the corners (2, 3) of a box, or of a mesh in memory; None for others."""
    if isinstance(area, Region):
        return area.bounds
    if isinstance(area, SceneShape) or area.mesh is None:
        return None
    corners = area.mesh.vertices[area.mesh.faces[area.select_faces(len(area.mesh.faces))]]
    return np.array([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])


# ---- Files ----


def format_areas(areas: Iterable[Area], folder: Path) -> str:
    """Format ``areas`` as the text of a JSON file in ``folder``. Raises `NergError` for a mesh in memory."""
    return json.dumps({"regions": [_area_to_json(area, folder) for area in areas]}, indent=1) + "\n"


def _area_to_json(area: Area, folder: Path) -> dict[str, Any]:
    if isinstance(area, Region):
        return box_to_json(area)
    if isinstance(area, AreaGroup):
        return {"name": area.name, "parts": list(area.parts)}
    if isinstance(area, SceneShape):
        return {"name": area.name, "shape": area.shape}
    if area.file is None:
        raise NergError(f'the mesh of the area "{area.name}" is in memory; write it with Areas.save')
    ranges = [first if first == last else [first, last] for first, last in area.faces or ()]
    mesh = Path(os.path.relpath(area.file, folder)).as_posix()
    return {"name": area.name, "mesh": mesh, **({"faces": ranges} if ranges else {})}


def _place_mesh(area: MeshPart, path: Path, name: str) -> MeshPart:
    """Return ``area`` with its mesh in or below the folder of the file of areas ``path``."""
    folder = path.parent.resolve()
    if area.file is not None and folder in area.file.resolve().parents:
        return area
    suffix = ".ply" if area.file is None else area.file.suffix
    file = make_folder(path.with_suffix(".meshes")) / f"{name}{suffix}"
    if area.file is None:
        assert area.mesh is not None
        write_mesh(file, area.mesh)
    else:
        with replace_atomically(file) as temporary:
            shutil.copyfile(area.file, temporary)
    return replace(area, file=file, mesh=None)


_READING_EXAMPLE = (
    '{"name": "a", "min": [0, 0, 0], "max": [1, 2, 3]}, {"name": "b", "mesh": "sign.ply", "faces": [0, [4, 9]]}, '
    '{"name": "c", "shape": "id"}, {"name": "all", "parts": ["a", "b"]} or {"adt": "folder"}'
)


def _parse_areas(entries: Iterable[AreaEntry], path: Path, source: str) -> Areas:
    """Parse entries; ``path`` is the file that meshes and recordings are next to, and none of ``files``."""
    areas: list[Area] = []
    twins: list[Path] = []
    for entry in entries:
        if entry.is_box:
            areas.append(parse_box(entry))
            continue
        try:
            areas += _parse_non_box(entry, path)
        except NergError as error:
            raise NergError(f"{entry.location}: {error}") from error
        if "adt" in entry.definition:
            twins += list_twin_files(path.parent / entry.definition["adt"])
        if len(areas) > MAX_AREAS:
            raise NergError(f'{source} has more than {MAX_AREAS} areas; select some of the objects with "categories"')
    try:
        parsed = Areas(tuple(areas))
    except NergError as error:
        raise NergError(f"{source}: {error}") from error
    return replace(parsed, files=tuple(dict.fromkeys([*parsed.meshes, *twins])))


def _parse_non_box(entry: AreaEntry, path: Path) -> list[Area]:
    """Parse an entry that is not a box into areas."""
    definition = entry.definition
    if "adt" in definition:
        return _read_objects(entry, path)
    name = entry.name
    if not isinstance(name, str):
        raise NergError(f'an area without "adt" needs a name, as in {_READING_EXAMPLE}')
    check_area_name(name)
    kinds = [key for key in ("mesh", "shape", "parts", "min", "max") if key in definition]
    if len(kinds) > 1:
        raise NergError(f'the area "{sanitize(name, 40)}" has the keys {", ".join(kinds)}, of which only one is read')
    if "mesh" in definition:
        faces = None if definition.get("faces") is None else _parse_ranges(definition["faces"])
        if isinstance(definition["mesh"], MeshFile):
            return [MeshPart(name, None, faces, definition["mesh"])]
        return [MeshPart(name, resolve_mesh_path(definition["mesh"], path), faces)]
    if "shape" in definition:
        if not isinstance(definition["shape"], str) or not definition["shape"]:
            raise NergError('"shape" must be the id of a shape of the scene')
        return [SceneShape(name, normalize_name(definition["shape"]))]
    return [AreaGroup(name, _parse_names(definition["parts"], "parts"))]


def _read_objects(entry: AreaEntry, path: Path) -> list[Area]:
    categories = entry.definition.get("categories")
    selected = None if categories is None else _parse_names(categories, "categories")
    objects: list[Area] = list(read_twin_objects(_resolve_inside(entry.definition["adt"], path), selected))
    if entry.name is None or entry.name == "":
        return objects
    if not isinstance(entry.name, str):
        raise NergError("the name must be a string")
    check_area_name(entry.name)
    return [*objects, AreaGroup(entry.name, tuple(a.name for a in objects))]


def resolve_mesh_path(name: object, path: Path, file_kind: str = "areas") -> Path:
    """Return the path of the mesh ``name`` (.ply, .obj), relative to the folder of the file ``path``.

    Raises `NergError` for another suffix, and for a path outside of that folder. ``file_kind`` names the file ``path``
    in messages.
    """
    file = _resolve_inside(name, path, file_kind)
    if file.suffix.lower() not in MESH_SUFFIXES:
        raise NergError(
            f'the mesh "{sanitize(file.name, 60)}" is not a .ply or .obj file; convert it to one of '
            f"{', '.join(MESH_SUFFIXES)}"
        )
    return file


def _resolve_inside(name: object, path: Path, file_kind: str = "areas") -> Path:
    """Return the path of the file or folder ``name`` inside the folder of the file ``path``."""
    if not isinstance(name, str) or not 0 < len(name) <= 1000 or "\0" in name:
        raise NergError('a file name must be a string, as in {"name": "a", "mesh": "sign.ply"}')
    folder = os.path.realpath(path.parent)
    resolved = os.path.realpath(os.path.join(folder, name))
    if os.path.isabs(name) or os.path.commonpath([folder, resolved]) != folder:
        raise NergError(f'"{sanitize(name, 80)}" is outside of the folder of the {file_kind}; move or copy it there')
    return path.parent / name


def _parse_ranges(value: object) -> tuple[tuple[int, int], ...]:
    """Parse face indices, or pairs of a first and a last index."""
    items = value if isinstance(value, list) else [None]
    ranges = []
    for item in items if 0 < len(items) <= MAX_PARTS else [None]:
        ends: list[Any] = item if isinstance(item, list) else [item, item]
        if len(ends) != 2 or not all(is_count(v) for v in ends) or ends[0] > ends[1]:
            raise NergError('"faces" must be indices from 0, or pairs of a first and a last index, as in [0, [4, 9]]')
        ranges.append((int(ends[0]), int(ends[1])))
    return tuple(ranges)


def _parse_names(value: object, key: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not 0 < len(value) <= MAX_PARTS or not all(isinstance(w, str) for w in value):
        raise NergError(f'"{key}" must be 1 to {MAX_PARTS} names')
    return tuple(dict.fromkeys(map(normalize_name, value)))


# ---- Definitions in memory ----


def _define_area(name: str, area: Any) -> dict[str, Any]:
    """Return the definition of an area as in a file, with its mesh in memory."""
    if is_trimesh(area):
        meshes = from_trimesh(area, name)
        if len(meshes) > 1:
            raise NergError(f'the area "{name}" is a trimesh.Scene of {len(meshes)} meshes; pass one trimesh.Trimesh')
        return {"mesh": next(iter(meshes.values()))}
    if isinstance(area, Mapping):
        return to_json_values(area)
    if np.shape(area) == (2, 3):
        # Opposite corners in any order.
        lower, upper = np.sort(to_numbers(area, f'the area "{name}"'), axis=0).tolist()
        return {"min": lower, "max": upper}
    raise NergError(
        f'the area "{name}" must be a box (two corners of three numbers), a trimesh.Trimesh or a dict as in a file of '
        f"areas, got {type(area).__name__}"
    )


def to_json_values(values: Any) -> Any:
    """Return ``values`` with lists in place of tuples and arrays. Raises `NergError` for objects."""
    return json.loads(json.dumps(values, default=_to_json_value))


def _to_json_value(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise NergError(f"a value of {type(value).__name__} is not supported; use numbers, texts, lists and dicts")
