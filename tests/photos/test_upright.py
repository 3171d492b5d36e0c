"""Up, of cameras and points whose up is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.photos.colmap import find_up, turn_to_z

SOME = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()


def around(count: int = 24, arc: float = 2 * np.pi, down: float = 30.0, roll: float = 0.0, seed: int = 0) -> np.ndarray:
    """Cameras on an arc about the z axis, looking ``down`` by so many degrees, rolled by up to ``roll``."""
    rng, out = np.random.default_rng(seed), []
    for a in np.linspace(0, arc, count, endpoint=False):
        back = np.array([np.cos(a) * np.cos(np.radians(down)), np.sin(a) * np.cos(np.radians(down)), 0])
        back[2] = np.sin(np.radians(down))
        right = np.cross([0, 0, 1], back) / np.cos(np.radians(down))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-roll, roll))]).as_matrix()
        pose[:3, 3] = 3 * back + [0, 0, 1]
        out.append(pose)
    return np.array(out)


def turned(poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = poses.copy()
    out[:, :3] = SOME @ poses[:, :3]
    return out, points @ SOME.T


def angle(up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(up @ SOME[:, 2], -1, 1))))


NOTHING = np.zeros((0, 3))


@pytest.mark.parametrize("arc, most", [(2 * np.pi, 0.01), (np.pi, 1.0), (np.pi / 2, 4.0)])
def test_level_cameras_tell_it_wherever_they_look_down(arc, most):
    up = find_up(*turned(around(arc=arc), NOTHING))
    assert angle(up.direction) < most and up.roll < most and up.plane is None and up.sure


def test_cameras_that_all_look_ahead_tell_it_by_their_pictures():
    """Their horizontal axes agree, and leave open how far they look down."""
    up = find_up(*turned(np.repeat(around(1, down=10), 8, axis=0), NOTHING))
    assert angle(up.direction) == pytest.approx(10, abs=0.01)


def test_a_few_that_are_held_on_end_do_not_matter():
    poses = around(30)
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    poses[::6, :3, :3] = poses[::6, :3, :3] @ quarter
    up = find_up(*turned(poses, NOTHING))
    assert angle(up.direction) < 1 and up.sure


def floor(count: int = 900, walls: int = 900) -> np.ndarray:
    rng = np.random.default_rng(3)
    ground = rng.uniform(-2, 2, (count, 3)) * [1, 1, 0.003]
    wall = rng.uniform(-2, 2, (walls, 3)) * [1, 0.003, 1] + [0, 2, 1]
    return np.concatenate([ground, wall, rng.uniform(-2, 2, (300, 3))])


def test_a_floor_is_more_exact_than_hands():
    poses, points = turned(around(roll=20, seed=1), floor())
    by_hands, up = find_up(poses, NOTHING), find_up(poses, points)
    assert angle(up.direction) < 0.3 < angle(by_hands.direction)
    assert 0.35 < up.plane < 0.55 and up.between == pytest.approx(angle(by_hands.direction), abs=0.4)
    assert "plane of" in str(up) and "no plane" in str(by_hands)


def test_walls_ceilings_and_lines_are_no_floor():
    poses = around()
    walls = floor(count=0)
    ceiling = floor(walls=0) + [0, 0, 6]
    edge = np.random.default_rng(0).uniform(-2, 2, (900, 3)) * [1, 0.003, 0.003]
    for points in (walls, ceiling, edge):
        assert find_up(*turned(poses, points)).plane is None


def test_cameras_that_do_not_agree_say_so():
    assert not find_up(*turned(around(roll=180), NOTHING)).sure


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, -0.8]])
def test_up_becomes_z(up):
    turn = turn_to_z(np.array(up, float))
    assert np.allclose(turn @ up, [0, 0, 1]) and np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) > 0
