"""Surfaces in files, as points: meshes and clouds (PLY, OBJ), tables (CSV, Project Aria's too), arrays (.npy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.capture.semidense import read_semidense
from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.npy import read_npy
from nerg_mi.formats.meshes import READERS, read_mesh_file
from nerg_mi.maths.coordinates import check_coordinates, check_near_origin
from nerg_mi.rays.readers.parsing.tables import iterate_table, table_columns

SUFFIXES = (*READERS, ".csv", ".csv.gz", ".npy")
"""Files that are read."""

POINTS = 200_000
"""Points that are taken of a mesh, evenly by area, or of a larger cloud."""


def read_surface(path: Path, count: int = POINTS) -> np.ndarray:
    """At most ``count`` points (N, 3) on the surface in ``path``, in its own frame and units; drawn at random, with the
    same result every time. Raises `NergError` for a file without finite points, or with some beyond all places."""
    if not path.name.lower().endswith(SUFFIXES):
        raise NergError(f'"{path}" is no surface that is read; give a mesh or points in {", ".join(SUFFIXES)}')
    if not path.exists():
        raise MissingFile(f'there is no surface "{path}"; correct its name')
    if path.name.lower().endswith((".csv", ".csv.gz")):
        points = _table(path)
    elif path.suffix.lower() == ".npy":
        points = _array(path)
    else:
        mesh = read_mesh_file(path, points=True)
        points = _sampled(mesh.vertices, mesh.faces, count)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise NergError(f'the surface "{path}" has no points; export it again')
    check_coordinates(points, f'the points of "{path}"')
    check_near_origin(points, f'the surface "{path}"')
    rng = np.random.default_rng(0)
    return points if len(points) <= count else points[np.sort(rng.permutation(len(points))[:count])]


def _table(path: Path) -> np.ndarray:
    if "px_world" in table_columns(path):
        return read_semidense(path).astype(np.float64)
    blocks = [b.numbers for b in iterate_table(path, ("x", "y", "z"))]
    return np.concatenate(blocks) if blocks else np.zeros((0, 3))


def _array(path: Path) -> np.ndarray:
    points = read_npy(path, "surface")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise NergError(f'the surface "{path}" holds an array of shape {points.shape}; it must be (N, 3) numbers')
    return points.astype(np.float64)


def _sampled(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Points on triangles, evenly by area; the vertices where there are none."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = np.where(np.isfinite(area), area, 0)
    if not area.sum() > 0:
        return vertices
    rng = np.random.default_rng(0)
    which = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return a[which] + u * (b[which] - a[which]) + v * (c[which] - a[which])
