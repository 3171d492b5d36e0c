"""Tests of `nerg_mi.environment.contents`."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.contents import load_content, load_mesh_child, to_scene_children
from nerg_mi.errors import NergError


def test01_names(rgb):
    ball = {"type": "sphere"}
    assert to_scene_children(None) == {}
    assert list(to_scene_children(ball, "thing")) == ["thing"]
    assert list(to_scene_children([ball, [ball, ball]])) == ["shape_0", "shape_1_0", "shape_1_1"]
    assert list(to_scene_children({"left": ball, "right": rgb.load_dict(ball)})) == ["left", "right"]


@pytest.mark.parametrize(
    "name", ["Cube.001", "camera", "integrator", "type", "$x", "a\x1b[31m", "", "x" * 300, "OTHER"]
)
def test03_names_that_scenes_use_or_forbid(tmp_path, name):
    trimesh = pytest.importorskip("trimesh")
    room = trimesh.Scene()
    for k, node in enumerate((name, "other")):
        room.add_geometry(trimesh.creation.box((1, 1, k + 1)), node_name=node)
    scene = nerg.make_scene(room, shapes=[room, room], camera=nerg.Camera((0, 0, 0), (1, 0, 0), width=8, height=8))
    scene.save(tmp_path / "scene.xml")
    # Files that differ by case only are one file in some folders.
    assert len({file.name.casefold() for file in (tmp_path / "scene.meshes").iterdir()}) == 6
    for each in (scene, nerg.Scene.load(tmp_path / "scene.xml")):
        shapes = each.mitsuba.shapes()
        assert sorted(round(shape.bbox().extents().z) for shape in shapes) == [1, 1, 1, 2, 2, 2]
        assert all(shape.id().isprintable() for shape in shapes)


def test02_a_scene_gives_its_shapes_and_lights(rgb):
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    scene = rgb.load_dict({"type": "scene", "lamp": lamp, "sky": {"type": "constant"}, "spot": {"type": "point"}})
    children = to_scene_children(scene)
    # The lamp has its own light.
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


def test04_files_are_checked_first(rgb, tmp_path):
    path = tmp_path / "cube.ply"
    rgb.load_dict({"type": "cube"}).write_ply(str(path))
    assert rgb.load_dict(load_mesh_child(path)).face_count() == 12
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(NergError, match="cube.ply"):
        load_mesh_child(path)
    # Mitsuba does not read quads; mesh arguments support them, with the material of other meshes.
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n")
    shape = load_content({"type": "scene", **to_scene_children(tmp_path / "quad.obj", "quad")}).shapes()[0]
    assert shape.face_count() == 2 and shape.id() == "quad" and shape.bsdf().class_name() == "TwoSidedBRDF"
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(NergError, match="empty.obj"):
        load_mesh_child(tmp_path / "empty.obj")


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("a.obj", "mtllib a.mtl\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n", "mtllib"),
        ("a.ply", PLY.format("uchar", "255 0 0 7"), "quality"),
        ("a.ply", PLY.format("float", "1 0 0 7"), "quality"),
    ],
)
def test_colours_of_files_are_used_and_other_content_is_reported(rgb, monkeypatch, tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    notes = []
    monkeypatch.setattr(rgb, "Log", lambda level, note: notes.append(note))
    child = load_mesh_child(tmp_path / name)
    (note,) = notes
    assert said in note and str(tmp_path / name) in note
    scene = load_content({"type": "scene", "a": child})
    si = scene.ray_intersect(rgb.Ray3f((0.2, 0.2, 1), (0, 0, -1)))
    assert np.allclose(np.ravel(si.bsdf().eval_diffuse_reflectance(si)), (1, 0, 0), atol=1e-4)


def test_saved_grids_are_loaded(tmp_path):
    rng = np.random.default_rng(0)
    grid = nerg.DensityGrid(rng.random((2, 3, 4)), (0, -1, 0), (1, 2, 3), rng.random((2, 3, 4, 3)))
    grid.save(tmp_path / "a.vol", tmp_path / "b.vol")
    again = nerg.DensityGrid.load(tmp_path / "a.vol", tmp_path / "b.vol")
    for name in ("density", "lower", "upper", "color"):
        np.testing.assert_array_equal(getattr(again, name), getattr(grid, name))
    with pytest.raises(NergError, match="3 channels"):
        nerg.DensityGrid.load(tmp_path / "b.vol")
