"""Meshes and gaze densities for tests of gaze on surfaces."""

from __future__ import annotations

import numpy as np

from nerg_mi.fields.splats import Splats
from nerg_mi.surfaces.mesh import Mesh, weld_mesh
from nerg_mi.surfaces.sources import SurfaceObserver

_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def box(lower, upper, without: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles of a box; ``without``: index of the omitted side, in the order x, x, y, y, z, z."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    corners = np.asarray(lower) + corners * (np.asarray(upper, float) - lower)
    quads = [q for k, q in enumerate(_QUADS) if k != without]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def joined(*parts) -> Mesh:
    """One mesh of several vertices and faces."""
    start = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([f + s for (_, f), s in zip(parts, start)])
    return weld_mesh(np.concatenate([v for v, _ in parts]), faces)[0]


def longest_edge(mesh: Mesh) -> float:
    return float(np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2).max())


def plate(n: int, jitter: float = 0.0, side: float = 1.0, z: float = 0.0, seed: int = 0) -> tuple:
    """A square sheet of n x n vertices around the origin; inner vertices are moved by at most ``jitter`` cells."""
    x = np.linspace(-side / 2, side / 2, n)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.full((n, n), z)], axis=-1).reshape(-1, 3)
    inner = (np.abs(p[:, :2]) < side / 2 - 1e-9).all(axis=1)
    p[inner, :2] += np.random.default_rng(seed).uniform(-jitter, jitter, (inner.sum(), 2)) * side / (n - 1)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return p, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def vmf(mi, mu, kappa: float):
    """The von Mises-Fisher density, in 1/sr, of Dr.Jit directions."""
    import drjit as dr

    mean = mi.Vector3f(*(np.asarray(mu, float) / np.linalg.norm(mu)).tolist())
    scale = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    return lambda d: scale * dr.exp(kappa * (dr.dot(mean, d) - 1))


def observers_from_law(law):
    """Observers with a density ``law`` of unit directions, in 1/sr, that does not depend on the position."""
    import mitsuba as mi

    def make(eye):
        center = mi.Point3f(np.asarray(eye, float).tolist())
        return SurfaceObserver(center, lambda p_od, p_o, r_o, active: law(r_o), law)

    return make


# ---- Walls of flat Gaussians that overlap ----

TURN_X = (0.0, 1.0, 0.0, 0.0)
"""By half a turn around x: what points along z points against it."""


def wall(z=0.0, side=1.0, offset=0.02, jitter=0.0, opacity=0.9, turned=(1.0, 0.0, 0.0, 0.0), seed=0) -> Splats:
    """A square wall in the plane ``z`` around the axis, of disks with the spacing ``offset`` and 0.7 of it as scale."""
    rng = np.random.default_rng(seed)
    x = np.arange(-side / 2 + offset / 2, side / 2, offset)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.full((len(x), len(x)), z)], axis=-1).reshape(-1, 3)
    p[:, 2] += jitter * rng.normal(size=len(p))
    n = len(p)
    scales = np.tile([0.7 * offset, 0.7 * offset, 1e-3], (n, 1))
    return Splats(p, scales, np.tile(turned, (n, 1)), np.full(n, opacity), np.zeros((n, 1, 3)))
