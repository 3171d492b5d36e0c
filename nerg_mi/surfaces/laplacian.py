"""Laplacian of a triangle mesh on an intrinsic Delaunay triangulation, heat smoothing, and surface sums."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .mesh import Mesh

# ---- Intrinsic Delaunay triangulation ----
#
# Edges are flipped intrinsically until the triangulation is Delaunay. The surface does not change; only the geodesic
# edges between its vertices do, as if pairs of triangles were unfolded into the plane (B. Springborn, A. Bobenko 2007;
# M. Fisher et al. 2007). Afterwards the two angles that face an edge sum to at most 180 degrees, so that all weights of
# the cotangent Laplacian are non-negative, even for long thin triangles. Edges of one triangle, or of more than two,
# are not flipped.

MAX_ROUNDS = 2000  # maximum number of rounds; independent flips are made in one round
_MIN_WEIGHT = -1e-9


def flip_to_delaunay(faces: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flip edges until the triangulation is Delaunay.

    ``faces`` and ``lengths`` are (F, 3); the lengths are those of the edges from each corner to the next.
    """
    faces, lengths = faces.copy(), lengths.copy()
    twin = find_twins(faces)
    for _ in range(MAX_ROUNDS):
        h = np.flatnonzero(twin > np.arange(len(twin)))
        weight = _cotangent(lengths, h) + _cotangent(lengths, twin[h])
        needs_flip = (weight < _MIN_WEIGHT) & (h // 3 != twin[h] // 3)
        h, weight = h[needs_flip], weight[needs_flip]
        if not len(h):
            break
        h = h[np.argsort(weight, kind="stable")]
        # Flip an edge if it is the worst one of both triangles.
        rank = np.arange(len(h))
        first = np.full(len(faces), len(h))
        np.minimum.at(first, h // 3, rank)
        np.minimum.at(first, twin[h] // 3, rank)
        h = h[(first[h // 3] == rank) & (first[twin[h] // 3] == rank)]
        if not _flip(faces, lengths, twin, h):
            break
    return faces, lengths


def find_twins(faces: np.ndarray) -> np.ndarray:
    """Return the opposite half-edge of each half-edge 3 f + k, which runs from corner k of face f to the next, (3 F,).

    The result is -1 for edges of one face or of more than two faces.
    """
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = int(faces.max()) + 1
    key = np.minimum(i, j) * count + np.maximum(i, j)
    order = np.argsort(key, kind="stable")
    _, start, number = np.unique(key[order], return_index=True, return_counts=True)
    out = np.full(len(key), -1)
    a, b = order[start[number == 2]], order[start[number == 2] + 1]
    # Two consistently oriented faces traverse their edge in opposite directions; others cannot be unfolded.
    opposite = i[a] == j[b]
    out[a[opposite]], out[b[opposite]] = b[opposite], a[opposite]
    return out


def _cotangent(lengths: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the cotangent of the angle opposite to half-edges ``h``."""
    f, k = h // 3, h % 3
    a, b, c = (lengths[f, (k + n) % 3] for n in range(3))
    return (b * b + c * c - a * a) / (4 * heron_area(a, b, c))


def heron_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the area of triangles with edges ``a``, ``b``, ``c`` by W. Kahan's formula, which is stable for
    needles."""
    c, b, a = np.sort(np.stack([a, b, c]), axis=0)
    square = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c))
    return np.maximum(0.25 * np.sqrt(np.maximum(square, 0)), np.finfo(float).tiny)


def _flip(faces: np.ndarray, lengths: np.ndarray, twin: np.ndarray, h: np.ndarray) -> int:
    """Flip half-edges ``h``, at most one per triangle, in place. Return the number of flips."""
    t = twin[h]
    # i and j are the ends of the edge, k and l the opposite corners.
    (f, a), (g, b) = (h // 3, h % 3), (t // 3, t % 3)
    a1, a2, b1, b2 = (a + 1) % 3, (a + 2) % 3, (b + 1) % 3, (b + 2) % 3
    ij, jk, ki = lengths[f, a], lengths[f, a1], lengths[f, a2]
    il, lj = lengths[g, b1], lengths[g, b2]
    angle = _angle(ij, ki, jk) + _angle(ij, il, lj)
    # Law of cosines, written as a sum of non-negative terms.
    kl = np.sqrt((ki - il) ** 2 + 4 * ki * il * np.sin(0.5 * np.minimum(angle, np.pi)) ** 2)
    is_valid = (angle < np.pi) & _is_triangle(kl, ki, il) & _is_triangle(kl, jk, lj)
    f, a, a1, a2, g, b, b1, b2, kl = (v[is_valid] for v in (f, a, a1, a2, g, b, b1, b2, kl))
    if not len(f):
        return 0
    jk, ki, il, lj = (v[is_valid] for v in (jk, ki, il, lj))
    i, j, k, l = faces[f, a], faces[f, a1], faces[f, a2], faces[g, b2]
    new_index = np.arange(len(twin))
    for old, new in (
        (3 * g + b1, 3 * f),
        (3 * f + a, 3 * f + 1),
        (3 * f + a2, 3 * f + 2),
        (3 * f + a1, 3 * g),
        (3 * g + b, 3 * g + 1),
        (3 * g + b2, 3 * g + 2),
    ):
        new_index[old] = new
    new_twin = np.where(twin >= 0, new_index[np.maximum(twin, 0)], -1)
    twin[new_index] = new_twin
    faces[f], faces[g] = np.stack([i, l, k], axis=1), np.stack([j, k, l], axis=1)
    lengths[f], lengths[g] = np.stack([il, kl, ki], axis=1), np.stack([jk, kl, lj], axis=1)
    return len(f)


def _angle(a: np.ndarray, b: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Return the angle between edges ``a`` and ``b`` of triangles, by the half-angle formula."""
    s = 0.5 * (a + b + facing)
    return 2 * np.arctan2(np.sqrt(np.maximum((s - a) * (s - b), 0)), np.sqrt(np.maximum(s * (s - facing), 0)))


def _is_triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (a + b > c) & (b + c > a) & (c + a > b)


# ---- Laplacian ----
#
#     (L u)_i = Σ_j w_ij (u_i - u_j),    w_ij = (cot α_ij + cot β_ij + ...) / 2
#
# The sum is over the angles opposite to the edge in all of its triangles: one at a border, more than two at
# non-manifold edges (linear finite elements; U. Pinkall, K. Polthier 1993). Angles are computed from edge lengths,
# which are increased by a small constant so that slivers satisfy the triangle inequality ("intrinsic mollification", N.
# Sharp, K. Crane, "A Laplacian for Nonmanifold Triangle Meshes", 2020, section 4.5), after flipping to Delaunay.
# Weights that are still negative, at edges of one or more than two triangles, are set to 0. Heat therefore never
# becomes negative, and is conserved, since L remains symmetric with zero row sums.

MOLLIFY = 1e-5  # minimum slack of the triangle inequality, relative to the mean edge length


def make_laplacian(mesh: Mesh) -> sparse.csr_array:
    """Return L (V, V), positive semidefinite and dimensionless: the integrated form, to be divided by vertex areas."""
    faces, lengths = flip_to_delaunay(mesh.faces, _mollify_lengths(mesh))
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = len(mesh.vertices)
    half = 0.5 * _cotangents(lengths).ravel()
    weights = sparse.coo_array((np.r_[half, half], (np.r_[i, j], np.r_[j, i])), (count, count)).tocsr()
    # Loops carry no heat.
    weights.setdiag(0)
    weights.data = np.maximum(weights.data, 0)
    weights.eliminate_zeros()
    degree = np.asarray(weights.sum(axis=1)).ravel()
    return (sparse.diags_array(degree) - weights).tocsr()


def _mollify_lengths(mesh: Mesh) -> np.ndarray:
    """Return the edge lengths (F, 3), increased by a constant so that each triangle satisfies the triangle
    inequality with slack."""
    lengths = np.linalg.norm(np.roll(mesh.corners, -1, axis=1) - mesh.corners, axis=2)
    slack = lengths.sum(axis=1, keepdims=True) - 2 * lengths
    return lengths + max(0.0, float((MOLLIFY * lengths.mean() - slack).max(initial=0)))


def _cotangents(lengths: np.ndarray) -> np.ndarray:
    """Return the cotangents (F, 3) of the angles opposite to each edge of triangles with edge ``lengths`` (F, 3)."""
    area = heron_area(*lengths.T)
    square = lengths**2
    return (square.sum(axis=1, keepdims=True) - 2 * square) / (4 * area[:, None])


# ---- Smoothing ----
#
# Attention is smoothed along the surface by heat diffusion, so it does not cross gaps.
#
# In the plane, heat from a point has after the time t = s² / 2 a Gaussian density with the standard deviation s per
# axis. On a mesh, M du/dt = -L u with the vertex areas M is integrated in n implicit Euler steps (Crane, Weischedel,
# Wardetzky, "Geodesics in Heat", 2013): each step solves (M + t/n L) u = M u_before. Densities stay non-negative for
# every mesh, the total is conserved, and disconnected components do not exchange heat. The implicit Gaussian has the
# correct variance, with longer tails of order 1/n.

STEPS = 8  # number of time steps


class Smoother:
    """Smooths densities on ``mesh`` with standard deviation ``length`` along the surface, in scene units."""

    def __init__(self, mesh: Mesh, length: float, steps: int = STEPS):
        if not (np.isfinite(length) and length > 0 and steps >= 1):
            raise ValueError(f"smoothing needs a positive length and at least one step, got {length} and {steps}")
        self._steps = steps
        area = mesh.vertex_area
        # Normalise by the mean area to avoid underflow for very small or large scenes.
        unit = float(area.mean())
        self._area = area / unit
        matrix = sparse.diags_array(self._area) + (0.5 * length**2 / steps / unit) * make_laplacian(mesh)
        # An M-matrix needs no pivoting. Without it the factors keep their signs, so densities stay non-negative, and
        # connected components stay separate blocks.
        self._solve = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve

    def __call__(self, amount: np.ndarray) -> np.ndarray:
        """Smooth the integrals over hat functions ``amount`` (V,); their sum is conserved."""
        heat = np.asarray(amount, np.float64)
        for _ in range(self._steps):
            heat = self._area * self._solve(heat)
        return heat


# ---- Sums ----
#
# Attention on a surface, added up in a fixed order.


@dataclass(frozen=True, eq=False)
class SurfaceSums:
    """Weighted attention on a surface, in float64.

    Parameters
    ----------
    face_sums
        Integral over each face, (F,).
    vertex_sums
        Integral with the hat function of each vertex, (V,); the total is the same.
    elsewhere, escaped
        Attention on other surfaces, and without a surface.
    total
        Total attention.
    weight, count
        Total weight and number of the observers or samples.
    """

    face_sums: np.ndarray
    vertex_sums: np.ndarray
    elsewhere: float = 0.0
    escaped: float = 0.0
    total: float = 0.0
    weight: float = 0.0
    count: int = 0

    @classmethod
    def zeros(cls, faces: int, vertices: int) -> SurfaceSums:
        """Return zero sums."""
        return cls(np.zeros(faces), np.zeros(vertices))

    def add(self, other: SurfaceSums) -> SurfaceSums:
        """Return the sum of both. The order of additions affects the last digits."""
        return SurfaceSums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def on_surface(self) -> float:
        """Attention on the surface."""
        return float(self.face_sums.sum())

    @property
    def unaccounted(self) -> float:
        """Total attention that is not assigned: the discrepancy of the two quadratures."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


def merge_sums(parts: Iterable[SurfaceSums]) -> SurfaceSums:
    """Add one or more sums in order."""
    parts = iter(parts)
    total = next(parts)
    for part in parts:
        total = total.add(part)
    return total


def deposit(faces: np.ndarray, vertices: int, face: np.ndarray, barycentric: np.ndarray, values: np.ndarray):
    """Distribute values over faces and vertices.

    Parameters
    ----------
    faces
        Corners of the faces, (F, 3).
    vertices
        Number of vertices V.
    face
        Face of each value, (P,).
    barycentric
        Barycentric coordinates of each value in its face, (P, 3).
    values
        Values, (P,) float64.

    Returns
    -------
    tuple
        Sums per face (F,) and per vertex (V,).
    """
    on_faces = np.bincount(face, values, len(faces))
    corner = faces[face]
    on_vertices = np.bincount(corner.ravel(), (values[:, None] * barycentric).ravel(), vertices)
    return on_faces, on_vertices
