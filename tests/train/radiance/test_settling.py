"""Cells that rendering will visit are found a piece at a time, and are then sampled whatever is found in them."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.train.radiance_grid import DensityGrid, Settling

from .test_density_grid import BOX, R, above, around, centres, cube, grown


def settle(grid, density, lit, settling=None):
    settling = settling or Settling(grid)
    while not settling.done:
        settling.advance(density, lit, 0)
    return settling


def empty(p, active):
    return dr.zeros(ns.Float, dr.width(p))


def everywhere(density, occupied, rng):
    """Points of lit samples: the centres of all occupied cells, and of others none."""
    p = ns.Array3f(np.ascontiguousarray(centres().reshape(-1, 3).T, np.float32))
    return dr.gather(ns.Array3f, p, dr.compress(occupied(p, True)))


def test_dense_cells_that_are_lit_and_their_neighbours_stay_on():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    settle(grid, around(centres()[3, 4, 2], 0.1), everywhere)
    grid.update(empty, np.random.default_rng(0), everywhere=True)
    held = np.zeros((R, R, R), bool)
    held[3, 4, 2] = True
    # Neighbours of the dense cell are occupied when the rays are looked at, and lit here: only what touches none is
    # not.
    assert np.array_equal(cube(grid.bits) > 0, grown(held))


def test_what_lights_no_ray_is_left_out():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    one = ns.Array3f(*map(float, centres()[5, 1, 6]))
    settle(grid, around((0, 0, 0), 9), lambda density, occupied, rng: one)
    grid.update(empty, np.random.default_rng(0), everywhere=True)
    lit = np.zeros((R, R, R), bool)
    lit[5, 1, 6] = True
    assert np.array_equal(cube(grid.bits) > 0, grown(lit))
    none = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    settle(none, around((0, 0, 0), 9), lambda density, occupied, rng: None)
    assert not none.always.numpy().any()


def test_no_piece_asks_for_more_than_a_part_of_the_cells():
    grid, asked = DensityGrid(ns, BOX, R, 0.1, above(), 1), []

    def density(p, active):
        asked.append(dr.width(p))
        return empty(p, active)

    settling = settle(grid, density, everywhere)
    assert max(asked) <= R**3 / 8 and sum(asked) == 4 * R**3
    settling.advance(density, everywhere, 0)
    assert sum(asked) == 4 * R**3 and settling.at == Settling.PIECES


def test_settling_goes_on_from_a_stored_state():
    lit = lambda density, occupied, rng: ns.Array3f(
        *[ns.Float(x) for x in rng.uniform(-1, 1, (3, 2)).astype(np.float32)]
    )
    density, whole, resumed = around((0.2, 0.1, 0), 0.6), *(DensityGrid(ns, BOX, R, 0.1, above(), 1) for _ in range(2))
    settle(whole, density, lit)
    for stop in (5, 40):
        first, second = Settling(DensityGrid(ns, BOX, R, 0.1, above(), 1)), Settling(resumed)
        while first.at < stop:
            first.advance(density, lit, 0)
        second.restore(first.at, first.found.numpy(), first.shown.numpy())
        settle(resumed, density, lit, second)
        assert np.array_equal(whole.always.numpy(), resumed.always.numpy())
        resumed = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    assert whole.always.numpy().any() and not whole.always.numpy().all()
