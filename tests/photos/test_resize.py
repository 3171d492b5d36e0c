"""Pictures at another size, against sums over the pixels that each new one covers."""

import numpy as np
import pytest

from nerg_mi.photos.cameras import all_used, area_average, nearest, overlap


def averaged(image, width, height):
    """The same by a picture of every sub-pixel, of which old and new pixels both have a whole number."""
    h, w, c = image.shape
    fine = image.repeat(height, axis=0).repeat(width, axis=1)
    return fine.reshape(height, h, width, w, c).mean(axis=(1, 3))


@pytest.mark.parametrize("size", [(3, 2), (5, 4), (7, 6), (1, 1)])
def test_areas_are_averaged(size):
    image = np.random.default_rng(0).random((6, 7, 3)).astype(np.float32)
    assert np.allclose(area_average(image, *size), averaged(image, *size), atol=1e-6)


def test_colours_count_by_their_alpha():
    image = np.zeros((1, 2, 4), np.float32)
    image[0, 0], image[0, 1] = (1, 0.5, 0, 0.25), (0, 0, 1, 0.75)
    assert np.allclose(area_average(image, 1, 1)[0, 0], [0.25, 0.125, 0.75, 0.5])
    assert np.all(area_average(image * [1, 1, 1, 0], 1, 1) == 0)


def test_every_old_pixel_is_shared_out():
    shares = overlap(7, 3).toarray()
    assert np.allclose(shares.sum(axis=1), 1) and np.allclose(shares.sum(axis=0), 3 / 7)


def test_the_nearest_value_is_that_of_the_centre():
    values = np.arange(12.0).reshape(3, 4)
    assert np.array_equal(nearest(values, 2, 1), [[5, 7]]) and np.array_equal(nearest(values, 4, 3), values)


def test_a_pixel_counts_where_all_of_it_does():
    mask = np.ones((4, 4), bool)
    mask[1, 2] = False
    assert np.array_equal(all_used(mask, 2, 2), [[True, False], [True, True]])
    assert all_used(mask, 4, 4) is mask
