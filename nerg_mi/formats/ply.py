"""Binary PLY files of triangles or points with columns of their own.

trimesh's writer adds an alpha to colours, which makes of them an attribute of four channels that no Mitsuba texture
shows, gives points an empty list of faces, and knows no attributes of faces that Mitsuba reads.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np

from nerg_mi.files.atomic import write_bytes

_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_columns(
    path: str | os.PathLike,
    vertices: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    of_faces: Mapping[str, np.ndarray] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write ``vertices``, columns (V,) by the names of their properties, and ``faces`` (F, 3), with columns (F,)
    ``of_faces``.

    Columns are float32, or uint8; ``comments``: lines of the header.
    Of properties ``NAME_0``, ``NAME_1``, ... Mitsuba makes an attribute ``NAME``.
    """
    table, head = _table(vertices), ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {line}" for line in comments]
    head += [f"element vertex {len(table)}", *_properties(table)]
    data = table.tobytes()
    if faces is not None:
        more = _table(of_faces or {}, len(faces))
        rows = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3), *more.dtype.descr])
        rows["n"], rows["v"] = 3, faces
        for name in more.dtype.names or ():
            rows[name] = more[name]
        head += [f"element face {len(rows)}", "property list uchar int vertex_indices", *_properties(more)]
        data += rows.tobytes()
    write_bytes(path, "\n".join([*head, "end_header", ""]).encode(), data)


def _table(columns: Mapping[str, np.ndarray], rows: int | None = None) -> np.ndarray:
    types = [(name, "u1" if np.asarray(c).dtype == np.uint8 else "<f4") for name, c in columns.items()]
    out = np.zeros(len(next(iter(columns.values()))) if rows is None else rows, types)
    for name, column in columns.items():
        out[name] = column
    return out


def _properties(table: np.ndarray) -> list[str]:
    return [f"property {_TYPES[table.dtype[name].str]} {name}" for name in table.dtype.names or ()]
