"""Single steps of a march: how long they are, that each moves on, and what is leapt over."""

from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.transport.march_primal import MarchSettings, advance, leap, step_length
from nerg_mi.transport.medium import VoxelCells

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


def test02_a_march_goes_on_where_it_begins_on_a_wall(rgb):
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


def test03_how_long_a_step_is(rgb):
    t = rgb.Float([0, 1, 10, 1e6])
    assert np.allclose(step_length(t, MarchSettings(0.1)).numpy(), [0.1, 0.1, 0.1, 1e6 * 2.0**-21])
    assert np.allclose(step_length(t, MarchSettings(0.1, dt_gamma=0.02)).numpy(), [0.1, 0.1, 0.2, 2e4])
    # Coarse ones end at the last moment where fine ones are to begin.
    fine_from = rgb.Float(1.45)
    t = rgb.Float([0, 1, 1.1, 2])
    assert np.allclose(step_length(t, MarchSettings(0.1, coarse=4), fine_from).numpy(), [0.4, 0.4, 0.1, 0.1])


@pytest.mark.parametrize("share", [1.0, 0.3])
def test04_leaps_pass_the_steps_whose_middle_lies_in_an_empty_cell_and_no_others(rgb, share):
    bits = np.zeros((16, 1, 1), bool)
    bits[11] = True
    same = lambda v: v
    medium, grid = SimpleNamespace(to_unit=same, vector_to_unit=same), OccupancyGrid(bits, ns, 0)
    ray = SimpleNamespace(o=ns.Array3f(0.5, 0.5, 0), d=ns.Array3f(0, 0, 1))
    step = 1 / 43
    borders = np.concatenate([[0], (share + np.arange(44)) * step])
    middles = 0.5 * (borders[:-1] + borders[1:])
    want = borders[np.argmax(np.floor(16 * middles) == 11)]
    t, first = leap(
        medium, grid, ray, ns.Float(0), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert np.isclose(t[0], want, atol=1e-6) and first[0] == 1
    # From inside matter nothing is passed, and the first step stays as short as it was.
    t, first = leap(
        medium, grid, ray, ns.Float(0.7), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert np.isclose(t[0], 0.7) and np.isclose(first[0], share)
    # Behind all matter they lead out of the box.
    t, _ = leap(
        medium, grid, ray, ns.Float(0.8), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert t[0] >= 1


def test05_leaps_of_coarse_steps_end_where_fine_ones_begin(rgb):
    bits = np.zeros((16, 1, 1), bool)
    bits[11] = True
    same = lambda v: v
    medium, grid = SimpleNamespace(to_unit=same, vector_to_unit=same), OccupancyGrid(bits, ns, 0)
    ray = SimpleNamespace(o=ns.Array3f(0.5, 0.5, 0), d=ns.Array3f(0, 0, 1))
    step, fine = 1 / 43, 0.52
    t, _ = leap(
        medium,
        grid,
        ray,
        ns.Float(0),
        ns.Float(1),
        ns.Float(1),
        MarchSettings(step, coarse=4),
        ns.Bool(True),
        ns.Float(fine),
    )
    middles = fine + (np.arange(22) + 0.5) * step
    assert t.numpy() == pytest.approx(fine + np.argmax(np.floor(16 * middles) == 11) * step, abs=1e-6)
