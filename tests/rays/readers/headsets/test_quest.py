"""OVREyeGaze and Unity's eye gaze device."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from tests.rays.readers.headset_examples import quest
from tests.rays.readers.reading import dropped, read

N = 8
RNG = np.random.default_rng(2)
LEFT, RIGHT = RNG.normal(size=(2, N, 3))
# Eyes that look nearly the same way.
TURN = Rotation.from_quat(RNG.normal(size=(N, 4)))
TURNS = TURN * Rotation.from_euler("y", 2, degrees=True), TURN * Rotation.from_euler("y", -2, degrees=True)
UNITY = [0, 2, 1]


def unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize("rig", [False, True])
def test_both_eyes_in_the_world(tmp_path, rig):
    at = (RNG.normal(size=(N, 3)), Rotation.from_quat(RNG.normal(size=(N, 4)))) if rig else None
    sure = np.full(N, 0.9), np.array([0.9, 0.2, *[0.8] * (N - 2)])
    path = tmp_path / "ann.csv"
    path.write_text(quest(0.02 * np.arange(N), LEFT, RIGHT, TURNS, sure, at))
    rays = read("quest", path)
    # Between eyes that are turned to either side lies the direction of the head.
    origin, direction = 0.5 * (LEFT + RIGHT), TURN.apply([0, 0, 1])
    if at is not None:
        origin, direction = at[0] + at[1].apply(origin), at[1].apply(direction)
    kept = np.arange(N) != 1
    assert np.allclose(rays.origin, origin[kept][:, UNITY]) and np.allclose(rays.direction, direction[kept][:, UNITY])
    assert np.allclose(rays.confidence, [0.9, *[0.8] * (N - 2)]) and dropped(rays) == {"confidence below 0.5": [[3, 3]]}
    assert len(read("quest", path, min_confidence=0.1)) == N


def test_one_pose_of_the_gaze(tmp_path):
    path = tmp_path / "ann.csv"
    q = Rotation.from_euler("YX", [90, 30], degrees=True).as_quat()  # to the right, then down
    path.write_text(
        "time,gazePosition_x,gazePosition_y,gazePosition_z,gazeRotation_x,gazeRotation_y,gazeRotation_z,"
        "gazeRotation_w,user_id\n" + ",".join(map(str, [0, 1, 1.6, 2, *q, "bo"])) + "\n"
    )
    rays = read("quest", path)
    assert np.allclose(rays.direction, [[3**0.5 / 2, 0, -0.5]]) and np.allclose(rays.origin, [[1, 2, 1.6]])
    assert rays.persons == ("bo",)
    path.write_text("time,gazePosition_x\n")
    with pytest.raises(NergError, match="has no columns"):
        read("quest", path)


@pytest.mark.parametrize("rig", [False, True])
def test_eyes_at_a_fill_value(tmp_path, rig):
    """Of one eye the row is dropped at once; of both where the person is otherwise elsewhere."""
    left, right = LEFT + [0, 3, 0], RIGHT + [0, 3, 0]
    left[2] = left[4] = right[4] = left[6] = right[6] = 0
    at = (RNG.normal(size=(N, 3)), Rotation.from_quat(RNG.normal(size=(N, 4)))) if rig else None
    (tmp_path / "a.csv").write_text(quest(0.02 * np.arange(N), left, right, TURNS, (np.ones(N), np.ones(N)), at))
    assert dropped(read("quest", tmp_path / "a.csv")) == {
        "origin is a repeated fill value": [[6, 6], [8, 8]],
        "origin is missing": [[4, 4]],
    }
