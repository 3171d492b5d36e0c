"""Who looks."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.bake_chunks import check_values, find_crowd, read_path, tracked_rays
from nerg_mi.workflows.bake_options import BakeOptions
from tests.workflows.recorder import Recorder

TURNED = Similarity(np.array([[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]))


def rays():
    n = 20
    t = np.arange(n) / 10
    return Rays(t, np.zeros(n), ("a",), np.stack([t, 0 * t, 0 * t + 1.6], 1), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test01_a_path(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n4,5,6\n")
    found = read_path(tmp_path / "a.csv")
    assert found.positions.tolist() == [[1, 2, 3], [4, 5, 6]] and found.weights.tolist() == [0.5, 0.5]
    (tmp_path / "b.csv").write_text("weight;x;y;z\n3;1;2;3\n1;4;5;6\n")
    assert read_path(tmp_path / "b.csv").weights.tolist() == [0.75, 0.25]


@pytest.mark.parametrize(
    "text, said",
    [
        ("x,y\n1,2\n", 'no column "z"'),
        ("x,y,z\n", "0 positions"),
        ("x,y,z\n1,2,nan\n", "positions of the path .* row 0 is"),
        ("x,y,z\n1,2,3\n1,2,1e200\n", r"coordinates from -1e\+07 to 1e\+07, and row 1 is \[1.0, 2.0, 1e\+200\]"),
        ("x,y,z\n-1.1e7,2,3\n", "row 0 is"),
        ("x,y,z,weight\n1,2,3,inf\n", "no numbers"),
        ("x,y,z,weight\n1,2,3,nan\n", "no numbers"),
        ("x,y,z,weight\n1,2,3,-1\n", "negative"),
    ],
)
def test02_paths_that_are_none(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(NergError, match=said):
        read_path(tmp_path / "a.csv")


def test03_people_stand_in_the_place():
    told = Recorder()
    found = find_crowd(BakeOptions(observers=4), rays(), TURNED, told)
    assert len(found.weights) == 4 and np.allclose(found.positions[:, 0], 1) and np.allclose(found.positions[:, 2], 3.2)
    # Metres are told, of which the place has two units each.
    assert f"{found.mean / 2:.2f} m away" in told.messages[0] and "1 people at 20 moments" in told.messages[0]
    who = tracked_rays(rays(), TURNED, "time")
    assert np.allclose(who.directions, [0, 1, 0]) and np.allclose(who.origins[:, 1], 2 * rays().origin[:, 0])
    assert np.isclose(who.weights.sum(), 1)


def test04_one_observer_or_nobody():
    assert find_crowd(BakeOptions(observer=(1, 2, 3)), None, TURNED, Recorder()).positions.tolist() == [[1, 2, 3]]
    for options, said in (
        (BakeOptions(), "nobody looks"),
        (BakeOptions(observer=(1, 2)), "three numbers"),
        (BakeOptions(observer=(1, 2, 3), path="a.csv"), "give one of them"),
    ):
        with pytest.raises(NergError, match=said):
            find_crowd(options, None, TURNED, Recorder())
    with pytest.raises(NergError, match="--weights"):
        check_values(BakeOptions(weights="money"))
