"""The Laplacian of a triangle mesh on an intrinsic Delaunay triangulation, smoothing with it, and sums in a fixed
order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .mesh import Mesh

# ---- Delaunay ----
#
# Triangles of the same surface whose Laplacian is a good one: edges flipped, intrinsically, until none is worth it.
#
# The surface stays what it is; only along which straight lines its triangles meet changes, as if they were folded flat
# in pairs (B. Springborn, A. Bobenko 2007; M. Fisher et al. 2007). After it no edge faces angles of more than 180
# degrees together, so that no weight of the cotangent Laplacian is negative, however long and thin triangles were.
# Edges of one triangle, or of more than two, stay.

ROUNDS = 2000  # flips that do not touch each other are made in one round; more rounds than these are not made
_WORTH = -1e-9


def delaunay(faces: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``faces`` (F, 3) and ``lengths`` (F, 3) of the edges from each corner to the next, after all flips."""
    faces, lengths = faces.copy(), lengths.copy()
    twin = twins(faces)
    for _ in range(ROUNDS):
        h = np.flatnonzero(twin > np.arange(len(twin)))
        weight = _cotangent(lengths, h) + _cotangent(lengths, twin[h])
        wanted = (weight < _WORTH) & (h // 3 != twin[h] // 3)
        h, weight = h[wanted], weight[wanted]
        if not len(h):
            break
        h = h[np.argsort(weight, kind="stable")]
        # Of each triangle the worst edge, if it is the worst of both.
        rank = np.arange(len(h))
        first = np.full(len(faces), len(h))
        np.minimum.at(first, h // 3, rank)
        np.minimum.at(first, twin[h] // 3, rank)
        h = h[(first[h // 3] == rank) & (first[twin[h] // 3] == rank)]
        if not _flip(faces, lengths, twin, h):
            break
    return faces, lengths


def twins(faces: np.ndarray) -> np.ndarray:
    """Of each half-edge 3 f + k, from corner k of face f to the next, the one that runs along it in the only other
    face, (3 F,); -1 where there is none, or there are several."""
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = int(faces.max()) + 1
    key = np.minimum(i, j) * count + np.maximum(i, j)
    order = np.argsort(key, kind="stable")
    _, start, number = np.unique(key[order], return_index=True, return_counts=True)
    out = np.full(len(key), -1)
    a, b = order[start[number == 2]], order[start[number == 2] + 1]
    # Two faces of a sheet see their edge in opposite directions; where they do not, no plane holds them as they are.
    opposite = i[a] == j[b]
    out[a[opposite]], out[b[opposite]] = b[opposite], a[opposite]
    return out


def _cotangent(lengths: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Cotangent of the angle that faces half-edge ``h``."""
    f, k = h // 3, h % 3
    a, b, c = (lengths[f, (k + n) % 3] for n in range(3))
    return (b * b + c * c - a * a) / (4 * heron(a, b, c))


def heron(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Area of triangles with edges ``a``, ``b``, ``c``, in W. Kahan's order, which keeps that of a needle."""
    c, b, a = np.sort(np.stack([a, b, c]), axis=0)
    square = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c))
    return np.maximum(0.25 * np.sqrt(np.maximum(square, 0)), np.finfo(float).tiny)


def _flip(faces: np.ndarray, lengths: np.ndarray, twin: np.ndarray, h: np.ndarray) -> int:
    """Flip half-edges ``h``, no two in one triangle, in place; gives how many could be."""
    t = twin[h]
    # i and j are the ends of the edge, k and l the corners that it faces.
    (f, a), (g, b) = (h // 3, h % 3), (t // 3, t % 3)
    a1, a2, b1, b2 = (a + 1) % 3, (a + 2) % 3, (b + 1) % 3, (b + 2) % 3
    ij, jk, ki = lengths[f, a], lengths[f, a1], lengths[f, a2]
    il, lj = lengths[g, b1], lengths[g, b2]
    angle = _angle(ij, ki, jk) + _angle(ij, il, lj)
    # The law of cosines, of terms of one sign.
    kl = np.sqrt((ki - il) ** 2 + 4 * ki * il * np.sin(0.5 * np.minimum(angle, np.pi)) ** 2)
    sound = (angle < np.pi) & _is_triangle(kl, ki, il) & _is_triangle(kl, jk, lj)
    f, a, a1, a2, g, b, b1, b2, kl = (v[sound] for v in (f, a, a1, a2, g, b, b1, b2, kl))
    if not len(f):
        return 0
    jk, ki, il, lj = (v[sound] for v in (jk, ki, il, lj))
    i, j, k, l = faces[f, a], faces[f, a1], faces[f, a2], faces[g, b2]
    moved = np.arange(len(twin))
    for old, new in (
        (3 * g + b1, 3 * f),
        (3 * f + a, 3 * f + 1),
        (3 * f + a2, 3 * f + 2),
        (3 * f + a1, 3 * g),
        (3 * g + b, 3 * g + 1),
        (3 * g + b2, 3 * g + 2),
    ):
        moved[old] = new
    other = np.where(twin >= 0, moved[np.maximum(twin, 0)], -1)
    twin[moved] = other
    faces[f], faces[g] = np.stack([i, l, k], axis=1), np.stack([j, k, l], axis=1)
    lengths[f], lengths[g] = np.stack([il, kl, ki], axis=1), np.stack([jk, kl, lj], axis=1)
    return len(f)


def _angle(a: np.ndarray, b: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Angle between edges ``a`` and ``b`` of triangles, by the tangent of its half."""
    s = 0.5 * (a + b + facing)
    return 2 * np.arctan2(np.sqrt(np.maximum((s - a) * (s - b), 0)), np.sqrt(np.maximum(s * (s - facing), 0)))


def _is_triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (a + b > c) & (b + c > a) & (c + a > b)


# ---- Laplacian ----
#
# The Laplacian of a triangle mesh: cotangents of lengths that are kept from being those of no triangle.
#
#     (L u)_i = Σ_j w_ij (u_i - u_j),    w_ij = (cot α_ij + cot β_ij + ...) / 2
#
# over the angles that face the edge in all of its triangles, one along a border, more where several sheets meet (linear
# finite elements; U. Pinkall, K. Polthier 1993). Angles are of lengths alone, which are made longer by one small amount
# where a sliver would else have none ("intrinsic mollification", N. Sharp, K. Crane, "A Laplacian for Nonmanifold
# Triangle Meshes", 2020, section 4.5), and of triangles that are flipped to be Delaunay (`delaunay`), as there. What is
# negative then all the same, across edges of more or fewer than two triangles, counts as 0: heat never becomes
# negative, and nothing of it is lost, since L stays symmetric with rows that add up to 0.

MOLLIFY = 1e-5  # share of the mean length of edges by which two edges of a triangle exceed the third at least


def make_laplacian(mesh: Mesh) -> sparse.csr_array:
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


# ---- Smoothing ----
#
# Smoothing along a surface: attention flows as heat does, over edges and never through the air.
#
# Heat that starts at a point of a plane has, after the time t = s² / 2, the density of a Gaussian with the standard
# deviation s along both axes. On a mesh M du/dt = -L u, with the areas M of vertices and the Laplacian L, is solved in
# n equal steps backwards in time (Crane, Weischedel, Wardetzky, "Geodesics in Heat", 2013, take one): each solves (M +
# t/n L) u = M u_before. No step makes a density negative, whatever the mesh, all of them together change no total, and
# where no edge leads nothing arrives, exactly. Backwards in time a Gaussian comes out with the right variance and, to
# the order 1/n, with longer tails.

STEPS = 8  # steps in time


class Smoother:
    """Smoothing of densities on ``mesh`` by ``length``, the standard deviation s along the surface in scene units."""

    def __init__(self, mesh: Mesh, length: float, steps: int = STEPS):
        if not (np.isfinite(length) and length > 0 and steps >= 1):
            raise ValueError(f"smoothing needs a positive length and a step at least, got {length} and {steps}")
        self._steps = steps
        area = mesh.vertex_area
        # In units in which neither areas nor times of tiny or huge places vanish.
        unit = float(area.mean())
        self._area = area / unit
        matrix = sparse.diags_array(self._area) + (0.5 * length**2 / steps / unit) * make_laplacian(mesh)
        # Without pivots: a matrix with such signs needs none, and its factors then keep them, so that no density
        # becomes negative. Other components are other blocks, which nothing of this one reaches.
        self._solve = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve

    def __call__(self, amount: np.ndarray) -> np.ndarray:
        """The integrals over hat functions ``amount`` (V,) of an attention, after smoothing; their sum stays."""
        heat = np.asarray(amount, np.float64)
        for _ in range(self._steps):
            heat = self._area * self._solve(heat)
        return heat


# ---- Sums ----
#
# What observers or rays leave on a surface: sums that are added up in a fixed order.


@dataclass(frozen=True, eq=False)
class SurfaceSums:
    """Attention, weighted by whom it is of, all in float64.

    ``face`` (F,): the integral over each face; ``vertex`` (V,): that of the attention times the hat function of each
    vertex, which adds up to the same. ``elsewhere``: what ended at something else, ``escaped``: at nothing; ``total``:
    what there was; ``weight``: of the observers or rays, ``count`` of them.
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
        """Nothing yet."""
        return cls(np.zeros(faces), np.zeros(vertices))

    def add(self, other: SurfaceSums) -> SurfaceSums:
        """Both; the order in which sums are added decides their last digits."""
        return SurfaceSums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def on_surface(self) -> float:
        """What ended on the surface."""
        return float(self.face_sums.sum())

    @property
    def unaccounted(self) -> float:
        """What there was and was found nowhere: the error of the sums, where they are computed in two ways."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


def merge_sums(parts: Iterable[SurfaceSums]) -> SurfaceSums:
    """The sum of ``parts``, of which there is one at least, in their order."""
    parts = iter(parts)
    found = next(parts)
    for part in parts:
        found = found.add(part)
    return found


def deposit(faces: np.ndarray, vertices: int, face: np.ndarray, place: np.ndarray, what: np.ndarray):
    """``(on faces (F,), on vertices (V,))`` of ``what`` (P,) float64 that ends on the faces numbered ``face`` (P,), at
    the barycentric coordinates ``place`` (P, 3); ``faces`` (F, 3)."""
    on_faces = np.bincount(face, what, len(faces))
    corner = faces[face]
    on_vertices = np.bincount(corner.ravel(), (what[:, None] * place).ravel(), vertices)
    return on_faces, on_vertices
