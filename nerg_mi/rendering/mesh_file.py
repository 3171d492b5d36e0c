"""Meshes and volumes that Mitsuba is going to read, looked at before: its readers believe the counts and indices in a
file, and fill the memory or end the process where these are wrong."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import reading

HEADER_BYTES = 1 << 20
"""The header of a PLY file may be so long."""

_KINDS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ROWS = 1 << 18


@dataclass
class _Element:
    """``fields``: of a row, name and NumPy type; a list is three values after their number, as Mitsuba takes it."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)


def check_ply(path: str | os.PathLike, faces: bool = True) -> None:
    """Raise `NergError` for a PLY file that holds less than its header says, no vertices, no faces (unless ``faces`` is
    false), faces that are no triangles, or corners that are none of its vertices."""
    path = Path(path)
    with reading(path, "mesh", "export it again, as triangles"), path.open("rb") as file:
        order, elements = _ply_header(file)
        start, length = file.tell(), path.stat().st_size
        count = {element.name: element.count for element in elements}
        if not count.get("vertex"):
            raise NergError(f'the mesh "{path}" has no vertices; export it again')
        if faces and not count.get("face"):
            raise NergError(f'the mesh "{path}" has no faces; export it with them, as triangles')
        dtypes = [np.dtype([(name, order + kind) for name, kind in e.fields]) for e in elements]
        # In text every value takes a character and a separator at least.
        needed = sum(e.count * (2 * len(e.fields) if not order else d.itemsize) for e, d in zip(elements, dtypes))
        if needed > length - start + (1 if not order else 0):
            raise NergError(
                f'the mesh "{path}" ends before the {sum(count.values()):,} rows that it announces; export it again'
            )
        tables = _text_tables(file, elements) if not order else _binary_tables(path, start, elements, dtypes)
        for element, rows in zip(elements, tables):
            if element.name == "face":
                _check_faces(path, element, rows, count["vertex"])


def _ply_header(file) -> tuple[str, list[_Element]]:
    head = file.read(HEADER_BYTES)
    end = re.search(rb"(?:^|\n)end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise ValueError("it has no header of a PLY file")
    file.seek(end.end())
    order, elements = None, []
    for line in head[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[0] == "element":
            elements.append(_Element(words[1], int(words[2])))
            if elements[-1].count < 0:
                raise ValueError(f"it has {elements[-1].count} rows of {words[1]}")
        elif words[0] == "property" and words[1] == "list":
            name = words[4]
            elements[-1].fields += [(f"{name}.count", _KINDS[words[2]])] + [
                (f"{name}.{k}", _KINDS[words[3]]) for k in range(3)
            ]
        elif words[0] == "property":
            elements[-1].fields.append((words[2], _KINDS[words[1]]))
        else:
            raise ValueError(f'its header has a line that begins with "{words[0][:40]}"')
    if order is None:
        raise ValueError("its header names no format")
    return order, elements


def _binary_tables(path: Path, start: int, elements, dtypes):
    for element, dtype in zip(elements, dtypes):
        if element.count and dtype.itemsize:
            yield np.memmap(path, dtype, mode="r", offset=start, shape=(element.count,))
        else:
            yield np.zeros(0, dtype)
        start += element.count * dtype.itemsize


def _text_tables(file, elements):
    words = iter(line for line in file)
    for element in elements:
        width, rows = len(element.fields), []
        # Rows of a face that is no triangle have another length.
        while len(rows) < element.count:
            line = next(words, None)
            if line is None:
                raise ValueError(f"it ends before row {len(rows) + 1:,} of {element.name}")
            values = line.split()
            if values and element.name == "face":
                rows.append(tuple(float(v) for v in values[:width]) + (-1.0,) * (width - len(values)))
            elif values:
                if len(values) < width:
                    raise ValueError(f"row {len(rows) + 1:,} of {element.name} has {len(values)} of {width} values")
                rows.append(())
        yield np.array(rows, [(name, "f8") for name, _ in element.fields]) if element.name == "face" else None


def _check_faces(path: Path, element: _Element, rows, vertices: int) -> None:
    lists = [name[: -len(".count")] for name, _ in element.fields if name.endswith(".count")]
    for name in lists:
        if name not in ("vertex_index", "vertex_indices"):
            continue
        for first in range(0, len(rows), _ROWS):
            part = rows[first : first + _ROWS]
            if np.any(part[f"{name}.count"] != 3):
                raise NergError(
                    f'the mesh "{path}" has faces of more or fewer than three corners; export it as triangles'
                )
            for k in range(3):
                corner = part[f"{name}.{k}"]
                if np.any(corner < 0) or np.any(corner >= vertices):
                    raise NergError(
                        f'the mesh "{path}" has a face with a corner that is none of its {vertices:,} vertices; '
                        "export it again"
                    )


def check_obj(path: str | os.PathLike) -> None:
    """Raise `NergError` for an OBJ file without a face."""
    with reading(path, "mesh"), Path(path).open("rb") as file:
        if not any(line.lstrip().startswith((b"f ", b"f\t")) for line in file):
            raise NergError(f'the mesh "{path}" has no faces; export it with them')


def check_vol(path: str | os.PathLike) -> None:
    """Raise `NergError` for a volume (Mitsuba's .vol) with counts below 1, or with fewer values than it announces."""
    path = Path(path)
    with reading(path, "volume"), path.open("rb") as file:
        head = file.read(48)
        magic, version, kind, *size = struct.unpack("<3sB5i", head[:24])
        if magic != b"VOL" or version != 3:
            raise ValueError("it is no volume of Mitsuba's version 3")
        if kind != 1:
            raise ValueError(f"its values are of kind {kind}, and only float32 (1) is read")
        if min(size) < 1:
            raise ValueError("it has {} x {} x {} voxels of {} channels".format(*size))
        # Python's integers do not overflow.
        needed = 48 + 4 * size[0] * size[1] * size[2] * size[3]
        if path.stat().st_size < needed:
            raise ValueError(f"it has {path.stat().st_size:,} bytes, and its header asks for {needed:,}")
