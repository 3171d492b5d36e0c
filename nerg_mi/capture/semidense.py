"""Semi-dense points of Project Aria: what the glasses saw of a place, in the world of the recording's trajectory."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.files.line_blocks import line_blocks

INV_DIST_STD, DIST_STD = 0.005, 0.01
"""Points whose inverse distance (1/m) and distance (m) are known less well are left out, as in Aria's own tools."""

_NUMBERS = ("px_world", "py_world", "pz_world", "inv_dist_std", "dist_std")
_WORLD = "graph_uid"
_BLOCK = 1 << 16  # lines converted at a time
_WORLDS = 1000  # a file of more is none of points


def read_semidense(
    path: str | os.PathLike, world: str | None = None, *, inv_dist_std: float = INV_DIST_STD, dist_std: float = DIST_STD
) -> np.ndarray:
    """The points (N, 3) float32, metres, of ``semidense_points.csv.gz`` (older name ``global_points.csv.gz``) that are
    known to ``inv_dist_std`` (1/m) and ``dist_std`` (m).

    ``world``: the graph_uid whose points are taken; by default that of the most. The axes are those of the trajectory
    of that world, in MPS right-handed with z up: the frame of rays. Raises `NergError` for a file that is damaged, has
    other columns, or no point that is known so well.
    """
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    with closing(line_blocks(path, "file of semi-dense points", _BLOCK)) as blocks:
        columns, count = None, 0
        for lines in blocks:
            if columns is None:
                columns, lines, count = _columns(path, lines[0]), lines[1:], 1
            kept = [(k, line) for k, line in enumerate(lines, count + 1) if not line.isspace()]
            count += len(lines)
            if not kept:
                continue
            values = _convert(path, kept, columns)
            well = np.flatnonzero((values[:, 3] <= inv_dist_std) & (values[:, 4] <= dist_std))
            well = well[np.isfinite(values[well, :3]).all(axis=1)]
            names = np.array([kept[i][1].split(",")[columns[1]].strip() for i in well.tolist()], dtype=object)
            for name in set(names.tolist()):
                found[name].append(values[well[names == name], :3].astype(np.float32))
            if len(found) > _WORLDS:
                raise NergError(f'"{path}" has more than {_WORLDS:,} worlds (graph_uid); have it made again by MPS')
    if not found:
        raise NergError(
            f'"{path}" holds no point that is known to {inv_dist_std:g} 1/m and {dist_std:g} m; allow larger deviations'
        )
    if world is None:
        world = max(found, key=lambda name: (sum(map(len, found[name])), name))
    if world not in found:
        named = ", ".join(plain(name, 40) for name in sorted(found)[:4])
        raise NergError(f'"{path}" has no point of the world "{plain(world, 40)}"; there are {named}')
    return np.concatenate(found[world])


def _columns(path: str | os.PathLike, header: str) -> tuple[int, ...]:
    """How many cells a line has, and where in it the world stands, and the numbers."""
    names = [name.strip() for name in header.lstrip("\ufeff").split(",")]
    missing = [name for name in (_WORLD, *_NUMBERS) if name not in names]
    if missing:
        there = ", ".join(plain(name, 40) for name in names[:8])
        raise NergError(
            f'"{path}" has no column {", ".join(missing)}; its columns are {there}; give semidense_points.csv.gz of an '
            "Aria recording"
        )
    return len(names), *(names.index(name) for name in (_WORLD, *_NUMBERS))


def _convert(path: str | os.PathLike, lines: Sequence[tuple[int, str]], columns: tuple[int, ...]) -> np.ndarray:
    """The numbers (n, 5) of numbered lines. Raises `NergError` naming the first line in which one is missing."""
    rows = []
    for number, line in lines:
        cells = line.split(",")
        if len(cells) != columns[0]:
            raise NergError(
                f'"{path}", line {number}: {len(cells)} cells, the header has {columns[0]}; copy the file again'
            )
        try:
            rows.append([float(cells[i]) for i in columns[2:]])
        except ValueError:
            raise NergError(f'"{path}", line {number}: {plain(line, 60)!r} is no point; copy the file again') from None
    return np.array(rows)
