"""Vectors of tracking: heads' rotations, tracks of poses that are interpolated, and fill values in their place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import MAX_COORDINATE, TIMES

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
        within = lambda v: (np.abs(v) <= MAX_COORDINATE).all(axis=1)
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


# ---- Heads' poses: from quaternions, angles and matrices to rotations, and on to rays ----
#
# A rotation takes the head's frame to the table's. ``forward`` names the axis of the head's frame along which it looks:
# ``z`` in Unity, ``-z`` of an OpenGL camera and in OpenXR, ``x`` in ROS and Unreal.

AXES = {f"{sign}{axis}": s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("", 1.0), ("-", -1.0))}
"""Unit vectors by name: x, -x, y, -y, z, -z."""

MIRRORED = "the head's matrix is mirrored (its determinant is negative)"  # Why a row is dropped


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


# ---- Fill values ----
#
# Vectors whose components are all one fill value, as 0, 0, 0 or -1, -1, -1 where a program had nothing to write.

_FILLS = np.array(
    [
        *(0.0, -1.0, *(sign * 10.0**k - sign for k in range(2, 7) for sign in (1, -1))),
        *(limit for bits in (16, 32) for limit in (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1, 2.0**bits - 1)),
    ]
)
_LIMIT = 1e30  # of floats that are lengths or directions; a fill beyond is the largest of its type, however rounded
_APART = 0.1  # metres between a fill value and the nearest place of a person who was never there
_AIMED = np.cos(np.radians(2.0))  # of a ray that points at its hit point


def fill_values(v: np.ndarray) -> np.ndarray:
    """The fill value of vectors (..., C), (...); NaN of those that are none."""
    first = v[..., 0]
    is_fill = np.isin(first, _FILLS) | (np.isfinite(first) & (np.abs(first) > _LIMIT))
    return np.where((v == v[..., :1]).all(axis=-1) & is_fill, first, np.nan)


def is_filled_angles(angles: np.ndarray) -> np.ndarray:
    """Whether angles (n, C) of a head or of gaze, in degrees or radians, are one fill value, (n,) bool; 0 and -1 may be
    true."""
    return np.abs(fill_values(angles)) > 90


def is_aimed(origin: np.ndarray, direction: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) point at their hit points, to 2 degrees, (n,) bool."""
    way = hit - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", way, direction) / np.linalg.norm(way, axis=1) / np.linalg.norm(direction, axis=1)
    return cosine > _AIMED


class FilledOrigins:
    """Finds origins of one source that are fill values, block by block.

    A place at exactly 0, 0, 0 may be true: somebody sits there, or a track begins there. It is a fill value where it is
    repeated and the same person is otherwise never within 0.1 m of it. ``metre``: of a unit of length.
    """

    def __init__(self, metre: float) -> None:
        self._apart = _APART / metre
        self._last: dict[int, np.ndarray] = {}  # the last place of each person that is none
        self._count: dict[tuple[int, float], int] = {}
        self.undecided: dict[int, int] = {}
        """Rows of a person that were let through since no other place was known yet, and turned out to be filled."""

    def find(self, origin: np.ndarray, person: np.ndarray) -> np.ndarray:
        """Which rows (n,) bool are filled, of origins (n, 3) and numbers of persons (n,)."""
        fill = fill_values(origin)
        filled, out = np.isfinite(fill), np.zeros(len(fill), bool)
        good = np.flatnonzero(np.isfinite(origin).all(axis=1) & ~filled)
        if filled.any():
            order = np.argsort(person, kind="stable")
            codes, starts = np.unique(person[order], return_index=True)
            for code, rows in zip(codes.tolist(), np.split(order, starts[1:])):
                if filled[rows].any():
                    out[rows] = self._find_of(code, origin[rows], fill[rows])
        if len(good):
            codes, at = np.unique(person[good][::-1], return_index=True)
            self._last.update(zip(codes.tolist(), origin[good[::-1][at]]))
        return out

    def _find_of(self, code: int, origin: np.ndarray, fill: np.ndarray) -> np.ndarray:
        others = origin[np.isnan(fill) & np.isfinite(origin).all(axis=1)]
        if code in self._last:
            others = np.vstack([others, self._last[code]])
        out = np.zeros(len(fill), bool)
        for value in np.unique(fill[np.isfinite(fill)]).tolist():
            before = self._count.get((code, value), 0)
            count = self._count[code, value] = before + int(np.count_nonzero(fill == value))
            if len(others) and count > 1 and np.linalg.norm(others - value, axis=1).min() > self._apart:
                out |= fill == value
                if before and code not in self._last:
                    self.undecided[code] = before
        return out
