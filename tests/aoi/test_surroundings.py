"""What files say of a place: surfaces, gaze, frames."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.aoi.scene import surroundings_of_files
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity

from .place import first_box, people, write_place


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("place")
    write_place(made)
    (made / "bare").mkdir()
    write_place(made / "bare", gaze=False)
    return made


def test01_depths_are_those_of_the_shapes(folder):
    around = surroundings_of_files(folder / "bare" / "scene.xml", None, None, None, ns)
    rays = people()
    expected = [first_box(o, d)[1] for o, d in zip(rays.origin, rays.direction)]
    assert np.allclose(around.depth(rays.origin, rays.direction), expected, rtol=1e-4) and around.gaze is None
    assert np.allclose(around.bounds(), [[0, 0, 0], [6, 4, 3]], atol=1e-5)


def test02_gaze_of_the_scene_or_beside_it(folder):
    d = np.array([[1.0, 0, 0], [0, 1, 0]])
    own = surroundings_of_files(folder / "scene.xml", None, None, None, ns)
    beside = surroundings_of_files(folder / "bare" / "scene.xml", None, folder / "gaze.safetensors", None, ns)
    eye = np.array([1.0, 1.0, 1.5])
    found, other = own.look_from(eye)(d), beside.look_from(eye)(d)
    assert found[0].shape == (1, 2) and np.allclose(found[0], other[0], rtol=1e-4)
    assert np.allclose(found[1], own.depth(np.broadcast_to(eye, d.shape), d)) and np.allclose(found[1], other[1])
    assert np.isnan(own.support(eye))


def test03_frames(folder):
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[:3, 3] = 1, 0, 0
    around = surroundings_of_files(folder / "scene.xml", None, None, Similarity(matrix), ns)
    assert around.scale == pytest.approx(2) and np.allclose(around.points(np.ones(3)), [3, 2, 2])
    assert np.allclose(around.directions(np.array([0, 0, 1.0])), [0, 0, 1])


def test04_nothing_is_known(folder):
    around = surroundings_of_files(None, None, None, None, ns)
    assert np.isinf(around.depth(np.zeros((3, 3)), np.eye(3))).all()
    with pytest.raises(NergError, match="no place"):
        around.bounds()


def test05_two_places(folder):
    with pytest.raises(NergError, match="both a place"):
        surroundings_of_files(folder / "scene.xml", folder / "field.safetensors", None, None, ns)
    (folder / "empty.xml").write_text('<scene version="3.0.0"><integrator type="path"/></scene>')
    with pytest.raises(NergError, match="neither shapes nor a field"):
        surroundings_of_files(folder / "empty.xml", None, None, None, ns)
