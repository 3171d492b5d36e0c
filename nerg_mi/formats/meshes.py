"""Meshes of files (PLY, OBJ, binary glTF) as triangles with colours, and what else their files hold.

Mitsuba's readers take fewer files than there are: triangles alone in PLY, no negative indices and no continued lines in
OBJ, no glTF. `MeshFile.unreadable` says so, and `MeshFile` has what to give it instead.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import map_bytes, translate_read_errors, check_regular_file
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.coordinates import check_near_origin

from .gltf import MAX_GLTF_BYTES, GLTF_MAGIC, parse_glb
from .ply import PLY_MAGIC, PlyTable, parse_numbers, parse_ply

MAX_BYTES = 64 << 30  # maximum bytes of a file
MAX_TEXT_BYTES = 1 << 30  # and so many where it is text
DEFAULT_GREY = 0.5  # what has no colour
_BLOCK = 1 << 24  # bytes of text that are read at once, and of its longest line
_FLAT = 1e-6  # of a polygon's area: a triangle of its fan that is turned over by more makes it concave
_CORNERS_TRIED, _AT_ONCE = 64, 1 << 20
_CENTER, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"), ("color_0", "color_1", "color_2", "color_3"))
_CORNERS = ("vertex_index", "vertex_indices")
_OBJ_USED = {b"v", b"vn", b"f", b"g", b"o", b"s"}
_OBJ_LINE = 1000
_BEYOND = "{:,} of its faces are concave, and have triangles that reach beyond them: triangulate it where it was made"
_BAD_NORMALS = "some of its normals are 0 or not finite"


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Triangles of a file, in its own frame and units (of glTF turned, so that z is up).

    ``vertices`` (V, 3) float64, ``faces`` (F, 3) int64; ``polygons`` (F,): of which face of the file each is a part;
    ``normals`` (V, 3), ``colors`` (V, 3), ``face_colors`` (F, 3), linear in 0..1, or None. ``notes``: sentences on what
    is not used, or was guessed. ``unreadable``: why Mitsuba does not read the file as it is, or ""; ``hides_colors``:
    whether it does without its colours, of which an alpha makes what no texture of Mitsuba shows; ``encodes_colors``:
    whether they are sRGB values in the file, which Mitsuba takes for linear ones.
    """

    vertices: np.ndarray
    faces: np.ndarray
    polygons: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    face_colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    unreadable_reason: str = ""
    hides_colors: bool = False
    encodes_colors: bool = False

    @property
    def is_readable_by_mitsuba(self) -> bool:
        """Whether Mitsuba shows the file as it is."""
        return not (self.unreadable_reason or self.hides_colors or self.encodes_colors)


def read_mesh_file(path: str | os.PathLike, allow_points: bool = False, suffix: str | None = None) -> MeshFile:
    """The mesh in ``path``; ``points``: whether it may have no faces; ``suffix``: of its format, whatever its name.

    Raises `NergError` for a file that is missing, damaged or no mesh, for vertices that are not finite, for faces with
    corners that are none of its vertices, and for coordinates too far from the origin for single precision.
    """
    suffix = suffix or Path(path).suffix.lower()
    if suffix not in READERS:
        raise NergError(f'"{path}" is no mesh that is read; give one that ends in {", ".join(READERS)}')
    # Whatever stands where another kind of value belongs is the file's mistake.
    with translate_read_errors(path, "mesh", "export it again", extra_errors=(TypeError, AttributeError)), np.errstate(all="ignore"):
        mesh = READERS[suffix](path)
        if not len(mesh.vertices):
            raise ValueError("it has no vertices")
        if not (len(mesh.faces) or allow_points):
            raise ValueError("it has no faces")
        bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
        if len(bad) and not allow_points:
            raise ValueError(f"vertex {bad[0] + 1:,} is not finite, one of {len(bad):,}")
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"it has a face with a corner that is none of its {len(mesh.vertices):,} vertices")
    check_near_origin(mesh.vertices, f'the mesh "{path}"')
    return mesh


class _Triangles(NamedTuple):
    """``faces`` (F, 3) of polygons, and of which polygon each is a part (F,); how many polygons are concave, and of how
    many of these triangles reach beyond them."""

    faces: np.ndarray
    polygons: np.ndarray
    concave: int = 0
    beyond: int = 0


def _split(counts: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> _Triangles:
    """Polygons with ``counts`` (P,) of ``corners``, one after another, of the ``vertices`` (V, 3), as fans."""
    if len(counts) and counts.min() < 3:
        raise ValueError(f"face {int(np.argmin(counts)) + 1:,} has fewer than three corners")
    if not len(counts) or counts.max() == 3:
        return _Triangles(corners.reshape(-1, 3), np.arange(len(counts)))
    starts, concave, beyond = np.cumsum(counts) - counts, 0, 0
    # Faces with corners that are none of the vertices are refused later.
    is_valid = 0 <= corners.min() <= corners.max() < len(vertices)
    for count in np.unique(counts[counts > 3]).tolist() if is_valid else ():
        places = starts[counts == count]
        for block in np.array_split(places, 1 + len(places) * count // _AT_ONCE):
            at = block[:, None] + np.arange(count)
            corners[at], turned, left = _turn_concave(corners[at], vertices)
            concave, beyond = concave + turned + left, beyond + left
    pieces = counts - 2
    polygons = np.repeat(np.arange(len(counts)), pieces)
    first = np.repeat(starts, pieces)
    k = np.arange(len(polygons)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    faces = np.stack([corners[first], corners[first + k + 1], corners[first + k + 2]], axis=1)
    return _Triangles(faces, polygons, concave, beyond)


def _turn_concave(index: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Polygons (P, N) with the corners of concave ones from one on that sees all others; how many these are, and how
    many have no such corner, or too many of them to look for it."""

    def is_flipped(index: np.ndarray) -> np.ndarray:
        p = vertices[index]
        normals = np.cross(p[:, 1:-1] - p[:, :1], p[:, 2:] - p[:, :1])
        whole = normals.sum(axis=1, keepdims=True)
        return ((normals * whole).sum(axis=2) < -_FLAT * (whole**2).sum(axis=2)).any(axis=1)

    (left,) = np.nonzero(is_flipped(index))
    concave = len(left)
    for k in range(1, min(index.shape[1], _CORNERS_TRIED, 1 + _AT_ONCE // index.shape[1])):
        if not len(left):
            break
        rolled = np.roll(index[left], -k, axis=1)
        is_good = ~is_flipped(rolled)
        index[left[is_good]] = rolled[is_good]
        left = left[~is_good]
    return index, concave - len(left), len(left)


def _linear_colors(columns: Sequence[np.ndarray], kind: np.dtype) -> tuple[np.ndarray, bool]:
    """Linear colours in 0..1 of the ``columns`` of a PLY file, and whether these are sRGB values.

    Whole numbers, of 8 bits if none is larger, else of 16 or as many as their type has, are those of pictures: cameras,
    scanners and modelling programs write them so. Floats up to 1 are linear, as renderers write them.
    """
    values = np.stack(columns, axis=-1).astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("some of its colours are not finite")
    most = values.max(initial=0)
    if kind.kind == "f" and most <= 1:
        return np.clip(values, 0, 1), False
    limits = [255, 65535, np.iinfo(kind).max] if kind.kind in "iu" and kind.itemsize > 1 else [255]
    top = next((limit for limit in limits if most <= limit), limits[-1])
    return decode_srgb(np.clip(values / top, 0, 1)), True


def _read_ply(path: str | os.PathLike) -> MeshFile:
    ply = parse_ply(np.frombuffer(map_bytes(path, "mesh", MAX_BYTES, PLY_MAGIC, "export it again"), np.uint8))
    vertex, face = (ply.tables.get(name, PlyTable(0)) for name in ("vertex", "face"))
    names = next((names for names in _CORNERS if names in face.lists), None)
    if face.count and names is None:
        raise ValueError("its faces have no property vertex_index or vertex_indices")
    counts, corners = face.lists[names]() if names else (np.zeros(0, np.int64), np.zeros(0))
    if corners.dtype.kind == "f" and not ((corners == np.floor(corners)) & np.isfinite(corners)).all():
        raise ValueError("the corners of its faces are no whole numbers")
    missing = [name for name in _CENTER if vertex.count and name not in vertex.columns]
    if missing:
        raise ValueError(f'its vertices have no property "{missing[0]}"')
    take = lambda table, names: [table.columns[name]() for name in names]
    vertices = np.stack(take(vertex, _CENTER), axis=1).astype(np.float64) if vertex.count else np.zeros((0, 3))
    faces, polygons, _, beyond = _split(counts, corners.astype(np.int64), vertices)
    used, notes, encodes, tints_of = {"vertex": {*_CENTER, *_NORMAL}, "face": {names}}, [], False, {}
    for name, table in (("vertex", vertex), ("face", face)):
        tints = next((c for c in _COLORS if all(n in table.columns for n in c[:3])), None)
        if tints:
            tints_of[name], encoded = _linear_colors(take(table, tints[:3]), table.dtypes[tints[0]])
            encodes |= encoded
            used[name] |= set(tints[:3])
    normals = None
    if all(name in vertex.columns for name in _NORMAL):
        normals = np.stack(take(vertex, _NORMAL), axis=1).astype(np.float64)
        length = np.linalg.norm(normals, axis=1)
        if not (np.isfinite(length).all() and (length > 0).all()):
            normals = None
            notes.append(f"its normals are not used: {_BAD_NORMALS}")
    for name, table in ply.tables.items():
        unused = [n for n in (*table.columns, *table.lists) if n not in used.get(name, ())]
        if unused and table.count:
            notes.append(f"columns of {sanitize(name, 40)} that are not used: {sanitize(', '.join(unused))}")
    notes += [f"not used: {sanitize(c, 80)}" for c in ply.comments if c.startswith("TextureFile")]
    uneven = int((counts != 3).sum())
    if uneven:
        notes.append(f"{uneven:,} faces of more than three corners are split into triangles")
    if beyond:
        notes.append(_BEYOND.format(beyond))
    unreadable = ""
    if uneven:
        unreadable = "it has faces of more than three corners"
    elif ply.has_trailing_data:
        unreadable = "more follows its rows"
    elif "nx" in vertex.columns and normals is None:
        # Whatever has such a normal is black.
        unreadable = _BAD_NORMALS
    elif len(face.lists) > 1 or any(t.lists for n, t in ply.tables.items() if n != "face"):
        # Each of them is taken for three values.
        unreadable = "it has other lists than the corners of its faces"
    hides_colors = any({"alpha", "a", "color_3"} & set(ply.tables[name].columns) for name in tints_of)
    return MeshFile(
        vertices,
        faces,
        polygons,
        normals,
        tints_of.get("vertex"),
        tints_of["face"][polygons] if "face" in tints_of else None,
        tuple(notes),
        unreadable,
        hides_colors,
        encodes,
    )


class _Obj:
    """The statements of an OBJ file."""

    def __init__(self) -> None:
        self.count = self.normals = self.textures = 0
        self.vertices: list[np.ndarray] = []
        # By the number of the vertex: what follows its coordinates.
        self.rest: dict[int, list[bytes]] = {}
        self.corners: list[np.ndarray] = []
        self.counts: list[int] = []
        self.other: dict[bytes, None] = {}
        self.unreadable = ""

    def read(self, lines: list[bytes]) -> None:
        """Whole lines, without their ends."""
        vertices: list[bytes] = []
        normals: list[bytes] = []
        tokens: list[bytes] = []
        counts: list[int] = []
        before: list[int] = []
        for line in lines:
            words = line.split()
            if b"#" in line:
                words = line.partition(b"#")[0].split()
            if not words:
                continue
            kind = words[0]
            if kind == b"v":
                vertices += words[1:4]
                if len(words) != 4:
                    if len(words) < 4:
                        raise ValueError(f"vertex {self.count + 1:,} has fewer than three coordinates")
                    self.rest[self.count] = words[4:]
                self.count += 1
            elif kind == b"f":
                tokens += words[1:]
                counts.append(len(words) - 1)
                before.append(self.count)
            elif kind == b"vn":
                normals += words[1:4]
                self.normals += 1
            elif kind == b"vt":
                self.textures += 1
                if len(words) < 3:
                    self.unreadable = "it has texture coordinates of one number"
            if kind not in _OBJ_USED:
                self.other[kind] = None
            if len(line) > _OBJ_LINE:
                self.unreadable = f"it has lines of more than {_OBJ_LINE:,} characters"
        self.vertices.append(parse_numbers(b" ".join(vertices)).reshape(-1, 3))
        directions = np.linalg.norm(parse_numbers(b" ".join(normals)).reshape(-1, 3), axis=1)
        if not (np.isfinite(directions).all() and (directions > 0).all()):
            self.unreadable = _BAD_NORMALS
        if tokens:
            self.corners.append(self._corners(tokens, np.repeat(before, counts)))
            self.counts += counts

    def _corners(self, tokens: list[bytes], before: np.ndarray) -> np.ndarray:
        """Vertices, from 0 on, that ``tokens`` (N,) of faces name, of which ``before`` (N,) precede the face; -1 where
        there is none."""
        index, *others = _parts(tokens)
        if (index == 0).any():
            raise ValueError("a face names vertex 0, and they are counted from 1")
        for named, count, what in zip(others, (self.textures, self.normals), ("texture coordinate", "normal")):
            wrong = named[np.abs(named) > count]
            if len(wrong):
                raise ValueError(f"a face names {what} {wrong[0]}, of which there are {count:,} before it")
        if any((named < 0).any() for named in (index, *others)):
            self.unreadable = "it has negative indices"
        elif (index > before).any():
            self.unreadable = "its faces name vertices that come later"
        # Negative ones count from the last vertex before the face.
        return np.where(index > 0, index - 1, np.where(-index <= before, before + index, -1))


def _parts(tokens: list[bytes]) -> list[np.ndarray]:
    """The numbers between the slashes of each of ``tokens`` (N,), up to three (N,); 0 where there is none."""
    joined = b" ".join(tokens)
    if b"/" not in joined:
        return [parse_numbers(joined, np.int64)]
    # Most files have one form in all faces.
    width = tokens[0].count(b"/") + 1
    if width <= 3 and all(token.count(b"/") == width - 1 for token in tokens):
        numbers = parse_numbers(joined.replace(b"//", b"/0/").replace(b"/", b" "), np.int64)
        if len(numbers) == width * len(tokens):
            return list(numbers.reshape(-1, width).T)
    table = np.zeros((len(tokens), 3), np.int64)
    for row, token in zip(table, tokens):
        parts = token.split(b"/")
        if len(parts) > 3:
            raise ValueError(f'a corner of a face is "{sanitize(token.decode("latin-1"), 40)}"')
        row[: len(parts)] = [int(part or 0) for part in parts]
    return list(table.T)


def _read_obj(path: str | os.PathLike) -> MeshFile:
    check_regular_file(path, "mesh", MAX_TEXT_BYTES)
    obj, rest, end, ended = _Obj(), bytearray(), b"", False
    with open(path, "rb") as file:
        while not ended:
            block = file.read(_BLOCK)
            ended = not block
            *lines, end = (end + (block or b"\n")).split(b"\n")
            lines = [line.rstrip() for line in lines]
            if rest or any(line.endswith(b"\\") for line in lines):
                obj.unreadable = "it has lines that go on after a \\"
                whole: list[bytes] = []
                for line in lines:
                    rest += line
                    if rest.endswith(b"\\"):
                        rest[-1:] = b" "
                    else:
                        whole.append(bytes(rest))
                        rest.clear()
                lines = whole
            if max(len(end), len(rest)) > _BLOCK:
                raise ValueError(f"it has a line of more than the {_BLOCK:,} bytes that are read")
            obj.read(lines)
    obj.read([bytes(rest)])
    vertices, corners = np.concatenate(obj.vertices), np.concatenate([*obj.corners, np.zeros(0, np.int64)])
    faces, polygons, concave, beyond = _split(np.array(obj.counts, np.int64), corners, vertices)
    if concave:
        obj.unreadable = "it has concave faces"
    notes, colors = [], None
    # After the coordinates a weight, a colour, or both; or, as some programs write, a colour and an alpha.
    firsts = parse_numbers(b" ".join(words[0] for words in obj.rest.values() if len(words) == 4))
    has_weights = bool((firsts == 1).all())
    tints = {
        k: words[1:] if len(words) == 4 and has_weights else words[:3]
        for k, words in obj.rest.items()
        if len(words) >= 3
    }
    if len(firsts):
        what = "the first is taken for a weight" if has_weights else "the last is taken for an alpha, and not used"
        notes.append(f"of four numbers after the coordinates of its vertices {what}")
    if tints:
        values = parse_numbers(b" ".join(word for words in tints.values() for word in words)).reshape(-1, 3)
        colors = np.full((obj.count, 3), DEFAULT_GREY)
        if not np.isfinite(values).all():
            raise ValueError("some of its colours are not finite")
        # sRGB values of 0 to 1, or to 255.
        colors[list(tints)] = decode_srgb(np.clip(values / (255 if values.max() > 1 else 1), 0, 1))
        if len(tints) < obj.count:
            notes.append(f"{obj.count - len(tints):,} of its vertices have no colour, and are grey")
    if any(len(words) < 3 for words in obj.rest.values()):
        notes.append("weights of its vertices are not used")
    if obj.other:
        names = ", ".join(name.decode("latin-1") for name in obj.other)
        notes.append(f"statements that are not used: {sanitize(names)}")
    if beyond:
        notes.append(_BEYOND.format(beyond))
    return MeshFile(
        vertices, faces, polygons, None, colors, None, tuple(notes), obj.unreadable, hides_colors=colors is not None
    )


def _read_glb(path: str | os.PathLike) -> MeshFile:
    triangles = parse_glb(map_bytes(path, "mesh", MAX_GLTF_BYTES, GLTF_MAGIC, "export it again"), path)
    # Its y is up.
    vertices = np.stack([triangles.vertices[:, 0], -triangles.vertices[:, 2], triangles.vertices[:, 1]], axis=1)
    faces = triangles.faces
    return MeshFile(
        vertices, faces, np.arange(len(faces)), None, triangles.colors, notes=triangles.notes, unreadable_reason="it is glTF"
    )


READERS = {".ply": _read_ply, ".obj": _read_obj, ".glb": _read_glb}  # readers by the ending of a file's name
