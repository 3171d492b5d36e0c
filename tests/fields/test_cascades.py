"""Cascades of occupancy against all cells of the finest size, one by one."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.occupancy import CascadeGrid, contracted_cascades
from nerg_mi.maths.geometry import Box, ContractedBox

R = 4


def made(bound, share, seed=0):
    rng = np.random.default_rng(seed)
    levels = 1 + int(np.ceil(np.log2(bound)))
    bits = rng.random((levels, R, R, R)) < share
    if seed % 2:
        bits[1:] = False  # what is far away is empty, so that leaps are long
        bits[-1, 0, 0, 0] = True
    return CascadeGrid(bits, bound, ns, 0.25), bits


def middles(grid):
    """Unit-cube middles (n, n, n, 3) of the common cells, [z, y, x]."""
    n = grid.cells[0]
    c = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def occupied(grid, bits, bound):
    """Whether each common cell is occupied: by the bit of the finest level that reaches it."""
    p = (middles(grid) - 0.5) * 2 * bound
    out = np.zeros(p.shape[:3], bool)
    for index in np.ndindex(out.shape):
        far = np.abs(p[index]).max()
        level = next(k for k in range(len(bits)) if far < min(2**k, bound))
        half = min(2**level, bound)
        x, y, z = ((p[index] / half + 1) / 2 * R).astype(int)
        out[index] = bits[level][z, y, x]
    return out


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("bound", [1, 2, 4])
def test_cells_are_those_of_the_finest_level_and_leaps_pass_over_nothing(bound, seed):
    grid, bits = made(bound, 0.1, seed)
    full = occupied(grid, bits, bound)
    n = grid.cells[0]
    assert n == R * bound and grid.fraction == pytest.approx(full.mean()) and 0 < full.mean() < 1
    u = middles(grid).reshape(-1, 3)
    k = grid.empty_cells(ns.Array3f(np.ascontiguousarray(u.T, np.float32))).numpy().reshape(full.shape)
    assert np.array_equal(k == 0, full)
    held = np.argwhere(full)
    where = np.argwhere(~full)
    nearest = np.abs(where[:, None] - held[None]).max(axis=2).min(axis=1)
    told = k[~full]
    assert (told >= 1).all() and (told <= nearest).all()
    # Where the levels agree nothing is given away but what a coarse cell hides.
    assert bound > 1 or np.array_equal(told, nearest)
    assert bound == 1 or seed == 0 or told.max() > 2


def test_points_beyond_the_cube_count_as_its_nearest_cell():
    grid, bits = made(4, 0.3)
    inside = np.random.default_rng(2).uniform(0, 1, (200, 3))
    inside[:, 1] = 0.001
    beyond = inside - (0, 3, 0)
    of = lambda u: grid.empty_cells(ns.Array3f(np.ascontiguousarray(u.T, np.float32))).numpy()
    assert np.array_equal(of(inside), of(beyond))


@pytest.mark.parametrize("bound", [1, 2, 4])
def test_bytes_and_back(bound):
    grid, bits = made(bound, 0.3)
    again = CascadeGrid.from_packed(grid.packed(), R, bound, ns, 0.25)
    assert np.array_equal(again.bits, bits) and again.threshold == 0.25 and again.resolution == R
    with pytest.raises(ValueError, match="bytes"):
        CascadeGrid.from_packed(grid.packed()[:-1], R, bound, ns, 0.25)


@pytest.mark.parametrize("reach", [2.0, 8.0, 64.0])
def test_cascades_of_a_contracted_box_hold_all_that_its_cells_hold(reach):
    rng, r = np.random.default_rng(int(reach)), 16
    box, bits = ContractedBox(Box((0, 0, 0), (2, 2, 2)), reach), rng.random((r, r, r)) < 0.02
    grid = contracted_cascades(bits, reach, ns, 1.0)
    u = rng.random((3, 200_000)).astype(np.float32)
    x, y, z = np.minimum((u * r).astype(int), r - 1)
    p = box.from_unit(ns.Array3f(u))
    # Those of the corners beyond the outer cube come to stand on its face, in other cells.
    held = (np.abs((u - 0.5) * 4).max(axis=0) < 2 - 1 / reach) & bits[z, y, x]
    assert held.sum() > 500 and np.all(grid.empty_cells(box.to_cube(p)).numpy()[held] == 0)
    # They are not much larger either: by the cells that touch.
    assert grid.bits[0].mean() < 0.2 and not contracted_cascades(np.zeros((r, r, r), bool), reach, ns, 1.0).bits.any()
