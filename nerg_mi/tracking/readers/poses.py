"""Poses and vectors of tracking data: rotations, interpolated tracks of poses, and fill values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.transforms import ROTATION_TOLERANCE, check_rigid_transforms, rotation_errors
from nerg_mi.ranges import MAX_COORDINATE, TIMES

# ---- Pose tracks ----


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """N >= 2 poses of a head or a camera, for interpolation."""

    times: np.ndarray  # (N,) seconds, strictly increasing
    rotation_vectors: np.ndarray  # (N, 3) rotations to the world as Rodrigues vectors, radians
    positions: np.ndarray  # (N, 3) in the world, in its unit of length

    @classmethod
    def from_samples(cls, times: np.ndarray, rotation_vectors: np.ndarray, positions: np.ndarray) -> PoseTrack | None:
        """Make a track from samples in any order. Drops samples with missing values or values beyond `MAX_COORDINATE`,
        and of samples with equal times all but the first. Returns None if fewer than two remain."""
        within = lambda v: (np.abs(v) <= MAX_COORDINATE).all(axis=1)
        is_valid = (np.abs(times) <= TIMES.high) & within(rotation_vectors) & within(positions)
        rows = np.flatnonzero(is_valid)
        rows = rows[np.unique(times[rows], return_index=True)[1]]
        return cls(times[rows], rotation_vectors[rows], positions[rows]) if len(rows) >= 2 else None

    def interpolate(self, t: np.ndarray, max_gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Interpolate rotations (n, 3, 3, spherically) and positions (n, 3, linearly) at the times ``t`` (n,) seconds.

        The third result is a mask (n,) bool of times without a pose: outside of the track, or farther than ``max_gap``
        seconds from the nearest sample.
        """
        from scipy.spatial.transform import Rotation, Slerp

        times = self.times
        inside = np.clip(np.nan_to_num(t), times[0], times[-1])
        after = np.clip(np.searchsorted(times, inside), 1, len(times) - 1)
        intervals = np.abs(t[:, None] - times[np.stack([after - 1, after], axis=1)])
        is_missing = (intervals.min(axis=1) > max_gap) | (inside != t)
        rotation = Slerp(times, Rotation.from_rotvec(self.rotation_vectors))(inside).as_matrix()
        position = np.stack([np.interp(inside, times, self.positions[:, i]) for i in range(3)], axis=1)
        return rotation, position, is_missing


# ---- Head poses from quaternions, angles and matrices ----
#
# A rotation transforms from the head's frame to that of the table. ``forward`` is the forward axis of the head's frame:
# ``z`` in Unity, ``-z`` for an OpenGL camera and in OpenXR, ``x`` in ROS and Unreal.

AXES = {f"{sign}{axis}": s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("", 1.0), ("-", -1.0))}
"""Unit vectors by name: x, -x, y, -y, z, -z."""

# Reasons for dropping a row.
MIRRORED_MATRIX = "the head's matrix is mirrored (its determinant is negative)"
_NO_ROTATION = f"the head's matrix is not a scaled rotation (R Rᵀ is not the identity within {ROTATION_TOLERANCE:g})"
_NO_UNIT_QUATERNION = f"the length of a quaternion is not 1 within {ROTATION_TOLERANCE:g} (are its columns right?)"


def parse_axis(name: str, what: str) -> np.ndarray:
    """Unit vector of an axis such as ``-z``. Raises `NergError` naming ``what`` for an invalid name."""
    if name not in AXES:
        raise NergError(f'{what} is "{name}"; it is one of {", ".join(AXES)}')
    return AXES[name]


def default_forward(up: str, handedness: str) -> str:
    """Usual forward axis of heads in a frame of this kind: z for Unity, -z for OpenGL, x for ROS and Unreal."""
    if up.endswith("y"):
        return "z" if handedness == "left" else "-z"
    return "x"


def rotations_from_quaternions(q: np.ndarray, order: str = "xyzw") -> np.ndarray:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in ``order`` xyzw or wxyz. NaN for quaternions that are not
    finite, zero or a fill value, or whose length is not 1 (`find_unusable_quaternions`)."""
    q = np.asarray(q, dtype=np.float64)
    if order not in ("xyzw", "wxyz") or q.ndim != 2 or q.shape[1] != 4:
        raise ValueError(f'quaternions {q.shape} in order "{order}": expected (N, 4), xyzw or wxyz')
    is_valid = ~_is_missing(q) & ~next(iter(find_unusable_quaternions(q).values()))
    if order == "wxyz":
        q = np.roll(q, -1, axis=1)
    return _make_rotations(is_valid, q, lambda rotation, q: rotation.from_quat(q))


def find_unusable_quaternions(q: np.ndarray) -> dict[str, np.ndarray]:
    """The reason to drop rows, with the mask (N,) bool of quaternions (N, 4) that are not missing, but whose length is
    not 1: other columns, or an average of different rotations."""
    with np.errstate(over="ignore"):
        is_unit = np.abs(np.linalg.norm(q, axis=1) - 1) <= ROTATION_TOLERANCE
    return {_NO_UNIT_QUATERNION: ~is_unit & ~_is_missing(q)}


def _is_missing(v: np.ndarray) -> np.ndarray:
    """Whether vectors (N, C) are not finite, zero or a fill value, (N,) bool."""
    return ~np.isfinite(v).all(axis=1) | np.isfinite(find_fill_values(v))


def rotations_from_angles(angles: np.ndarray, up: str, forward: str, degrees: bool = True) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of yaw, pitch and optionally roll, (N, 2 or 3).

    The head is rotated about the up axis (yaw), then about its own sideways axis (pitch), then about its forward axis
    (roll), with the usual rotation matrix about each coordinate axis. Positive angles therefore turn right and down in
    Unity (y up, z forward), left and down in ROS (z up, x forward), and left and up in OpenXR (y up, -z forward).
    Raises `NergError` if ``up`` and ``forward`` are the same axis.
    """
    angles = np.asarray(angles, dtype=np.float64)
    up, forward = up[-1], forward[-1]
    if up == forward:
        raise NergError(
            f"the up axis and the forward axis are both {up}; set the forward axis of heads ({parameter('forward')})"
        )
    (side,) = set("xyz") - {up, forward}
    sequence = (up + side + forward).upper()[: angles.shape[1]]
    is_valid = np.isfinite(angles).all(axis=1) & ~is_filled_angles(angles)
    return _make_rotations(is_valid, angles, lambda rotation, a: rotation.from_euler(sequence, a, degrees=degrees))


def directions_from_azimuths(
    angles: np.ndarray, up: str, forward: str, handedness: str, degrees: bool = True
) -> np.ndarray:
    """Unit directions (N, 3) of azimuths, from ``forward`` to the right, and elevations, towards ``up``, (N, 2).

    With azimuth a and elevation e: cos e cos a forward + cos e sin a right + sin e up. In coordinates, right is
    forward x up in a right-handed frame, and up x forward in a left-handed one. Raises `NergError` if ``up`` and
    ``forward`` are the same axis.
    """
    if up[-1] == forward[-1]:
        raise NergError(
            f"the up axis and the forward axis are both {up[-1]}; set the forward axis of heads "
            f"({parameter('forward')})"
        )
    ahead, top = parse_axis(forward, "forward"), parse_axis(up, "up")
    right = np.cross(ahead, top) if handedness == "right" else np.cross(top, ahead)
    angles = np.where(is_filled_angles(angles)[:, None], np.nan, angles)
    a, e = (np.radians(angles) if degrees else angles).T
    part = lambda weight, vector: weight[:, None] * vector
    return part(np.cos(e) * np.cos(a), ahead) + part(np.cos(e) * np.sin(a), right) + part(np.sin(e), top)


def rotations_from_matrices(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrices (N, 3, 3) and origins (N, 3) of head-to-world matrices, row by row as (N, 12) or (N, 16).

    Removes a uniform scale. NaN for rows with missing values, and for those of `find_unusable_matrices`.
    """
    m = np.asarray(values, dtype=np.float64)[:, :12].reshape(-1, 3, 4)
    R, origin = m[:, :, :3].copy(), m[:, :, 3]
    R[_is_missing(values) | np.logical_or.reduce([*find_unusable_matrices(values).values()])] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        R /= np.cbrt(np.linalg.det(R))[:, None, None]
    return R, origin


def find_unusable_matrices(values: np.ndarray) -> dict[str, np.ndarray]:
    """Reasons to drop rows, with masks (N,) bool of matrices (N, 12) or (N, 16) that are not missing, but mirrored, or
    whose upper left part is not a scaled rotation."""
    mirrored = is_mirrored(values)
    return {MIRRORED_MATRIX: mirrored, **{why: ~mirrored & mask for why, mask in find_no_rotations(values).items()}}


def find_no_rotations(values: np.ndarray) -> dict[str, np.ndarray]:
    """The reason to drop rows, with the mask (N,) bool of matrices (N, 12) or (N, 16) that are not missing, and whose
    upper left part is no rotation or reflection with a uniform scale."""
    R = values[:, :12].reshape(-1, 3, 4)[:, :, :3]
    is_rotation = rotation_errors(R, may_scale=True, may_mirror=True) <= ROTATION_TOLERANCE
    return {_NO_ROTATION: ~_is_missing(values) & ~is_rotation}


def check_last_rows(values: np.ndarray, name: str, lines: np.ndarray) -> None:
    """Raise `NergError` with ``name`` and the line for a matrix (N, 16) that is not missing, and whose last row is not
    0, 0, 0, 1; ``lines`` (N,) are line numbers."""
    rows = np.flatnonzero(~_is_missing(values))
    if values.shape[1] == 16:
        matrices = values[rows].reshape(-1, 4, 4)
        check_rigid_transforms(matrices, name, lambda row: f"line {lines[rows[row]]}", tolerance=np.inf)


def is_mirrored(values: np.ndarray) -> np.ndarray:
    """Whether head-to-world matrices (N, 12) or (N, 16) have a negative determinant, (N,) bool."""
    R = np.asarray(values, dtype=np.float64)[:, :12].reshape(-1, 3, 4)[:, :, :3]
    return np.linalg.det(np.where(np.isfinite(R), R, 0.0)) < 0


def rotate(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (N, 3), each by its own one of the ``rotations`` (N, 3, 3)."""
    return np.einsum("nij,nj->ni", rotations, vectors)


def average_eyes(v: np.ndarray) -> np.ndarray:
    """Mean of the finite values of both eyes, (n, 2, 3); NaN if neither is finite."""
    is_finite = np.isfinite(v).all(axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(is_finite, v, 0.0).sum(axis=1) / is_finite.sum(axis=1)


def _make_rotations(is_valid: np.ndarray | np.bool_, values: np.ndarray, make) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.full((len(values), 3, 3), np.nan)
    if is_valid.any():
        out[is_valid] = make(Rotation, values[is_valid]).as_matrix()
    return out


# ---- Fill values ----
#
# Vectors whose components all have one value, such as 0, 0, 0 or -1, -1, -1, written by programs for missing data.

_FILL_VALUES = np.array(
    [
        *(0.0, -1.0, *(sign * 10.0**k - sign for k in range(2, 7) for sign in (1, -1))),
        *(sign * 10.0**k for k in range(5, 13) for sign in (1, -1)),
        *(65504.0, -65504.0),  # the largest of a float of 16 bits
        *(limit for bits in (16, 32) for limit in (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1, 2.0**bits - 1)),
    ]
)
_MAX_PLAUSIBLE = 1e30  # of lengths and directions; larger equal values are the maximum of a float type
_MIN_DISTANCE = 0.1  # metres between a fill value and the nearest valid position of a participant
_MIN_AIM_COSINE = np.cos(np.radians(2.0))  # of a ray that points at its hit point


def find_fill_values(v: np.ndarray) -> np.ndarray:
    """Fill values (...) of vectors (..., C); NaN for vectors that are not fill values."""
    first = v[..., 0]
    is_fill = np.isin(first, _FILL_VALUES) | (np.isfinite(first) & (np.abs(first) > _MAX_PLAUSIBLE))
    return np.where((v == v[..., :1]).all(axis=-1) & is_fill, first, np.nan)


def is_filled_angles(angles: np.ndarray) -> np.ndarray:
    """Whether angles (n, C) of a head or of gaze, in degrees or radians, are a fill value, (n,) bool; 0 and -1 count as
    valid."""
    return np.abs(find_fill_values(angles)) > 90


def is_aimed(origin: np.ndarray, direction: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) point at their hit points within 2 degrees, (n,) bool."""
    to_hit = hit - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (
            np.einsum("ij,ij->i", to_hit, direction)
            / np.linalg.norm(to_hit, axis=1)
            / np.linalg.norm(direction, axis=1)
        )
    return cosine > _MIN_AIM_COSINE


_MAX_FIXED_RATIO = 0.1  # of the movement of eyes in the head's frame to that of the head


def is_fixed(positions: np.ndarray, heads: np.ndarray) -> bool:
    """Whether ``positions`` (n, 3) stay in one place, like eyes in the head's frame, while ``heads`` (m, 3) move."""
    extent, movement = (
        float(np.ptp(v[np.isfinite(v).all(axis=1)], axis=0).max(initial=0)) if len(v) else 0.0
        for v in (positions, heads)
    )
    return movement > 0 and extent <= _MAX_FIXED_RATIO * movement


class FilledOriginFinder:
    """Finds origins of one source that are fill values, block by block.

    A position of exactly 0, 0, 0 may be valid: somebody may sit there, or a track may start there. It is a fill value
    if it is repeated, and the same participant is otherwise never within 0.1 m of it. ``metre`` is the length of a unit
    in metres.
    """

    def __init__(self, metre: float) -> None:
        self._min_distance = _MIN_DISTANCE / metre
        self._last_origin: dict[int, np.ndarray] = {}  # last valid position of each participant
        self._count: dict[tuple[int, float], int] = {}
        self.undecided_counts: dict[int, int] = {}
        """Number of rows per participant that were accepted before a valid position was known, but are fill values."""

    def find(self, origin: np.ndarray, person: np.ndarray) -> np.ndarray:
        """Mask (n,) bool of fill values among origins (n, 3) of participants with codes ``person`` (n,)."""
        fill = find_fill_values(origin)
        is_filled, out = np.isfinite(fill), np.zeros(len(fill), bool)
        valid_rows = np.flatnonzero(np.isfinite(origin).all(axis=1) & ~is_filled)
        if is_filled.any():
            order = np.argsort(person, kind="stable")
            codes, starts = np.unique(person[order], return_index=True)
            for code, rows in zip(codes.tolist(), np.split(order, starts[1:])):
                if is_filled[rows].any():
                    out[rows] = self._find_for_person(code, origin[rows], fill[rows])
        if len(valid_rows):
            codes, at = np.unique(person[valid_rows][::-1], return_index=True)
            self._last_origin.update(zip(codes.tolist(), origin[valid_rows[::-1][at]]))
        return out

    def _find_for_person(self, code: int, origin: np.ndarray, fill: np.ndarray) -> np.ndarray:
        other_origins = origin[np.isnan(fill) & np.isfinite(origin).all(axis=1)]
        if code in self._last_origin:
            other_origins = np.vstack([other_origins, self._last_origin[code]])
        out = np.zeros(len(fill), bool)
        for value in np.unique(fill[np.isfinite(fill)]).tolist():
            before = self._count.get((code, value), 0)
            count = self._count[code, value] = before + int(np.count_nonzero(fill == value))
            if (
                len(other_origins)
                and count > 1
                and np.linalg.norm(other_origins - value, axis=1).min() > self._min_distance
            ):
                out |= fill == value
                if before and code not in self._last_origin:
                    self.undecided_counts[code] = before
        return out
