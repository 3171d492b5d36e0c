"""Mesh files (PLY, OBJ, binary glTF) as triangles with colours, including files that Mitsuba cannot read.

- Vertex or face colours (PLY ``red, green, blue``; OBJ after the coordinates; glTF ``COLOR_0``) are sRGB if PLY has
  integers (or floats up to 255) and in OBJ; PLY floats up to 1, as Mitsuba writes them, and glTF colours are linear.
- Polygons are cut into triangle fans, concave ones from a corner that sees all others.
- KHR_mesh_quantization is decoded. glTF's y axis becomes z up.
- Other columns, transparency, textures, materials and animations are named and ignored.
- Refused: non-finite vertices, indices out of range, decimal commas, unknown statements of an OBJ, rows that differ
  from the header of a PLY, UTF-16, and glTF extensions that compress or multiply triangles.

Mitsuba's readers support only triangles in PLY, and neither negative indices nor continued lines in OBJ, nor glTF.
`MeshFile.unreadable_reason` reports this, and `MeshFile` contains the data to pass to Mitsuba instead.
``nerg scene`` writes such a mesh again as ``NAME.mesh.ply`` next to the scene; a scene file that references it
directly is refused with the reason.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import check_regular_file, map_bytes, measure_byte_order_mark, translate_read_errors
from nerg_mi.files.values import normalize_name
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.coordinates import check_near_origin

from .gltf import GLTF_MAGIC, MAX_GLTF_BYTES, parse_glb
from .ply import BYTE_ORDER_MARK, MAC_LINE_ENDS, PLY_MAGIC, PlyTable, describe_cell, find_cell, parse_numbers, parse_ply

MAX_BYTES = 64 << 30  # maximum size of a file in bytes
MAX_TEXT_BYTES = 1 << 30  # maximum size of a text file in bytes
DEFAULT_GREY = 0.5  # grey value of vertices without a colour
_BLOCK = 1 << 24  # bytes of text that are read at once, and maximum length of a line
_MIN_FLIPPED_AREA = 1e-6  # relative to the squared area of a polygon, see _rotate_concave
_MAX_FAN_STARTS, _CHUNK_CORNERS = 64, 1 << 20
_CENTER, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"), ("color_0", "color_1", "color_2", "color_3"))
_FACE_INDEX_NAMES = ("vertex_index", "vertex_indices")
_OBJ_STATEMENTS = {b"v", b"vn", b"f", b"g", b"o", b"s"}
# The other statements of the format (Wavefront, appendix B1 of the Advanced Visualizer, and its older versions).
_UNUSED_OBJ_STATEMENTS = set(
    b"vt vp cstype deg bmat step p l curv curv2 surf parm trim hole scrv sp end con mg bevel c_interp d_interp lod "
    b"usemtl mtllib shadow_obj trace_obj ctech stech usemap maplib call csh bsp bzp cdc cdp res".split()
)
_MAX_OBJ_LINE = 1000
_CONCAVE_NOTE = (
    "{:,} of its faces are concave and were triangulated incorrectly: triangulate it in the program that made it"
)
_BAD_NORMALS = "some of its normals are 0 or not finite"


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Triangles of a file, in its own frame and units; glTF is rotated so that z is up.

    Attributes
    ----------
    vertices
        Positions (V, 3) float64.
    faces
        Vertex indices (F, 3) int64.
    polygons
        Index (F,) of the face in the file from which each triangle was made.
    normals
        Normals (V, 3), or None.
    colors
        Linear vertex colours (V, 3) in 0..1, or None.
    face_colors
        Linear face colours (F, 3) in 0..1, or None.
    notes
        Sentences about data that is not used or was guessed.
    unreadable_reason
        Why Mitsuba cannot read the file, or "".
    hides_colors
        Whether Mitsuba would ignore the colours; it cannot texture colours with an alpha channel.
    encodes_colors
        Whether the colours in the file are sRGB values, which Mitsuba would treat as linear.
    parts
        Name of each node, object or group, and the index of its first face in the file.
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
    parts: tuple[tuple[str, int], ...] = ()

    def split_parts(self) -> dict[str, np.ndarray]:
        """Return the faces (F, 3) of each part by its name; those without a name are "mesh"."""
        labels = ["mesh", *(normalize_name(name) or "mesh" for name, _ in self.parts)]
        names, number = np.unique(labels, return_inverse=True)
        part = number[np.searchsorted([start for _, start in self.parts], self.polygons, side="right")]
        return {str(names[k]): self.faces[part == k] for k in np.unique(part)}

    @property
    def is_readable_by_mitsuba(self) -> bool:
        """Whether Mitsuba reads the file and its colours correctly."""
        return not (self.unreadable_reason or self.hides_colors or self.encodes_colors)


def read_mesh_file(path: str | os.PathLike, allow_points: bool = False, suffix: str | None = None) -> MeshFile:
    """Read the mesh in ``path``.

    Parameters
    ----------
    path
        The file.
    allow_points
        Whether the mesh may have no faces.
    suffix
        Suffix of the format, if it differs from that of the file name.

    Raises
    ------
    NergError
        For a file that is missing, damaged or not a mesh, for vertices that are not finite, for faces with invalid
        vertex indices, and for coordinates too far from the origin for single precision.
    """
    suffix = suffix or Path(path).suffix.lower()
    if suffix not in READERS:
        raise NergError(f'"{path}" is not a supported mesh; use a file that ends in {", ".join(READERS)}')
    # A value of a wrong type is an error of the file.
    with (
        translate_read_errors(path, "mesh", "export it again", extra_errors=(TypeError, AttributeError)),
        np.errstate(all="ignore"),
    ):
        mesh = READERS[suffix](path)
        if not len(mesh.vertices):
            raise ValueError("it has no vertices")
        if not (len(mesh.faces) or allow_points):
            raise ValueError("it has no faces")
        bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
        if len(bad) and not allow_points:
            raise ValueError(f"vertex {bad[0] + 1:,} is not finite ({len(bad):,} in total)")
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"it has a face with an index beyond its {len(mesh.vertices):,} vertices")
    check_near_origin(mesh.vertices, f'the mesh "{path}"')
    return mesh


# ---- Normals for shading ----

MAX_CREASED_FACES = 500_000  # Faces of a mesh without normals up to which creases are searched
_CREASE = np.cos(np.radians(40))


def with_shading_normals(mesh: MeshFile) -> MeshFile:
    """Return ``mesh`` with normals that are smooth except across creases, edges whose faces differ by over 40 degrees.

    Vertices at creases are duplicated. A mesh that has normals, or more than `MAX_CREASED_FACES` faces, is returned
    unchanged: the triangles of such a scan are too small to be distinguished.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if mesh.normals is not None or not 0 < len(mesh.faces) <= MAX_CREASED_FACES:
        return mesh
    # Files duplicate vertices where colours or textures differ, which are not creases.
    welded = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a)
    unit = area_normals / np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-300)
    # Half-edges by their corners at the smaller and at the larger vertex; equal ones belong to adjacent faces.
    corner = np.arange(welded.size).reshape(-1, 3)
    ends, corners = (np.stack([v, np.roll(v, -1, axis=1)], axis=-1).reshape(-1, 2) for v in (welded, corner))
    order = np.argsort(ends, axis=1)
    ends, corners = np.take_along_axis(ends, order, axis=1), np.take_along_axis(corners, order, axis=1)
    by_edge = np.lexsort(ends.T)
    ends, corners = ends[by_edge], corners[by_edge]
    face = corners[:, 0] // 3
    is_smooth = (ends[1:] == ends[:-1]).all(axis=1) & ((unit[face[1:]] * unit[face[:-1]]).sum(axis=1) > _CREASE)
    first, second = corners[:-1][is_smooth].ravel(), corners[1:][is_smooth].ravel()
    # coo_array keeps 64-bit indices, with which older versions of SciPy return nonsense without an exception.
    links = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(welded.size, welded.size))
    count, group = connected_components(links, directed=False)
    normals = np.stack([np.bincount(group, np.repeat(n, 3), count) for n in area_normals.T], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.maximum(length, 1e-300), (0.0, 0.0, 1.0))
    keys, faces = np.unique(group * len(mesh.vertices) + mesh.faces.ravel(), return_inverse=True)
    group, vertex = np.divmod(keys, len(mesh.vertices))
    colors = None if mesh.colors is None else mesh.colors[vertex]
    return replace(
        mesh, vertices=mesh.vertices[vertex], faces=faces.reshape(-1, 3), normals=normals[group], colors=colors
    )


class _Triangles(NamedTuple):
    """Triangulated polygons.

    Attributes
    ----------
    faces
        Vertex indices (F, 3).
    polygons
        Index of the polygon of each triangle (F,).
    concave
        Number of concave polygons.
    beyond
        Number of concave polygons whose triangles extend beyond the polygon.
    """

    faces: np.ndarray
    polygons: np.ndarray
    concave: int = 0
    beyond: int = 0


def _triangulate(counts: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> _Triangles:
    """Split polygons into triangle fans.

    Parameters
    ----------
    counts
        Number of corners of each polygon (P,).
    corners
        Vertex indices of all polygons, one after another.
    vertices
        Positions (V, 3).
    """
    if len(counts) and counts.min() < 3:
        raise ValueError(f"face {int(np.argmin(counts)) + 1:,} has fewer than three corners")
    if not len(counts) or counts.max() == 3:
        return _Triangles(corners.reshape(-1, 3), np.arange(len(counts)))
    starts, concave, beyond = np.cumsum(counts) - counts, 0, 0
    # Faces with invalid vertex indices raise an error later.
    is_valid = 0 <= corners.min() <= corners.max() < len(vertices)
    for count in np.unique(counts[counts > 3]).tolist() if is_valid else ():
        places = starts[counts == count]
        for block in np.array_split(places, 1 + len(places) * count // _CHUNK_CORNERS):
            at = block[:, None] + np.arange(count)
            corners[at], turned, unresolved = _rotate_concave(corners[at], vertices)
            concave, beyond = concave + turned + unresolved, beyond + unresolved
    pieces = counts - 2
    polygons = np.repeat(np.arange(len(counts)), pieces)
    first = np.repeat(starts, pieces)
    k = np.arange(len(polygons)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    faces = np.stack([corners[first], corners[first + k + 1], corners[first + k + 2]], axis=1)
    return _Triangles(faces, polygons, concave, beyond)


def _rotate_concave(index: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Rotate the corners of concave polygons (P, N) so that their fan starts at a corner that sees all others.

    Returns the polygons, how many were rotated, and how many have no such corner or too many corners to search.
    """

    def is_flipped(index: np.ndarray) -> np.ndarray:
        p = vertices[index]
        normals = np.cross(p[:, 1:-1] - p[:, :1], p[:, 2:] - p[:, :1])
        total = normals.sum(axis=1, keepdims=True)
        return ((normals * total).sum(axis=2) < -_MIN_FLIPPED_AREA * (total**2).sum(axis=2)).any(axis=1)

    (unresolved,) = np.nonzero(is_flipped(index))
    concave = len(unresolved)
    for k in range(1, min(index.shape[1], _MAX_FAN_STARTS, 1 + _CHUNK_CORNERS // index.shape[1])):
        if not len(unresolved):
            break
        rolled = np.roll(index[unresolved], -k, axis=1)
        is_good = ~is_flipped(rolled)
        index[unresolved[is_good]] = rolled[is_good]
        unresolved = unresolved[~is_good]
    return index, concave - len(unresolved), len(unresolved)


def _linear_colors(columns: Sequence[np.ndarray], kind: np.dtype) -> tuple[np.ndarray, bool]:
    """Convert the colour ``columns`` of a PLY file to linear colours in 0..1. Returns them and whether they were sRGB
    values.

    Integers are sRGB values, as cameras, scanners and modelling programs write them. Their maximum is 255 if no value
    is larger, otherwise 65535 or the maximum of the type. Floats up to 1 are linear, as renderers write them.
    """
    values = np.stack(columns, axis=-1).astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("some of its colours are not finite")
    largest = values.max(initial=0)
    if kind.kind == "f" and largest <= 1:
        return np.clip(values, 0, 1), False
    limits = [255, 65535, np.iinfo(kind).max] if kind.kind in "iu" and kind.itemsize > 1 else [255]
    scale = next((limit for limit in limits if largest <= limit), limits[-1])
    return decode_srgb(np.clip(values / scale, 0, 1)), True


def _read_ply(path: str | os.PathLike) -> MeshFile:
    ply = parse_ply(np.frombuffer(map_bytes(path, "mesh", MAX_BYTES, PLY_MAGIC, "export it again"), np.uint8))
    vertex, face = (ply.tables.get(name, PlyTable(0)) for name in ("vertex", "face"))
    names = next((names for names in _FACE_INDEX_NAMES if names in face.lists), None)
    if face.count and names is None:
        raise ValueError("its faces have no property vertex_index or vertex_indices")
    counts, corners = face.lists[names]() if names else (np.zeros(0, np.int64), np.zeros(0))
    if corners.dtype.kind == "f" and not ((corners == np.floor(corners)) & np.isfinite(corners)).all():
        raise ValueError("the vertex indices of its faces are not whole numbers")
    if not face.count and ply.tables.get("tristrips", PlyTable(0)).count:
        raise ValueError('its triangles are strips (the element "tristrips"), which are not read; export it as faces')
    missing = [name for name in _CENTER if vertex.count and name not in vertex.columns]
    if missing:
        raise ValueError(f'its vertices have no property "{missing[0]}"')
    take = lambda table, names: [table.columns[name]() for name in names]
    vertices = np.stack(take(vertex, _CENTER), axis=1).astype(np.float64) if vertex.count else np.zeros((0, 3))
    faces, polygons, _, beyond = _triangulate(counts, corners.astype(np.int64), vertices)
    used, notes, is_encoded, colors = {"vertex": {*_CENTER, *_NORMAL}, "face": {names}}, [], False, {}
    for name, table in (("vertex", vertex), ("face", face)):
        color_names = next((c for c in _COLORS if all(n in table.columns for n in c[:3])), None)
        if color_names:
            colors[name], encoded = _linear_colors(take(table, color_names[:3]), table.dtypes[color_names[0]])
            is_encoded |= encoded
            used[name] |= set(color_names[:3])
    normals = None
    if all(name in vertex.columns for name in _NORMAL):
        normals = np.stack(take(vertex, _NORMAL), axis=1).astype(np.float64)
        length = np.linalg.norm(normals, axis=1)
        if not (np.isfinite(length).all() and (length > 0).all()):
            normals = None
            notes.append(f"the normals are not used: {_BAD_NORMALS}")
    for name, table in ply.tables.items():
        unused = [n for n in (*table.columns, *table.lists) if n not in used.get(name, ())]
        if unused and table.count:
            notes.append(f"unused columns of {sanitize(name, 40)}: {sanitize(', '.join(unused))}")
    notes += [f"unused: {sanitize(c, 80)}" for c in ply.comments if c.startswith("TextureFile")]
    num_polygons = int((counts != 3).sum())
    if num_polygons:
        notes.append(f"{num_polygons:,} faces with more than three corners are split into triangles")
    if beyond:
        notes.append(_CONCAVE_NOTE.format(beyond))
    unreadable = ""
    if num_polygons:
        unreadable = "it has faces with more than three corners"
    elif ply.unusual_text:
        unreadable = ply.unusual_text
    elif ply.has_trailing_data:
        unreadable = "it has data after its rows"
    elif "nx" in vertex.columns and normals is None:
        # Mitsuba renders vertices with such normals black.
        unreadable = _BAD_NORMALS
    elif len(face.lists) > 1 or any(t.lists for n, t in ply.tables.items() if n != "face"):
        # Mitsuba assumes three values in each list.
        unreadable = "it has lists besides the vertex indices of its faces"
    hides_colors = any({"alpha", "a", "color_3"} & set(ply.tables[name].columns) for name in colors)
    return MeshFile(
        vertices,
        faces,
        polygons,
        normals,
        colors.get("vertex"),
        colors["face"][polygons] if "face" in colors else None,
        tuple(notes),
        unreadable,
        hides_colors,
        is_encoded,
    )


class _ObjStatements:
    """The statements of an OBJ file."""

    def __init__(self) -> None:
        self.count = self.normals = self.textures = 0
        self.vertices: list[np.ndarray] = []
        # By vertex index: the numbers that follow the coordinates.
        self.vertex_extras: dict[int, list[bytes]] = {}
        self.corners: list[np.ndarray] = []
        self.counts: list[int] = []
        self.parts: list[tuple[str, int]] = []
        self.unused_statements: dict[bytes, None] = {}
        self.unreadable_reason = ""

    def read(self, lines: list[bytes], numbers: Sequence[int]) -> None:
        """Parse complete lines, whose line numbers are ``numbers``, without their line ends."""
        vertices: list[bytes] = []
        # Cells that need to be numbers, but whose values are not used here.
        other_cells: list[bytes] = []
        normals: list[bytes] = []
        tokens: list[bytes] = []
        counts: list[int] = []
        before: list[int] = []
        for number, line in zip(numbers, lines):
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
                        raise ValueError(f"line {number:,}: vertex {self.count + 1:,} has fewer than three coordinates")
                    self.vertex_extras[self.count] = words[4:]
                    other_cells += words[4:]
                self.count += 1
            elif kind == b"f":
                tokens += words[1:]
                counts.append(len(words) - 1)
                before.append(self.count)
            elif kind in (b"o", b"g"):
                self.parts.append((b" ".join(words[1:]).decode("utf-8", "replace"), len(self.counts) + len(counts)))
            elif kind == b"vn":
                if len(words) < 4:
                    raise ValueError(f"line {number:,}: a normal has fewer than three components")
                normals += words[1:4]
                self.normals += 1
            elif kind == b"vt":
                self.textures += 1
                other_cells += words[1:]
                if len(words) < 3:
                    self.unreadable_reason = "it has texture coordinates with one number"
            if kind not in _OBJ_STATEMENTS:
                if kind not in _UNUSED_OBJ_STATEMENTS:
                    name = sanitize(kind.decode("latin-1"), 40)
                    raise ValueError(f'line {number:,} begins with "{name}", which is no statement of an OBJ file')
                self.unused_statements[kind] = None
            if len(line) > _MAX_OBJ_LINE:
                self.unreadable_reason = f"it has lines with more than {_MAX_OBJ_LINE:,} characters"
        try:
            corners = _split_corners(tokens)
            positions, directions, _ = (parse_numbers(b" ".join(cells)) for cells in (vertices, normals, other_cells))
        except ValueError as error:
            raise ValueError(_describe_bad_line(lines, numbers) or str(error)) from error
        self.vertices.append(positions.reshape(-1, 3))
        lengths = np.linalg.norm(directions.reshape(-1, 3), axis=1)
        if not (np.isfinite(lengths).all() and (lengths > 0).all()):
            self.unreadable_reason = _BAD_NORMALS
        if tokens:
            self.corners.append(self._parse_corners(corners, np.repeat(before, counts)))
            self.counts += counts

    def _parse_corners(self, corners: list[np.ndarray], before: np.ndarray) -> np.ndarray:
        """Return the vertex indices (N,), from 0, of face ``corners`` of `_split_corners`; -1 for an invalid index.

        ``before`` (N,) is the number of vertices that precede the face.
        """
        index, *other_indices = corners
        if (index == 0).any():
            raise ValueError("a face refers to vertex 0, but indices start at 1")
        for indices, count, what in zip(other_indices, (self.textures, self.normals), ("texture coordinate", "normal")):
            invalid = indices[np.abs(indices) > count]
            if len(invalid):
                raise ValueError(f"a face refers to {what} {invalid[0]}, but only {count:,} precede it")
        if any((named < 0).any() for named in (index, *other_indices)):
            self.unreadable_reason = "it has negative indices"
        elif (index > before).any():
            self.unreadable_reason = "its faces refer to later vertices"
        # Negative indices count back from the last vertex before the face.
        return np.where(index > 0, index - 1, np.where(-index <= before, before + index, -1))


def _describe_bad_line(lines: list[bytes], numbers: Sequence[int]) -> str | None:
    """Return the number and the cell of the first of ``lines`` with text in place of a number."""
    for number, line in zip(numbers, lines):
        kind, *words = line.partition(b"#")[0].split() or [b""]
        text, dtype = (b" ".join(words), np.float64) if kind in (b"v", b"vn", b"vt") else (b"", np.float64)
        if kind == b"f":
            text, dtype = b" ".join(words).replace(b"/", b" "), np.int64
        if find_cell(text, dtype) >= 0:
            return f"line {number:,} has {describe_cell(text, dtype)}"
    return None


def _split_corners(tokens: list[bytes]) -> list[np.ndarray]:
    """Return the numbers between the slashes of the corners ``tokens`` (N,) as up to three arrays (N,); 0 for a
    missing number.
    """
    joined = b" ".join(tokens)
    if b"/" not in joined:
        return [parse_numbers(joined, np.int64)]
    # Most files use one form for all faces.
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
    obj, continued, end, is_at_end, num_lines = _ObjStatements(), bytearray(), b"", False, 0
    with open(path, "rb") as file:
        if file.seek(measure_byte_order_mark(file.read(4), path, "mesh")):
            obj.unreadable_reason = BYTE_ORDER_MARK
        while not is_at_end:
            block = file.read(_BLOCK)
            if block.endswith(b"\r"):
                block += file.read(1)  # the second half of \r\n
            if re.search(rb"\r[^\r\n]", block):
                obj.unreadable_reason = MAC_LINE_ENDS
            is_at_end = not block
            block = block.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            *lines, end = (end + (block or b"\n")).split(b"\n")
            lines = [line.rstrip() for line in lines]
            numbers: Sequence[int] = range(num_lines + 1, num_lines + 1 + len(lines))
            num_lines += len(lines)
            if continued or any(line.endswith(b"\\") for line in lines):
                joined: list[tuple[int, bytes]] = []
                for number, line in zip(numbers, lines):
                    continued += line
                    if continued.endswith(b"\\") and not line.lstrip().startswith(b"#"):
                        continued[-1:] = b" "
                        obj.unreadable_reason = "it has lines that are continued after a \\"
                    else:
                        joined.append((number, bytes(continued)))
                        continued.clear()
                numbers, lines = [number for number, _ in joined], [line for _, line in joined]
            if max(len(end), len(continued)) > _BLOCK:
                raise ValueError(f"it has a line of more than {_BLOCK:,} bytes, the limit")
            obj.read(lines, numbers)
    obj.read([bytes(continued)], [num_lines])
    vertices, corners = np.concatenate(obj.vertices), np.concatenate([*obj.corners, np.zeros(0, np.int64)])
    faces, polygons, concave, beyond = _triangulate(np.array(obj.counts, np.int64), corners, vertices)
    if concave:
        obj.unreadable_reason = "it has concave faces"
    notes, colors = [], None
    # A weight, a colour or both may follow the coordinates. Some programs write a colour and an alpha value.
    first_extras = parse_numbers(b" ".join(words[0] for words in obj.vertex_extras.values() if len(words) == 4))
    has_weights = bool((first_extras == 1).all())
    colors_by_vertex = {
        k: words[1:] if len(words) == 4 and has_weights else words[:3]
        for k, words in obj.vertex_extras.items()
        if len(words) >= 3
    }
    if len(first_extras):
        what = (
            "the first is interpreted as a weight" if has_weights else "the last is interpreted as alpha and not used"
        )
        notes.append(f"of the four numbers after vertex coordinates, {what}")
    if colors_by_vertex:
        values = parse_numbers(b" ".join(word for words in colors_by_vertex.values() for word in words)).reshape(-1, 3)
        colors = np.full((obj.count, 3), DEFAULT_GREY)
        if not np.isfinite(values).all():
            raise ValueError("some of its colours are not finite")
        # sRGB values in 0..1 or 0..255.
        colors[list(colors_by_vertex)] = decode_srgb(np.clip(values / (255 if values.max() > 1 else 1), 0, 1))
        if len(colors_by_vertex) < obj.count:
            notes.append(f"{obj.count - len(colors_by_vertex):,} vertices have no colour and are grey")
    if any(len(words) < 3 for words in obj.vertex_extras.values()):
        notes.append("the weights of vertices are not used")
    if obj.unused_statements:
        names = ", ".join(name.decode("latin-1") for name in obj.unused_statements)
        notes.append(f"unused statements: {sanitize(names)}")
    if beyond:
        notes.append(_CONCAVE_NOTE.format(beyond))
    return MeshFile(
        vertices,
        faces,
        polygons,
        None,
        colors,
        None,
        tuple(notes),
        obj.unreadable_reason,
        hides_colors=colors is not None,
        parts=tuple(obj.parts),
    )


def _read_glb(path: str | os.PathLike) -> MeshFile:
    triangles = parse_glb(map_bytes(path, "mesh", MAX_GLTF_BYTES, GLTF_MAGIC, "export it again"), path)
    # The up axis of glTF is y.
    vertices = np.stack([triangles.vertices[:, 0], -triangles.vertices[:, 2], triangles.vertices[:, 1]], axis=1)
    faces = triangles.faces
    return MeshFile(
        vertices,
        faces,
        np.arange(len(faces)),
        None,
        triangles.colors,
        notes=triangles.notes,
        unreadable_reason="it is glTF",
        parts=triangles.parts,
    )


READERS = {".ply": _read_ply, ".obj": _read_obj, ".glb": _read_glb}  # reader by file suffix
