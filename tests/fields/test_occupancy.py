"""Tests of `nerg_mi.fields.occupancy`."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from nerg_mi.fields.occupancy import (
    MIN_STEP_OPTICAL_DEPTH,
    PARTS_PER_AXIS,
    CascadeGrid,
    OccupancyGrid,
    RefinedGrid,
    cascades_from_contracted,
    chessboard_distance,
    refine_occupancy,
)
from nerg_mi.maths.geometry import Box, ContractedBox

# ---- Cascades of occupancy against all cells of the finest size, one by one ----

R = 4


def made(bound, share, seed=0):
    rng = np.random.default_rng(seed)
    levels = 1 + int(np.ceil(np.log2(bound)))
    bits = rng.random((levels, R, R, R)) < share
    if seed % 2:
        bits[1:] = False  # distant cells are empty, so that skips are long
        bits[-1, 0, 0, 0] = True
    return CascadeGrid(bits, bound, ns, 0.25), bits


def middles(grid):
    """Unit-cube centres (n, n, n, 3) of the common cells, [z, y, x]."""
    n = grid.cells[0]
    c = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def occupied(grid, bits, bound):
    """Whether each common cell is occupied: by the bit of the finest level that contains it."""
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
def test_common_grid_matches_levels_and_skips_no_matter(bound, seed):
    grid, bits = made(bound, 0.1, seed)
    full = occupied(grid, bits, bound)
    n = grid.cells[0]
    assert n == R * bound and grid.occupied_fraction == pytest.approx(full.mean()) and 0 < full.mean() < 1
    u = middles(grid).reshape(-1, 3)
    k = grid.distance_to_occupied(ns.Array3f(np.ascontiguousarray(u.T, np.float32))).numpy().reshape(full.shape)
    assert np.array_equal(k == 0, full)
    held = np.argwhere(full)
    where = np.argwhere(~full)
    nearest = np.abs(where[:, None] - held[None]).max(axis=2).min(axis=1)
    reported = k[~full]
    assert (reported >= 1).all() and (reported <= nearest).all()
    # Where the levels agree, only what a coarse cell hides is lost.
    assert bound > 1 or np.array_equal(reported, nearest)
    assert bound == 1 or seed == 0 or reported.max() > 2


def test_points_outside_are_clamped():
    grid, bits = made(4, 0.3)
    inside = np.random.default_rng(2).uniform(0, 1, (200, 3))
    inside[:, 1] = 0.001
    beyond = inside - (0, 3, 0)
    make = lambda u: grid.distance_to_occupied(ns.Array3f(np.ascontiguousarray(u.T, np.float32))).numpy()
    assert np.array_equal(make(inside), make(beyond))


@pytest.mark.parametrize("bound", [1, 2, 4])
def test_packed_bits_round_trip(bound):
    grid, bits = made(bound, 0.3)
    again = CascadeGrid.from_packed(grid.pack_bits(), R, bound, ns, 0.25)
    assert np.array_equal(again.bits, bits) and again.threshold == 0.25 and again.resolution == R  # noqa: RUF069 (stored)
    with pytest.raises(ValueError, match="bytes"):
        CascadeGrid.from_packed(grid.pack_bits()[:-1], R, bound, ns, 0.25)


@pytest.mark.parametrize("reach", [2.0, 8.0, 64.0])
def test_cascades_cover_contracted_cells(reach):
    rng, r = np.random.default_rng(int(reach)), 16
    box, bits = ContractedBox(Box((0, 0, 0), (2, 2, 2)), reach), rng.random((r, r, r)) < 0.02
    grid = cascades_from_contracted(bits, reach, ns, 1.0)
    u = rng.random((3, 200_000)).astype(np.float32)
    x, y, z = np.minimum((u * r).astype(int), r - 1)
    p = box.from_unit(ns.Array3f(u))
    # Corners beyond the outer cube are moved to its face, into other cells.
    held = (np.abs((u - 0.5) * 4).max(axis=0) < 2 - 1 / reach) & bits[z, y, x]
    assert held.sum() > 500 and np.all(grid.distance_to_occupied(box.to_cube(p)).numpy()[held] == 0)
    # They are not much larger either: by touching cells.
    assert (
        grid.bits[0].mean() < 0.2 and not cascades_from_contracted(np.zeros((r, r, r), bool), reach, ns, 1.0).bits.any()
    )


# ---- Occupancy: distances against brute force, look-ups, and the packed form ----


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
    assert np.isclose(grid.occupied_fraction, bits.mean())


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 131), (3, 2, 64), (300, 1, 2)])
def test01_rows_of_any_length_and_maximum_distance(shape):
    """Rows that fill words of 64 cells, or not; distances saturate at 255."""
    bits = np.random.default_rng(1).random(shape) < 0.01
    bits[0, 0, 0] = True
    expected = np.minimum(distance_transform_cdt(~bits, metric="chessboard"), 255)
    assert np.array_equal(chessboard_distance(bits), expected) and chessboard_distance(bits).dtype == np.uint8
    bits[...] = False
    assert (chessboard_distance(bits) == 255).all()


def test02_lookup_is_indexed_zyx_and_clamped():
    bits = np.zeros((4, 4, 4), bool)
    bits[3, 1, 0] = True  # z = 3, y = 1, x = 0
    grid = OccupancyGrid(bits, ns, 0.1)
    points = np.array(
        [[0.1, 0.4, 0.9], [0.3, 0.4, 0.9], [0.9, 0.4, 0.9], [0, 0.25, 0.75], [0.1, 0.4, 1.0], [-5, 0.4, 9], [1, 1, 0]]
    )
    assert grid.distance_to_occupied(ns.Array3f(points.T)).numpy().tolist() == [0, 1, 3, 0, 0, 0, 3]


@pytest.mark.parametrize("resolution", [1, 3, 8, 13])
def test05_packed_round_trip(resolution):
    bits = np.random.default_rng(1).random((resolution,) * 3) < 0.3
    packed = OccupancyGrid(bits, ns, 0.5).pack_bits()
    assert packed.dtype == np.uint8 and packed.size == -(-(resolution**3) // 8)
    again = OccupancyGrid.from_packed(packed, resolution, ns, 0.5)
    assert np.array_equal(again.bits, bits) and again.threshold == 0.5  # noqa: RUF069 (stored)
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
    assert np.array_equal(grid.distance_to_occupied(ns.Array3f(centres.T)).numpy(), brute_force(bits).ravel())
    with pytest.raises(ValueError, match="no single resolution"):
        _ = grid.resolution


# ---- Refined cells: occupied parts stay occupied, and no skip passes them ----


def refined(resolution=7, share=0.2, seed=0):
    rng = np.random.default_rng(seed)
    bits = rng.random((resolution,) * 3) < share
    return RefinedGrid(bits, rng.integers(0, 256, bits.sum(), np.uint8), ns, 0.1, 0.5, 1e-4)


def centres(n):
    z, y, x = np.meshgrid(*(np.arange(n),) * 3, indexing="ij")
    return (np.stack([x, y, z]).reshape(3, -1) + 0.5) / n


@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_skips_pass_no_occupied_part(share):
    grid = refined(share=share)
    result = grid.distance_to_occupied(ns.Array3f(centres(grid.resolution))).numpy().reshape(grid.bits.shape)
    away = brute_force(grid.bits)
    assert np.array_equal(result == 0, grid.bits) and np.all(result <= away)
    # Nor is it much too short: at least half of the way, minus a part.
    assert np.all(2 * result + PARTS_PER_AXIS > away)


def test_parts_belong_to_their_cells():
    bits = np.zeros((3, 3, 3), bool)
    bits[2, 0, 1] = True  # z = 2, y = 0, x = 1
    # The part with the upper x, the lower y and the upper z.
    grid = RefinedGrid(bits, np.array([1 << 0b101]), ns, 0.1, 0.5, 0)
    assert np.argwhere(grid.bits).tolist() == [[5, 0, 3]]
    assert grid.cells == (6, 6, 6) and grid.occupied_fraction == pytest.approx(1 / 216)
    points = ns.Array3f([3.5 / 6, 2.5 / 6, 3.5 / 6], [0.1 / 6, 0.1 / 6, -4], [5.5 / 6, 5.5 / 6, 9])
    assert grid.distance_to_occupied(points).numpy().tolist() == [0, 1, 0]
    assert np.array_equal(grid.coarse.bits, bits) and grid.coarse.threshold == 0.5  # noqa: RUF069 (stored)


def test_cells_without_parts_are_empty():
    grid = RefinedGrid(np.ones((2, 2, 2), bool), np.zeros(8, np.uint8), ns, 0, 0, 0)
    assert np.all(grid.distance_to_occupied(ns.Array3f(centres(4))).numpy() > 4)


def test_wrong_byte_counts_are_refused():
    with pytest.raises(ValueError, match="7.*8.*2.*2.*2"):
        RefinedGrid(np.ones((2, 2, 2), bool), np.zeros(7, np.uint8), ns, 0, 0, 0)


# ---- Refinement: a refined grid for analytic densities ----

BOX = Box((-1, -2, 0), (3, 2, 2))
R_REFINEMENT = 16


def field(density, step=0.01, occupancy=None):
    """A field of this density at (x, y, z), all of whose cells are occupied."""
    everywhere = OccupancyGrid(np.ones((R_REFINEMENT,) * 3, bool), ns, 1.0)
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
    return p, grid.distance_to_occupied(BOX.to_cube(p)).numpy() == 0


def test_refined_grid_covers_density_tightly():
    def wall(x, y, z):
        # A third of a part thick, oblique, and very dense.
        away = dr.abs(x + 0.3 * y - 0.7 * z - 0.2) / np.sqrt(1 + 0.3**2 + 0.7**2)
        return dr.select(away < 0.02, ns.Float(1e6), 0)

    grid = refine_occupancy(field(wall))
    p, inside = held(grid)
    dense = wall(*p).numpy() > 0
    assert dense.sum() > 2000 and inside[dense].mean() > 0.995
    # Parts are 4 / 32 long: parts more than a diagonal away from the wall cannot contain it.
    far = wall(p.x * 0.0 + p.x, p.y, p.z).numpy() == 0
    assert inside[far].mean() < 0.2
    assert grid.missed_optical_depth < 0.02


def test_missed_optical_depth_of_a_wire():
    # A twentieth of a part thick: many neighbouring parts are sampled.
    radius, sigma, step = 0.003, 1e3, 0.01
    wire = lambda x, y, z: dr.select((x - 0.42) ** 2 + (y - 0.13) ** 2 < radius**2, ns.Float(sigma), 0)
    grid = refine_occupancy(field(wire, step))
    through = ns.Float(np.linspace(0, 2, 4001)[1:-1])
    inside = grid.distance_to_occupied(BOX.to_cube(ns.Array3f(0.42, 0.13, through))).numpy() == 0
    lost = (1 - np.exp(-sigma * step)) / step * np.pi * radius**2 * 2 * (1 - inside.mean())
    assert grid.missed_optical_depth == pytest.approx(lost * 4 / 64, abs=1e-3)


def test_missed_optical_depth_of_fog():
    thin = 0.5 * MIN_STEP_OPTICAL_DEPTH / 0.01
    grid = refine_occupancy(field(lambda x, y, z: thin + 0 * x))
    assert not grid.masks.any()
    # The mean chord of a box is 4 V / S: 4 x 4 x 2 has V = 32, S = 64.
    assert grid.missed_optical_depth == pytest.approx(thin * 2, rel=0.02)
    thick = refine_occupancy(field(lambda x, y, z: 4 * thin + 0 * x))
    # The box is half as high as the cube that is divided into cells.
    assert thick.occupied_fraction == pytest.approx(0.5, abs=0.04) and thick.missed_optical_depth == 0


def test_empty_cells_stay_empty_and_refinement_is_deterministic():
    bits = np.random.default_rng(2).random((R_REFINEMENT,) * 3) < 0.3
    smooth = lambda x, y, z: dr.exp(6 * dr.sin(3 * x) * dr.cos(2 * y) - 2)
    one, other = (refine_occupancy(field(smooth, occupancy=OccupancyGrid(bits, ns, 1.0))) for _ in range(2))
    assert np.array_equal(one.coarse_bits, bits) and np.array_equal(one.masks, other.masks)
    # Again, from the refined grid: the same.
    again = refine_occupancy(field(smooth, occupancy=one))
    assert np.array_equal(again.masks, one.masks) and again.threshold == one.threshold
    assert one.threshold == pytest.approx(MIN_STEP_OPTICAL_DEPTH / 0.01)
    assert again.coarse_threshold == 1.0  # noqa: RUF069 (stored)


def test_cascades_and_missing_grids_are_not_refined():
    nested = CascadeGrid(np.ones((2, 4, 4, 4), bool), 2.0, ns, 0.1)
    assert refine_occupancy(field(lambda x, y, z: x, occupancy=nested)) is None
    zeros = field(lambda x, y, z: x)
    zeros.occupancy = None
    assert refine_occupancy(zeros) is None
    empty = refine_occupancy(
        field(lambda x, y, z: x, occupancy=OccupancyGrid(np.zeros((R_REFINEMENT,) * 3, bool), ns, 0.1))
    )
    assert empty.missed_optical_depth == 0 and empty.masks.size == 0
