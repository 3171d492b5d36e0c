"""PLY files with columns of their own, as trimesh and Mitsuba read them."""

import numpy as np
import trimesh

from nerg_mi.formats.ply import write_columns

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 1, 2], [0, 3, 1]])


def test_triangles_with_columns(tmp_path):
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)
    columns = dict(zip("xyz", CORNERS.T)) | dict(zip(("red", "green", "blue"), colors.T))
    write_columns(tmp_path / "new" / "a.ply", columns, FACES)
    body = trimesh.load(tmp_path / "new" / "a.ply", process=False)
    assert np.array_equal(body.vertices, CORNERS) and np.array_equal(body.faces, FACES)
    assert np.array_equal(body.visual.vertex_colors[:, :3], colors)


def test_points_have_no_faces(tmp_path):
    write_columns(tmp_path / "p.ply", dict(zip("xyz", CORNERS.T)))
    raw = (tmp_path / "p.ply").read_bytes()
    head, _, data = raw.partition(b"end_header\n")
    assert b"element face" not in head and np.array_equal(np.frombuffer(data, "<f4").reshape(-1, 3), CORNERS)


def test_columns_of_faces_are_an_attribute_in_mitsuba(rgb, tmp_path):
    tints = np.array([[0.25, 0.5, 0.75], [1, 0, 0.125]])
    of_faces = {f"color_{k}": tints[:, k] for k in range(3)}
    write_columns(tmp_path / "f.ply", dict(zip("xyz", CORNERS.T)), FACES, of_faces)
    mesh = rgb.load_dict({"type": "ply", "filename": str(tmp_path / "f.ply")})
    assert np.allclose(np.array(rgb.traverse(mesh)["face_color"]).reshape(-1, 3), tints)
