"""Triangle meshes as attention is put on them: connected where they touch, and without faces that are none."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.coordinates import check_coordinates


@dataclass(frozen=True, eq=False)
class Mesh:
    """``vertices`` (V, 3) float64 in scene units, and triangles ``faces`` (F, 3) int64."""

    vertices: np.ndarray
    faces: np.ndarray

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners of the triangles, (F, 3, 3)."""
        return self.vertices[self.faces]

    @cached_property
    def area(self) -> np.ndarray:
        """Area (F,) of the triangles, square scene units."""
        return triangle_areas(self.corners)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals (F, 3), to the side that sees the corners counter-clockwise; 0 of faces without area."""
        across = _across(self.corners)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        return across / np.where(length > 0, length, 1)

    @cached_property
    def vertex_area(self) -> np.ndarray:
        """A third of the area of the triangles around each vertex, (V,): the integral of its hat function."""
        return np.bincount(self.faces.ravel(), np.repeat(self.area / 3, 3), len(self.vertices))

    @property
    def longest(self) -> np.ndarray:
        """Longest edge (F,) of each triangle."""
        return np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=1), axis=2).max(axis=1)

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around all vertices."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


@dataclass(frozen=True)
class Repairs:
    """What of a mesh was put right: ``merged`` vertices that lay on others, and faces left out: ``flat`` ones without
    area, and ``repeated`` ones with the corners of another."""

    merged: int
    flat: int
    repeated: int

    @property
    def sentence(self) -> str | None:
        """What was done, None where nothing was."""
        said = [
            f"{number:,} {what}"
            for number, what in (
                (self.merged, "vertices that lie on others merged"),
                (self.flat, "faces without area left out"),
                (self.repeated, "faces that repeat others left out"),
            )
            if number
        ]
        return ", ".join(said) or None


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Area (...) of triangles (..., 3, 3)."""
    return 0.5 * np.linalg.norm(_across(corners), axis=-1)


def _across(corners: np.ndarray) -> np.ndarray:
    a, b, c = (corners[..., k, :] for k in range(3))
    return np.cross(b - a, c - a)


def weld(vertices: np.ndarray, faces: np.ndarray, what: str = "the mesh") -> tuple[Mesh, np.ndarray, Repairs]:
    """The mesh of ``vertices`` (V, 3) and ``faces`` (F, 3) with one vertex for each place, ``(mesh, index, repairs)``.

    Files repeat vertices along edges where normals or colours jump; surfaces that touch there are one surface, and
    smoothing goes on over it. Only vertices of exactly equal coordinates are one: plates a hair apart stay apart. Faces
    without area receive nothing and faces with the corners of another would receive it twice: both are left out.
    ``index`` (F',): which of ``faces`` the mesh's are. Raises `NergError`, about ``what``, for vertices that are not
    finite, and where no face is left.
    """
    # A zero may be negative, and is the same place.
    vertices = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3) + 0.0
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    check_coordinates(vertices, f"the vertices of {what}")
    kept = np.unique(faces)
    one, number = _unique_rows(vertices[kept])
    place = vertices[kept[one]]
    of = np.zeros(len(vertices), np.int64)
    of[kept] = number
    joined = of[faces]
    a, b, c = (joined[:, k] for k in range(3))
    whole = (a != b) & (b != c) & (c != a)
    # Products of tiny edges vanish before the edges do.
    extent = float(np.abs(place - place.mean(0)).max(initial=0)) or 1.0
    whole[whole] = triangle_areas(place[joined[whole]] / extent) > 0
    first, _ = _unique_rows(np.sort(joined[whole], axis=1))
    index = np.flatnonzero(whole)[np.sort(first)]
    if not len(index):
        raise NergError(f"{what} has no face with an area; export it again, as triangles")
    left, corner = np.unique(joined[index], return_inverse=True)
    mesh = Mesh(place[left], corner.reshape(-1, 3).astype(np.int64))
    flat = int(len(faces) - whole.sum())
    return mesh, index, Repairs(len(kept) - len(place), flat, int(whole.sum() - len(index)))


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(first, number)`` of rows (N, 3) that are equal: the first of each kind, and the kind (N,) of each."""
    order = np.lexsort(rows.T[::-1])
    new = np.r_[True, (rows[order[1:]] != rows[order[:-1]]).any(axis=1)] if len(rows) else np.zeros(0, bool)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number
