import gzip

import numpy as np
import pytest
import trimesh

from nerg_mi.alignment.constraints import read_surface
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns


def test_points_are_on_the_triangles_evenly_by_area(tmp_path):
    v = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [10, 0, 0], [10.0, 1, 0], [10, 0, 1]])
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), np.array([[0, 1, 2], [3, 4, 5]]))
    trimesh.Trimesh(v, [[0, 1, 2], [3, 4, 5]], process=False).export(tmp_path / "a.obj")
    for name in ("a.ply", "a.obj"):
        p = read_surface(tmp_path / name, 5000)
        small = p[:, 0] > 5
        assert len(p) == 5000 and small.mean() == pytest.approx(0.1, abs=0.02)
        assert np.abs(p[~small, 2]).max() == 0 and (p[~small, :2].sum(axis=1) <= 3 + 1e-9).all()
        np.testing.assert_array_equal(p, read_surface(tmp_path / name, 5000))


def test_clouds_tables_and_arrays(tmp_path):
    p = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    write_columns(tmp_path / "a.ply", dict(zip("xyz", p.T)))
    np.save(tmp_path / "a.npy", p)
    (tmp_path / "a.csv").write_text("x,y,z\n" + "".join(f"{a},{b},{c}\n" for a, b, c in p.tolist()) + "nan,1,2\n")
    head = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n"
    rows = "".join(f"{k},g,{x},{y},{z},0.001,0.01\n" for k, (x, y, z) in enumerate(p.tolist()))
    (tmp_path / "s.csv.gz").write_bytes(gzip.compress((head + rows).encode()))
    for name in ("a.ply", "a.npy", "a.csv", "s.csv.gz"):
        np.testing.assert_allclose(read_surface(tmp_path / name), p, atol=1e-6)
    assert len(read_surface(tmp_path / "a.npy", 10)) == 10


@pytest.mark.parametrize(
    "name, data, why",
    [
        ("a.txt", b"", "no surface that is read"),
        ("a.ply", b"ply\nno", "no header"),
        ("a.obj", b"", "no vertices"),
        ("a.csv", b"x,y,z\n", "no points"),
        ("a.csv", b"a,b\n1,2\n", "x"),
    ],
)
def test_other_files_are_refused(tmp_path, name, data, why):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(NergError, match=why):
        read_surface(tmp_path / name)
    with pytest.raises(NergError, match="there is no surface"):
        read_surface(tmp_path / "no.ply")


def test_arrays_of_another_shape_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 2)))
    with pytest.raises(NergError, match=r"shape \(3, 2\)"):
        read_surface(tmp_path / "a.npy")


def test_rows_that_do_not_match_the_header_are_refused(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,z\n1,2,3\n1,2,3,4,5\n")
    with pytest.raises(NergError, match="line 3: 5 cells, the header has 3"):
        read_surface(tmp_path / "points.csv")


@pytest.mark.parametrize("far", ["1.1e7", "-1e30", "1e308"])
def test_points_beyond_all_places_are_refused(tmp_path, far):
    (tmp_path / "a.csv").write_text(f"x,y,z\n0,0,0\n1,{far},0\n")
    with pytest.raises(NergError, match="the points of .*a.csv.* must have coordinates from"):
        read_surface(tmp_path / "a.csv")
