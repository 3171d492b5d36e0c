"""Semi-dense points of Aria's glasses."""

import csv
import gzip

import numpy as np
import pytest

from nerg_mi.photos import posed
from nerg_mi.photos.posed import read_semidense

HEAD = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"


def write(path, *rows):
    path.write_bytes(gzip.compress("\n".join([HEAD, *rows, ""]).encode()))
    return path


def test_points_of_one_world_that_are_known_well(tmp_path, monkeypatch):
    monkeypatch.setattr(posed, "_BLOCK", 2)
    path = write(
        tmp_path / "semidense_points.csv.gz",
        *("1,a,1,2,3,0.005,0.01", "2,a,4,5,6,0.0051,0.001", "3,a,7,8,9,0.001,0.02", "4,b,1,1,1,0.001,0.001"),
        *("5,a,nan,8,9,0.001,0.01", "", "6,a,0.5,0,-1,0,0"),
    )
    points = read_semidense(path)
    assert points.dtype == np.float32 and points.tolist() == [[1, 2, 3], [0.5, 0, -1]]
    assert read_semidense(path, "b").tolist() == [[1, 1, 1]]
    assert len(read_semidense(path, "a", inv_dist_std=1, dist_std=1)) == 4
    with pytest.raises(ValueError, match='"c"'):
        read_semidense(path, "c")
    with pytest.raises(ValueError, match="holds no point that is known to 0.005 1/m and -1 m"):
        read_semidense(path, dist_std=-1)
    monkeypatch.setattr(posed, "_WORLDS", 1)
    with pytest.raises(ValueError, match="more than 1 worlds"):
        read_semidense(path)


def test_what_is_no_file_of_points(tmp_path):
    for row, why in (
        ("1,a,1,2", "line 2: 4 cells, the header has 7"),
        ("1,a,1,2,3,0,0,0,0", "line 2: 9 cells, the header has 7"),
        ("1,a,x,2,3,0,0", "is no point"),
    ):
        with pytest.raises(ValueError, match=why):
            read_semidense(write(tmp_path / "p.csv.gz", row))
    (tmp_path / "p.csv").write_text("px_world,py_world,pz_world,inv_dist_std,dist_std,graph_uid\n1,2,3,0,0\n")
    with pytest.raises(ValueError, match="5 cells, the header has 6"):
        read_semidense(tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="graph_uid.*px_world"):
        read_semidense(tmp_path / "p.csv")


def test_recorded_points(recorded):
    path = recorded("aria") / "gen1/mps_sample/trajectory/global_points.csv.gz"
    points = read_semidense(path)
    with gzip.open(path, "rt") as file:
        rows = [r for r in csv.DictReader(file) if float(r["inv_dist_std"]) <= 0.005 and float(r["dist_std"]) <= 0.01]
    assert points.shape == (len(rows), 3) and len(points) == 27231
    last = rows[-1]
    assert np.allclose(points[-1], [float(last[f"p{a}_world"]) for a in "xyz"], atol=1e-6)
