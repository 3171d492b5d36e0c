"""Meshes from files, the same in all of them."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.gltf import shown_unlit
from nerg_mi.formats.ply import write_columns
from nerg_mi.surfaces.reading import read_mesh, shape_triangles
from tests.surfaces.meshes import box


def test01_ply_obj_and_glb_give_the_same_triangles(rgb, tmp_path):
    v, f = box((0, 0, 0), (1, 2, 3))
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), f)
    lines = [f"v {x} {y} {z}" for x, y, z in v] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in f]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    (tmp_path / "a.glb").write_bytes(b"".join(shown_unlit([("POSITION", v.astype("<f4"), False)], f)))
    for name in ("a.ply", "a.obj", "a.glb"):
        vertices, faces = read_mesh(tmp_path / name)
        assert np.allclose(vertices[faces], v[f], atol=1e-6), name


def test02_shapes_of_scenes(rgb):
    flat = rgb.load_dict(
        {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([1, 2, 3]).scale([2, 1, 1])}
    )
    vertices, faces = shape_triangles(flat)
    assert np.allclose(sorted(map(tuple, vertices)), [(-1, 1, 3), (-1, 3, 3), (3, 1, 3), (3, 3, 3)])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.allclose(np.cross(b - a, c - a).sum(axis=0), [0, 0, 16])
    assert len(shape_triangles(rgb.load_dict({"type": "cube"}))[1]) == 12
    assert shape_triangles(rgb.load_dict({"type": "sphere"})) is None


def test03_what_is_no_mesh(tmp_path):
    with pytest.raises(NergError, match=r"one that ends in \.ply, \.obj, \.glb"):
        read_mesh(tmp_path / "a.stl")
    with pytest.raises(NergError, match="there is no mesh"):
        read_mesh(tmp_path / "a.glb")
