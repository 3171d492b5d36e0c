"""Parts of a bake of splats: the same wherever and however often they are computed."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.surfaces.sources import Crowd, RaySettings
from nerg_mi.workflows.bake_chunks import SplatScene, splat_place
from tests.surfaces.test_splat_rays import falling
from tests.surfaces.walls import wall

RAYS = RaySettings(cone=0.03, bundle=4)


@pytest.fixture
def scene(tmp_path, rgb):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    return SplatScene(tmp_path / "wall.ply", len(plain), of_rays=RAYS)


def test01_a_pickled_scene_gives_the_same_and_another_file_is_another_scene(scene):
    rays = falling(100, 0.5)
    first = scene.sums(rays)
    again = pickle.loads(pickle.dumps(scene))
    assert np.array_equal(again.sums(rays).face, first.face)
    assert len(first.face) == len(scene.nothing.face) == 2 * 64 and not len(first.vertex)
    write_ply_splats(scene.splats, wall(0.1, 0.4, 0.05))
    moved = replace(scene)
    assert not np.array_equal(moved.sums(rays).face, first.face)


def test02_without_a_field_nobody_looks(scene):
    with pytest.raises(NergError, match="there is no gaze field"):
        scene.sums(Crowd(np.ones((1, 3)), np.ones(1)))


def test03_how_far_apart_two_ideas_of_a_surface_may_be(rgb):
    assert np.isclose(splat_place(wall(0.0, 0.2)).tolerance, 2 * 1e-3)
