"""Tests of `nerg_mi.surfaces.laplacian`."""

import numpy as np
import pytest
import trimesh

from nerg_mi.surfaces.laplacian import (
    Smoother,
    SurfaceSums,
    deposit,
    find_twins,
    flip_to_delaunay,
    heron_area,
    make_laplacian,
    merge_sums,
)
from nerg_mi.surfaces.mesh import Mesh, weld_mesh
from tests.surfaces.meshes import box, joined, plate

# ---- Intrinsic flips: all weights become non-negative, and the surface does not change ----


def lengths_of(mesh):
    return np.linalg.norm(np.roll(mesh.corners, -1, axis=1) - mesh.corners, axis=2)


def angles_facing(lengths):
    a, b, c = (np.roll(lengths, -n, axis=1) for n in range(3))
    return np.arccos(np.clip((b * b + c * c - a * a) / (2 * b * c), -1, 1))


@pytest.mark.parametrize("mesh", [joined(plate(21, 0.45)), joined(box((0, 0, 0), (5, 0.1, 1)))])
def test_opposite_angles_sum_to_at_most_180_degrees(mesh):
    faces, lengths = flip_to_delaunay(mesh.faces, lengths_of(mesh))
    assert np.isclose(heron_area(*lengths.T).sum(), mesh.area.sum(), rtol=1e-9)
    assert np.allclose(angles_facing(lengths).sum(axis=1), np.pi)
    # The two angles opposite an edge sum to at most 180 degrees.
    total = {}
    for face, angle in zip(faces, angles_facing(lengths)):
        for k in range(3):
            edge = tuple(sorted((face[k], face[(k + 1) % 3])))
            total.setdefault(edge, []).append(angle[k])
    # Two vertices can share several edges, which are not distinguished here and are skipped.
    assert all(sum(v) < np.pi + 1e-6 for v in total.values() if len(v) == 2)
    assert len(faces) == len(mesh.faces) and set(np.unique(faces)) == set(np.unique(mesh.faces))


def test_delaunay_mesh_is_unchanged():
    mesh = joined(plate(8))
    faces, lengths = flip_to_delaunay(mesh.faces, lengths_of(mesh))
    assert np.array_equal(faces, mesh.faces) and np.array_equal(lengths, lengths_of(mesh))


def test_twins_of_manifold_edges():
    two = np.array([(0, 1, 2), (2, 1, 3)])
    assert find_twins(two).tolist() == [-1, 3, -1, 1, -1, -1]
    # Edges with three faces, or with two faces of the same orientation, are excluded.
    assert (find_twins(np.array([(0, 1, 2), (1, 0, 3), (0, 1, 4)])) == -1).all()
    assert (find_twins(np.array([(0, 1, 2), (0, 1, 3)])) == -1).all()


# ---- The Laplacian of regular and degenerate meshes ----


def sound(matrix):
    dense = matrix.toarray()
    off = dense - np.diag(np.diag(dense))
    assert np.isfinite(dense).all() and np.allclose(dense, dense.T)
    assert (off <= 0).all() and np.allclose(dense.sum(axis=1), 0, atol=1e-9 * np.abs(dense).max())
    return dense


def test_laplacian_of_a_grid_is_the_five_point_stencil():
    dense = sound(make_laplacian(joined(plate(7))))
    middle = 24
    assert np.isclose(dense[middle, middle], 4)
    assert sorted(np.flatnonzero(np.abs(dense[middle]) > 1e-12)) == [17, 23, 24, 25, 31]


def test_laplacian_of_linear_functions_is_zero():
    mesh = joined(plate(15, 0.3))
    inner = (np.abs(mesh.vertices[:, :2]) < 0.35).all(axis=1)
    for along in ((1, 0, 0), (0.3, -2, 0)):
        assert np.abs((make_laplacian(mesh) @ (mesh.vertices @ along))[inner]).max() < 1e-9


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_laplacian_of_degenerate_meshes(scale):
    needle = Mesh(
        np.array([(0, 0, 0), (1, 0, 0), (0.5, 1e-13, 0), (0.5, 1, 0)]) * scale, np.array([(0, 1, 2), (0, 2, 3)])
    )
    # Three triangles at one edge, and a separate triangle.
    book = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, -1, 0), (5, 5, 5), (6, 5, 5), (5, 6, 5)]) * scale
    pages = Mesh(book, np.array([(0, 1, 2), (0, 1, 3), (0, 1, 4), (5, 6, 7)]))
    for mesh in (needle, pages, joined(box((0, 0, 0), (1, 1, 1e-4)))):
        dense = sound(make_laplacian(mesh))
    dense = sound(make_laplacian(pages))
    assert (dense[:5, 5:] == 0).all() and dense[0, 1] < 0
    # The result does not depend on the unit of length.
    assert np.allclose(dense, make_laplacian(Mesh(book / scale, pages.faces)).toarray(), rtol=1e-6, atol=1e-9)


# ---- Smoothing ----
#
# Heat on surfaces against closed forms: Gaussians on a plane, harmonics on a sphere; and its invariants.


def spike(mesh, at=(0, 0, 0)):
    out = np.zeros(len(mesh.vertices))
    out[np.argmin(np.linalg.norm(mesh.vertices - at, axis=1))] = 1
    return out


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_point_is_smoothed_to_a_gaussian(jitter):
    mesh, s = joined(plate(61, jitter)), 0.07
    start = spike(mesh)
    origin = mesh.vertices[start > 0][0]
    exact = np.exp(-((mesh.vertices - origin) ** 2).sum(1) / (2 * s * s)) / (2 * np.pi * s * s) * mesh.vertex_area
    errors = [np.abs(Smoother(mesh, s, steps)(start) - exact).sum() for steps in (4, 16, 64)]
    assert errors[0] > 2 * errors[1] > 3 * errors[2] and errors[2] < 0.03
    for k in (0, 1):
        variance = (Smoother(mesh, s)(start) * (mesh.vertices - origin)[:, k] ** 2).sum()
        assert abs(variance / s**2 - 1) < (0.02 if jitter else 1e-3)


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_spherical_harmonics_decay(degree):
    ball = trimesh.creation.icosphere(4)
    mesh, s, steps = Mesh(np.array(ball.vertices), np.array(ball.faces)), 0.3, 8
    wave = np.polynomial.legendre.Legendre.basis(degree)(mesh.vertices[:, 2])
    result = Smoother(mesh, s, steps)(wave * mesh.vertex_area)
    left = (result * wave).sum() / (wave * wave * mesh.vertex_area).sum()
    rate = degree * (degree + 1) * s * s / 2
    # Exact for backward Euler steps, and for heat up to their order.
    assert np.isclose(left, (1 + rate / steps) ** -steps, rtol=6e-3)
    assert np.isclose(left, np.exp(-rate), rtol=rate**2 / steps + 6e-3)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_smoothing_does_not_cross_gaps(scale):
    """Two plates 5 cm apart: all heat of one stays there, and none reaches the other."""
    v, f = plate(20, 0.3)
    mesh, _, _ = weld_mesh(scale * np.concatenate([v, v + [0, 0, 0.05]]), np.concatenate([f, f + len(v)]))
    upper = mesh.vertices[:, 2] > 0.02 * scale
    start = np.where(upper, 0, np.random.default_rng(0).random(len(upper)))
    result = Smoother(mesh, 0.3 * scale)(start)
    assert (result[upper] == 0).all() and np.isclose(result.sum(), start.sum(), rtol=1e-10)
    assert result[~upper].min() > 0


def test_smoothing_keeps_uniform_densities_and_signs():
    needles = joined(box((0, 0, 0), (3, 1e-3, 1)), box((1, 2, 0), (4, 2 + 1e-7, 1e-4)))
    for mesh in (needles, joined(plate(12, 0.49))):
        smoother = Smoother(mesh, 0.2)
        assert np.allclose(smoother(mesh.vertex_area), mesh.vertex_area, rtol=1e-6)
        for k in range(0, len(mesh.vertices), 7):
            start = np.zeros(len(mesh.vertices))
            start[k] = 1.0
            result = smoother(start)
            assert result.min() >= 0 and np.isclose(result.sum(), 1, rtol=1e-9)
        assert not smoother(np.zeros(len(mesh.vertices))).any()


@pytest.mark.parametrize("length, steps", [(0.0, 8), (np.nan, 8), (0.1, 0)])
def test_invalid_lengths_are_refused(length, steps):
    with pytest.raises(ValueError, match="positive length"):
        Smoother(joined(plate(3)), length, steps)


# ---- Partial sums ----


def test_deposit_conserves_its_sum():
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    place = np.array([(0.2, 0.3, 0.5), (1.0, 0, 0), (0, 0.25, 0.75)])
    on_faces, on_vertices = deposit(faces, 5, np.array([0, 1, 1]), place, np.array([1.0, 2.0, 4.0]))
    assert on_faces.tolist() == [1, 6]
    assert np.allclose(on_vertices, [0.2, 0.3 + 1.0, 0.5 + 2.0, 3.0, 0])


def test_sums_are_added_in_order():
    rng = np.random.default_rng(0)
    parts = [SurfaceSums(rng.random(3), rng.random(4), *rng.random(4), 1) for _ in range(5)]
    whole_result = merge_sums(parts)
    assert np.array_equal(
        whole_result.face_sums,
        ((((parts[0].face_sums + parts[1].face_sums) + parts[2].face_sums) + parts[3].face_sums) + parts[4].face_sums),
    )
    assert whole_result.count == 5 and np.isclose(whole_result.weight, sum(p.weight for p in parts))
    assert np.isclose(
        whole_result.unaccounted,
        whole_result.total - whole_result.face_sums.sum() - whole_result.elsewhere - whole_result.escaped,
    )
    assert SurfaceSums.zeros(2, 3).on_surface == 0
