"""Cells of rays: bounds of ellipsoids against points of them in float64, and the cells of rays that meet these."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.transport.ray_cells import CubeCells, Ellipsoids, LensCells, ParallelCells, RayCells

RNG = np.random.default_rng(0)
AXES = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
PLANE = AXES, (-1.5, -1.0), (1.5, 1.0), (60, 40)
FOCUS = 2.0
KINDS = {
    "point": RayCells(*PLANE),
    "cube": CubeCells(20),
    "parallel": ParallelCells(*PLANE),
    "lens": LensCells(*PLANE, radius=0.05, focus=FOCUS).adapt(1, np.zeros(3)),
    "one tile": LensCells(*PLANE, radius=0.4, focus=FOCUS),
    "large lens": LensCells(*PLANE, radius=0.8, focus=FOCUS).adapt(1, np.zeros(3)),
    "few tiles": LensCells(*PLANE, radius=0.8, focus=FOCUS).adapt(1 << 24, np.zeros(3)),
}


def make_ellipsoids(count=300):
    """In front of, behind and across the plane of the lens; some contain the centre."""
    rng = np.random.default_rng(1)
    center = rng.uniform([-2, -2, -1], [2, 2, 6], (count, 3)) @ AXES
    scales = 0.2 * np.exp(rng.normal(0, 1, (count, 3)))
    semi_axes = quaternions_to_matrices(rng.normal(size=(count, 4))) * scales[:, None]
    return center, semi_axes, rng.uniform(0.1, 9, count)


def make_rays(kind, cells, p):
    """Origins and directions of rays through points ``p`` in front of the camera, with random lens points."""
    rng, z = np.random.default_rng(2), p @ AXES[2]
    if kind == "parallel":
        return p - (z + 3)[:, None] * AXES[2], np.broadcast_to(AXES[2], p.shape)
    if kind in ("point", "cube"):
        return np.zeros_like(p), p
    φ, r = rng.uniform(0, 2 * np.pi, len(p)), cells.radius * rng.uniform(0, 1, len(p)) ** 0.1
    lens = np.column_stack([r * np.cos(φ), r * np.sin(φ)]) @ AXES[:2]
    start = rng.uniform(0, 1, (len(p), 1))
    return lens + start * (p - lens), (p - lens) * (1 - start)


@pytest.mark.parametrize("kind", KINDS)
def test_all_rays_that_meet_an_ellipsoid_are_in_its_cells(rgb, kind):
    ns, (center, semi_axes, square) = namespace(rgb.Float), make_ellipsoids()
    array = lambda v: ns.Array3f(*np.asarray(v, np.float32).T)
    cells = KINDS[kind].prepare(ns)
    ellipsoids = Ellipsoids(
        array(center), [array(semi_axes[:, :, i]) for i in range(3)], ns.Float(square.astype(np.float32))
    )
    bounds = [[[np.array(v) for v in b] for b in cells.bound(ellipsoids, face)] for face in range(cells.num_faces)]
    directions = np.random.default_rng(3).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    (nu, nv), num_seen, reached = cells.cells, 0, []
    for i in range(len(center)):
        p = center[i] + np.sqrt(square[i]) * directions @ semi_axes[i].T
        if kind not in ("cube", "parallel"):
            p = p[p @ AXES[2] > 1e-3]
        o, d = make_rays(kind, cells, p)
        if len(p) == 0:
            continue
        number = np.array(cells.find_cell(array(o), array(d))).astype(int)
        face, v, u = number // (nu * nv), number // nu % nv, number % nu
        for k, position, count in ((0, u, nu), (1, v, nv)):
            low, high = np.array([[b[k][0][i], b[k][1][i]] for b in bounds])[face].T
            is_inside = (position > 0) & (position < count - 1)  # Others can be outside of all cells
            assert np.all(position[is_inside] >= np.floor(low - 0.02)[is_inside])
            assert np.all(position[is_inside] <= np.floor(high + 0.02)[is_inside])
            num_seen += is_inside.sum()
            finite = is_inside.all() and np.isfinite(low + high).all() and cells.num_faces == 1
            if finite:
                reached.append(((position.max() - position.min()), (high - low).max()))
    assert num_seen > 10000
    if reached:
        extent, bound = np.transpose(reached)
        assert np.mean(bound - extent < 1.5 + 0.1 * bound) > 0.95


@pytest.mark.parametrize("kind", ["point", "lens", "large lens", "parallel"])
def test_ellipsoids_behind_the_camera_have_no_cells(rgb, kind):
    ns, cells = namespace(rgb.Float), KINDS[kind].prepare(namespace(rgb.Float))
    center = ns.Array3f(*(-3 * AXES[2]).tolist())
    unit = [ns.Array3f(*row) for row in (0.3 * np.eye(3)).tolist()]
    for face in range(cells.num_faces):
        (low, high), _ = cells.bound(Ellipsoids(center, unit, ns.Float(4)), face)
        assert dr.all(low > high) == (kind != "parallel")


def test_a_small_lens_bounds_as_a_point(rgb):
    ns, (center, semi_axes, square) = namespace(rgb.Float), make_ellipsoids()
    array = lambda v: ns.Array3f(*np.asarray(v, np.float32).T)
    ellipsoids = Ellipsoids(array(center), [array(semi_axes[:, :, i]) for i in range(3)], ns.Float(square))
    bound = lambda cells: np.array([v for b in cells.prepare(ns).bound(ellipsoids, 0) for v in b])
    np.testing.assert_allclose(bound(LensCells(*PLANE, radius=1e-9, focus=FOCUS)), bound(RayCells(*PLANE)), atol=1e-3)


def test_bounds_of_many_ellipsoids_have_little_memory():
    lens = LensCells(*PLANE, radius=2.0, focus=FOCUS)
    tiles = [lens.adapt(count, np.zeros(3)).num_faces for count in (1, 1 << 20, 1 << 24, 1 << 28)]
    assert tiles == [64, 64, 4, 1]
