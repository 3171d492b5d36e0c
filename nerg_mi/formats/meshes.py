"""Meshes of files (PLY, OBJ, binary glTF) as triangles with colours, and what else their files hold.

Mitsuba's readers take fewer files than there are: triangles alone in PLY, no negative indices and no continued lines in
OBJ, no glTF. `MeshFile.unreadable` says so, and `MeshFile` has what to give it instead.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import read_bytes, reading, size_of
from nerg_mi.maths.coordinates import check_near_origin

from .gltf import BYTES as GLTF_BYTES
from .gltf import parse_glb
from .ply import PlyTable, parse_ply

BYTES = 64 << 30
"""A file may have so many bytes."""

TEXT_BYTES = 1 << 30
"""And so many where it is text."""

GREY = 0.5
"""What has no colour."""

_BLOCK = 1 << 24
_CENTER, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"))
_CORNERS = ("vertex_index", "vertex_indices")
_OBJ_USED = {b"v", b"vn", b"f", b"g", b"o", b"s"}
_OBJ_LINE = 1000


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Triangles of a file, in its own frame and units (of glTF turned, so that z is up).

    ``vertices`` (V, 3) float64, ``faces`` (F, 3) int64; ``polygons`` (F,): of which face of the file each is a part;
    ``normals`` (V, 3), ``colors`` (V, 3), ``face_colors`` (F, 3) in 0..1, or None; ``color_scale``: what the file's own
    numbers of colours are multiplied by. ``notes``: sentences on what is not used, or was guessed. ``unreadable``: why
    Mitsuba does not read the file as it is, or ""; ``misread``: whether it does without its colours or normals.
    """

    vertices: np.ndarray
    faces: np.ndarray
    polygons: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    face_colors: np.ndarray | None = None
    color_scale: float = 1.0
    notes: tuple[str, ...] = ()
    unreadable: str = ""
    misread: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether Mitsuba shows the file as it is."""
        return not (self.unreadable or self.misread)


def read_mesh_file(path: str | os.PathLike, points: bool = False, suffix: str | None = None) -> MeshFile:
    """The mesh in ``path``; ``points``: whether it may have no faces; ``suffix``: of its format, whatever its name.

    Raises `NergError` for a file that is missing, damaged or no mesh, for vertices that are not finite, for faces with
    corners that are none of its vertices, and for coordinates too far from the origin for single precision.
    """
    suffix = suffix or Path(path).suffix.lower()
    if suffix not in READERS:
        raise NergError(f'"{path}" is no mesh that is read; give one that ends in {", ".join(READERS)}')
    # Whatever stands where another kind of value belongs is the file's mistake.
    with reading(path, "mesh", "export it again", also=(TypeError, AttributeError)):
        mesh = READERS[suffix](path)
        if not len(mesh.vertices):
            raise ValueError("it has no vertices")
        if not (len(mesh.faces) or points):
            raise ValueError("it has no faces")
        bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
        if len(bad) and not points:
            raise ValueError(f"vertex {bad[0] + 1:,} is not finite, one of {len(bad):,}")
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"it has a face with a corner that is none of its {len(mesh.vertices):,} vertices")
    check_near_origin(mesh.vertices, f'the mesh "{path}"')
    return mesh


def _split(counts: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polygons with ``counts`` (P,) of ``corners``, one after another, as triangles (F, 3), and whose each is (F,)."""
    if len(counts) and counts.min() < 3:
        raise ValueError(f"face {int(np.argmin(counts)) + 1:,} has fewer than three corners")
    if not len(counts) or counts.max() == 3:
        return corners.reshape(-1, 3), np.arange(len(counts))
    pieces = counts - 2
    polygons = np.repeat(np.arange(len(counts)), pieces)
    first = np.repeat(np.cumsum(counts) - counts, pieces)
    k = np.arange(len(polygons)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.stack([corners[first], corners[first + k + 1], corners[first + k + 2]], axis=1), polygons


def _unit_colors(columns: Sequence[np.ndarray], kind: np.dtype) -> tuple[np.ndarray, float]:
    """Colours in 0..1, and what they were multiplied by: whole numbers of a type reach up to its largest."""
    values = np.stack(columns, axis=-1).astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("some of its colours are not finite")
    top = np.iinfo(kind).max if kind.kind in "iu" else 255 if values.size and values.max() > 1 else 1
    return np.clip(values / top, 0, 1), 1 / top


def _read_ply(path: str | os.PathLike) -> MeshFile:
    size = size_of(path, "mesh", BYTES)
    ply = parse_ply(np.memmap(path, np.uint8, mode="r") if size else np.zeros(0, np.uint8))
    vertex, face = (ply.tables.get(name, PlyTable(0)) for name in ("vertex", "face"))
    names = next((names for names in _CORNERS if names in face.lists), None)
    if face.count and names is None:
        raise ValueError("its faces have no property vertex_index or vertex_indices")
    counts, corners = face.lists[names]() if names else (np.zeros(0, np.int64), np.zeros(0))
    if corners.dtype.kind == "f" and (corners != np.floor(corners)).any():
        raise ValueError("the corners of its faces are no whole numbers")
    faces, polygons = _split(counts, corners.astype(np.int64))
    missing = [name for name in _CENTER if vertex.count and name not in vertex.columns]
    if missing:
        raise ValueError(f'its vertices have no property "{missing[0]}"')
    take = lambda table, names: [table.columns[name]() for name in names]
    vertices = np.stack(take(vertex, _CENTER), axis=1).astype(np.float64) if vertex.count else np.zeros((0, 3))
    used, notes, scales, found = {"vertex": {*_CENTER, *_NORMAL}, "face": {names}}, [], {}, {}
    for name, table in (("vertex", vertex), ("face", face)):
        tints = next((c for c in _COLORS if all(n in table.columns for n in c[:3])), None)
        if tints:
            found[name], scales[name] = _unit_colors(take(table, tints[:3]), table.kinds[tints[0]])
            used[name] |= set(tints[:3])
    normals = None
    if all(name in vertex.columns for name in _NORMAL):
        normals = np.stack(take(vertex, _NORMAL), axis=1).astype(np.float64)
        length = np.linalg.norm(normals, axis=1)
        if not (np.isfinite(length).all() and (length > 0).all()):
            normals = None
            notes.append("its normals are not used: some are 0 or not finite")
    for name, table in ply.tables.items():
        unused = [n for n in (*table.columns, *table.lists) if n not in used.get(name, ())]
        if unused and table.count:
            notes.append(f"columns of {plain(name, 40)} that are not used: {plain(', '.join(unused))}")
    notes += [f"not used: {plain(c, 80)}" for c in ply.comments if c.startswith("TextureFile")]
    uneven = int((counts != 3).sum())
    if uneven:
        notes.append(f"{uneven:,} faces of more than three corners are split into triangles")
    unreadable = ""
    if uneven:
        unreadable = "it has faces of more than three corners"
    elif ply.trailing:
        unreadable = "more follows its rows"
    elif len(face.lists) > 1 or any(t.lists for n, t in ply.tables.items() if n != "face"):
        # Each of them is taken for three values.
        unreadable = "it has other lists than the corners of its faces"
    # An alpha makes a colour of four channels, which no texture of Mitsuba shows.
    misread = any({"alpha", "a"} & set(ply.tables[name].columns) for name in found)
    misread = misread or ("nx" in vertex.columns and normals is None)
    return MeshFile(
        vertices,
        faces,
        polygons,
        normals,
        found.get("vertex"),
        found["face"][polygons] if "face" in found else None,
        scales.get("vertex", scales.get("face", 1.0)),
        tuple(notes),
        unreadable,
        misread,
    )


class _Obj:
    """The statements of an OBJ file."""

    def __init__(self) -> None:
        self.vertices: list[list[bytes]] = []
        self.normals: list[list[bytes]] = []
        self.textures = 0
        self.corners: list[np.ndarray] = []
        self.counts: list[int] = []
        self.other: dict[bytes, None] = {}
        self.unreadable = ""
        # Tokens of the faces of this block, and vertices that precede each face.
        self._faces: list[list[bytes]] = []
        self._before: list[int] = []

    def read(self, lines: list[bytes]) -> None:
        for line in lines:
            if len(line) > _OBJ_LINE:
                self.unreadable = f"it has lines of more than {_OBJ_LINE:,} characters"
            words = line.partition(b"#")[0].split()
            if not words:
                continue
            kind = words[0]
            if kind == b"v":
                if len(words) < 4:
                    raise ValueError(f"vertex {len(self.vertices) + 1:,} has fewer than three coordinates")
                self.vertices.append(words[1:])
            elif kind == b"f":
                self._faces.append(words[1:])
                self._before.append(len(self.vertices))
            elif kind == b"vn":
                self.normals.append(words[1:])
            elif kind == b"vt":
                self.textures += 1
                if len(words) < 3:
                    self.unreadable = "it has texture coordinates of one number"
            if kind not in _OBJ_USED:
                self.other[kind] = None
        self._take_faces()

    def _take_faces(self) -> None:
        if not self._faces:
            return
        counts = [len(face) for face in self._faces]
        tokens = [token for face in self._faces for token in face]
        before = np.repeat(self._before, counts)
        parts = [token.split(b"/") for token in tokens]
        index = np.array([part[0] for part in parts]).astype(np.int64)
        for k, count, what in ((1, self.textures, "texture coordinate"), (2, len(self.normals), "normal")):
            named = [int(part[k]) for part in parts if len(part) > k and part[k]]
            wrong = next((n for n in named if not 1 <= abs(n) <= count), None)
            if wrong is not None:
                raise ValueError(f"a face names {what} {wrong}, of which there are {count:,} before it")
            if any(n < 0 for n in named):
                self.unreadable = "it has negative indices"
        if (index == 0).any():
            raise ValueError("a face names vertex 0, and they are counted from 1")
        if (index < 0).any():
            self.unreadable = "it has negative indices"
        elif (index > before).any():
            self.unreadable = "its faces name vertices that come later"
        # Negative ones count from the last vertex before the face.
        self.corners.append(np.where(index > 0, index - 1, np.where(-index <= before, before + index, -1)))
        self.counts += counts
        self._faces, self._before = [], []


def _read_obj(path: str | os.PathLike) -> MeshFile:
    size_of(path, "mesh", TEXT_BYTES)
    obj, rest = _Obj(), b""
    with open(path, "rb") as file:
        while lines := file.readlines(_BLOCK):
            lines = [line.rstrip() for line in lines]
            if any(line.endswith(b"\\") for line in lines):
                obj.unreadable = "it has lines that go on after a \\"
                whole: list[bytes] = []
                for line in lines:
                    rest += line
                    if rest.endswith(b"\\"):
                        rest = rest[:-1] + b" "
                    else:
                        whole.append(rest)
                        rest = b""
                lines = whole
            elif rest:
                lines[0], rest = rest + lines[0], b""
            obj.read(lines)
    obj.read([rest])
    vertices = np.array([v[:3] for v in obj.vertices]).astype(np.float64) if obj.vertices else np.zeros((0, 3))
    corners = np.concatenate(obj.corners) if obj.corners else np.zeros(0, np.int64)
    faces, polygons = _split(np.array(obj.counts, np.int64), corners)
    notes, colors, scale = [], None, 1.0
    # After the coordinates a weight, a colour, or both.
    if any(len(v) >= 6 for v in obj.vertices):
        bare = np.array([len(v) < 6 for v in obj.vertices])
        triples = [(b"0",) * 3 if len(v) < 6 else v[4:7] if len(v) == 7 else v[3:6] for v in obj.vertices]
        colors, scale = _unit_colors(list(np.array(triples).astype(np.float64).T), np.dtype(np.float64))
        colors[bare] = GREY
        notes += [f"{bare.sum():,} of its vertices have no colour, and are grey"] if bare.any() else []
    if obj.other:
        names = ", ".join(name.decode("latin-1") for name in obj.other)
        notes.append(f"statements that are not used: {plain(names)}")
    unreadable = obj.unreadable
    if obj.normals and not unreadable:
        directions = np.array([n[:3] for n in obj.normals]).astype(np.float64)
        length = np.linalg.norm(directions, axis=1)
        if not (np.isfinite(length).all() and (length > 0).all()):
            unreadable = "some of its normals are 0 or not finite"
    return MeshFile(
        vertices, faces, polygons, None, colors, None, scale, tuple(notes), unreadable, misread=colors is not None
    )


def _read_glb(path: str | os.PathLike) -> MeshFile:
    found = parse_glb(read_bytes(path, "mesh", GLTF_BYTES), path)
    # Its y is up.
    vertices = np.stack([found.vertices[:, 0], -found.vertices[:, 2], found.vertices[:, 1]], axis=1)
    faces = found.faces
    return MeshFile(
        vertices, faces, np.arange(len(faces)), None, found.colors, notes=found.notes, unreadable="it is glTF"
    )


READERS = {".ply": _read_ply, ".obj": _read_obj, ".glb": _read_glb}
"""Readers by the ending of a file's name."""
