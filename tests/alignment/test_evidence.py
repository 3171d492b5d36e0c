import numpy as np
import pytest

from nerg_mi.alignment.constraints import Target, angles, pair_covariance
from nerg_mi.alignment.similarity import ALL, fit_similarity, scale_of
from nerg_mi.errors import NergError

from .rooms import carried, similarity


def test_angles_are_seen_from_the_viewpoint():
    at, to = np.array([[1.0, 0, 0], [0, 2, 0]]), np.array([[1.0, 1, 0], [0, 2, 2e-7]])
    np.testing.assert_allclose(angles(np.zeros(3), at, to), [45, np.degrees(1e-7)], rtol=1e-6)


def test_the_covariance_is_that_of_many_fits():
    rng = np.random.default_rng(0)
    truth, x, noise = similarity(rng, scale=2.0), rng.normal(size=(12, 3)), 0.02
    exact = carried(truth, x)
    draws = [fit_similarity(x, exact + rng.normal(0, noise, x.shape)) for _ in range(2000)]
    scales = np.log([scale_of(m) for m in draws])
    middle = np.array([carried(m, x.mean(axis=0)[None])[0] for m in draws])
    y = exact + rng.normal(0, noise, x.shape)
    stated = [pair_covariance(x, exact + rng.normal(0, noise, x.shape), fit_similarity(x, y), ALL) for _ in range(50)]
    mean = np.mean(stated, axis=0)
    assert np.sqrt(mean[6, 6]) == pytest.approx(scales.std(), rel=0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(mean)[3:6]), middle.std(axis=0), rtol=0.3)
    assert pair_covariance(x[:2], y[:2], truth, ALL) is None


def test_a_place_is_needed_by_what_asks_for_it():
    with pytest.raises(NergError, match="--field"):
        _ = Target().surface


def test_a_turned_place_is_turned_back():
    rng = np.random.default_rng(1)
    turn, matrix = similarity(rng, scale=1.0), similarity(rng)
    turn[:3, 3] = 0
    np.testing.assert_allclose(turn @ Target(turn=turn).to_place(matrix), matrix, atol=1e-12)
