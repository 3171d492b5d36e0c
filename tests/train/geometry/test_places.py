"""Places: frames and boxes, and damaged files of hit points (Mitsuba believes their headers)."""

from __future__ import annotations

import struct

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.splats import Splats, joined
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.rendering.scene import files_of_scene
from nerg_mi.train.geometry import GazePlace, place_of_field, place_of_nothing, place_of_scene, place_of_volume
from nerg_mi.transport.geometry import trace_depth
from tests.formats.splats.writers import random_splats


@pytest.fixture
def volume(tmp_path):
    path = tmp_path / "place.vol"
    write_volume(path, np.eye(3, dtype=np.float32)[None] + np.zeros((4, 1, 1)), (0, 0, 0), (1, 2, 3))
    return path


def test_a_whole_one(rgb, volume):
    # Mitsuba returns the box by a transform in single precision.
    assert np.allclose(place_of_volume(volume).box.upper, (1, 2, 3), rtol=1e-6)


@pytest.mark.parametrize(
    "at, value",
    [
        (0, b"XOL"),
        (3, b"\x02"),
        (4, struct.pack("<i", 2)),
        (8, struct.pack("<i", -3)),
        (8, struct.pack("<i", 0)),
        (12, struct.pack("<i", 2**31 - 1)),
        (20, struct.pack("<i", -1)),
        (20, struct.pack("<i", 10**9)),
        (24, struct.pack("<f", np.nan)),
        (36, struct.pack("<f", -1)),
    ],
)
def test_a_header_that_lies(rgb, volume, at, value):
    data = volume.read_bytes()
    volume.write_bytes(data[:at] + value + data[at + len(value) :])
    with pytest.raises(NergError, match="place.vol"):
        place_of_volume(volume)


@pytest.mark.parametrize("size", [0, 10, 30, 48, 100])
def test_one_that_is_cut_off(rgb, volume, size):
    volume.write_bytes(volume.read_bytes()[:size])
    with pytest.raises(NergError, match="place.vol"):
        place_of_volume(volume)


def test_frames_of_rays_and_place():
    """Twice the size, a quarter turn about z, and moved."""
    align = Similarity([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    place = GazePlace(None, Box((0, 0, 0), (1, 1, 1)), "none", align=align)
    np.testing.assert_allclose(place.points_from_rays(np.array([[1.0, 0, 0], [0, 1, 1]])), [[1, 4, 3], [-1, 2, 5]])
    d = np.array([[[0.6, 0.8, 0], [0, 0, 1.0]]])
    turned = place.directions_from_rays(d)
    np.testing.assert_allclose(turned, [[[-0.8, 0.6, 0], [0, 0, 1]]], atol=1e-12)
    np.testing.assert_allclose(place.directions_to_rays(turned), d, atol=1e-12)


def test_without_geometry_the_box_is_around_whoever_looked():
    assert place_of_nothing(np.array([[0.0, 1, 2], [1, 0, 2]])).box == Box((-2, -2, 0), (3, 3, 4))


def test_a_scenes_box_holds_its_field_and_its_shapes_and_a_hundredth_more(rgb, tmp_path):
    (tmp_path / "both.xml").write_text("""<scene version="3.0.0">
      <integrator type="nerg"><volume name="density" type="constvolume"><float name="value" value="1"/>
      </volume></integrator>
      <shape type="cube"><transform name="to_world"><translate x="-2" y="-2" z="-3"/></transform></shape></scene>""")
    box = place_of_scene(tmp_path / "both.xml").box
    np.testing.assert_allclose([box.lower, box.upper], [[-3.05, -3.05, -4.05], [1.05, 1.05, 1.05]], atol=1e-6)


@pytest.mark.parametrize("name", ["a.ply", "a.obj"])
def test_a_mesh_is_a_scene_of_its_own(rgb, tmp_path, name):
    rgb.load_dict({"type": "cube"}).write_ply(str(tmp_path / "a.ply"))
    corners, faces = "-1 -1 -1|1 -1 -1|1 1 -1|-1 1 1".split("|"), ("1 2 3", "1 3 4")
    (tmp_path / "a.obj").write_text("".join(f"v {c}\n" for c in corners) + "".join(f"f {f}\n" for f in faces))
    place = place_of_scene(tmp_path / name)
    np.testing.assert_allclose([place.box.lower, place.box.upper], [[-1.02] * 3, [1.02] * 3], atol=1e-6)
    assert place.kind == "scene" and place.about["scene_file"]["file"] == name
    assert files_of_scene(tmp_path / name) == [tmp_path / name]


def test_splats_are_no_scene(rgb, tmp_path):
    write_ply_splats(tmp_path / "a.ply", random_splats(10))
    with pytest.raises(NergError, match="--field"):
        place_of_scene(tmp_path / "a.ply")


def test_a_scene_without_anything_is_no_place(rgb, tmp_path):
    (tmp_path / "empty.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="neither shapes nor a field"):
        place_of_scene(tmp_path / "empty.xml")


def test_splats_are_a_place_without_their_strays(tmp_path):
    splats = random_splats(1000, degree=0, size=0.02)
    far = Splats([[90, 0, 0]], [[1, 1, 1]], [[1, 0, 0, 0]], [0.5], np.zeros((1, 1, 3)))
    write_ply_splats(tmp_path / "a.ply", joined([splats, far]))
    place = place_of_field(tmp_path / "a.ply", ns)
    assert place.kind == "field" and place.radiance is None and place.about["field_file"]["file"] == "a.ply"
    assert np.allclose(place.box.upper, 1, atol=0.15) and np.allclose(place.box.lower, -1, atol=0.15)
    origin, along = np.float32([[0, 0, -3]]), np.float32([[0, 0, 1]])
    # Trained in as it is rendered.
    assert 1.9 < trace_depth(place.medium, origin, along)[0][0] < 4.1
