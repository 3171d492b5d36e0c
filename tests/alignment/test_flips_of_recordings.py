"""Gaze that was recorded by Aria's glasses against the points that they triangulated, as it is and with mistakes."""

import numpy as np
import pytest

from nerg_mi.alignment.tracking import DECLARED, compare_flips
from nerg_mi.photos.posed import read_semidense
from nerg_mi.rays.readers.registry import read_rays


@pytest.mark.parametrize("file", ["eye_gaze/generalized_eye_gaze.csv", "eye_gaze_vergence/generalized_gaze.csv"])
def test_each_planted_mistake_is_named(file, recorded):
    sample = recorded("aria") / "gen1" / "mps_sample"
    rays, points = read_rays("aria", sample / file), read_semidense(sample / "trajectory" / "global_points.csv.gz")
    flips = compare_flips(points, np.eye(4), rays.origin, rays.direction, rays.head)
    assert flips.warning() is None and np.median(flips.degrees[DECLARED]) < 0.2
    left = np.cross((0, 0, 1), rays.head)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    mistakes = {f"{'xyz'[k]} of the directions negated": np.eye(3)[k][None] for k in range(3)}
    mistakes |= {"left and right of the eyes": left, "up and down of the eyes": np.cross(rays.head, left)}
    for name, axis in mistakes.items():
        wrong = rays.direction - 2 * np.sum(rays.direction * axis, axis=1, keepdims=True) * axis
        assert name in str(compare_flips(points, np.eye(4), rays.origin, wrong, rays.head).warning())
