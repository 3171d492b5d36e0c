"""Greys of hit points: by the axis that a surface faces, in the box of the voxels."""

import numpy as np
import pytest

from nerg_mi.train.geometry import shade_hits


@pytest.mark.parametrize("axis, grey", [(0, 0.34), (1, 0.16), (2, 0.55)])
def test_a_sheet_has_the_grey_of_its_axis(axis, grey):
    density = np.zeros((24, 24, 24), np.float32)
    sheet = [slice(None)] * 3
    sheet[2 - axis] = slice(11, 13)
    density[tuple(sheet)] = 9
    color, upper = shade_hits(density, np.zeros(3), np.full(3, 2.4))
    assert color.shape == (12, 12, 12, 3) and color.dtype == np.float32
    np.testing.assert_allclose(upper, 2.4)
    middle = color[6, 6, 6]
    np.testing.assert_allclose(middle, grey, atol=0.01)


def test_odd_numbers_of_voxels_and_nothing():
    color, upper = shade_hits(np.zeros((5, 4, 3), np.float32), np.array([1.0, 2, 3]), np.array([4.0, 6, 8]))
    assert color.shape == (3, 2, 2, 3) and np.isfinite(color).all()
    # A voxel is 1 wide.
    np.testing.assert_allclose(upper, [5, 6, 9])
