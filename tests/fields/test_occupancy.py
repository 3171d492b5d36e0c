"""Occupancy: distances against brute force, look-ups, and the packed form."""

import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from nerg_mi.fields.occupancy import OccupancyGrid, chessboard


def brute_force(bits):
    occupied = np.argwhere(bits)
    cells = np.argwhere(np.ones_like(bits))
    return np.abs(cells[:, None] - occupied[None]).max(-1).min(-1).reshape(bits.shape)


@pytest.mark.parametrize("share", [0.002, 0.05, 0.9])
def test01_chessboard_distances(share):
    bits = np.random.default_rng(0).random((9, 9, 9)) < share
    bits[2, 5, 7] = True
    grid = OccupancyGrid(bits, ns, 0.1)
    assert np.array_equal(grid.distance.numpy().reshape(bits.shape), brute_force(bits))
    assert np.isclose(grid.fraction, bits.mean())


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 131), (3, 2, 64), (300, 1, 2)])
def test01_rows_of_any_length_and_the_farthest(shape):
    """Rows that fill words of 64 cells, or not; beyond 255 all are alike."""
    bits = np.random.default_rng(1).random(shape) < 0.01
    bits[0, 0, 0] = True
    expected = np.minimum(distance_transform_cdt(~bits, metric="chessboard"), 255)
    assert np.array_equal(chessboard(bits), expected) and chessboard(bits).dtype == np.uint8
    bits[...] = False
    assert (chessboard(bits) == 255).all()


def test02_lookup_is_indexed_zyx_and_clamped():
    bits = np.zeros((4, 4, 4), bool)
    bits[3, 1, 0] = True  # z = 3, y = 1, x = 0
    grid = OccupancyGrid(bits, ns, 0.1)
    points = np.array(
        [[0.1, 0.4, 0.9], [0.3, 0.4, 0.9], [0.9, 0.4, 0.9], [0, 0.25, 0.75], [0.1, 0.4, 1.0], [-5, 0.4, 9], [1, 1, 0]]
    )
    assert grid.empty_cells(ns.Array3f(points.T)).numpy().tolist() == [0, 1, 3, 0, 0, 0, 3]


def test03_empty_full_and_far():
    assert np.all(OccupancyGrid(np.zeros((3, 3, 3), bool), ns, 1).distance.numpy() == 255)
    assert np.all(OccupancyGrid(np.ones((3, 3, 3), bool), ns, 1).distance.numpy() == 0)


def test04_distances_beyond_a_byte_do_not_wrap():
    bits = np.zeros((260, 260, 260), bool)
    bits[0, 0, 0] = True
    grid = OccupancyGrid(bits, ns, 1)
    assert grid.empty_cells(ns.Array3f(0.9999, 0.5, 0.5)).numpy()[0] == 255
    assert grid.empty_cells(ns.Array3f(254.5 / 260, 0.5, 0.5)).numpy()[0] == 254


@pytest.mark.parametrize("resolution", [1, 3, 8, 13])
def test05_packed_round_trip(resolution):
    bits = np.random.default_rng(1).random((resolution,) * 3) < 0.3
    packed = OccupancyGrid(bits, ns, 0.5).packed()
    assert packed.dtype == np.uint8 and packed.size == -(-(resolution**3) // 8)
    again = OccupancyGrid.from_packed(packed, resolution, ns, 0.5)
    assert np.array_equal(again.bits, bits) and again.threshold == 0.5
    # Lowest bit first, x fastest
    i = int(np.flatnonzero(bits.ravel())[-1]) if bits.any() else 0
    assert bool(packed[i // 8] >> (i % 8) & 1) == bool(bits.ravel()[i])


def test06_wrong_shapes():
    for shape in ((2, 2), (2, 0, 3)):
        with pytest.raises(ValueError, match="three axes of at least one cell"):
            OccupancyGrid(np.zeros(shape, bool), ns, 1)
    with pytest.raises(ValueError, match="needs 64 bytes, got 63"):
        OccupancyGrid.from_packed(np.zeros(63, np.uint8), 8, ns, 1)


def test07_grids_with_unequal_edges():
    bits = np.random.default_rng(2).random((2, 5, 7)) < 0.2
    grid = OccupancyGrid(bits, ns, 0)
    z, y, x = np.meshgrid(*(np.arange(n) for n in bits.shape), indexing="ij")
    centres = (np.stack([x, y, z], -1).reshape(-1, 3) + 0.5) / (7, 5, 2)
    assert np.array_equal(grid.empty_cells(ns.Array3f(centres.T)).numpy(), brute_force(bits).ravel())
    with pytest.raises(ValueError, match="no single resolution"):
        _ = grid.resolution
