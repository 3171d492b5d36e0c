"""``nerg rays filter``."""

import pytest

from nerg_mi.rays.rays import Rays
from tests.cli.rays.running import run, write_walk


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_filter(walk, tmp_path):
    out = tmp_path / "some.npz"
    done = run(
        "filter", walk, "-o", out, "--person", "a", "--person", "c", "--from", 10, "--to", 30, "--box=0,3,0,3,0,3"
    )
    assert done.exit_code == 0, done.output
    some = Rays.load(out)
    assert (
        {some.persons[p] for p in some.person} == {"a", "c"}
        and some.t.min() >= 10
        and some.t.max() < 30
        and some.origin[:, 0].max() <= 3
    )
    (step,) = some.metadata["steps"]
    assert (
        step["step"] == "filter"
        and step["kept"] == len(some)
        and step["of"] == 12_000
        and step["persons"] == ["a", "c"]
    )
    done = run(
        "filter", out, "-o", tmp_path / "few.npz", "--fixations", "idt", "--dispersion", 30, "--one-ray", "--thin", 1
    )
    assert done.exit_code == 0, done.output
    few = Rays.load(tmp_path / "few.npz")
    assert [s["step"] for s in few.metadata["steps"]] == ["filter", "fixations", "thin"] and 0 < len(few) < len(some)
    assert "then" in run("show", tmp_path / "few.npz").output


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "say which rays"),
        (["--one-ray"], "add --fixations"),
        (["--fixations", "magic"], "ivt or idt"),
        (["--person", "zoe"], "no person is called"),
        (["--from", "1e9"], "leaves none"),
        (["--box", "1,2"], "a box is"),
        (["--box", "a,b"], "numbers with commas"),
    ],
)
def test_filter_refuses(walk, tmp_path, arguments, message):
    done = run("filter", walk, "-o", tmp_path / "x.npz", *arguments)
    assert done.exit_code != 0 and message in str(done.exception) and not (tmp_path / "x.npz").exists()
