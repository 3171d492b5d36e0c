"""Shapes from files, dicts and objects, by name."""

import numpy as np
import pytest

from nerg_mi.api.scene import box_dict, mesh_child, scene_children
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


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property {0} red
property {0} green
property {0} blue
property float quality
element face 1
property list uchar int vertex_indices
end_header
0 0 0 {1}
1 0 0 {1}
0 1 0 {1}
3 0 1 2
"""


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


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("a.obj", "mtllib a.mtl\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n", "mtllib"),
        ("a.ply", PLY.format("uchar", "255 0 0 7"), "quality"),
        ("a.ply", PLY.format("float", "1 0 0 7"), "quality"),
    ],
)
def test_colours_of_files_are_shown_and_the_rest_is_named(rgb, monkeypatch, tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    notes = []
    monkeypatch.setattr(rgb, "Log", lambda level, note: notes.append(note))
    child = mesh_child(tmp_path / name)
    shape = child if isinstance(child, rgb.Mesh) else rgb.load_dict(child)
    (note,) = notes
    assert said in note and str(tmp_path / name) in note
    si = rgb.load_dict({"type": "scene", "a": shape}).ray_intersect(rgb.Ray3f((0.2, 0.2, 1), (0, 0, -1)))
    assert np.allclose(np.ravel(si.bsdf().eval_diffuse_reflectance(si)), (1, 0, 0), atol=1e-4)
