"""Intrinsic flips: no weight is negative any more, and the surface is what it was."""

import numpy as np
import pytest

from nerg_mi.surfaces.laplacian import delaunay, heron, twins
from tests.surfaces.meshes import box, joined, plate


def lengths_of(mesh):
    return np.linalg.norm(np.roll(mesh.corners, -1, axis=1) - mesh.corners, axis=2)


def angles_facing(lengths):
    a, b, c = (np.roll(lengths, -n, axis=1) for n in range(3))
    return np.arccos(np.clip((b * b + c * c - a * a) / (2 * b * c), -1, 1))


@pytest.mark.parametrize("mesh", [joined(plate(21, 0.45)), joined(box((0, 0, 0), (5, 0.1, 1)))])
def test01_no_edge_faces_more_than_two_right_angles(mesh):
    faces, lengths = delaunay(mesh.faces, lengths_of(mesh))
    assert np.isclose(heron(*lengths.T).sum(), mesh.area.sum(), rtol=1e-9)
    assert np.allclose(angles_facing(lengths).sum(axis=1), np.pi)
    # In the plane flips are those of the points: SciPy's circles are empty, too.
    total = {}
    for face, angle in zip(faces, angles_facing(lengths)):
        for k in range(3):
            edge = tuple(sorted((face[k], face[(k + 1) % 3])))
            total.setdefault(edge, []).append(angle[k])
    # Of pairs; an edge that two flips made twice is counted with its own two.
    assert all(sum(v) < np.pi + 1e-6 for v in total.values() if len(v) == 2)
    assert len(faces) == len(mesh.faces) and set(np.unique(faces)) == set(np.unique(mesh.faces))


def test02_what_is_delaunay_stays():
    mesh = joined(plate(8))
    faces, lengths = delaunay(mesh.faces, lengths_of(mesh))
    assert np.array_equal(faces, mesh.faces) and np.array_equal(lengths, lengths_of(mesh))


def test03_twins_are_those_of_sheets():
    two = np.array([(0, 1, 2), (2, 1, 3)])
    assert twins(two).tolist() == [-1, 3, -1, 1, -1, -1]
    # Three faces at an edge, and two that see it alike, are none.
    assert (twins(np.array([(0, 1, 2), (1, 0, 3), (0, 1, 4)])) == -1).all()
    assert (twins(np.array([(0, 1, 2), (0, 1, 3)])) == -1).all()
