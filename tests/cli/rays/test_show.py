"""``nerg rays show``."""

from nerg_mi.errors import NergError
from nerg_mi.workflows.rays import split_rays
from nerg_mi.workflows.rays_commands import SplitOptions
from tests.cli.rays.running import run, write_walk


def test_the_card(tmp_path):
    walk = write_walk(tmp_path / "walk.npz")
    done = run("show", walk)
    shown = " ".join(done.output.split())
    assert done.exit_code == 0 and "12,000 of 12,000 rows" in shown and "4: a, b, c, d" in shown
    assert "100.0 % of the rays, median distance 2.00 m" in shown and "at 50 rays a second" in shown
    split_rays(walk, SplitOptions(people=0.5, test_output=tmp_path / "test.npz"))
    assert "then split test: 6,000 of 12,000 rays kept" in " ".join(run("show", tmp_path / "test.npz").output.split())
    assert isinstance(run("show", tmp_path / "absent.npz").exception, NergError)
