"""``nerg rays import`` and ``show``."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.skeleton import keypoints_from_head, write_skeleton
from tests.cli.rays.running import run


def test_import_and_show_skeletons(tmp_path):
    origin = np.array([[0.1 * i, 0, 1.65] for i in range(20)])
    body = keypoints_from_head(origin, np.tile([0.0, 1.0, 0.0], (20, 1)))
    body[4, 11] = np.nan
    write_skeleton(tmp_path / "day.csv", ["ann"] * 20, np.arange(20), body)
    done = run("import", tmp_path / "day.csv", "-o", tmp_path / "rays.npz", "--preset", "skeleton", "--tick", 0.1)
    assert done.exit_code == 0, done.output
    assert (
        "19 of 20 rows" in done.output
        and "wrote" in done.output
        and "lines 5 of day.csv" in " ".join(done.output.split())
    )
    assert len(Rays.load(tmp_path / "rays.npz")) == 19
    shown = run("show", tmp_path / "rays.npz")
    assert shown.exit_code == 0 and "eye height" in shown.output and "1.65 m" in shown.output


def test_import_by_map(tmp_path):
    (tmp_path / "ann.csv").write_text("t,x,y,z,a,b,c\n0,1,1.6,2,0,0,1\n1,1,1.6,2,0,0,1\n")
    done = run(
        "import",
        tmp_path / "ann.csv",
        "-o",
        tmp_path / "r.npz",
        "--map",
        "origin=x,y,z direction=a,b,c t=t",
        "--up",
        "y",
        "--hand",
        "left",
        "--person-from",
        "filename",
    )
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "r.npz")
    assert (
        rays.persons == ("ann",)
        and np.allclose(rays.origin[0], [1, 2, 1.6])
        and np.allclose(rays.direction[0], [0, 1, 0])
    )


def test_contradictions(tmp_path):
    (tmp_path / "a.csv").write_text("x\n")
    for extra, message in [
        ([], "either --preset NAME or --map"),
        (["--preset", "vr_supermarket", "--up", "y"], "leave out --up"),
    ]:
        done = run("import", tmp_path / "a.csv", "-o", tmp_path / "r.npz", *extra)
        assert done.exit_code != 0 and message in str(done.exception)


def test_import_of_heads_and_their_options(tmp_path):
    (tmp_path / "h.csv").write_text("x,y,z,yaw,pitch,g\n0,1.6,0,1.5707963,0,new\n0,1.6,0,0,0,old\n")
    done = run(
        "import",
        tmp_path / "h.csv",
        "-o",
        tmp_path / "h.npz",
        "--map",
        "origin=x,y,z ypr=yaw,pitch cohort=g",
        "--up",
        "y",
        "--hand",
        "left",
        "--radians",
    )
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "h.npz")
    assert np.allclose(rays.direction, [[1, 0, 0], [0, 1, 0]], atol=1e-6) and rays.cohorts == ("new", "old")
    assert "new 1, old 1" in " ".join(done.output.split())
    done = run(
        "import", tmp_path / "h.csv", "-o", tmp_path / "h.npz", "--map", "origin=x,y,z ypr=yaw,pitch", "--marker", 0.05
    )
    assert "--marker belongs to a preset" in str(done.exception)
    done = run("import", tmp_path / "h.csv", "-o", tmp_path / "h.npz", "--preset", "skeleton", "--keypoints", "1,2")
    assert "--keypoints is three places" in str(done.exception)


def test_pseudonyms(tmp_path):
    for name in ("anna", "bo"):
        (tmp_path / f"{name}.csv").write_text("t,x,y,z,a,b,c\n0,1,1.6,2,0,0,1\n1,1,1.6,2,0,0,1\n")
    about = ["--map", "origin=x,y,z direction=a,b,c t=t", "--up", "y", "--hand", "left"]
    plain = run("import", tmp_path / "anna.csv", tmp_path / "bo.csv", "-o", tmp_path / "plain.npz", *about)
    assert plain.exit_code == 0 and "anna" in plain.output
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    hidden = []
    for files in (["anna", "bo"], ["bo"]):
        done = run(
            "import",
            *(tmp_path / f"{n}.csv" for n in files),
            "-o",
            tmp_path / "r.npz",
            *about,
            "--pseudonyms",
            "--salt",
            tmp_path / "salt",
        )
        assert done.exit_code == 0, done.output
        hidden.append(Rays.load(tmp_path / "r.npz"))
        assert "anna" not in done.output.replace(str(tmp_path), "") and "anna" not in str(hidden[-1].metadata)
    assert len(hidden[0].persons) == 2 and hidden[1].persons[0] in hidden[0].persons
    done = run("import", tmp_path / "bo.csv", "-o", tmp_path / "r.npz", *about, "--salt", tmp_path / "salt")
    assert "belongs to --pseudonyms" in str(done.exception)


def test_one_line_that_was_cut_off_among_many_files(tmp_path):
    row = "{},1,1.6,2,0,0,1\n"
    for i in range(4):
        (tmp_path / f"p{i}.csv").write_text(
            "t,x,y,z,a,b,c\n" + "".join(row.format(k * 0.02) for k in range(150)) + ("3,1,1." if i == 2 else "")
        )
    about = ["--map", "origin=x,y,z direction=a,b,c t=t", "--up", "y", "--hand", "left"]
    files = [tmp_path / f"p{i}.csv" for i in range(4)]
    done = run("import", *files, "-o", tmp_path / "r.npz", *about)
    assert isinstance(done.exception, NergError) and "p2.csv, line 152: 3 cells" in str(done.exception)
    assert "--skip-bad-lines" in str(done.exception) and not (tmp_path / "r.npz").exists()
    done = run("import", *files, "-o", tmp_path / "r.npz", *about, "--skip-bad-lines")
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "r.npz")
    assert len(rays) == 600 and rays.metadata["rows_read"] == 601
    (lost,) = rays.metadata["dropped"]
    assert lost["file"] == "p2.csv" and lost["rows"] == [[152, 152]] and lost["count"] == 1
    words = " ".join(done.output.split())
    assert "600 of 601 rows" in words and "line is cut off" in words and "lines 152 of p2.csv" in words
    # Of several files that lost lines one is named with its lines, and the others are counted.
    files[1].write_text(files[1].read_text() + "\n1,x,1,1,1,1,1\n")
    done = run("import", *files, "-o", tmp_path / "both.npz", *about, "--skip-bad-lines")
    assert "of p1.csv and of 1 more" in " ".join(done.output.split()), done.output
    # Two of 152 lines are more than one in a hundred; one is always allowed.
    files[2].write_text(files[2].read_text() + "\n3,x,1,1,1,1,1\n")
    done = run("import", *files, "-o", tmp_path / "s.npz", *about, "--skip-bad-lines")
    assert (
        isinstance(done.exception, NergError)
        and "p2.csv: 2 of 152 lines" in str(done.exception)
        and "1 %" in str(done.exception)
    )
    assert not (tmp_path / "s.npz").exists()
    (tmp_path / "two.csv").write_text("t,x,y,z,a,b,c\n0,1,1.6,2,0,0,1\n0,1")
    assert run("import", tmp_path / "two.csv", "-o", tmp_path / "t.npz", *about, "--skip-bad-lines").exit_code == 0


def test_bad_lines_of_presets(tmp_path):
    body = keypoints_from_head(np.array([[0.1 * i, 0, 1.65] for i in range(20)]), np.tile([0.0, 1.0, 0.0], (20, 1)))
    write_skeleton(tmp_path / "day.csv", ["ann"] * 20, np.arange(20), body)
    with open(tmp_path / "day.csv", "a") as out:
        out.write("ann|20|[1.0, 2.")
    arguments = ["import", tmp_path / "day.csv", "-o", tmp_path / "r.npz", "--preset", "skeleton", "--tick", 0.1]
    assert "line 21" in str(run(*arguments).exception)
    done = run(*arguments, "--skip-bad-lines")
    assert done.exit_code == 0 and "20 of 21 rows" in done.output, done.output
    for tick in (0, -1, "nan"):
        assert "--tick" in str(run(*arguments[:-1], tick, "--skip-bad-lines").exception)


@pytest.mark.parametrize(
    "tick, words",
    [
        (1, "a ray comes every 20 s; were a unit of the file's time 0.001 s, it would be 50 a second (--tick 0.001)"),
        (1e-6, "(--tick 0.001)"),
        (0.001, ""),
    ],
)
def test_a_wrong_tick_is_told_and_nothing_is_nan(tmp_path, tick, words):
    rows = "".join(f"{20 * i},{0.01 * i},0,1.6,1,0,0\n" for i in range(300))
    (tmp_path / "ms.csv").write_text("t,x,y,z,a,b,c\n" + rows)
    done = run(
        "import",
        tmp_path / "ms.csv",
        "-o",
        tmp_path / "r.npz",
        "--map",
        "origin=x,y,z direction=a,b,c t=t",
        "--tick",
        tick,
    )
    said = " ".join(done.output.split())
    assert done.exit_code == 0 and "nan" not in said and words in said, said
    # People have rays at many times, however far apart these are taken to be.
    assert f"{1 / (20 * tick):.4g} rays a second" in said and "at two times" not in said, said
    assert ("implausible" in said) == bool(words)


def test_times_that_do_not_change(tmp_path):
    (tmp_path / "c.csv").write_text("t,x,y,z,a,b,c\n" + "5,0,0,1.6,1,0,0\n" * 30)
    done = run("import", tmp_path / "c.csv", "-o", tmp_path / "r.npz", "--map", "origin=x,y,z direction=a,b,c t=t")
    said = " ".join(done.output.split())
    assert "nan" not in said and "no person has rays at two times" in said and "--map t=" in said


def test_names_are_not_markup(tmp_path):
    """Somebody's name is not a command to the terminal, and none of the table's."""
    (tmp_path / "m.csv").write_text("t,x,y,z,a,b,c,who\n0,0,0,1.6,1,0,0,[/bold]\n1,0,0,1.6,1,0,0,x\x1b[31m\n")
    done = run(
        "import", tmp_path / "m.csv", "-o", tmp_path / "r.npz", "--map", "origin=x,y,z direction=a,b,c t=t person=who"
    )
    assert done.exit_code == 0 and "[/bold]" in done.output and "\x1b[31m" not in done.output, done.output
