"""Poses along time: rotations, gaze vectors in them, and tracks that are interpolated."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.safe_read import OnBadLine, line_blocks
from nerg_mi.ranges import FARTHEST, TIMES

from .values import fill_values, is_filled_angles

# ---- Gaze vectors ----
#
# Gaze vectors as Qualisys Track Manager exports them: a header of words and values, then numbers between tabs.
#
# After QTM's manual ("Gaze vector data (_g.tsv)"). The header, the names of the columns and the time are options of the
# export, so that each may be missing.


_COLUMNS = ("x pos", "y pos", "z pos", "x vec", "y vec", "z vec")
_BLOCK = 1 << 16  # lines converted at a time
_HEADER_LINES = 200
_MISSING = {"", "nan", "null", "-"}
_WHAT = "file of gaze vectors"


class GazeVectors(NamedTuple):
    """A run of n samples."""

    times: np.ndarray  # (n,) seconds
    vectors: np.ndarray  # (n, 6) position in mm and direction, NaN where a cell is empty
    samples: np.ndarray  # (n,) which of the file they are, from 0
    lines: np.ndarray  # (n,) of the file, from 1


@dataclass(frozen=True)
class _Layout:
    """Where samples begin, and what stands in their cells."""

    first: int  # line of the first sample
    cells: tuple[int, ...]  # of `_COLUMNS`
    time: int | None  # cell of the seconds
    step: float  # seconds from sample to sample, where no cell tells
    start: float  # seconds of the first
    width: int  # cells of a line


def iterate_gaze_vectors(path: Path, on_bad: OnBadLine | None = None) -> Iterator[GazeVectors]:
    """The samples of ``path`` in blocks.

    Raises `NergError` for what is no such file, for times that nothing tells, and, unless ``on_bad`` is given, for a
    line that cannot be read; ``on_bad`` is told of such lines, which are left out.
    """
    layout, count, sample = _read_layout(path), 0, 0
    with closing(line_blocks(path, _WHAT, _BLOCK)) as blocks:
        for lines in blocks:
            found: list[tuple[float, list[float], int, int]] = []
            for number, line in enumerate(lines, count + 1):
                if number < layout.first or not line.strip("\r\n "):
                    continue
                try:
                    cells = _cells(line)
                    if not layout.width <= len(cells) <= layout.width + (not cells[-1]):
                        raise ValueError(f"{len(cells)} cells, not {layout.width}")
                    time = layout.start + sample * layout.step if layout.time is None else _number(cells[layout.time])
                    found.append((time, [_number(cells[i]) for i in layout.cells], sample, number))
                except ValueError as error:
                    why = f": {plain(line, 60)!r} is no sample ({plain(error)}); correct or remove the line"
                    if on_bad is None:
                        raise NergError(
                            f"{path}, line {number}{why}, or leave such lines out with --skip-bad-lines"
                        ) from None
                    on_bad(number, why)
                sample += 1
            count += len(lines)
            if found:
                times, vectors, samples, numbers = zip(*found)
                yield GazeVectors(np.array(times), np.array(vectors), np.array(samples), np.array(numbers))


def _read_layout(path: Path) -> _Layout:
    """What the head of the file, or its first sample, tells."""
    with closing(line_blocks(path, _WHAT, _HEADER_LINES)) as blocks:
        head = next(blocks, [])
    about: dict[str, str] = {}
    for number, line in enumerate(head, 1):
        cells = _cells(line)
        names = [re.sub(r"\s+", " ", cell).lower() for cell in cells]
        where = [next((i for i, name in enumerate(names) if name.endswith(wanted)), None) for wanted in _COLUMNS]
        if all(i is not None for i in where):
            time = names.index("time") if "time" in names else None
            return _layout(
                path, number + 1, tuple(i for i in where if i is not None), time, about, len(cells) - (not cells[-1])
            )
        if re.match(r"[A-Za-z_]", cells[0]) and cells[0].lower() not in _MISSING:
            about[cells[0].upper()] = cells[1] if len(cells) > 1 else ""
        elif len(cells) in (6, 8):
            # Without names: six numbers, or a sample's number and its time before them.
            time = 1 if len(cells) == 8 else None
            return _layout(path, number, tuple(range(len(cells) - 6, len(cells))), time, about, len(cells))
        elif line.strip():
            break
    raise NergError(
        f"{path} has no gaze vectors (X Pos, Y Pos, Z Pos, X Vec, Y Vec, Z Vec between tabs); export them from QTM "
        "(TSV, eye tracker), with column headers"
    )


def _layout(
    path: Path, first: int, cells: tuple[int, ...], time: int | None, about: dict[str, str], width: int
) -> _Layout:
    if time is not None:
        return _Layout(first, cells, time, 0.0, 0.0, width)
    try:
        rate, offset = float(about.get("FREQUENCY", "")), float(about.get("START_OFFSET", "") or 0)
    except ValueError:
        rate, offset = 0.0, 0.0
    if not (0 < rate < 1e6 and abs(offset) < 1e9):
        raise NergError(
            f"{path} tells no time: neither a column Time nor a FREQUENCY in its header; export it from QTM with "
            "its header"
        )
    return _Layout(first, cells, None, 1 / rate, -offset, width)


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.lstrip("\ufeff").rstrip("\r\n").split("\t")]


def _number(cell: str) -> float:
    return np.nan if cell.lower() in _MISSING else float(cell)


# ---- Where something was and how it was turned, sample by sample, and in between ----


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of a head or a camera in N >= 2 samples, to be interpolated."""

    times: np.ndarray  # (N,) seconds, strictly rising
    vectors: np.ndarray  # (N, 3) rotations to the world as Rodrigues vectors, radians
    places: np.ndarray  # (N, 3) origins in the world, in its unit of length

    @classmethod
    def of_samples(cls, times: np.ndarray, vectors: np.ndarray, places: np.ndarray) -> PoseTrack | None:
        """A track of samples in any order; those with something missing, or beyond `FARTHEST`, are left out, and of
        those at one time all but the first. None where fewer than two are left."""
        within = lambda v: (np.abs(v) <= FARTHEST).all(axis=1)
        good = (np.abs(times) <= TIMES.high) & within(vectors) & within(places)
        kept = np.flatnonzero(good)
        kept = kept[np.unique(times[kept], return_index=True)[1]]
        return cls(times[kept], vectors[kept], places[kept]) if len(kept) >= 2 else None

    def at(self, t: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations (n, 3, 3) and places (n, 3) at the times ``t`` (n,), seconds, turned along the shortest way and
        moved along a straight line between the samples around them; and where nothing is known, (n,) bool: before the
        first sample, after the last, or farther than ``gap`` seconds from the nearest."""
        from scipy.spatial.transform import Rotation, Slerp

        times = self.times
        inside = np.clip(np.nan_to_num(t), times[0], times[-1])
        after = np.clip(np.searchsorted(times, inside), 1, len(times) - 1)
        apart = np.abs(t[:, None] - times[np.stack([after - 1, after], axis=1)])
        lost = (apart.min(axis=1) > gap) | (inside != t)
        turn = Slerp(times, Rotation.from_rotvec(self.vectors))(inside).as_matrix()
        place = np.stack([np.interp(inside, times, self.places[:, i]) for i in range(3)], axis=1)
        return turn, place, lost


# ---- Poses ----
#
# Heads' poses: from quaternions, angles and matrices to rotations, and on to rays.
#
# A rotation takes the head's frame to the table's. ``forward`` names the axis of the head's frame along which it looks:
# ``z`` in Unity, ``-z`` of an OpenGL camera and in OpenXR, ``x`` in ROS and Unreal.


AXES = {f"{sign}{axis}": s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("", 1.0), ("-", -1.0))}
"""Unit vectors by name: x, -x, y, -y, z, -z."""

MIRRORED = "the head's matrix is mirrored (its determinant is negative)"
"""Why a row is dropped."""


def axis(name: str, what: str) -> np.ndarray:
    """The unit vector of a name such as ``-z``. Raises `NergError` naming ``what`` for another word."""
    if name not in AXES:
        raise NergError(f'{what} is "{name}"; it is one of {", ".join(AXES)}')
    return AXES[name]


def default_forward(up: str, handedness: str) -> str:
    """Where heads look in the usual frame of this kind: Unity's z, OpenGL's -z, the x of ROS and Unreal."""
    if up.endswith("y"):
        return "z" if handedness == "left" else "-z"
    return "x"


def rotations_from_quaternions(q: np.ndarray, order: str = "xyzw") -> np.ndarray:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in ``order`` xyzw or wxyz; they need not be unit. NaN where one
    is not finite, zero or a fill value."""
    q = np.asarray(q, dtype=np.float64)
    if order not in ("xyzw", "wxyz") or q.ndim != 2 or q.shape[1] != 4:
        raise ValueError(f'quaternions {q.shape} in order "{order}": expected (N, 4), xyzw or wxyz')
    with np.errstate(over="ignore"):
        length = np.linalg.norm(q, axis=1)
    good = np.isfinite(length) & (length > 1e-12) & np.isnan(fill_values(q))
    if order == "wxyz":
        q = np.roll(q, -1, axis=1)
    return _where(good, q, lambda rotation, q: rotation.from_quat(q))


def rotations_from_angles(angles: np.ndarray, up: str, forward: str, degrees: bool = True) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of yaw, pitch and, where there is a third column, roll (N, 2 or 3).

    First the head turns about the up axis (yaw), then about its own sideways axis (pitch), then about its forward axis
    (roll), each by the usual rotation matrix about the coordinate axis of that name. So in Unity (y up, z forward)
    positive angles turn right and look down, in ROS (z up, x forward) they turn left and look down, and in OpenXR (y
    up, -z forward) they turn left and look up. Raises `NergError` where ``up`` and ``forward`` are the same axis.
    """
    angles = np.asarray(angles, dtype=np.float64)
    up, forward = up[-1], forward[-1]
    if up == forward:
        raise NergError(f"the up axis and the forward axis are both {up}; say where heads look with forward")
    (side,) = set("xyz") - {up, forward}
    sequence = (up + side + forward).upper()[: angles.shape[1]]
    good = np.isfinite(angles).all(axis=1) & ~is_filled_angles(angles)
    return _where(good, angles, lambda rotation, a: rotation.from_euler(sequence, a, degrees=degrees))


def directions_from_azimuths(
    angles: np.ndarray, up: str, forward: str, handedness: str, degrees: bool = True
) -> np.ndarray:
    """Unit directions (N, 3) of azimuths, which turn from ``forward`` to the right, and elevations, which turn up from
    there to the axis ``up``, (N, 2).

    With a = azimuth and e = elevation: cos e cos a forward + cos e sin a right + sin e up. Right is forward x up in a
    right-handed frame, and up x forward, by coordinates, in a left-handed one. Raises `NergError` where ``up`` and
    ``forward`` are the same axis.
    """
    if up[-1] == forward[-1]:
        raise NergError(f"the up axis and the forward axis are both {up[-1]}; say where heads look with forward")
    ahead, top = axis(forward, "forward"), axis(up, "up")
    right = np.cross(ahead, top) if handedness == "right" else np.cross(top, ahead)
    angles = np.where(is_filled_angles(angles)[:, None], np.nan, angles)
    a, e = (np.radians(angles) if degrees else angles).T
    part = lambda weight, vector: weight[:, None] * vector
    return part(np.cos(e) * np.cos(a), ahead) + part(np.cos(e) * np.sin(a), right) + part(np.sin(e), top)


def rotations_from_matrices(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrices (N, 3, 3) and origins (N, 3) of head-to-world matrices, given row by row as (N, 12) or (N, 16).

    A uniform scale is taken out. NaN where the upper left part is no rotation times a scale, to 1 %, or is mirrored.
    """
    values = np.asarray(values, dtype=np.float64)
    m = values[:, :12].reshape(-1, 3, 4)
    R, origin = m[:, :, :3].copy(), m[:, :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        # The cube root keeps the sign: a mirrored matrix becomes the rotation that it is times -1, and is left out.
        R /= np.cbrt(_determinants(values))[:, None, None]
        off = np.abs(np.einsum("nij,nik->njk", R, R) - np.eye(3)).max(axis=(1, 2))
    R[~(off < 0.01) | is_mirrored(values)] = np.nan
    return R, origin


def is_mirrored(values: np.ndarray) -> np.ndarray:
    """Whether head-to-world matrices (N, 12) or (N, 16) have a negative determinant, (N,) bool."""
    return _determinants(values) < 0


def _determinants(values: np.ndarray) -> np.ndarray:
    R = np.asarray(values, dtype=np.float64)[:, :12].reshape(-1, 3, 4)[:, :, :3]
    return np.linalg.det(np.where(np.isfinite(R), R, 0.0))


def rotate(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (N, 3), each turned by its own of the ``rotations`` (N, 3, 3)."""
    return np.einsum("nij,nj->ni", rotations, vectors)


def mean_of_two(v: np.ndarray) -> np.ndarray:
    """Mean over the eyes of (n, 2, 3), of those that are there; NaN where neither is."""
    there = np.isfinite(v).all(axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(there, v, 0.0).sum(axis=1) / there.sum(axis=1)


def _where(good: np.ndarray | np.bool_, values: np.ndarray, make) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.full((len(values), 3, 3), np.nan)
    if good.any():
        out[good] = make(Rotation, values[good]).as_matrix()
    return out
