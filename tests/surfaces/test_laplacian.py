"""The Laplacian of meshes, good and bad."""

import numpy as np
import pytest

from nerg_mi.surfaces.laplacian import laplacian
from nerg_mi.surfaces.mesh import Mesh
from tests.surfaces.meshes import box, joined, plate


def sound(matrix):
    dense = matrix.toarray()
    off = dense - np.diag(np.diag(dense))
    assert np.isfinite(dense).all() and np.allclose(dense, dense.T)
    assert (off <= 0).all() and np.allclose(dense.sum(axis=1), 0, atol=1e-9 * np.abs(dense).max())
    return dense


def test01_of_a_square_grid_it_is_the_five_point_stencil():
    dense = sound(laplacian(joined(plate(7))))
    middle = 24
    assert np.isclose(dense[middle, middle], 4)
    assert sorted(np.flatnonzero(np.abs(dense[middle]) > 1e-12)) == [17, 23, 24, 25, 31]


def test02_linear_functions_have_none_on_any_triangles_of_a_plane():
    mesh = joined(plate(15, 0.3))
    inner = (np.abs(mesh.vertices[:, :2]) < 0.35).all(axis=1)
    for along in ((1, 0, 0), (0.3, -2, 0)):
        assert np.abs((laplacian(mesh) @ (mesh.vertices @ along))[inner]).max() < 1e-9


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test03_needles_books_and_components(scale):
    needle = Mesh(
        np.array([(0, 0, 0), (1, 0, 0), (0.5, 1e-13, 0), (0.5, 1, 0)]) * scale, np.array([(0, 1, 2), (0, 2, 3)])
    )
    # Three pages of a book at one edge, and a triangle apart.
    book = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, -1, 0), (5, 5, 5), (6, 5, 5), (5, 6, 5)]) * scale
    pages = Mesh(book, np.array([(0, 1, 2), (0, 1, 3), (0, 1, 4), (5, 6, 7)]))
    for mesh in (needle, pages, joined(box((0, 0, 0), (1, 1, 1e-4)))):
        dense = sound(laplacian(mesh))
    dense = sound(laplacian(pages))
    assert (dense[:5, 5:] == 0).all() and dense[0, 1] < 0
    # Free of the unit of length.
    assert np.allclose(dense, laplacian(Mesh(book / scale, pages.faces)).toarray(), rtol=1e-6, atol=1e-9)
