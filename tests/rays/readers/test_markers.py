"""C3D files: heads by their markers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers import registry
from tests.rays.readers.c3d_examples import write_c3d, write_heads
from tests.rays.readers.reading import dropped, read

pytest.importorskip("c3d", reason="c3d is not installed")

# A head that looks along x, with y to its left, in metres: ears, nose, and the band of Plug-in Gait.
HEAD = {
    "Left_Ear": (0, 0.075, 0),
    "Right_Ear": (0, -0.075, 0),
    "Nose": (0.12, 0, 0),
    "LFHD": (0.08, 0.06, 0.05),
    "RFHD": (0.08, -0.06, 0.05),
    "LBHD": (-0.1, 0.06, 0.05),
    "RBHD": (-0.1, -0.06, 0.05),
    "L_HDF": (0.08, 0.06, 0.05),
    "R_HDF": (0.08, -0.06, 0.05),
    "L_HDB": (-0.1, 0.06, 0.05),
    "R_HDB": (-0.1, -0.06, 0.05),
    "C7": (-0.05, 0, -0.3),
}


def turned(n=12, seed=0):
    """Heads (n) in all directions: turns, and where they are."""
    rng = np.random.default_rng(seed)
    return Rotation.from_quat(rng.normal(size=(n, 4))), rng.uniform([-4, -4, 1.2], [4, 4, 1.9], (n, 3))


def positions(names, turn, place):
    return np.stack([turn.apply(HEAD[name]) + place for name in names], axis=1)


@pytest.mark.parametrize(
    "names, keypoints, centre, unused",
    [
        (["C7", "LFHD", "RFHD", "LBHD", "RBHD"], None, (-0.01, 0, 0.05), ["C7"]),
        (["Nose", "Left_Ear", "Right_Ear", "LFHD"], None, (0, 0, 0), ["LFHD"]),
        (["L_HDF", "R_HDF", "L_HDB", "R_HDB"], None, (-0.01, 0, 0.05), []),
        (["LFHD", "RFHD", "C7"], ("LFHD", "RFHD", "LFHD+RFHD+C7"), (0.08, 0, 0.05), []),
    ],
)
@pytest.mark.parametrize("unit, size", [("mm", 1e-3), ("m", 1.0)])
def test_heads_in_all_directions(tmp_path, names, keypoints, centre, unused, unit, size):
    turn, place = turned()
    write_c3d(tmp_path / "ann.c3d", names, positions(names, turn, place) / size, units=unit)
    rays = read("c3d", tmp_path / "ann.c3d", **({"keypoints": keypoints} if keypoints else {}))
    forward = np.array([1.0, 0, 0])
    if keypoints:
        front = np.mean([HEAD[name] for name in ("LFHD", "RFHD", "C7")], axis=0) - centre
        forward = front / np.linalg.norm(front)
    assert np.abs(rays.direction - turn.apply(forward)).max() < 1e-5
    assert np.abs(rays.origin - turn.apply(centre) - place).max() < 1e-5
    assert np.allclose(rays.t, np.arange(12) / 100) and rays.persons == ("ann",)
    assert "complaints" not in rays.metadata
    assert rays.metadata.get("unused_columns", []) == unused


@pytest.mark.parametrize("up", ["+Y", "-Y"])
def test_people_axes_and_markers_that_were_not_seen(tmp_path, up):
    """Two people in one file whose y points up; markers that were lost, at exactly zero and at a fill value."""
    turn, place = turned()
    names = ["LFHD", "RFHD", "LBHD", "RBHD"]
    ann = positions(names, turn, place)
    bo = positions(names, turn.inv(), place + 1)
    ann[3, 1], bo[5, 2] = np.nan, 0
    both = np.concatenate([ann, bo], axis=1)
    upright = 1000 * np.stack([both[..., 0], both[..., 2], -both[..., 1]], axis=-1)
    upright[7, 6] = -9999
    labels = [f"{person}:{name}" for person in ("Ann", "Bo") for name in names]
    write_c3d(tmp_path / "trial.c3d", labels, upright, up=up, rate=50)
    rays = read("c3d", tmp_path / "trial.c3d")
    assert rays.persons == ("Ann", "Bo") and rays.metadata["source_frame"]["up"] == "y"
    assert dropped(rays) == {"a keypoint of the head is missing": [[4, 4], [6, 6], [8, 8]]}
    mine = rays.person == 1
    there = ~np.isin(np.arange(12), [5, 7])
    assert np.abs(rays.direction[mine] - turn.inv().apply([1, 0, 0])[there]).max() < 1e-5
    assert np.allclose(rays.t[mine], np.arange(12)[there] / 50)


def test_what_a_file_does_not_say(tmp_path):
    path = tmp_path / "ann.c3d"
    turn, place = turned()
    there = positions(["LFHD", "RFHD", "LBHD", "RBHD"], turn, place)
    write_c3d(path, ["LFHD", "RFHD", "LBHD", "RBHD"], there, units=None, up=None, frames=40)
    with pytest.raises(NergError, match="--units"):
        read("c3d", path)
    said = read("c3d", path, units="m").metadata["complaints"]
    assert "which axis points up; z was taken" in said[0] and "ends after 12 of the 40 frames" in said[1]
    wide = read("c3d", path, units="mm", up="z").metadata["complaints"]
    assert "0.00012 m apart" in wide[1]
    write_c3d(path, ["LFHD", "RFHD", "LBHD", "RBHD"], there, units="in")
    with pytest.raises(NergError, match='is in "in"'):
        read("c3d", path)
    write_c3d(path, ["A", "B"], there[:, :2])
    with pytest.raises(NergError, match="whose markers are A, B; name those"):
        read("c3d", path, units="m")
    write_c3d(tmp_path / "forces.c3d", ["A"], there[:, :0])
    with pytest.raises(NergError, match="holds no markers"):
        read("c3d", tmp_path / "forces.c3d")
    with pytest.raises(NergError, match="markers of a head"):
        read("c3d", path, units="m", keypoints=("A", "B", "C"))


@pytest.mark.parametrize("tilt", [10, 40, -25])
def test_headbands_that_are_not_level(tmp_path, tilt):
    """A walker who looks ahead, whose headband points up; levelled by the pitch that is proposed."""
    names, path = ["LFHD", "RFHD", "LBHD", "RBHD"], tmp_path / "ann.c3d"
    turn = Rotation.from_euler("z", np.linspace(0, 300, 30)[:, None], degrees=True)
    band = turn * Rotation.from_euler("y", -tilt, degrees=True)
    write_c3d(path, names, 1000 * positions(names, band, np.full((30, 3), 1.6)), units="mm  mm  mm", frames=31)
    said = read("c3d", path).metadata.get("complaints", [])
    assert said == [] if tilt == 10 else f"point {tilt} degrees up (median)" in said[0]
    assert tilt == 10 or f"--pitch {-tilt} levels" in said[0]
    assert np.abs(read("c3d", path, pitch=-tilt).direction - turn.apply([1, 0, 0])).max() < 1e-5


@pytest.mark.parametrize("length", [1, 100, 600, 700])
def test_files_that_are_cut_off(tmp_path, length):
    write_heads(tmp_path / "ann.c3d")
    data = (tmp_path / "ann.c3d").read_bytes()
    (tmp_path / "ann.c3d").write_bytes(data[:length])
    with pytest.raises(NergError, match=r"ann\.c3d"):
        registry.read_rays("c3d", tmp_path / "ann.c3d")
