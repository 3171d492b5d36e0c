"""Meshes made whole: vertices of one place are one, and faces that are none are left out."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.surfaces.mesh import weld
from tests.surfaces.meshes import box


def test01_a_box_whose_sides_repeat_its_corners_is_one_surface():
    v, f = box((0, 0, 0), (1, 2, 3))
    mesh, index, repairs = weld(v[f].reshape(-1, 3), np.arange(f.size).reshape(-1, 3))
    assert (len(mesh.vertices), len(mesh.faces), repairs.merged) == (8, 12, 28)
    assert np.array_equal(index, np.arange(12)) and np.isclose(mesh.area.sum(), 22)
    assert np.allclose(mesh.corners, v[f]) and np.isclose(mesh.vertex_area.sum(), 22)
    assert np.isclose(mesh.diagonal, np.sqrt(14)) and np.isclose(mesh.longest.max(), np.sqrt(13))
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test02_a_hair_keeps_plates_apart_and_zeros_of_both_signs_are_one_place():
    v = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (-0.0, 0, 0), (0, 1, 1e-9), (1, 0, 0)])
    mesh, _, _ = weld(v, [(0, 1, 2), (3, 4, 5)])
    assert len(mesh.vertices) == 4


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
def test03_flat_and_repeated_faces_are_left_out_at_any_scale(scale):
    v = scale * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (9, 9, 9)])
    mesh, index, repairs = weld(v, [(0, 1, 2), (0, 1, 3), (1, 1, 2), (2, 0, 1), (2, 1, 0)])
    assert index.tolist() == [0] and (repairs.flat, repairs.repeated) == (2, 2)
    assert repairs.sentence == "2 faces without area left out, 2 faces that repeat others left out"
    assert len(mesh.vertices) == 3 and np.isclose(mesh.area[0], scale**2 / 2)
    assert weld(v, [(0, 1, 2)])[2].sentence is None


def test04_what_is_no_surface():
    with pytest.raises(NergError, match="vertices of the wall"):
        weld([(0, 0, np.nan)], [(0, 0, 0)], "the wall")
    with pytest.raises(NergError, match="row 1 is"):
        weld([(0, 0, 0), (0, 0, 1.1e7), (1, 0, 0)], [(0, 1, 2)])
    with pytest.raises(NergError, match="no face with an area"):
        weld([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)])
