"""Triangles cut until none of their edges is longer than attention is to be resolved.

An edge that is too long is halved in all triangles that have it, so that no vertex comes to lie in the middle of an
edge of a neighbour: a surface stays as connected as it was. Triangles of one, two or three such edges become two, three
or four (Bank, Sherman, Weiser 1983, "red" and "green").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from .mesh import Mesh

MOST_FACES = 8_000_000
"""A refined mesh has so many faces at most."""


@dataclass(frozen=True, eq=False)
class Refined:
    """``mesh`` cut of another: ``parent`` (F,) the face of that which each face lies in, and ``place`` (F, 3, 3), of
    each of its corners the barycentric coordinates there."""

    mesh: Mesh
    parent: np.ndarray
    place: np.ndarray


def refine(mesh: Mesh, longest: float) -> Refined:
    """``mesh`` with edges of at most ``longest`` scene units. Raises `NergError` for more than `MOST_FACES` faces."""
    vertices, faces = mesh.vertices, mesh.faces
    parent, place = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    while True:
        edges, of_face = _edges(faces)
        ends = vertices[edges]
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest
        if not long.any():
            return Refined(Mesh(vertices, faces), parent, place)
        middle = np.full(len(edges), -1)
        middle[long] = len(vertices) + np.arange(np.count_nonzero(long))
        cut = middle[of_face]
        if len(faces) + np.count_nonzero(cut >= 0) > MOST_FACES:
            raise NergError(
                f"edges of at most {longest:.3g} scene units make more than {MOST_FACES:,} faces; give a "
                "larger --detail"
            )
        vertices = np.concatenate([vertices, 0.5 * (ends[long, 0] + ends[long, 1])])
        faces, parent, place = _cut(vertices, faces, cut, parent, place)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), and the number (F, 3) of that from each corner of a face to the next."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    # One number a pair sorts in a tenth of the time that rows take.
    count = int(faces.max()) + 1
    key, number = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    return np.stack([key // count, key % count], axis=1), number.reshape(-1, 3)


def _cut(vertices, faces, cut, parent, place):
    """Faces, parents and places after their edges were halved; ``cut`` (F, 3): the vertex in the middle of each edge,
    -1 of those that stay."""
    halves = 0.5 * (place + np.roll(place, -1, axis=1))
    known = np.concatenate([faces, cut], axis=1)
    where = np.concatenate([place, halves], axis=1)
    out: list[tuple[np.ndarray, np.ndarray]] = []
    marks = cut >= 0
    number = marks.sum(axis=1)
    # Corners 0, 1, 2, and 3, 4, 5 in the middle of the edges behind them.
    out.append(_taken(np.flatnonzero(number == 0), ((0, 1, 2),)))
    out.append(_taken(np.flatnonzero(number == 3), ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))))
    for k in range(3):
        a, b, c = k, (k + 1) % 3, (k + 2) % 3
        only = np.flatnonzero((number == 1) & marks[:, k])
        out.append(_taken(only, ((a, 3 + a, c), (3 + a, b, c))))
        # The edge behind c stays, and the quadrangle beside it is cut along its shorter diagonal.
        both = np.flatnonzero((number == 2) & ~marks[:, c])
        corner = vertices[known[both]]
        first = np.linalg.norm(corner[:, a] - corner[:, 3 + b], axis=1)
        short = first <= np.linalg.norm(corner[:, 3 + a] - corner[:, c], axis=1)
        out.append(_taken(both, ((3 + a, b, 3 + b),)))
        out.append(_taken(both[short], ((a, 3 + a, 3 + b), (a, 3 + b, c))))
        out.append(_taken(both[~short], ((a, 3 + a, c), (3 + a, 3 + b, c))))
    rows, corners = (np.concatenate(part) for part in zip(*out))
    order = np.argsort(rows, kind="stable")
    rows, corners = rows[order], corners[order]
    return known[rows[:, None], corners], parent[rows], where[rows[:, None], corners]


def _taken(rows: np.ndarray, triangles) -> tuple[np.ndarray, np.ndarray]:
    """Each of ``triangles``, three corners, for each of ``rows``."""
    corners = np.tile(np.array(triangles), (len(rows), 1))
    return np.repeat(rows, len(triangles)), corners
