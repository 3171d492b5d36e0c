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


def test_what_cannot_be_read(tmp_path):
    done = run("guess", tmp_path / "none.csv")
    assert done.exit_code != 0 and "none.csv" in str(done.exception)
