"""How far poses are from others of the same pictures, whatever coordinates both are in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PoseErrors:
    """``rotation``: (N,) degrees; ``scatter``: (N,) degrees that are left without the turn that all cameras have in
    common, in their own frames, as where one lens has another principal point; ``position``: (N,), as shares of the
    extent of the reference's cameras, which is their largest distance from their mean; ``similarity``: (4, 4), from
    the poses' coordinates to the reference's."""

    rotation: np.ndarray
    scatter: np.ndarray
    position: np.ndarray
    similarity: np.ndarray


def fit_similarity(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The similarity (4, 4) that takes ``points`` (N, 3) closest to ``targets`` (N, 3), by least squares.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991. Raises
    ``ValueError`` for less than three points, or points on a line, which leave it open.
    """
    if len(points) < 3 or points.shape != targets.shape:
        raise ValueError(f"a similarity needs 3 pairs of points or more, got {len(points)} and {len(targets)}")
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    if s[1] <= 1e-9 * s[0]:
        raise ValueError("the points lie on a line, around which anything can be turned")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float(s @ sign / np.sum(a * a))
    out = np.eye(4)
    out[:3, :3] = scale * rotation
    out[:3, 3] = targets.mean(axis=0) - scale * rotation @ points.mean(axis=0)
    return out


def pose_errors(found: np.ndarray, reference: np.ndarray) -> PoseErrors:
    """Errors of the camera-to-world poses ``found`` (N, 4, 4) against ``reference`` (N, 4, 4), after the similarity
    that fits their positions best."""
    similarity = fit_similarity(found[:, :3, 3], reference[:, :3, 3])
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    apart = np.swapaxes(reference[:, :3, :3], 1, 2) @ (similarity[:3, :3] / scale) @ found[:, :3, :3]
    # The rotation nearest to their mean.
    u, _, vt = np.linalg.svd(apart.mean(axis=0))
    common = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    moved = found[:, :3, 3] @ similarity[:3, :3].T + similarity[:3, 3]
    centers = reference[:, :3, 3]
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    position = np.linalg.norm(moved - centers, axis=1) / extent
    return PoseErrors(_degrees(apart), _degrees(apart @ common.T), position, similarity)


def _degrees(rotations: np.ndarray) -> np.ndarray:
    """Angles (N,) of ``rotations`` (N, 3, 3): by the sine of the half, which is exact where they are small."""
    half = np.linalg.norm(rotations - np.eye(3), axis=(1, 2)) / np.sqrt(8)
    return np.degrees(2 * np.arcsin(np.clip(half, 0, 1)))
