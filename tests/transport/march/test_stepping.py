"""Single steps of a march: that each moves on, and where fine ones begin."""

import numpy as np
import pytest

from nerg_mi.transport.march.march import fine_start
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.march.stepping import advance
from nerg_mi.transport.media.cells import VoxelCells

from .test_primal import grid


@pytest.mark.parametrize("distance", [0, 3, 300, 3e4, 1e6])
def test01_every_step_moves_on(rgb, distance):
    """Also where a voxel's wall has just been reached, and where voxels are smaller than the spacing of floats."""
    planes = VoxelCells((0, 0, 0), (1, 1, 1), (64, 64, 64), 0.5)
    medium = grid(rgb, np.ones((64, 64, 64)))
    wall = np.float32(distance + (np.arange(64) + 0.5) / 64)
    t = rgb.Float(np.concatenate([wall, np.nextafter(wall, np.float32(0)), np.nextafter(wall, np.float32(2e6))]))
    ray = medium.local(rgb.Point3f(0.4, 0.6, -float(distance)), rgb.Vector3f(0, 0, 1))
    for step in (1e-12, 1e-3, 0.5):
        _, begin, delta, after = advance(
            medium, ray, t, rgb.Float(1e9), rgb.Float(1), MarchSettings(step, cell_step=step), rgb.Bool(True), planes
        )
        assert (after.numpy() > begin.numpy()).all() and np.array_equal(delta.numpy(), after.numpy() - begin.numpy())


def test02_fine_steps_begin_before_matter_does(rgb):
    """A step of the scout before where it found the first trace, so that none of the matter is marched coarsely."""
    for face in (0.3, 0.55, 0.9):
        data = np.zeros((200, 1, 1))
        data[round(200 * face) :] = 30
        medium = grid(rgb, data, filter_type="nearest")
        ray = medium.local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
        settings = MarchSettings(0.01, coarse=8)
        start, evals = fine_start(medium, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)
        assert face - 2.1 * 0.08 < start[0] < face and 1 <= evals[0] <= 14
    vacuum = grid(rgb, np.zeros((4, 1, 1)))
    assert fine_start(vacuum, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)[0][0] == np.inf


def test03_a_march_goes_on_where_it_begins_on_a_wall(rgb):
    """Whatever rounding says of the boundary that has just been reached, also at the ray's very start."""

    class Reached:
        edge = 1 / 64

        def next_boundary(self, ray, t):
            return t - 1e-7

    medium = grid(rgb, np.ones((4, 4, 4)))
    t = rgb.Float([0, 1e-30, 1e-3, 5, 1e6])
    ray = medium.local(rgb.Point3f(0.4, 0.6, 0), rgb.Vector3f(0, 0, 1))
    _, begin, delta, after = advance(
        medium, ray, t, rgb.Float(1e9), rgb.Float(1), MarchSettings(0.01), rgb.Bool(True), Reached()
    )
    assert (after.numpy() > begin.numpy()).all() and (delta.numpy() > 0).all()
    # Nothing that counts is passed over.
    assert (delta.numpy() <= 2e-6 * np.maximum(t.numpy(), 0.01)).all()
