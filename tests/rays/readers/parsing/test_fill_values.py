"""Fill values in place of vectors."""

import numpy as np
import pytest

from nerg_mi.rays.readers.values import FilledOrigins, fill_values, is_aimed


def test_values():
    v = np.array([[0, 0, -0.0], [-1, -1, -1], [9999, 9999, 9999], [-99, -99, -99], [0.5, 0.5, 0.5], [0, 0, 1e-9]])
    assert np.array_equal(fill_values(v), [0, -1, 9999, -99, np.nan, np.nan], equal_nan=True)


@pytest.mark.parametrize(
    "fill", [-32768, 32767, 65535, -2147483648, 4294967295, 999999, -999999, 3.402823e38, -3.4028235e38]
)
def test_limits_of_types_are_fill_values(fill):
    v = np.array([[fill] * 3, [fill, fill, 0], [1, 1, 1]], float)
    assert np.array_equal(fill_values(v), [fill, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(fill_values(v[:, :2]), [fill, fill, np.nan], equal_nan=True)


def test_infinity_is_no_fill_value():
    assert np.isnan(fill_values(np.full((2, 3), [np.inf, np.inf, np.inf]))).all()


def test_rays_that_point_at_their_hits():
    o, d = np.tile([1.0, 1.6, 2.0], (3, 1)), np.array([[-1, -1.6, -2.0], [0, 0, 1.0], [np.nan, 0, 0]])
    assert is_aimed(o, d, np.zeros((3, 3))).tolist() == [True, False, False]


def places(*rows):
    return np.array(rows, float)


def test_origins_of_a_person_who_is_elsewhere():
    find = FilledOrigins(1.0).find
    walk = places([1, 1.6, 2], [0, 0, 0], [1, 1.6, 2.1], [0, 0, 0], [1, 1.6, 2.2])
    assert find(walk, np.zeros(5, int)).tolist() == [False, True, False, True, False]
    # In a later block without another place.
    assert find(np.zeros((4, 3)), np.zeros(4, int)).all()


def test_origins_that_are_places():
    zeros = np.zeros((3, 3))
    assert not FilledOrigins(1.0).find(zeros, np.zeros(3, int)).any()  # somebody sits there
    track = places([0, 0, 0], [0, 0, 0], [0, 0, 0.01], [0, 0, 0.05], [2, 0, 2])
    assert not FilledOrigins(1.0).find(track, np.zeros(5, int)).any()  # a track begins there
    once = places([0, 0, 0], [1, 1.6, 1], [1, 1.6, 1.1])
    assert not FilledOrigins(1.0).find(once, np.zeros(3, int)).any()
    # In another unit of length.
    near = places([0, 0, 0], [0, 0, 0], [50, 0, 0])
    assert not FilledOrigins(0.001).find(near, np.zeros(3, int)).any()
    assert FilledOrigins(1.0).find(near, np.zeros(3, int)).tolist() == [True, True, False]


def test_people_are_apart():
    """One sits at the origin, another walks, and a third is met there only before anywhere else."""
    origins = FilledOrigins(1.0)
    origin = places([0, 0, 0], [1, 1, 1.6], [0, 0, 0], [0, 0, 0], [2, 1, 1.6], [0, 0, 0], [0, 0, 0])
    person = np.array([0, 1, 0, 1, 1, 1, 2])
    assert np.flatnonzero(origins.find(origin, person)).tolist() == [3, 5]
    assert origins.find(places([3, 3, 3], [0, 0, 0]), np.array([2, 2])).tolist() == [False, True]
    assert origins.undecided == {2: 1}
