"""Poses against others: similarities and errors that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.photos.structure import fit_similarity, pose_errors


def similarity(scale: float, seed: int = 0) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix()
    out[:3, 3] = 1, -2, 3
    return out


def poses(count: int = 12) -> np.ndarray:
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.random(count, random_state=1).as_matrix()
    out[:, :3, 3] = np.random.default_rng(2).normal(size=(count, 3))
    return out


def moved(all_poses: np.ndarray, by: np.ndarray) -> np.ndarray:
    out = all_poses.copy()
    scale = np.cbrt(np.linalg.det(by[:3, :3]))
    out[:, :3, :3] = by[:3, :3] / scale @ all_poses[:, :3, :3]
    out[:, :3, 3] = all_poses[:, :3, 3] @ by[:3, :3].T + by[:3, 3]
    return out


@pytest.mark.parametrize("flat", [False, True])
def test_a_similarity_is_found_again(flat):
    points = np.random.default_rng(0).normal(size=(9, 3)) * [1, 1, 0 if flat else 1]
    by = similarity(2.5)
    assert np.allclose(fit_similarity(points, points @ by[:3, :3].T + by[:3, 3]), by)


def test_a_mirror_is_none():
    points = np.random.default_rng(0).normal(size=(9, 3))
    assert np.linalg.det(fit_similarity(points, points * [1, 1, -1])[:3, :3]) > 0


@pytest.mark.parametrize(
    "points, said", [(np.eye(3)[:2], "3 pairs"), (np.outer(np.arange(5.0), [1, 2, 3]), "on a line")]
)
def test_what_leaves_it_open_is_refused(points, said):
    with pytest.raises(ValueError, match=said):
        fit_similarity(points, points)


def test_errors_do_not_depend_on_coordinates():
    errors = pose_errors(poses(), moved(poses(), similarity(0.3)))
    assert errors.rotation.max() < 1e-6 and errors.position.max() < 1e-12


def test_errors_are_those_that_were_made():
    reference, wrong = poses(), poses()
    wrong[4, :3, :3] = wrong[4, :3, :3] @ Rotation.from_rotvec([0, np.radians(7), 0]).as_matrix()
    errors = pose_errors(wrong, reference)
    assert errors.rotation[4] == pytest.approx(7) and np.delete(errors.rotation, 4).max() < 1e-6
    wrong = poses()
    wrong[:, :3, :3] = wrong[:, :3, :3] @ Rotation.from_rotvec([0.02, -0.01, 0]).as_matrix()
    errors = pose_errors(wrong, reference)
    assert errors.rotation == pytest.approx(np.degrees(np.hypot(0.02, 0.01))) and errors.scatter.max() < 1e-6
    wrong = moved(poses(), similarity(5))
    wrong[0, :3, 3] += 0.01
    assert 0 < pose_errors(wrong, reference).position.argmax() + 1 == 1
