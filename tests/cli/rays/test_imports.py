"""``nerg rays import`` and ``show``."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.skeleton import keypoints_from_head, write_skeleton
from tests.cli.rays.running import run

MAP = ["--map", "origin=x,y,z direction=a,b,c t=t"]
UNITY = ["--up", "y", "--hand", "left"]
ROWS = "t,x,y,z,a,b,c\n0,1,1.6,2,0,0,1\n1,1,1.6,2,0,0,1\n"


def test_import_and_show_skeletons(tmp_path):
    origin = np.array([[0.1 * i, 0, 1.65] for i in range(20)])
    body = keypoints_from_head(origin, np.tile([0.0, 1.0, 0.0], (20, 1)))
    body[4, 11] = np.nan
    write_skeleton(tmp_path / "day.csv", ["ann"] * 20, np.arange(20), body)
    done = run("import", tmp_path / "day.csv", "-o", tmp_path / "rays.npz", "--preset", "skeleton", "--tick", 0.1)
    assert done.exit_code == 0, done.output
    assert "19 of 20 rows" in done.output and "wrote" in done.output
    assert "lines 5 of day.csv" in " ".join(done.output.split())
    assert len(Rays.load(tmp_path / "rays.npz")) == 19
    shown = run("show", tmp_path / "rays.npz")
    assert shown.exit_code == 0 and "eye height" in shown.output and "1.65 m" in shown.output


def test_import_by_map(tmp_path):
    (tmp_path / "ann.csv").write_text(ROWS)
    done = run("import", tmp_path / "ann.csv", "-o", tmp_path / "r.npz", *MAP, *UNITY, "--person-from", "filename")
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "r.npz")
    assert rays.persons == ("ann",) and np.allclose(rays.origin, [1, 2, 1.6])
    assert np.allclose(rays.direction, [0, 1, 0])


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "the format of the files is not given"),
        (["--preset", "vr_supermarket", "--up", "y"], "up"),
        ([*MAP, "--marker", 0.05], "marker"),
        (["--preset", "skeleton", "--keypoints", "1,2"], "keypoints"),
        (["--preset", "skeleton", "--tick", 0], "tick"),
        (["--preset", "skeleton", "--tick", "nan"], "tick"),
    ],
)
def test_contradictory_options_are_refused(tmp_path, arguments, message):
    (tmp_path / "a.csv").write_text("x\n")
    done = run("import", tmp_path / "a.csv", "-o", tmp_path / "r.npz", *arguments)
    assert done.exit_code != 0
    assert (
        next(iter(done.exception.parameters)) == message if message.isidentifier() else message in str(done.exception)
    )


def test_import_of_heads_and_their_options(tmp_path):
    (tmp_path / "h.csv").write_text("x,y,z,yaw,pitch,g\n0,1.6,0,1.5707963,0,new\n0,1.6,0,0,0,old\n")
    command = ["import", tmp_path / "h.csv", "-o", tmp_path / "h.npz"]
    done = run(*command, "--map", "origin=x,y,z ypr=yaw,pitch cohort=g", *UNITY, "--radians")
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "h.npz")
    assert np.allclose(rays.direction, [[1, 0, 0], [0, 1, 0]], atol=1e-6) and rays.cohorts == ("new", "old")
    assert "new 1, old 1" in " ".join(done.output.split())


def test_pseudonyms_replace_names(tmp_path):
    for name in ("anna", "bo"):
        (tmp_path / f"{name}.csv").write_text(ROWS)
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    hidden = []
    for files in (["anna", "bo"], ["bo"]):
        paths = [tmp_path / f"{n}.csv" for n in files]
        done = run("import", *paths, "-o", tmp_path / "r.npz", *MAP, "--pseudonyms", tmp_path / "salt")
        assert done.exit_code == 0, done.output
        hidden.append(Rays.load(tmp_path / "r.npz"))
        assert "anna" not in done.output.replace(str(tmp_path), "") and "anna" not in str(hidden[-1].metadata)
    assert len(hidden[0].persons) == 2 and hidden[1].persons[0] in hidden[0].persons


def test_one_truncated_line_in_many_files_is_allowed(tmp_path):
    files = [tmp_path / f"p{i}.csv" for i in range(4)]
    rows = "t,x,y,z,a,b,c\n" + "".join(f"{k * 0.02},1,1.6,2,0,0,1\n" for k in range(150))
    for path in files:
        path.write_text(rows + ("3,1,1." if path is files[2] else ""))
    command = ["import", *files, "-o", tmp_path / "r.npz", *MAP, *UNITY]
    done = run(*command)
    assert isinstance(done.exception, NergError) and "p2.csv, line 152: 3 cells" in str(done.exception)
    assert "skip_bad_lines" in done.exception.parameters and not (tmp_path / "r.npz").exists()
    done = run(*command, "--skip-bad-lines")
    assert done.exit_code == 0, done.output
    rays = Rays.load(tmp_path / "r.npz")
    assert len(rays) == 600 and rays.metadata["rows_read"] == 601
    (lost,) = rays.metadata["dropped"]
    assert lost["file"] == "p2.csv" and lost["rows"] == [[152, 152]] and lost["count"] == 1
    # Two of 152 lines are more than one in a hundred; one is always allowed.
    files[2].write_text(files[2].read_text() + "\n3,x,1,1,1,1,1\n")
    done = run(*command, "--skip-bad-lines")
    assert isinstance(done.exception, NergError) and "p2.csv: 2 of 152 lines" in str(done.exception)
    files[0].write_text(ROWS.rpartition(",1,1.6")[0])
    assert run("import", files[0], *command[5:], "--skip-bad-lines").exit_code == 0


@pytest.mark.parametrize("tick, words", [(1, "would be 50 Hz (--tick 0.001)"), (1e-6, "(--tick 0.001)"), (0.001, "")])
def test_a_wrong_tick_is_reported_and_no_output_is_nan(tmp_path, tick, words):
    rows = "".join(f"{20 * i},{0.01 * i},0,1.6,1,0,0\n" for i in range(300))
    (tmp_path / "ms.csv").write_text("t,x,y,z,a,b,c\n" + rows)
    done = run("import", tmp_path / "ms.csv", "-o", tmp_path / "r.npz", *MAP, "--tick", tick)
    said = " ".join(done.output.split())
    assert done.exit_code == 0 and "nan" not in said and words in said, said
    # Participants have rays at many times for any assumed unit of time.
    assert f"{1 / (20 * tick):.4g} Hz" in said and "at two times" not in said, said
    assert ("(--tick" in said) == bool(words)


def test_names_are_not_interpreted_as_markup(tmp_path):
    """Names are interpreted neither by the terminal nor by the table."""
    (tmp_path / "m.csv").write_text("t,x,y,z,a,b,c,who\n0,0,0,1.6,1,0,0,[/bold]\n1,0,0,1.6,1,0,0,x\x1b[31m\n")
    done = run("import", tmp_path / "m.csv", "-o", tmp_path / "r.npz", "--map", f"{MAP[1]} person=who")
    assert done.exit_code == 0 and "[/bold]" in done.output and "\x1b[31m" not in done.output, done.output


@pytest.mark.parametrize("output", ["r.npz", "r.rays"])
def test_files_with_faults_can_be_found_despite_pseudonyms(tmp_path, output):
    if output == "r.rays":
        pytest.importorskip("pyarrow")
    (tmp_path / "ann.csv").write_text(ROWS)
    (tmp_path / "berta.csv").write_text(ROWS + "2,1,1.6,2,0,0,0\n")
    (tmp_path / "salt").write_bytes(b"s" * 32)
    salt = "random" if output == "r.npz" else tmp_path / "salt"
    command = [*MAP, *UNITY, "--person-from", "filename", "--pseudonyms", salt]
    done = run("import", tmp_path / "ann.csv", tmp_path / "berta.csv", "-o", tmp_path / output, *command)
    assert done.exit_code == 0, done.output
    (line,) = [line for line in done.output.splitlines() if "berta.csv" in line]
    alias = line.split()[0]
    assert alias.endswith(".csv") and f"of {alias}" in " ".join(done.output.split()) and "ann.csv is" not in done.output
    written = [tmp_path / output] if output == "r.npz" else (tmp_path / output).rglob("*")
    assert not any(b"berta" in path.read_bytes() for path in written if path.is_file())
    assert "berta" not in str(run("show", tmp_path / output).output)
