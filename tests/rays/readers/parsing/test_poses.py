"""Heads' poses as rotations; what their angles mean is tried in tests/rays/readers/test_table.py."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers import poses


def test_quaternions_need_not_be_unit():
    turn = Rotation.from_quat(np.random.default_rng(0).normal(size=(20, 4)))
    q = turn.as_quat() * 3
    assert np.allclose(poses.rotations_from_quaternions(q), turn.as_matrix())
    assert np.allclose(poses.rotations_from_quaternions(np.roll(q, 1, axis=1), "wxyz"), turn.as_matrix())
    q[3], q[4, 1] = 0, np.nan
    assert np.isnan(poses.rotations_from_quaternions(q)[3:5]).all()
    for bad, order in ((q[:, :3], "xyzw"), (q, "zyxw")):
        with pytest.raises(ValueError, match="expected"):
            poses.rotations_from_quaternions(bad, order)


def test_matrices_lose_their_scale_and_others_are_none():
    turn = Rotation.from_quat(np.random.default_rng(1).normal(size=(4, 4))).as_matrix()
    rows = np.concatenate([turn * 2, np.arange(12.0).reshape(4, 3, 1)], axis=2)
    rows[3, 0, 0] += 1
    R, place = poses.rotations_from_matrices(rows.reshape(4, 12))
    assert np.allclose(R[:3], turn[:3]) and np.isnan(R[3]).all() and np.array_equal(place.ravel(), np.arange(12.0))


@pytest.mark.parametrize("mirror", [-np.eye(3), np.diag([-1.0, 1, 1]), np.diag([1.0, 1, -2]), np.eye(3)[[1, 0, 2]]])
def test_mirrored_matrices_are_no_rotations(mirror):
    turn = Rotation.from_quat(np.random.default_rng(1).normal(size=(4, 4))).as_matrix()
    turn[2] = turn[2] @ mirror
    R, _ = poses.rotations_from_matrices(np.concatenate([turn, np.ones((4, 3, 1))], axis=2).reshape(4, 12))
    assert np.isnan(R[2]).all() and np.allclose(R[[0, 1, 3]], turn[[0, 1, 3]])


def test_vectors_are_each_turned_by_their_own():
    turn = Rotation.from_quat(np.random.default_rng(2).normal(size=(5, 4)))
    v = np.random.default_rng(3).normal(size=(5, 3))
    assert np.allclose(poses.rotate(turn.as_matrix(), v), turn.apply(v))


def test_axes_and_forward():
    assert [poses.default_forward(up, hand) for up, hand in (("y", "left"), ("-y", "right"), ("z", "right"))] == [
        "z",
        "-z",
        "x",
    ]
    assert poses.axis("-y", "up").tolist() == [0, -1, 0]
    with pytest.raises(NergError, match='"w"'):
        poses.axis("w", "up")
    with pytest.raises(NergError, match="both z"):
        poses.rotations_from_angles(np.zeros((1, 3)), "z", "-z")


def test_azimuths_turn_right_in_every_frame():
    """Against a way that knows of no cross product: the frame of rays, in which right is x where forward is y."""
    from nerg_mi.rays.readers.base import HANDS, Frame

    a, e = np.radians([35.0, -12.0])
    for up in poses.AXES:
        for hand in HANDS:
            to_rays = Frame(up, hand).to_rays()[:3, :3]
            for forward in (f for f in poses.AXES if f[-1] != up[-1]):
                found = poses.directions_from_azimuths(np.array([[35.0, -12.0]]), up, forward, hand)[0] @ to_rays.T
                ahead = to_rays @ poses.AXES[forward]
                heading = np.arctan2(ahead[0], ahead[1])  # clockwise from y, seen from above
                want = [np.cos(e) * np.sin(heading + a), np.cos(e) * np.cos(heading + a), np.sin(e)]
                assert np.allclose(found, want), (up, hand, forward)
