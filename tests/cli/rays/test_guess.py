"""``nerg rays guess``."""

import os

from tests.cli.rays.running import run
from tests.rays.guess.tables import csv, frame, walk, xyz


def test_the_command_is_printed_and_nothing_is_written(tmp_path):
    w = walk()
    eye, gaze, _ = frame(w, "y left")
    path = tmp_path / "log.csv"
    path.write_text(csv(t=w.t, **xyz("p", eye), **xyz("d", gaze)))
    before = os.listdir(tmp_path)
    done = run("guess", path)
    assert done.exit_code == 0 and os.listdir(tmp_path) == before
    lines = done.output.splitlines()
    assert lines[-1].startswith(f"nerg rays import {path} -o log.npz --map 'origin=px,py,pz direction=dx,dy,dz t=t'")
    assert any(line.startswith("guess  y is up and the unit m") for line in lines)
    path.write_text("a,b\n1,2\n")
    assert run("guess", path).output.splitlines()[-1] == "nothing can be proposed"


def test_several_files(tmp_path):
    eye, gaze, _ = frame(walk(), "y left")
    for name, metre in (("a.csv", 1), ("b.csv", 1), ("c.csv", 0.01)):
        (tmp_path / name).write_text(csv(t=walk().t, **xyz("p", eye / metre), **xyz("d", gaze)))
    lines = run("guess", tmp_path).output.splitlines()
    assert lines[0] == f"{tmp_path / 'a.csv'} and 1 more" and f"{tmp_path / 'c.csv'}" in lines
    assert [line.count(".csv") for line in lines if line.startswith("nerg")] == [2, 1]


def test_what_cannot_be_read(tmp_path):
    done = run("guess", tmp_path / "none.csv")
    assert done.exit_code != 0 and "none.csv" in str(done.exception)
