"""Cells in parts: what is occupied stays so, and no leap passes it."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.occupancy import PARTS, RefinedGrid

from .test_occupancy import brute_force


def refined(resolution=7, share=0.2, seed=0):
    rng = np.random.default_rng(seed)
    bits = rng.random((resolution,) * 3) < share
    return RefinedGrid(bits, rng.integers(0, 256, bits.sum(), np.uint8), ns, 0.1, 0.5, 1e-4)


def centres(n):
    z, y, x = np.meshgrid(*(np.arange(n),) * 3, indexing="ij")
    return (np.stack([x, y, z]).reshape(3, -1) + 0.5) / n


@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_no_leap_passes_an_occupied_part(share):
    grid = refined(share=share)
    found = grid.empty_cells(ns.Array3f(centres(grid.resolution))).numpy().reshape(grid.bits.shape)
    away = brute_force(grid.bits)
    assert np.array_equal(found == 0, grid.bits) and np.all(found <= away)
    # Nor is it much too short: never less than half of the way, but for a part.
    assert np.all(2 * found + PARTS > away)


def test_parts_are_those_of_their_cells():
    bits = np.zeros((3, 3, 3), bool)
    bits[2, 0, 1] = True  # z = 2, y = 0, x = 1
    # The part with the upper x, the lower y and the upper z.
    grid = RefinedGrid(bits, np.array([1 << 0b101]), ns, 0.1, 0.5, 0)
    assert np.argwhere(grid.bits).tolist() == [[5, 0, 3]]
    assert grid.cells == (6, 6, 6) and grid.fraction == 1 / 216
    points = ns.Array3f([3.5 / 6, 2.5 / 6, 3.5 / 6], [0.1 / 6, 0.1 / 6, -4], [5.5 / 6, 5.5 / 6, 9])
    assert grid.empty_cells(points).numpy().tolist() == [0, 1, 0]
    assert np.array_equal(grid.coarse.bits, bits) and grid.coarse.threshold == 0.5


def test_cells_without_parts_are_empty():
    grid = RefinedGrid(np.ones((2, 2, 2), bool), np.zeros(8, np.uint8), ns, 0, 0, 0)
    assert np.all(grid.empty_cells(ns.Array3f(centres(4))).numpy() > 4)


def test_bytes_that_do_not_fit():
    with pytest.raises(ValueError, match="7.*8.*2.*2.*2"):
        RefinedGrid(np.ones((2, 2, 2), bool), np.zeros(7, np.uint8), ns, 0, 0, 0)
