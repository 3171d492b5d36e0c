"""Shapes from files, dicts and objects, by name."""

import numpy as np
import pytest

from nerg_mi.api.shapes import box_dict, mesh_child, scene_children
from nerg_mi.errors import NergError


def test01_names(rgb):
    ball = {"type": "sphere"}
    assert scene_children(None) == {}
    assert list(scene_children(ball, "thing")) == ["thing"]
    assert list(scene_children([ball, [ball, ball]])) == ["shape_0", "shape_1_0", "shape_1_1"]
    assert list(scene_children({"left": ball, "right": rgb.load_dict(ball)})) == ["left", "right"]


def test02_a_scene_gives_its_shapes_and_lights(rgb):
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    scene = rgb.load_dict({"type": "scene", "lamp": lamp, "sky": {"type": "constant"}, "spot": {"type": "point"}})
    children = scene_children(scene)
    # The lamp brings its own light.
    assert set(children) == {"lamp", "shape_light_0", "shape_light_1"}
    again = rgb.load_dict({"type": "scene", **children})
    assert len(again.emitters()) == 3 and len(again.shapes()) == 1


def test03_a_box_reaches_from_corner_to_corner(rgb):
    box = rgb.load_dict(box_dict(np.array((1.0, 2, 3)), np.array((2.0, 5, 4)))).bbox()
    assert np.allclose(np.ravel(box.min), (1, 2, 3)) and np.allclose(np.ravel(box.max), (2, 5, 4))


def test04_files_are_looked_at_first(rgb, tmp_path):
    path = tmp_path / "cube.ply"
    rgb.load_dict({"type": "cube"}).write_ply(str(path))
    assert rgb.load_dict(mesh_child(path)).face_count() == 12
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(NergError, match="cube.ply"):
        mesh_child(path)
    # Mitsuba reads no quads; what takes a mesh does, with the material that others have.
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n")
    shape = rgb.load_dict({"type": "scene", **scene_children(tmp_path / "quad.obj", "quad")}).shapes()[0]
    assert shape.face_count() == 2 and shape.id() == "quad" and shape.bsdf().class_name() == "TwoSidedBRDF"
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(NergError, match="empty.obj"):
        mesh_child(tmp_path / "empty.obj")
