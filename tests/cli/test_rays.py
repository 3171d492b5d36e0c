import numpy as np
from typer.testing import CliRunner

from nerg_mi.attention.rays import Rays
from nerg_mi.attention.skeleton import keypoints_from_head
from nerg_mi.cli.rays import app
from nerg_mi.formats.skeleton_file import write_skeleton


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_import_and_show_skeletons(tmp_path):
    origin = np.array([[0.1 * i, 0, 1.65] for i in range(20)])
    body = keypoints_from_head(origin, np.tile([0.0, 1.0, 0.0], (20, 1)))
    body[4, 11] = np.nan
    write_skeleton(tmp_path / "day.csv", ["ann"] * 20, np.arange(20), body)
    done = run("import", tmp_path / "day.csv", "-o", tmp_path / "rays.npz", "--preset", "skeleton22", "--tick", 0.1)
    assert done.exit_code == 0, done.output
    assert "19 of 20 rows" in done.output and "wrote" in done.output and "lines 5 of day.csv" in " ".join(done.output.split())
    assert len(Rays.load(tmp_path / "rays.npz")) == 19
    shown = run("show", tmp_path / "rays.npz")
    assert shown.exit_code == 0 and "eye height" in shown.output and "1.65 m" in shown.output


def test_import_by_map(tmp_path):
    (tmp_path / "ann.csv").write_text("t,x,y,z,a,b,c\n0,1,1.6,2,0,0,1\n1,1,1.6,2,0,0,1\n")
    done = run(
        "import", tmp_path / "ann.csv", "-o", tmp_path / "r.npz", "--map", "origin=x,y,z direction=a,b,c t=t",
        "--up", "y", "--hand", "left", "--person-from", "filename",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "r.npz")
    assert rays.persons == ("ann",) and np.allclose(rays.origin[0], [1, 2, 1.6]) and np.allclose(rays.direction[0], [0, 1, 0])


def test_contradictions(tmp_path):
    (tmp_path / "a.csv").write_text("x\n")
    for extra, message in [([], "either --preset NAME or --map"), (["--preset", "vr_supermarket", "--up", "y"], "leave out --up")]:
        done = run("import", tmp_path / "a.csv", "-o", tmp_path / "r.npz", *extra)
        assert done.exit_code != 0 and message in str(done.exception)
