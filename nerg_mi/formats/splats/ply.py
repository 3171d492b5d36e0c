"""Gaussian splats as PLY, as 3DGS trainings write them (Kerbl et al. 2023): logarithms of scales, logits of opacities.

Columns are found by name, in any order; normals are left out, other columns kept. Files of 2DGS lack ``scale_2``: their
Gaussians become a thousandth as thick as they are wide. Of Mip-Splatting (Yu et al. 2024) the 3D filter is applied.
Opacities and lengths where logits and logarithms belong are recognised by values that these cannot have.
"""

from __future__ import annotations

import os
import re

import numpy as np

from nerg_mi.errors import plain
from nerg_mi.fields.splats import Splats, logits_of, opacities_of, scales_of
from nerg_mi.files.safe_read import map_bytes, open_file, reading
from nerg_mi.formats.ply import PLY_MAGIC, parse_ply, write_columns
from nerg_mi.maths.sphere import DEGREES

PLY_BYTES = 8 << 30
"""A file may have so many bytes."""

HEADER_BYTES = 64 << 10
"""So many of them tell splats from meshes."""

_CENTER, _SCALE, _ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), tuple(f"rot_{i}" for i in range(4))
_BASE, _NORMAL = tuple(f"f_dc_{i}" for i in range(3)), ("nx", "ny", "nz")
_FILTER = "filter_3D"
_THIN = 1e-3

# From so many Gaussians on the range of a column is evidence.
_SOME = 64
_NEIGHBOR, _SAMPLE = 4, 2000
# No training has such a logit: at half of it float32 is 1.
_OPAQUE = 32


def has_splats(path: str | os.PathLike) -> bool:
    """Whether the header of the PLY file ``path`` names what Gaussian splats have: their colours, or their shape."""
    with open_file(path, "PLY file") as file:
        names = re.findall(rb"^property [a-z0-9]+ (\w+)\s*$", file.read(HEADER_BYTES), re.MULTILINE)
        return b"f_dc_0" in names or {b"opacity", b"scale_0", b"rot_0"} <= set(names)


def read_ply_splats(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in the PLY file ``path``; `NergError` for another kind of file, and for a damaged one."""
    remedy = "export it again as a 3DGS .ply"
    raw = map_bytes(path, "splat file", PLY_BYTES, PLY_MAGIC, remedy)
    with reading(path, "splat file", remedy):
        tables = parse_ply(np.frombuffer(raw, np.uint8)).tables
        first = next(iter(tables), "")
        if first != "vertex":
            raise ValueError(f'other things ("{first[:40]}") stand before its vertices')
        if tables["vertex"].lists:
            raise ValueError("its vertices have properties that are no numbers")
        columns = {name: values() for name, values in tables["vertex"].columns.items()}
        missing = [name for name in (*_CENTER, "opacity", *_SCALE[:2], *_ROTATION, *_BASE) if name not in columns]
        if "packed_position" in columns:
            raise ValueError("it is a compressed .ply; convert it by: npx @playcanvas/splat-transform in.ply out.ply")
        if missing:
            raise ValueError(f'it lacks the column "{missing[0]}", which Gaussian splats have')
        rest = sorted((int(m[1]), name) for name in columns if (m := re.fullmatch(r"f_rest_(\d{1,3})", name)))
        count = 1 + len(rest) // 3
        if len(rest) % 3 or count not in DEGREES or [i for i, _ in rest] != list(range(len(rest))):
            raise ValueError(f"its {len(rest)} columns f_rest_* are those of no degree from 0 to 3")
        take = lambda names: np.stack([columns.pop(name) for name in names if name in columns], axis=-1)
        base = take(_BASE)[:, None]
        # Stored channel by channel.
        more = take([n for _, n in rest]).reshape(len(base), 3, count - 1).swapaxes(1, 2) if rest else base[:, :0]
        centers, rotations = take(_CENTER), take(_ROTATION)
        scales, opacities, guesses = _activated(centers, take(_SCALE), columns.pop("opacity"))
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _THIN * scales.min(axis=1)])
        if _FILTER in columns:
            scales, opacities = _filtered(scales, opacities, columns.pop(_FILTER))
        extra = {name: column for name, column in columns.items() if name not in _NORMAL}
        unused = [*extra, *(f"those of {name}" for name in list(tables)[1:])]
        notes = (f"columns that are not used: {plain(', '.join(unused))}",) if unused else ()
        harmonics = np.concatenate([base, more], axis=1)
        return Splats(centers, scales, rotations, opacities, harmonics, extra, guesses=guesses, notes=notes)


def _activated(
    centers: np.ndarray, scales: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Scales and opacities of what the columns hold, and sentences where that is not what trainings write."""
    guesses = []
    if _are_lengths(centers, scales):
        guesses.append("its scales are taken as lengths: as logarithms they would far exceed the Gaussians' distances")
    else:
        scales = scales_of(scales)
    # As logits, all opacities of a training would lie between 0.5 and 0.73.
    if len(opacities) >= _SOME and 0 <= opacities.min() < opacities.max() <= 1:
        guesses.append("its opacities are taken as they are, since all lie in 0..1: logits reach further")
    elif len(opacities) >= _SOME and opacities.min() >= 0 and _OPAQUE < opacities.max() <= 255:
        guesses.append("its opacities are taken for 255ths: as logits they would all be opaque or half so")
        opacities = opacities / np.float32(255)
    else:
        opacities = opacities_of(opacities)
    return scales, opacities, tuple(guesses)


def _are_lengths(centers: np.ndarray, scales: np.ndarray) -> bool:
    """Whether ``scales`` (N, 2 or 3) fit the distances of the ``centers`` as they are, and not at all as logarithms."""
    if len(centers) < _SOME or not np.isfinite(centers).all() or not (scales >= 0).all():
        return False
    from scipy.spatial import KDTree

    some = centers[:: max(len(centers) // _SAMPLE, 1)]
    distance = float(np.median(KDTree(centers).query(some, k=_NEIGHBOR + 1)[0][:, -1]))
    usual = np.median(scales.max(axis=1))
    # Logarithms that all lie in 0..1 are suspicious by themselves: no training leaves all sizes within a factor of 2.7.
    overlap = 2 if scales.max() <= 1 else 16
    return bool(distance > 0 and usual < 4 * distance and overlap * distance < scales_of(usual))


def _filtered(scales: np.ndarray, opacities: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians convolved with one of the standard ``deviation`` (N,), of the same mass along a ray: what a training of
    Mip-Splatting renders."""
    squares = np.asarray(scales, np.float64) ** 2
    widened = squares + np.asarray(deviation, np.float64)[:, None] ** 2
    return np.sqrt(widened), opacities * np.sqrt(np.prod(squares / widened, axis=1))


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
