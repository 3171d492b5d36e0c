"""PLY files: reading of all tables and columns, and writing of binary files with custom columns.

This module does not use trimesh (5.2). Its reader rejects files that mix triangles and quadrilaterals with face
colours, and does not check vertex indices. Its writer does not support comments, which contain units and provenance. It
drops the columns of point clouds or adds an empty list of faces, and adds an alpha channel to colours, which Mitsuba
reads as an attribute with four channels that its textures do not support.
"""

from __future__ import annotations

import os
import re
import warnings
from codecs import BOM_UTF8
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from nerg_mi.errors import sanitize
from nerg_mi.files.atomic import write_bytes

PLY_MAGIC = b"ply"  # first bytes of a file
MAX_HEADER_BYTES = 1 << 20  # maximum size of the header in bytes
MAX_TEXT_BYTES = 256 << 20  # maximum size of the rows of a text file in bytes
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}
_DTYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True, eq=False)
class PlyTable:
    """An element of a PLY file.

    Attributes
    ----------
    count
        Number of rows.
    columns
        By name of a scalar property: function that returns the values (count,).
    lists
        By name of a list property: function that returns the lengths (count,) and the concatenated values.
    dtypes
        NumPy type of each property.
    """

    count: int
    columns: dict[str, Callable[[], np.ndarray]] = field(default_factory=dict)
    lists: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    dtypes: dict[str, np.dtype] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Ply:
    """Parsed file: ``tables`` by element name in file order, ``comments``, whether data follows the last row, and why
    stricter readers reject its text, or "".
    """

    tables: dict[str, PlyTable]
    comments: tuple[str, ...]
    has_trailing_data: bool
    unusual_text: str = ""


BYTE_ORDER_MARK, MAC_LINE_ENDS = "it begins with a byte order mark", "its lines end as on an old Mac (CR)"


def parse_ply(raw: np.ndarray) -> Ply:
    """Parse the bytes ``raw`` (uint8) of a file, read or memory-mapped. A byte order mark is skipped.

    Raises `ValueError` for another kind of file, and for a file that ends before its rows. No memory is allocated for
    counts that exceed the file. Values of text files are float64.
    """
    start = len(BOM_UTF8) if raw[: len(BOM_UTF8)].tobytes() == BOM_UTF8 else 0
    head = bytes(raw[start : start + MAX_HEADER_BYTES])
    # The first line tells the line ends of the header: a byte of binary rows may look like the second half of \r\n.
    line_end = re.match(rb"ply[ \t]*(\r\n|\r|\n)", head)
    end = re.search(rb"[\r\n]end_header[ \t]*" + (b"\r" if line_end and line_end[1] == b"\r" else b"\r?\n"), head)
    if line_end is None or end is None:
        raise ValueError("it has no PLY header")
    order, elements, comments = _parse_header(head[: end.start()].decode("latin-1"))
    body = raw[start + end.end() :]
    num_lines = len(re.findall(rb"\r\n|\r|\n", head[: end.end()]))
    source: _BinaryRows | _TextRows = _BinaryRows(body, order) if order else _TextRows(body, num_lines + 1)
    tables, at = {}, 0
    for name, count, properties in elements:
        if name in tables:
            raise ValueError(f'it has two elements named "{name}"')
        tables[name], at = source.read_table(at, name, count, properties)
    if at < source.length and not order:
        raise ValueError(f"its header describes {at:,} numbers, but {source.length:,} follow")
    return Ply(
        tables,
        comments,
        at < source.length,
        BYTE_ORDER_MARK if start else MAC_LINE_ENDS if line_end[1] == b"\r" else "",
    )


_REAL = rb"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[iI][nN][fF](?:[iI][nN][iI][tT][yY])?|[nN][aA][nN])"
_CELLS = {
    kind: re.compile(rb"(?<!\S)(?!" + pattern + rb"(?!\S))\S+")
    for kind, pattern in ((np.float64, _REAL), (np.int64, rb"[-+]?\d+"))
}


def parse_numbers(text: bytes, dtype: type = np.float64) -> np.ndarray:
    """Parse the numbers in ``text``, separated by white space. Raises `ValueError`, which quotes the cell, for anything
    else; see `find_cell`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text, dtype, sep=" ") if text.strip() else np.zeros(0, dtype)
        except (DeprecationWarning, ValueError):
            values = None
    # "1.5.2" is parsed as two numbers.
    if values is None or len(values) != _count_cells(text):
        raise ValueError(f"it has {describe_cell(text, dtype)}")
    return values


def _count_cells(text: bytes) -> int:
    is_in_cell = np.frombuffer(text, np.uint8) > 32
    return int(np.count_nonzero(is_in_cell[1:] & ~is_in_cell[:-1])) + int(is_in_cell[:1].sum())


def find_cell(text: bytes, dtype: type = np.float64) -> int:
    """Return the position of the first cell of ``text`` that is not a number; -1 if there is none."""
    match = _CELLS[dtype].search(text)
    return match.start() if match else -1


def describe_cell(text: bytes, dtype: type = np.float64) -> str:
    """Return what the first cell of ``text`` is that is not a number, with the likely cause."""
    match = _CELLS[dtype].search(text)
    if match is None:
        return "text in place of numbers"
    cause = "; decimals need a point, not a comma" if b"," in match[0] else ""
    return f'"{sanitize(match[0].decode("latin-1"), 40)}" in place of a number{cause}'


# Name, NumPy type of the values, and NumPy type of the length of a list.
_Property = tuple[str, str, str | None]


_HEADER_LINE = re.compile(r"(format \S+( \S+)?|element \S+ -?\d{1,40}|property list \S+ \S+ \S+|property \S+ \S+)")


def _parse_header(head: str) -> tuple[str, list[tuple[str, int, list[_Property]]], tuple[str, ...]]:
    """Return the byte order ("" for text), the elements and the comments."""
    order, elements, comments = None, [], []
    for line in head.splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            comments.append(line.partition(" ")[2].strip())
        elif not _HEADER_LINE.fullmatch(" ".join(words)) or (words[0] == "property" and not elements):
            raise ValueError(f'its header has the line "{sanitize(line.strip(), 60)}"')
        elif words[0] == "format":
            if words[1] not in (orders := {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}):
                raise ValueError(f'its format is "{words[1][:40]}"')
            order = orders[words[1]]
        elif words[0] == "element":
            elements.append((words[1], int(words[2]), []))
            if elements[-1][1] < 0:
                raise ValueError(f'its element "{words[1][:40]}" has {elements[-1][1]} rows')
        else:
            listed = words[1] == "list"
            name, kind, count = (words[4], words[3], words[2]) if listed else (words[2], words[1], None)
            for used in (kind, *([count] if count else [])):
                if used not in _DTYPES:
                    raise ValueError(f'its property {name[:40]} has the type "{used[:40]}"')
            if any(name == other for other, *_ in elements[-1][2]):
                raise ValueError(f'it has two properties named "{name[:40]}"')
            elements[-1][2].append((name, _DTYPES[kind], _DTYPES[count] if count else None))
    if order is None:
        raise ValueError("its header has no format")
    return order, elements, tuple(c for c in comments if c)


class _RowSource:
    """Access to the values of a file by position. Positions count bytes in binary files and words in text files."""

    length: int

    def size(self, kind: str) -> int:
        """Size of a value in positions."""
        raise NotImplementedError

    def take(self, positions: np.ndarray, kind: str) -> np.ndarray:
        """Return the values at ``positions``."""
        raise NotImplementedError

    def number(self, position: int, kind: str) -> int:
        """Return the integer at ``position``; -1 if it is invalid."""
        raise NotImplementedError

    def read_fixed_rows(self, at: int, count: int, widths: list[tuple[str, int]]) -> Callable[[int], np.ndarray]:
        """Return a function of k that reads field k of ``count`` rows from ``at``; all rows have fields of these
        ``widths``.
        """
        raise NotImplementedError

    def read_table(self, at: int, name: str, count: int, properties: list[_Property]) -> tuple[PlyTable, int]:
        """Return the element whose rows start at ``at``, and the position after its rows."""
        min_size = sum(self.size(c or k) for _, k, c in properties)
        if count * min_size > self.length - at:
            raise ValueError(f"it is truncated: it claims {count:,} rows of {name}")
        kinds = {name: np.dtype(kind) for name, kind, _ in properties}
        if not (properties and count):
            make_empty = lambda: np.zeros(0)
            columns = {n: make_empty for n, _, c in properties if c is None}
            return PlyTable(
                count, columns, {n: lambda: (make_empty(), make_empty()) for n, _, c in properties if c}, kinds
            ), at
        # Most lists have the same length in all rows.
        lengths, position = [], at
        for _, kind, counted in properties:
            lengths.append(self.number(position, counted) if counted and position < self.length else -1)
            position += self.size(counted or kind) + (max(lengths[-1], 0) * self.size(kind) if counted else 0)
        if at + count * (position - at) <= self.length and all(n > 0 for n, p in zip(lengths, properties) if p[2]):
            widths = [w for (_, k, c), n in zip(properties, lengths) for w in ([(c, 1), (k, n)] if c else [(k, 1)])]
            values = self.read_fixed_rows(at, count, widths)
            columns, lists, is_uniform, k = {}, {}, True, 0
            for (name, _, counted), n in zip(properties, lengths):
                if counted is None:
                    columns[name] = partial(values, k)
                else:
                    is_uniform = is_uniform and bool((values(k) == n).all())
                    lists[name] = lambda k=k: (values(k).astype(np.int64), values(k + 1).reshape(-1))
                k += 2 if counted else 1
            if is_uniform:
                return PlyTable(count, columns, lists, kinds), at + count * (position - at)
        return self._read_varying_rows(at, name, count, properties, kinds)

    def _read_varying_rows(self, at, name, count, properties: list[_Property], kinds) -> tuple[PlyTable, int]:
        starts = np.zeros((len(properties), count), np.int64)
        counts = np.zeros((len(properties), count), np.int64)
        sizes: list[Any] = [
            (self.size(kind), counted and self.size(counted), counted) for _, kind, counted in properties
        ]
        for row in range(count):
            for k, (size, head, counted) in enumerate(sizes):
                if counted:
                    if at + head > self.length:
                        raise ValueError(f"it is truncated before row {row + 1:,} of {name}")
                    n = self.number(at, counted)
                    if n < 0:
                        raise ValueError(f"row {row + 1:,} of {name} has a list with a negative length")
                    starts[k, row], counts[k, row] = at + head, n
                    at += head + n * size
                else:
                    starts[k, row] = at
                    at += size
            if at > self.length:
                raise ValueError(f"it is truncated before row {row + 1:,} of {name}")

        def listed(k: int) -> tuple[np.ndarray, np.ndarray]:
            kind, total = properties[k][1], np.cumsum(counts[k])
            within = np.arange(total[-1]) - np.repeat(total - counts[k], counts[k])
            return counts[k], self.take(np.repeat(starts[k], counts[k]) + within * self.size(kind), kind)

        columns = {n: partial(self.take, starts[k], kind) for k, (n, kind, c) in enumerate(properties) if c is None}
        lists = {n: partial(listed, k) for k, (n, _, c) in enumerate(properties) if c}
        return PlyTable(count, columns, lists, kinds), at


class _BinaryRows(_RowSource):
    def __init__(self, raw: np.ndarray, order: str):
        self._raw, self._order, self.length = raw, order, len(raw)

    def size(self, kind: str) -> int:
        return np.dtype(kind).itemsize

    def take(self, positions: np.ndarray, kind: str) -> np.ndarray:
        dtype = np.dtype(self._order + kind)
        data = self._raw[positions[:, None] + np.arange(dtype.itemsize)]
        return np.ascontiguousarray(data).view(dtype).reshape(-1).astype(kind)

    def number(self, position: int, kind: str) -> int:
        dtype = np.dtype(self._order + kind)
        if position + dtype.itemsize > self.length or dtype.kind == "f":
            return -1
        return int.from_bytes(
            self._raw[position : position + dtype.itemsize].tobytes(),
            "little" if self._order == "<" else "big",
            signed=dtype.kind == "i",
        )

    def read_fixed_rows(self, at: int, count: int, widths: list[tuple[str, int]]) -> Callable[[int], np.ndarray]:
        dtype = np.dtype([(f"{k}", self._order + kind, (n,)) for k, (kind, n) in enumerate(widths)])
        rows = np.ndarray((count,), dtype, self._raw, at)
        return lambda k: rows[f"{k}"].reshape(count, -1).squeeze(1 if widths[k][1] == 1 else ()).astype(widths[k][0])


class _TextRows(_RowSource):
    def __init__(self, raw: np.ndarray, first_line: int):
        if len(raw) > MAX_TEXT_BYTES:
            raise ValueError(f"it is a text file of more than {MAX_TEXT_BYTES:,} bytes, the limit; save it as binary")
        text = raw.tobytes()
        try:
            self._words = parse_numbers(text)
        except ValueError as error:
            lines_before = re.findall(rb"\r\n|\r|\n", text[: max(find_cell(text), 0)])
            raise ValueError(f"line {first_line + len(lines_before):,}: {error}") from error
        self.length = len(self._words)

    def size(self, kind: str) -> int:
        return 1

    def take(self, positions: np.ndarray, kind: str) -> np.ndarray:
        return self._words[positions]

    def number(self, position: int, kind: str) -> int:
        value = self._words[position]
        return int(value) if np.isfinite(value) and value == np.floor(value) else -1

    def read_fixed_rows(self, at: int, count: int, widths: list[tuple[str, int]]) -> Callable[[int], np.ndarray]:
        ends = np.cumsum([0, *(n for _, n in widths)])
        rows = self._words[at : at + count * ends[-1]].reshape(count, ends[-1])
        return lambda k: rows[:, ends[k]] if widths[k][1] == 1 else rows[:, ends[k] : ends[k + 1]]


def write_columns(
    path: str | os.PathLike,
    vertices: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    face_columns: Mapping[str, np.ndarray] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary file of vertices and, optionally, triangles.

    Parameters
    ----------
    path
        The file.
    vertices
        Vertex columns (V,) by property name; float32 or uint8. Mitsuba combines properties ``NAME_0``, ``NAME_1``, ...
        into an attribute ``NAME``.
    faces
        Vertex indices (F, 3).
    face_columns
        Face columns (F,) by property name.
    comments
        Comment lines of the header.
    """
    table, head = _make_table(vertices), ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {line}" for line in comments]
    head += [f"element vertex {len(table)}", *_format_properties(table)]
    data = table.tobytes()
    if faces is not None:
        face_table = _make_table(face_columns or {}, len(faces))
        rows = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3), *face_table.dtype.descr])
        rows["n"], rows["v"] = 3, faces
        for name in face_table.dtype.names or ():
            rows[name] = face_table[name]
        head += [f"element face {len(rows)}", "property list uchar int vertex_indices", *_format_properties(face_table)]
        data += rows.tobytes()
    write_bytes(path, "\n".join([*head, "end_header", ""]).encode(), data)


def _make_table(columns: Mapping[str, np.ndarray], rows: int | None = None) -> np.ndarray:
    types = [(name, "u1" if np.asarray(c).dtype == np.uint8 else "<f4") for name, c in columns.items()]
    out = np.zeros(len(next(iter(columns.values()))) if rows is None else rows, types)
    for name, column in columns.items():
        out[name] = column
    return out


def _format_properties(table: np.ndarray) -> list[str]:
    return [f"property {_PLY_TYPES[table.dtype[name].str]} {name}" for name in table.dtype.names or ()]
