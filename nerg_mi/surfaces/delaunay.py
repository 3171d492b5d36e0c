"""Triangles of the same surface whose Laplacian is a good one: edges flipped, intrinsically, until none is worth it.

The surface stays what it is; only along which straight lines its triangles meet changes, as if they were folded flat in
pairs (B. Springborn, A. Bobenko 2007; M. Fisher et al. 2007). After it no edge faces angles of more than 180 degrees
together, so that no weight of the cotangent Laplacian is negative, however long and thin triangles were. Edges of one
triangle, or of more than two, stay.
"""

from __future__ import annotations

import numpy as np

ROUNDS = 2000
"""Flips that do not touch each other are made in one round; more rounds than these are not made."""

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
