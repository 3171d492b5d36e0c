"""Rigid and similarity transforms given as matrices: checks, corrections, and their points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.values import to_numbers

ROTATION_TOLERANCE = 0.01
"""Maximum deviation of an element of R Rᵀ from the identity for a rotation R, and of a unit quaternion's length from
1: matrices and quaternions that were written with two decimals pass."""

# Deviation of a rotation from orthonormality that is not corrected.
_ROUNDING = 1e-4
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
_LAST_ROW_TOLERANCE = 1e-5  # of single precision


def check_rigid_transforms(
    matrices: Any,
    name: str,
    label: Callable[[int], str] = "matrix {}".format,
    *,
    may_scale: bool = False,
    may_mirror: bool = False,
    shape: tuple[int, ...] | None = None,
    tolerance: float = ROTATION_TOLERANCE,
) -> np.ndarray:
    """Return ``matrices`` as an array of floats. Raises `NergError` for one that is not a rotation and a translation
    with the last row 0, 0, 0, 1.

    Parameters
    ----------
    matrices
        (4, 4), (3, 4) without the last row, or N of them (N, 4, 4) or (N, 3, 4).
    name
        For the message: "the matrix of the head", "to_world".
    label
        Returns the name of each of N matrices for the message, such as "line 7", from its index.
    may_scale
        Whether the rotation may be multiplied by a uniform scale, as in an alignment.
    may_mirror
        Whether the rotation may be followed by a reflection, as between left- and right-handed frames.
    shape
        The only shape that is accepted.
    tolerance
        Maximum deviation of an element of R Rᵀ from the identity; infinite: any 3 x 3 part is accepted.
    """
    out = to_numbers(matrices, name)
    is_accepted = out.ndim in (2, 3) and out.shape[-2:] in ((4, 4), (3, 4)) if shape is None else out.shape == shape
    if not is_accepted:
        raise NergError(f"{name} has the shape {out.shape}; it must be {shape or '(4, 4) or (3, 4)'}")
    is_single = out.ndim == 2
    m = out.reshape(-1, *out.shape[-2:])
    errors = rotation_errors(m[:, :3, :3], may_scale=may_scale, may_mirror=may_mirror)
    is_bad = ~np.isfinite(m).all(axis=(1, 2)) | ~(errors <= tolerance) | ~has_last_row(m)
    if not is_bad.any():
        return out
    row = int(np.argmax(is_bad))
    where = name if is_single else f"{name}, {label(row)}"
    with np.errstate(all="ignore"):
        raise NergError(f"{where}: {_explain(m[row], errors[row], tolerance, may_scale, may_mirror)}")


def invert_similarity(matrix: Any, name: str) -> np.ndarray:
    """The inverse of a similarity (4, 4). Raises `NergError` with ``name`` for another matrix."""
    return np.linalg.inv(check_rigid_transforms(matrix, name, may_scale=True, shape=(4, 4)))


def similarity_scale(matrix: np.ndarray) -> float:
    """Return the scale of a similarity: units of the target per unit of the source."""
    return float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))


def has_last_row(matrices: np.ndarray) -> np.ndarray:
    """Whether the last row of each matrix (N, 4, 4) is 0, 0, 0, 1, (N,) bool; True for (N, 3, 4)."""
    rows = np.abs(matrices[:, 3:] - _LAST_ROW)
    return np.asarray((rows <= _LAST_ROW_TOLERANCE).all(axis=(1, 2)))


def rotation_errors(linear: np.ndarray, *, may_scale: bool = False, may_mirror: bool = False) -> np.ndarray:
    """Maximum deviation of R Rᵀ from the identity for each of the matrices (N, 3, 3), (N,); infinite for mirrored
    matrices, unless ``may_mirror``, and values that are not finite. ``may_scale``: a uniform scale is removed
    before."""
    is_finite = np.asarray(np.isfinite(linear).all(axis=(1, 2)))
    R = np.where(is_finite[:, None, None], linear, 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        determinant = np.abs(np.linalg.det(R)) if may_mirror else np.linalg.det(R)
        if may_scale:
            R = R / np.cbrt(determinant)[:, None, None]
        errors = np.abs(np.einsum("nij,nkj->nik", R, R) - np.eye(3)).max(axis=(1, 2))
    return np.where(determinant > 0, errors, np.inf)


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform ``points`` (..., 3) by a matrix (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def nearest_rotation(linear: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a matrix with a positive determinant, which removes scale and rounding errors."""
    u, _, vt = np.linalg.svd(linear)
    return u @ vt


def correct_rotation(linear: np.ndarray) -> np.ndarray:
    """``linear`` (3, 3), a rotation times a uniform scale, with its rounding errors removed if they matter."""
    if rotation_errors(linear[None], may_scale=True)[0] <= _ROUNDING:
        return linear
    return np.cbrt(np.linalg.det(linear)) * nearest_rotation(linear)


def _explain(m: np.ndarray, error: float, tolerance: float, may_scale: bool, may_mirror: bool) -> str:
    """Why a matrix (4, 4) or (3, 4) is refused, and the remedy."""
    if not np.isfinite(m).all():
        return "it has values that are not finite; correct or remove it"
    if len(m) == 4 and not has_last_row(m[None])[0]:
        if has_last_row(m.T[None])[0]:
            return "it is transposed: its last column is 0, 0, 0, 1 instead of its last row; transpose it"
        values = ", ".join(f"{v:g}" for v in m[3])
        return f"its last row is {values} instead of 0, 0, 0, 1; check the order of its values"
    scale = float(np.cbrt(np.linalg.det(m[:3, :3])))
    if scale < 0 and not may_mirror:
        return "it is mirrored (its determinant is negative); exchange two axes or negate one in the file's frame"
    if scale > 0 and rotation_errors(m[None, :3, :3], may_scale=True)[0] <= tolerance:
        return f"it contains a scale of {scale:.6g}; only a rotation and a translation are possible, so divide by it"
    deviation = f"R Rᵀ differs from the identity by {error:.3g}; at most {tolerance:g}"
    deviation = deviation if np.isfinite(error) else "its determinant is 0"
    kind = "a rotation times a uniform scale" if may_scale else "a rotation"
    return f"its upper left 3 x 3 part is not {kind} ({deviation}); correct it"
