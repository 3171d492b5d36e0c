"""Heads that Motive tracked."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.columns import ColumnMap
from tests.rays.readers.headset_examples import motive
from tests.rays.readers.reading import dropped, read

N = 12
T = 0.01 * np.arange(N)
PLACE = np.c_[0.1 * np.arange(N), np.full(N, 1.6), -2 + 0.05 * np.arange(N)]
TURN = Rotation.from_euler("YX", np.c_[10.0 * np.arange(N), np.full(N, -20.0)], degrees=True)


def write(path, **more):
    path.write_text(motive(T, **{"bodies": {"Head": (PLACE, TURN)}, **more}))
    return path


def in_rays(v):
    return np.c_[v[:, 0], -v[:, 2], v[:, 1]]


@pytest.mark.parametrize("forward, axis", [(None, [0, 0, -1]), ("-z", [0, 0, -1]), ("x", [1, 0, 0])])
def test_heads(tmp_path, forward, axis):
    rays = read("motive", write(tmp_path / "ann.csv"), forward=forward)
    assert np.allclose(rays.t, T) and rays.persons == ("ann",)
    assert np.allclose(rays.origin, in_rays(PLACE)) and np.allclose(rays.direction, in_rays(TURN.apply(axis)))
    assert ("complaints" in rays.metadata) == (forward is None)
    unused = rays.metadata["unused_columns"]
    assert unused[0] == "Head Rigid Body Mean Marker Error" and len(unused) == 4 and "Frame" not in unused


def test_units_up_and_lost_samples(tmp_path):
    place = 1000 * PLACE[:, [0, 2, 1]] * [1, -1, 1]
    place[3:5] = np.nan
    turn = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ TURN.as_matrix())
    path = write(tmp_path / "ann.csv", bodies={"Head": (place, turn)}, units="Millimeters")
    rays = read("motive", path, up="z")
    kept = np.r_[0:3, 5:N]
    assert np.allclose(rays.origin, in_rays(PLACE)[kept])
    assert np.allclose(rays.direction, in_rays(TURN.apply([0, 0, -1]))[kept])
    assert dropped(rays) == {"the rigid body was not tracked": [[11, 12]]}


def test_which_body_is_the_head(tmp_path):
    other = PLACE + 5, TURN
    both = write(tmp_path / "a.csv", bodies={"Trolley": other, "HMD 1": (PLACE, TURN)})
    assert np.allclose(read("motive", both).origin, in_rays(PLACE))
    assert np.allclose(read("motive", both, rigid_body="Trolley").origin, in_rays(PLACE + 5))
    unclear = write(tmp_path / "b.csv", bodies={"A": other, "B": other})
    for options in ({}, {"rigid_body": "C"}):
        with pytest.raises(NergError, match="rigid bodies A, B"):
            read("motive", unclear, **options)
    # The same name twice is one body whose columns repeat.
    path = tmp_path / "c.csv"
    path.write_text(motive(T, {"Head": other, "head": other}).replace("head", "Head"))
    with pytest.raises(NergError, match="several columns called 'Head Rigid Body"):
        read("motive", path)


@pytest.mark.parametrize(
    "name, options", [("unity", {}), ("table", {"columns": ColumnMap.parse("origin=X,Y,Z ypr=a,b")})]
)
def test_other_readers_name_it(tmp_path, name, options):
    with pytest.raises(NergError, match="--preset"):
        read(name, write(tmp_path / "ann.csv"), **options)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("Rotation Type,Quaternion", "Rotation Type,XYZ", "rotation type 'XYZ'; export it again with Quaternion"),
        ("Space,Global", "Space,Local", "coordinate space 'Local'"),
        ("Units,Meters", "Units,Inches", "length units 'Inches'"),
        ("Format Version,1.23,", "", "no export of Motive"),
        ("Frame,Time", "Frames,Time", "no export of Motive"),
        (",Type,", ",Kind,", "no lines of types"),
        ("0,0.0,", "0,0.0,9,", "line 8: 17 cells, the header has 16|line 8: 14 cells, the header has 13"),
    ],
)
def test_other_exports_are_refused(tmp_path, old, new, message):
    path = write(tmp_path / "ann.csv")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(NergError, match=message):
        read("motive", path)
