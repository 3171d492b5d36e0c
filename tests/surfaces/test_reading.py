"""Shapes of scenes as triangles."""

import numpy as np

from nerg_mi.surfaces.mesh import shape_triangles


def test01_shapes_of_scenes(rgb):
    flat = rgb.load_dict(
        {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([1, 2, 3]).scale([2, 1, 1])}
    )
    vertices, faces = shape_triangles(flat)
    assert np.allclose(sorted(map(tuple, vertices)), [(-1, 1, 3), (-1, 3, 3), (3, 1, 3), (3, 3, 3)])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.allclose(np.cross(b - a, c - a).sum(axis=0), [0, 0, 16])
    assert len(shape_triangles(rgb.load_dict({"type": "cube"}))[1]) == 12
    assert shape_triangles(rgb.load_dict({"type": "sphere"})) is None
