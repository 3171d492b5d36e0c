"""Positions of observers at which nobody can stand or nobody was recorded: values there are extrapolated."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.transforms import transform_points

from .geometry import SURFACE_OPACITY, SceneGeometry, shape_corners, trace_depth
from .mitsuba_mesh import count_faces, is_mesh, read_triangles

if TYPE_CHECKING:
    from .observer_gaze import GazeFieldInstance

_MIN_RELATIVE_EXTENT = 0.5
"""Minimum extent of the environment's box along an axis, relative to its largest one: an observer may stand above a
floor with furniture, whose box is flat."""

_MAX_SOLID_FACES = 100_000  # larger meshes are not searched for solids
_SOLID_DIRECTIONS = 64
_SOLID_DEPTH = 0.01  # depth in all directions within matter, relative to the environment's diagonal


def find_extrapolation(
    geometry: SceneGeometry | None, gaze: GazeFieldInstance | None, observers: ArrayLike
) -> list[str]:
    """Return for each of M observers why values there are extrapolated; "" if they are not.

    An observer is far from all recorded positions (for a gaze field that stores these), or else outside of the
    environment's bounding box, or inside a solid: a closed part of a mesh with outward faces that contains no other
    part, or matter of a radiance field.

    Parameters
    ----------
    geometry : SceneGeometry or None
        The environment.
    gaze : GazeFieldInstance or None
        The gaze field.
    observers : array_like of shape (M, 3)
        Positions in scene units.
    """
    positions = np.asarray(observers, np.float64).reshape(-1, 3)
    reasons = [""] * len(positions)
    support = None if gaze is None else gaze.field.support
    if support is not None and gaze is not None:
        from scipy.spatial import KDTree

        local = transform_points(gaze.to_world.inverse, positions)
        distance = KDTree(support.cells[:, :3].astype(np.float64)).query(local)[0]
        for k in np.flatnonzero(distance > support.cutoff):
            reasons[k] = f"is {distance[k] * gaze.to_world.scale:.3g} from the nearest recorded position"
    bounds = None if geometry is None else geometry.bounds()
    if bounds is None and gaze is not None:
        corners = np.array([gaze.field.box.lower, gaze.field.box.upper], np.float64)
        placed = transform_points(gaze.to_world.matrix, corners)
        bounds = placed.min(axis=0), placed.max(axis=0)
    if bounds is None:
        return reasons
    lower, upper = (np.asarray(corner, np.float64) for corner in bounds)
    if support is None:
        padding = np.maximum(_MIN_RELATIVE_EXTENT * (upper - lower).max() - (upper - lower), 0) / 2
        slack = padding + 1e-3 * (upper - lower).max()
        for k in np.flatnonzero(((positions < lower - slack) | (positions > upper + slack)).any(axis=1)):
            box = " to ".join(f"({', '.join(f'{x:.4g}' for x in corner)})" for corner in (lower, upper))
            reasons[k] = f"is outside of the environment, which extends from {box}"
    if geometry is not None:
        for k in np.flatnonzero(_is_in_solid(geometry, lower, upper, positions)):
            reasons[k] = reasons[k] or "is inside a solid"
    return reasons


def describe_extrapolation(geometry: SceneGeometry | None, gaze: GazeFieldInstance | None, observers: ArrayLike) -> str:
    """Return a sentence on the observers whose values are extrapolated (`find_extrapolation`); "" if there are none."""
    positions = np.asarray(observers, np.float64).reshape(-1, 3)
    reasons = find_extrapolation(geometry, gaze, positions)
    rows = [k for k, reason in enumerate(reasons) if reason]
    if not rows:
        return ""
    first = f"observer at ({', '.join(f'{x:.6g}' for x in positions[rows[0]])}) {reasons[rows[0]]}"
    several = f"{len(rows):,} of {len(positions):,} observers are at extrapolated positions: the first, the "
    return f"{several if len(positions) > 1 else 'the '}{first}; values there are extrapolated"


def warn_extrapolation(
    warn: Callable[[str], Any], geometry: SceneGeometry | None, gaze: GazeFieldInstance | None, observers: ArrayLike
) -> None:
    """Call ``warn`` with the sentence of `describe_extrapolation`, if there is one."""
    if sentence := describe_extrapolation(geometry, gaze, observers):
        warn(sentence)


def _is_in_solid(geometry: SceneGeometry, lower: np.ndarray, upper: np.ndarray, positions: np.ndarray) -> np.ndarray:
    inside = np.zeros(len(positions), bool)
    if geometry.medium is not None:
        d = fibonacci_directions(_SOLID_DIRECTIONS)
        rays = np.repeat(positions, len(d), axis=0), np.tile(d, (len(positions), 1))
        depth, opacity = trace_depth(geometry, *rays)
        reach = np.where(opacity > SURFACE_OPACITY, depth, np.inf).reshape(len(positions), -1).max(axis=1)
        inside |= reach < _SOLID_DEPTH * np.linalg.norm(upper - lower)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for shape in [] if geometry.scene is None else geometry.scene.shapes():
        low, high = (np.asarray(corner, np.float64) for corner in shape_corners(shape))
        is_near = ((positions > low) & (positions < high)).all(axis=1).any()
        if is_near and is_mesh(shape) and count_faces(shape) <= _MAX_SOLID_FACES:
            parts += _split_mesh(*read_triangles(shape))
        else:
            parts.append((low, high, np.zeros((0, 3, 3))))
    for low, high, corners in parts:
        rows = np.flatnonzero(((positions > low) & (positions < high)).all(axis=1))
        is_shell = (high - low > 0.9 * (upper - lower)).all()
        middles = np.array([(a + b) / 2 for a, b, c in parts if c is not corners]).reshape(-1, 3)
        if len(rows) and not is_shell and not ((middles > low) & (middles < high)).all(axis=1).any():
            inside[rows] |= np.array([_winding_number(corners - positions[k]) > 0.9 for k in rows])
    return inside


def _split_mesh(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Split a mesh into connected parts: their lower and upper corners, and the corners (F, 3, 3) of their faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    # Vertices at the same position are one, since normals and texture coordinates divide them.
    points, index = np.unique(np.asarray(vertices, np.float64), axis=0, return_inverse=True)
    f = index.reshape(-1)[faces]
    edges = np.concatenate([f[:, :2], f[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label[f[:, 0]], kind="stable")
    groups = np.split(points[f[order]], np.flatnonzero(np.diff(label[f[order, 0]])) + 1)
    return [(c.min(axis=(0, 1)), c.max(axis=(0, 1)), c) for c in groups]


def _winding_number(corners: np.ndarray) -> float:
    """Return the winding number of triangles (F, 3, 3) around the origin (van Oosterom and Strackee 1983)."""
    a, b, c = (corners[:, k] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = lambda u, v: np.einsum("ij,ij->i", u, v)
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return float(np.arctan2(dot(a, np.cross(b, c)), below).sum() / (2 * np.pi))
