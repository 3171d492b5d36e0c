"""Where observers meet surfaces: what escapes ends on the box, or at the depth around it."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.train.gaze_data import box_exit, surface_distances
from nerg_mi.train.geometry import NOWHERE, GazePlace
from nerg_mi.transport.volume_medium import VolumeMedium

BOX = Box((-2, -2, 0), (2, 2, 3))


@pytest.fixture
def wall(rgb):
    """An opaque slab behind x = 1.5, in BOX."""
    data = np.zeros((6, 8, 8, 1), np.float32)
    data[:, :, 7] = 200
    to_world = rgb.ScalarTransform4f().translate([-2, -2, 0]).scale([4, 4, 3])
    volume = {"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest", "to_world": to_world}
    return GazePlace(VolumeMedium(rgb.load_dict(volume)), BOX, "scene")


def test_what_meets_nothing_ends_where_the_box_ends(wall):
    positions = np.array([[-0.5, 0, 1.6], [0.2, -0.4, 1.5]])
    directions = np.tile(fibonacci_directions(256), (2, 1, 1))
    distance, escaped = surface_distances(wall, positions, directions)
    p = positions[:, None] + directions * distance[..., None]
    # The wall is met from x = 1.5 on, everything else ends on the box.
    assert np.abs(p[~escaped][:, 0] - 1.5).max() < 0.02
    on_box = np.minimum(np.abs(p - BOX.lower), np.abs(p - BOX.upper)).min(axis=-1)
    assert on_box[escaped].max() < 1e-5 and 0.5 < escaped.mean() < 0.95


def test_holes_are_filled_with_the_depth_around_them(wall):
    """Of directions that look past the wall, the ones beside it are as far as it is."""
    positions, directions = np.array([[-0.5, 0, 1.6]]), fibonacci_directions(1024)[None]
    plain, escaped = surface_distances(wall, positions, directions)
    filled, same = surface_distances(wall, positions, directions, fill=True)
    np.testing.assert_array_equal(escaped, same)
    np.testing.assert_array_equal(filled[~escaped], plain[~escaped])
    assert plain[~escaped].min() <= filled[escaped].min() and filled[escaped].max() <= plain[~escaped].max()
    nothing = np.array([[[-1.0, 0, 0], [-0.8, 0.6, 0]]])
    np.testing.assert_array_equal(*(surface_distances(wall, positions, nothing, fill=f)[0] for f in (True, False)))


def test_without_geometry_everything_is_equally_far():
    distance, escaped = surface_distances(GazePlace(None, BOX, "none"), np.zeros((3, 3)), np.ones((3, 5, 3)))
    assert distance.shape == (3, 5) and (distance == NOWHERE).all() and not escaped.any()


def test_exits_of_a_box():
    o = np.array([[0, 0, 1.0], [0, 0, 1], [5, 0, 1], [5, 0, 1], [0, 2, 1]])
    d = np.array([[1.0, 0, 0], [0, 0, -1], [-1, 0, 0], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(box_exit(BOX, o, d), [2, 1, 7, BOX.diagonal, 2])
