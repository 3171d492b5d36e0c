"""Heads' poses: from quaternions, angles and matrices to rotations, and on to rays.

A rotation takes the head's frame to the table's. ``forward`` names the axis of the head's frame along which it looks:
``z`` in Unity, ``-z`` of an OpenGL camera and in OpenXR, ``x`` in ROS and Unreal.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

from .fill_values import fill_values, is_filled_angles

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
