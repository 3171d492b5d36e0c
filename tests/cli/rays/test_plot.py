"""``nerg rays plot``."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from tests.cli.rays.running import run, write_walk


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_refusals(walk, tmp_path):
    for arguments, message in [
        (["plot", walk, "-o", tmp_path / "p.jpg"], "end in .png"),
        (["plot", walk, "-o", tmp_path / "p.png", "--kind", "map"], "density or layout"),
        (["plot", walk, "-o", tmp_path / "p.png", "--test", walk], "add --kind layout"),
        (["plot", walk, "-o", tmp_path / "p.png", "--cell=-1"], "Invalid value for '--cell'"),
        (["plot", walk, "-o", tmp_path / "p.png", "--cell=0"], "Invalid value for '--cell'"),
        (["plot", walk, "-o", tmp_path / "p.png", "--cell=nan"], "Invalid value for '--cell'"),
        (["plot", walk, "-o", tmp_path / "p.png", "--cell=1e-5"], "more than 4,000,000 cells of 1e-05 m"),
    ]:
        done = run(*arguments)
        assert done.exit_code != 0 and message in f"{done.exception} {' '.join(done.output.split())}"


@pytest.mark.parametrize("kind", ["density", "layout"])
def test_no_rays(walk, tmp_path, kind):
    rays = Rays.load(walk)
    rays.select(rays.t < rays.t).save(tmp_path / "none.npz")
    done = run("plot", tmp_path / "none.npz", "-o", tmp_path / "p.png", "--kind", kind)
    assert isinstance(done.exception, NergError) and "no rays to draw" in str(done.exception)


def test_plot_density(walk, tmp_path):
    assert run("plot", walk, "-o", tmp_path / "p.png").exit_code == 0
    first = (tmp_path / "p.png").read_bytes()
    run("plot", walk, "-o", tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes() == first
