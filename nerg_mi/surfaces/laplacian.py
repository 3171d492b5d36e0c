r"""The Laplacian of a triangle mesh: cotangents of lengths that are kept from being those of no triangle.

    (L u)_i = Σ_j w_ij (u_i - u_j),    w_ij = (cot α_ij + cot β_ij + ...) / 2

over the angles that face the edge in all of its triangles, one along a border, more where several sheets meet (linear
finite elements; U. Pinkall, K. Polthier 1993). Angles are of lengths alone, which are made longer by one small amount
where a sliver would else have none ("intrinsic mollification", N. Sharp, K. Crane, "A Laplacian for Nonmanifold
Triangle Meshes", 2020, section 4.5), and of triangles that are flipped to be Delaunay (`delaunay`), as there. What is
negative then all the same, across edges of more or fewer than two triangles, counts as 0: heat never becomes negative,
and nothing of it is lost, since L stays symmetric with rows that add up to 0.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .delaunay import delaunay, heron
from .mesh import Mesh

MOLLIFY = 1e-5
"""Share of the mean length of edges by which two edges of a triangle exceed the third at least."""


def laplacian(mesh: Mesh) -> sparse.csr_array:
    """L (V, V), positive semidefinite, without unit: its integral form, to be divided by areas of vertices."""
    faces, lengths = delaunay(mesh.faces, _mollified(mesh))
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = len(mesh.vertices)
    half = 0.5 * _cotangents(lengths).ravel()
    weights = sparse.coo_array((np.r_[half, half], (np.r_[i, j], np.r_[j, i])), (count, count)).tocsr()
    # An edge that leads back to where it began carries no heat.
    weights.setdiag(0)
    weights.data = np.maximum(weights.data, 0)
    weights.eliminate_zeros()
    degree = np.asarray(weights.sum(axis=1)).ravel()
    return (sparse.diags_array(degree) - weights).tocsr()


def _mollified(mesh: Mesh) -> np.ndarray:
    """Lengths (F, 3) of the edges from each corner to the next, all the same longer, so that each is less than the
    others together."""
    lengths = np.linalg.norm(np.roll(mesh.corners, -1, axis=1) - mesh.corners, axis=2)
    slack = lengths.sum(axis=1, keepdims=True) - 2 * lengths
    return lengths + max(0.0, float((MOLLIFY * lengths.mean() - slack).max(initial=0)))


def _cotangents(lengths: np.ndarray) -> np.ndarray:
    """Cotangent (F, 3) of the angle that faces each edge of triangles with edges ``lengths`` (F, 3)."""
    area = heron(*lengths.T)
    square = lengths**2
    return (square.sum(axis=1, keepdims=True) - 2 * square) / (4 * area[:, None])
