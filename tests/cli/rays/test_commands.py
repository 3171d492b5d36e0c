"""The sub-commands of ``nerg rays`` on files."""

import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from tests.cli.rays.running import run, write_walk


def test_help_loads_no_renderer():
    code = (
        "import sys; import nerg_mi.workflows.rays; print(*{'mitsuba', 'drjit', 'scipy', 'trimesh'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""


# ---- ``nerg rays show`` ----


def test_show_prints_the_quality_report(walk):
    done = run("show", walk)
    shown = " ".join(done.output.split())
    assert done.exit_code == 0 and "12,000 of 12,000 rows" in shown and "sampling rate 50 Hz" in shown


# ---- ``nerg rays filter`` ----


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_filter(walk, tmp_path):
    conditions = ["--person", "a", "--person", "c", "--start", 10, "--end", 30, "--box=0,3,0,3,0,3"]
    done = run("filter", walk, "-o", tmp_path / "some.npz", *conditions)
    assert done.exit_code == 0, done.output
    some = Rays.load(tmp_path / "some.npz")
    assert {some.persons[p] for p in some.person} == {"a", "c"}
    assert some.t.min() >= 10 and some.t.max() < 30 and some.origin[:, 0].max() <= 3
    (step,) = some.metadata["steps"]
    assert (step["step"], step["kept"], step["of"], step["persons"]) == ("filter", len(some), 12_000, ["a", "c"])
    fixations = ["--fixations", "idt", "--dispersion-threshold", 30, "--merge-fixations", "--thin", 1]
    done = run("filter", tmp_path / "some.npz", "-o", tmp_path / "few.npz", *fixations)
    assert done.exit_code == 0, done.output
    few = Rays.load(tmp_path / "few.npz")
    assert [s["step"] for s in few.metadata["steps"]] == ["filter", "fixations", "thin"] and 0 < len(few) < len(some)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["filter"], "no selection is given"),
        (["filter", "--merge-fixations"], "fixations"),
        (["filter", "--fixations", "magic"], "ivt or idt"),
        (["filter", "--start", "1e9"], "selects none"),
        (["filter", "--box", "a,b"], "comma-separated numbers"),
        (["split"], "no criterion is given"),
        (["plot", "--kind", "map"], "density or layout"),
        (["plot", "--test", "walk.npz"], "kind"),
        (["plot", "--cell-size=0"], "Invalid value for '--cell-size'"),
        (["plot", "--cell-size=1e-5"], "more than 4,000,000 cells of 1e-05 m"),
    ],
)
def test_wrong_arguments_are_refused(walk, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    command, *options = arguments
    output = "x.png" if command == "plot" else "x.npz"
    done = run(command, walk, "-o", output, *options)
    assert done.exit_code != 0 and message in f"{done.exception} {' '.join(done.output.split())}"
    assert [path.name for path in tmp_path.iterdir()] == ["walk.npz"]


# ---- ``nerg rays split`` ----


@pytest.mark.parametrize(
    "how",
    [
        ["--test-zones", 2, "--test-positions", 10, "--min-rays", 8],
        ["--test-participants", 0.5],
        ["--test-time", 0.3, "--gap", 1],
        ["--test-zones", 2, "--min-rays", 8, "--person", "b", "--test-time", 0.5, "--clock", "person"],
    ],
)
def test_split_shares_no_ray(walk, tmp_path, how):
    done = run("split", walk, "-o", tmp_path / "s.npz", *how)
    assert done.exit_code == 0, done.output
    sides = [tmp_path / f"s-{side}.npz" for side in ("train", "test")]
    train, test = map(Rays.load, sides)
    assert len(train) and len(test) and not set(train.t) & set(test.t)
    assert set(train.t) | set(test.t) <= set(Rays.load(walk).t)
    step = test.metadata["steps"][-1]
    assert step["side"] == "test" and step["kept"] == len(test) and set(step["by"]) <= {"position", "person", "time"}
    if "--test-positions" in how:
        centres = np.array(step["by"]["position"]["test_centres"])
        assert np.linalg.norm(train.origin[:, None] - centres[None], axis=2).min() > 0.5
        done = run("plot", sides[0], "-o", tmp_path / "s.png", "--kind", "layout", "--test", sides[1])
        assert done.exit_code == 0 and (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG"), done.output


# ---- ``nerg rays plot`` ----


def test_plots_are_png(walk, tmp_path):
    assert "ends in .png" in str(run("plot", walk, "-o", tmp_path / "p.jpg").exception)


def test_a_file_without_rays_is_refused(walk, tmp_path):
    rays = Rays.load(walk)
    rays.select(rays.t < rays.t).save(tmp_path / "none.npz")
    for kind in ("density", "layout"):
        done = run("plot", tmp_path / "none.npz", "-o", tmp_path / "p.png", "--kind", kind)
        assert isinstance(done.exception, NergError) and "no gaze samples to draw" in str(done.exception)


def test_plot_density(walk, tmp_path):
    assert run("plot", walk, "-o", tmp_path / "p.png").exit_code == 0
    first = (tmp_path / "p.png").read_bytes()
    run("plot", walk, "-o", tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes() == first
