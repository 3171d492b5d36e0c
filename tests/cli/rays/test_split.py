"""``nerg rays split``."""

import numpy as np
import pytest

from nerg_mi.rays.rays import Rays
from tests.cli.rays.running import run, write_walk


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


@pytest.mark.parametrize(
    "how",
    [
        ["--zones", 2, "--positions", 10, "--min-rays", 8],
        ["--people", 0.5],
        ["--time", 0.3, "--gap", 1],
        ["--zones", 2, "--min-rays", 8, "--person", "b", "--time", 0.5, "--clock", "person"],
    ],
)
def test_split_shares_no_ray(walk, tmp_path, how):
    done = run("split", walk, "-o", tmp_path / "s.npz", *how)
    assert done.exit_code == 0, done.output
    train, test = (Rays.load(tmp_path / f"s-{side}.npz") for side in ("train", "test"))
    assert len(train) and len(test) and not set(train.t) & set(test.t)
    assert set(train.t) | set(test.t) <= set(Rays.load(walk).t)
    step = test.metadata["steps"][-1]
    assert step["side"] == "test" and step["kept"] == len(test) and set(step["by"]) <= {"position", "person", "time"}
    if "--zones" in how:
        centres = np.array(step["by"]["position"]["test_centres"])
        assert np.linalg.norm(train.origin[:, None] - centres[None], axis=2).min() > 0.5
        done = run(
            "plot",
            tmp_path / "s-train.npz",
            "-o",
            tmp_path / "s.png",
            "--kind",
            "layout",
            "--test",
            tmp_path / "s-test.npz",
        )
        assert done.exit_code == 0 and (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG"), done.output


def test_nothing_said(walk, tmp_path):
    done = run("split", walk, "-o", tmp_path / "s.npz")
    assert done.exit_code != 0 and "say how to split" in str(done.exception)
