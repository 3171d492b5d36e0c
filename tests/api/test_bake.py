"""`nerg_mi.api.workflows`: its example, and rays in memory or in a file."""

import doctest

import numpy as np
import pytest

import nerg_mi.api.workflows as module
from nerg_mi.api.workflows import bake
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.rays.rays import Rays
from tests.surfaces.meshes import box


@pytest.mark.nightly
def test01_the_example_runs(rgb):
    assert doctest.testmod(module).failed == 0


def test02_rays_in_memory_and_in_a_file_are_one(rgb, tmp_path):
    v, f = box((0, 0, 0), (4, 3, 2.5))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    rays = Rays([0.0, 0.1], [0, 0], ("a",), np.ones((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]]), np.ones(2))
    rays.save(tmp_path / "a.npz")
    first = bake(tmp_path / "room.ply", rays=rays, detail=1.0)
    second = bake(str(tmp_path / "room.ply"), str(tmp_path / "b.json"), rays=str(tmp_path / "a.npz"), detail=1.0)
    assert np.array_equal(first.density, second.density) and second.files == (tmp_path / "b.json",)
    with pytest.raises(NergError, match='"smoth".*"smooth"'):
        bake(tmp_path / "room.ply", rays=rays, smoth=0.1)
