"""Sensors of figures: level poses and films."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment.sensors import make_film, upright_pose
from nerg_mi.errors import NergError
from nerg_mi.figures.occlusion import draw_sphere
from nerg_mi.ranges import find_ranges


def camera(mi, origin, target, up):
    return mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(origin, target, up)})


@pytest.mark.parametrize(
    "target, up, level, heading",
    [
        ((4, 6, 0.5), (0, 0, 1), (0, 0, 1), (0.6, 0.8, 0)),  # looks down a little, z up
        ((1, 2.5, -9), (0, 1, 0), (0, 1, 0), (0, 0, -1)),  # y up
        ((1, 9, 3), (0, 0, -1), (0, 0, -1), (0, 1, 0)),  # upside down
    ],
)
def test_a_level_pose(rgb, target, up, level, heading):
    matrix = np.array(upright_pose(camera(rgb, (1, 2, 3), target, up)).matrix, float)
    np.testing.assert_allclose(matrix[:3, 3], (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 1], level, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 2], heading, atol=1e-6)


def test_a_camera_looking_straight_down_has_a_heading(rgb):
    matrix = np.array(upright_pose(camera(rgb, (0, 0, 3), (0, 0, 0), (0, 1, 0))).matrix, float)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)


def test_a_film_that_is_too_large_is_refused():
    assert make_film(30, 20)["rfilter"] == {"type": "box"}
    with pytest.raises(NergError, match="4,096.*4,096"):
        make_film(4096, 4096)
    # The widest sphere, which takes a gigabyte to draw, is allowed.
    width = find_ranges(draw_sphere)["width"].high
    assert make_film(width, width // 2)["width"] == width
