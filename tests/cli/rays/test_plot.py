"""``nerg rays plot``."""

import pytest

from tests.cli.rays.running import run, write_walk


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_refusals(walk, tmp_path):
    for arguments, message in [
        (["plot", walk, "-o", tmp_path / "p.jpg"], "end in .png"),
        (["plot", walk, "-o", tmp_path / "p.png", "--kind", "map"], "density or layout"),
        (["plot", walk, "-o", tmp_path / "p.png", "--test", walk], "add --kind layout"),
    ]:
        done = run(*arguments)
        assert done.exit_code != 0 and message in str(done.exception)


def test_plot_density(walk, tmp_path):
    assert run("plot", walk, "-o", tmp_path / "p.png").exit_code == 0
    first = (tmp_path / "p.png").read_bytes()
    run("plot", walk, "-o", tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes() == first
