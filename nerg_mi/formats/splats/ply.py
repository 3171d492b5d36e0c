"""Gaussian splats as PLY, as 3DGS trainings write them (Kerbl et al. 2023): logarithms of scales, logits of opacities.

Columns are found by name, in any order; normals are left out, other columns kept. Files of 2DGS lack ``scale_2``: their
Gaussians become a thousandth as thick as they are wide.
"""

from __future__ import annotations

import os
import re

import numpy as np

from nerg_mi.field.splats import Splats, from_trained, logits_of
from nerg_mi.files.bounded import read_bytes, reading
from nerg_mi.formats.ply import write_columns
from nerg_mi.maths.harmonics import DEGREES

BYTES = 8 << 30
"""A file may have so many bytes."""

TEXT_BYTES = 256 << 20
"""And so many where its numbers are text."""

HEADER_BYTES = 64 << 10
"""So many of them may be the header."""

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_CENTER, _SCALE, _ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), tuple(f"rot_{i}" for i in range(4))
_BASE, _NORMAL = tuple(f"f_dc_{i}" for i in range(3)), ("nx", "ny", "nz")
_THIN = np.log(1e-3)


def has_splats(path: str | os.PathLike) -> bool:
    """Whether the header of the PLY file ``path`` names what Gaussian splats have."""
    with reading(path, "PLY file"), open(path, "rb") as file:
        return re.search(rb"^property [a-z0-9]+ f_dc_0\s*$", file.read(HEADER_BYTES), re.MULTILINE) is not None


def read_ply_splats(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in the PLY file ``path``; `NergError` for another kind of file, and for a damaged one."""
    raw = read_bytes(path, "splat file", BYTES)
    with reading(path, "splat file", "export it again as a 3DGS .ply"):
        columns = _columns(raw)
        missing = [name for name in (*_CENTER, "opacity", *_SCALE[:2], *_ROTATION, *_BASE) if name not in columns]
        if "packed_position" in columns:
            raise ValueError("it is a compressed .ply; convert it by: npx @playcanvas/splat-transform in.ply out.ply")
        if missing:
            raise ValueError(f'it lacks the column "{missing[0]}", which Gaussian splats have')
        if _SCALE[2] not in columns:
            columns[_SCALE[2]] = np.minimum(columns[_SCALE[0]], columns[_SCALE[1]]) + _THIN
        rest = sorted((int(m[1]), name) for name in columns if (m := re.fullmatch(r"f_rest_(\d{1,3})", name)))
        count = 1 + len(rest) // 3
        if len(rest) % 3 or count not in DEGREES or [i for i, _ in rest] != list(range(len(rest))):
            raise ValueError(f"its {len(rest)} columns f_rest_* are those of no degree from 0 to 3")
        take = lambda names: np.stack([columns.pop(name) for name in names], axis=-1)
        base = take(_BASE)[:, None]
        # Stored channel by channel.
        more = take([n for _, n in rest]).reshape(len(base), 3, count - 1).swapaxes(1, 2) if rest else base[:, :0]
        parts = take(_CENTER), take(_SCALE), take(_ROTATION), columns.pop("opacity")
        extra = {name: column for name, column in columns.items() if name not in _NORMAL}
        return from_trained(*parts, np.concatenate([base, more], axis=1), extra)


def write_ply_splats(path: str | os.PathLike, splats: Splats, comments: tuple[str, ...] = ()) -> None:
    """Write ``splats`` as viewers and Mitsuba read them: float32, normals of 0, further columns at the end (Mitsuba
    reads no file with such)."""
    columns = {name: splats.centers[:, i] for i, name in enumerate(_CENTER)}
    columns |= {name: np.zeros(len(splats), np.float32) for name in _NORMAL}
    columns |= {name: splats.harmonics[:, 0, i] for i, name in enumerate(_BASE)}
    rest = splats.harmonics[:, 1:].swapaxes(1, 2).reshape(len(splats), -1)
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns["opacity"] = logits_of(splats.opacities)
    logs = np.log(splats.scales.astype(np.float64))
    columns |= {name: logs[:, i] for i, name in enumerate(_SCALE)}
    columns |= {name: splats.rotations[:, i] for i, name in enumerate(_ROTATION)}
    write_columns(path, columns | dict(splats.extra), comments=comments)


def _columns(raw: bytes) -> dict[str, np.ndarray]:
    """The vertices' columns by name."""
    end = re.search(rb"^end_header[ \t]*\r?\n", raw[:HEADER_BYTES], re.MULTILINE)
    if not raw.startswith(b"ply") or end is None:
        raise ValueError("it is no PLY file, or its header has no end")
    lines = [line.split() for line in raw[: end.start()].decode("ascii").splitlines()]
    style, element, count, types = "", "", -1, []
    for words in lines:
        if words[:1] == ["format"] and len(words) == 3:
            style = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if element == "vertex":
                count = int(words[2])
            elif count < 0:
                raise ValueError(f'other things ("{element}") stand before its vertices')
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError("its vertices have properties that are no numbers")
            types.append((words[2], _TYPES[words[1]]))
    if count < 0 or not types or len({name for name, _ in types}) < len(types):
        raise ValueError("it has no vertices, or two columns of one name")
    data = memoryview(raw)[end.end() :]
    if style == "ascii":
        table = _text(bytes(data), count, len(types))
        return {name: table[:, i] for i, (name, _) in enumerate(types)}
    if style != "binary_little_endian":
        raise ValueError(f'its format is "{style}", and "binary_little_endian" or "ascii" is read')
    rows = np.dtype(types)
    if count * rows.itemsize > len(data):
        raise ValueError(f"its header announces {count:,} vertices, and {len(data) // rows.itemsize:,} are there")
    table = np.frombuffer(data, rows, count)
    return {name: np.ascontiguousarray(table[name]) for name, _ in types}


def _text(data: bytes, count: int, width: int) -> np.ndarray:
    if len(data) > TEXT_BYTES:
        raise ValueError(f"it is text of more than {TEXT_BYTES:,} bytes")
    words = data.split(None, count * width)[: count * width]
    if len(words) < count * width:
        raise ValueError(f"its header announces {count:,} vertices, and {len(words) // width:,} are there")
    return np.array(words, np.float64).reshape(count, width)
