"""Pixels and angles of a scene camera."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.scene_glasses import SceneCamera, angles_between, directions_from_angles
from tests.rays.readers import own_camera
from tests.rays.readers.scene_examples import LENS, MATRIX

SIZE = (1600, 1200)


def test_pixels_lead_back_to_where_they_came_from():
    gaze = own_camera.gaze_in_camera(500)
    camera = SceneCamera.of_opencv(MATRIX, list(LENS.values()), SIZE)
    assert np.abs(camera.directions(own_camera.project(gaze, MATRIX, **LENS)) - gaze).max() < 1e-10
    plain = SceneCamera.of_opencv(MATRIX, None)
    assert np.allclose(plain.directions(np.array([[810.0, 605.0]])), [[0, 0, 1]])
    # Four zeros of thin prisms follow in some files.
    padded = SceneCamera.of_opencv(np.ravel(MATRIX), [list(LENS.values()) + [0] * 4], SIZE)
    assert padded == camera


def test_beyond_the_picture_there_is_no_direction():
    camera = SceneCamera.of_opencv(MATRIX, list(LENS.values()), SIZE)
    pixels = np.array([[-1.0, 600], [800, 1200.2], [np.nan, 3], [-0.4, 0], [1599.4, 1199]])
    assert np.isnan(camera.directions(pixels)).any(axis=1).tolist() == [True, True, True, False, False]
    folding = SceneCamera.of_opencv(MATRIX, [-0.4], None)
    far = folding.directions(np.array([[811.0, 605.0], [3000.0, 605.0]]))
    assert np.isfinite(far[0]).all() and np.isnan(far[1]).all()


def test_angles():
    gaze = own_camera.gaze_in_camera(50, 3)
    assert np.abs(directions_from_angles(own_camera.angles(gaze)) - gaze).max() < 1e-12
    assert np.allclose(directions_from_angles(np.array([[90.0, 0], [0, 90]])), [[1, 0, 0], [0, -1, 0]])
    assert np.allclose(
        angles_between(np.eye(3), np.array([[1, 1e-9, 0], [0, 2, 2], [0, 0, -1]])), [np.degrees(1e-9), 45, 180]
    )


@pytest.mark.parametrize("matrix", [None, [[1, 2]], "abc", np.full((3, 3), np.nan), np.eye(3) * -1, np.eye(3) * 1e9])
def test_what_is_no_camera(matrix):
    with pytest.raises(NergError, match="the calibration"):
        SceneCamera.of_opencv(matrix, None)
