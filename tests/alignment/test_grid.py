import numpy as np
from scipy.interpolate import RegularGridInterpolator

from nerg_mi.alignment.constraints import DistanceGrid

GRID = DistanceGrid(np.random.default_rng(0).random((6, 7, 5)), np.array([-1.0, 0, 2]), 0.5)


def test_inside_it_is_the_trilinear_interpolation():
    axes = [GRID.lower[a] + GRID.step * np.arange(n) for a, n in enumerate(GRID.values.shape)]
    p = np.random.default_rng(1).uniform(GRID.lower, GRID.upper, (300, 3))
    np.testing.assert_allclose(GRID.at(p), RegularGridInterpolator(axes, GRID.values)(p), atol=1e-12)


def test_beyond_it_the_distance_to_it_is_added():
    p = GRID.upper + np.array([[3.0, 4, 0], [0, 0, 2]])
    np.testing.assert_allclose(GRID.at(p), GRID.values[-1, -1, -1] + np.array([5, 2]))


def test_gradients_are_those_of_central_differences():
    p = np.random.default_rng(2).uniform(GRID.lower - 1, GRID.upper + 1, (500, 3))
    slope = GRID.with_slope(p)[1]
    for a, e in enumerate(1e-7 * np.eye(3)):
        np.testing.assert_allclose(slope[:, a], (GRID.at(p + e) - GRID.at(p - e)) / 2e-7, atol=1e-6)


def test_a_lattice_of_one_layer_has_no_slope_across():
    flat = DistanceGrid(np.arange(4.0).reshape(4, 1, 1), np.zeros(3), 1.0)
    value, slope = flat.with_slope(np.array([[1.5, 0, 0]]))
    assert value[0] == 1.5 and slope[0].tolist() == [1, 0, 0]
