"""Surfaces in files, as points: meshes and clouds (PLY, OBJ), tables (CSV, Project Aria's too), arrays (.npy)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from nerg_mi.capture.semidense import read_semidense
from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.bounded import read_bytes, reading, size_of
from nerg_mi.files.line_blocks import line_blocks
from nerg_mi.files.npy import read_npy
from nerg_mi.rays.readers.parsing.tables import iterate_table, table_columns
from nerg_mi.rendering.mesh_file import check_ply

SUFFIXES = (".ply", ".obj", ".csv", ".csv.gz", ".npy")
"""Files that are read."""

POINTS = 200_000
"""Points that are taken of a mesh, evenly by area, or of a larger cloud."""

BYTES = 1 << 30
"""A file may have so many bytes."""


def read_surface(path: Path, count: int = POINTS) -> np.ndarray:
    """At most ``count`` points (N, 3) on the surface in ``path``, in its own frame and units; drawn at random, with the
    same result every time. Raises `NergError` for a file without finite points."""
    if not path.name.lower().endswith(SUFFIXES):
        raise NergError(f'"{path}" is no surface that is read; give a mesh or points in {", ".join(SUFFIXES)}')
    if not path.is_file():
        raise MissingFile(f'there is no surface "{path}"; correct its name')
    if path.name.lower().endswith((".csv", ".csv.gz")):
        points = _table(path)
    elif path.suffix.lower() == ".npy":
        points = _array(path)
    else:
        points = (_ply if path.suffix.lower() == ".ply" else _obj)(path, count)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise NergError(f'the surface "{path}" has no points; export it again')
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


def _ply(path: Path, count: int) -> np.ndarray:
    import trimesh

    check_ply(path, faces=False)
    raw = read_bytes(path, "surface", BYTES)
    # From memory: so that what the file names beside it is not read.
    with reading(path, "surface", "export it again", also=(TypeError, AttributeError, ZeroDivisionError)):
        found = trimesh.load(io.BytesIO(raw), file_type="ply", process=False, skip_materials=True)
        parts = list(found.geometry.values()) if isinstance(found, trimesh.Scene) else [found]
        meshes = [
            (
                np.asarray(getattr(part, "vertices", np.zeros((0, 3))), np.float64).reshape(-1, 3),
                np.asarray(getattr(part, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3),
            )
            for part in parts
        ]
    points = [_sampled(vertices, faces, count) for vertices, faces in meshes]
    return np.concatenate(points) if points else np.zeros((0, 3))


def _obj(path: Path, count: int) -> np.ndarray:
    """Vertices and faces alone: what readers of whole scenes do besides is to look for materials, and to guess at
    encodings."""
    size_of(path, "surface", BYTES)
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    with reading(path, "surface", "export it again"):
        for lines in line_blocks(path, "surface", 1 << 16):
            for words in map(str.split, lines):
                if words and words[0] == "v":
                    if len(words) < 4:
                        raise ValueError("a vertex has fewer than three coordinates")
                    vertices.append([float(w) for w in words[1:4]])
                elif words and words[0] == "f":
                    corners = [int(w.split("/")[0]) for w in words[1:]]
                    # From 1 on; negative ones count from the last that was told.
                    corners = [k - 1 if k > 0 else len(vertices) + k for k in corners]
                    faces += [(corners[0], i, j) for i, j in zip(corners[1:], corners[2:])]
        triangles = np.array(faces, np.int64).reshape(-1, 3)
    return _sampled(np.array(vertices).reshape(-1, 3), triangles, count)


def _sampled(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Points on triangles, evenly by area; the vertices where there are none."""
    faces = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)]
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
