"""What a finer bound keeps of analytic densities, and that what it misses is what it says."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.fields.refinement import STEP_DEPTH, refine
from nerg_mi.maths.geometry import Box

BOX = Box((-1, -2, 0), (3, 2, 2))
R = 16


def field(density, step=0.01, occupancy=None):
    """A field of this density at (x, y, z), all of whose cells may hold some."""
    everywhere = OccupancyGrid(np.ones((R,) * 3, bool), ns, 1.0)
    return SimpleNamespace(
        ns=ns,
        box=BOX,
        march_step=step,
        occupancy=occupancy or everywhere,
        density=lambda p, active=True: dr.select(active & BOX.contains(p), density(p.x, p.y, p.z), 0),
    )


def held(grid, count=200_000):
    """Random points of the box, and whether they lie in occupied parts."""
    p = ns.Array3f(*(ns.Float(v) for v in np.random.default_rng(1).uniform(BOX.lower, BOX.upper, (count, 3)).T))
    return p, grid.empty_cells(BOX.to_cube(p)).numpy() == 0


def test_what_counts_is_held_and_nothing_far_from_it():
    def wall(x, y, z):
        # A third of a part thick, aslant, and as dense as anything.
        away = dr.abs(x + 0.3 * y - 0.7 * z - 0.2) / np.sqrt(1 + 0.3**2 + 0.7**2)
        return dr.select(away < 0.02, ns.Float(1e6), 0)

    grid = refine(field(wall))
    p, inside = held(grid)
    dense = wall(*p).numpy() > 0
    assert dense.sum() > 2000 and inside[dense].mean() > 0.995
    # Parts are 4 / 32 long: what is a diagonal away from the wall cannot hold it.
    far = wall(p.x * 0.0 + p.x, p.y, p.z).numpy() == 0
    assert inside[far].mean() < 0.2
    assert grid.missed < 0.02


def test_a_wire_is_missed_as_much_as_is_said():
    # A twentieth of a part thick: many parts are looked at beside it.
    radius, sigma, step = 0.003, 1e3, 0.01
    wire = lambda x, y, z: dr.select((x - 0.42) ** 2 + (y - 0.13) ** 2 < radius**2, ns.Float(sigma), 0)
    grid = refine(field(wire, step))
    through = ns.Float(np.linspace(0, 2, 4001)[1:-1])
    inside = grid.empty_cells(BOX.to_cube(ns.Array3f(0.42, 0.13, through))).numpy() == 0
    lost = (1 - np.exp(-sigma * step)) / step * np.pi * radius**2 * 2 * (1 - inside.mean())
    assert grid.missed == pytest.approx(lost * 4 / 64, abs=1e-3)


def test_fog_below_the_threshold_is_missed_by_its_mean_depth():
    thin = 0.5 * STEP_DEPTH / 0.01
    grid = refine(field(lambda x, y, z: thin + 0 * x))
    assert not grid.masks.any()
    # The mean chord of a box is 4 V / S: 4 x 4 x 2 has V = 32, S = 64.
    assert grid.missed == pytest.approx(thin * 2, rel=0.02)
    thick = refine(field(lambda x, y, z: 4 * thin + 0 * x))
    # The box is half as high as the cube that cells divide.
    assert thick.fraction == pytest.approx(0.5, abs=0.04) and thick.missed == 0


def test_cells_that_are_empty_stay_so_and_the_bound_is_one_of_the_field():
    bits = np.random.default_rng(2).random((R,) * 3) < 0.3
    smooth = lambda x, y, z: dr.exp(6 * dr.sin(3 * x) * dr.cos(2 * y) - 2)
    one, other = (refine(field(smooth, occupancy=OccupancyGrid(bits, ns, 1.0))) for _ in range(2))
    assert np.array_equal(one.coarse_bits, bits) and np.array_equal(one.masks, other.masks)
    # Again, from the refined grid: the same.
    again = refine(field(smooth, occupancy=one))
    assert np.array_equal(again.masks, one.masks) and again.threshold == one.threshold == STEP_DEPTH / 0.01
    assert again.coarse_threshold == 1.0


def test_nested_cubes_and_nothing_are_not_refined():
    nested = CascadeGrid(np.ones((2, 4, 4, 4), bool), 2.0, ns, 0.1)
    assert refine(field(lambda x, y, z: x, occupancy=nested)) is None
    nothing = field(lambda x, y, z: x)
    nothing.occupancy = None
    assert refine(nothing) is None
    empty = refine(field(lambda x, y, z: x, occupancy=OccupancyGrid(np.zeros((R,) * 3, bool), ns, 0.1)))
    assert empty.missed == 0 and empty.masks.size == 0
