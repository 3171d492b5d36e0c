"""Poses between samples."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.rays.readers.poses import PoseTrack


def test_between_samples():
    """A quarter turn about z and two metres along x in a second, sampled ten times."""
    times = np.linspace(5, 6, 11)
    vectors = np.outer(times - 5, [0, 0, np.pi / 2])
    places = np.outer(times - 5, [2.0, 0, 0])
    track = PoseTrack.of_samples(times, vectors, places)
    t = np.array([5.0, 5.123, 6.0, 4.99, 6.01, np.nan])
    turn, place, lost = track.at(t, 0.2)
    assert lost.tolist() == [False, False, False, True, True, True]
    assert np.allclose(turn[:3], Rotation.from_rotvec(np.outer(t[:3] - 5, [0, 0, np.pi / 2])).as_matrix())
    assert np.allclose(place[:3, 0], 2 * (t[:3] - 5)) and not place[:3, 1:].any()
    assert np.isfinite(turn).all() and np.isfinite(place).all()


def test_gaps():
    track = PoseTrack.of_samples(np.array([0.0, 0.05, 1.0]), np.zeros((3, 3)), np.zeros((3, 3)))
    assert track.at(np.array([0.02, 0.14, 0.16, 0.5, 0.91]), 0.1)[2].tolist() == [False, False, True, True, False]


@pytest.mark.parametrize("far", [1.1e7, -1e200, 1e308, np.inf])
@pytest.mark.parametrize("of", ["times", "vectors", "places"])
def test_samples_beyond_all_places_are_left_out(far, of):
    samples = {"times": np.arange(4.0), "vectors": np.zeros((4, 3)), "places": np.zeros((4, 3))}
    samples[of][2] = far * (1e14 if of == "times" and abs(far) < 1e100 else 1)
    with np.errstate(over="raise"):
        turn, place, lost = PoseTrack.of_samples(**samples).at(np.array([0.1, 2.0, 2.9]), 0.2)
    assert np.isfinite(turn).all() and np.isfinite(place).all() and lost.tolist() == [False, True, False]


def test_samples_in_any_order_with_something_missing():
    times = np.array([3.0, 1.0, np.nan, 1.0, 2.0, 4.0])
    places = np.arange(18.0).reshape(6, 3)
    places[5, 1] = np.nan
    track = PoseTrack.of_samples(times, np.zeros((6, 3)), places)
    assert track.times.tolist() == [1, 2, 3] and track.places[:, 0].tolist() == [3, 12, 0]
    assert PoseTrack.of_samples(times[:1], np.zeros((1, 3)), places[:1]) is None
    assert PoseTrack.of_samples(times[1:4], np.zeros((3, 3)), places[1:4]) is None
