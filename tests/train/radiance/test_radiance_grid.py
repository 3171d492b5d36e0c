"""Tests of `nerg_mi.train.radiance_grid`."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.train.radiance_data import FreeSpace
from nerg_mi.train.radiance_grid import MarchGrid, OccupancyExtraction

# ---- Density grid ----
#
# Sampled cells: seen by cameras, dense, containing surface points, and stored.

BOX = Box((-1, -1, -1), (1, 1, 1))
R = 8


def camera_at(x, y, z):
    """A camera that looks along -z of the world with 45 degrees (and a tenth) to each side."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return PosedCamera(Intrinsics(20, 20, 10.0, 10.0, 10.0, 10.0), pose)


def above():
    return [camera_at(0, 0, 30.0)]


def centres():
    """World positions (R, R, R, 3) of the cell centres, indexed [z, y, x]."""
    c = (np.arange(R) + 0.5) / R * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def cube(values):
    return np.asarray(values).reshape(R, R, R)


def grown(cells):
    """``cells`` and all of their 26 neighbours, computed directly."""
    padded = np.pad(cells, 1)
    return np.any(
        [padded[a : a + R, b : b + R, c : c + R] for a in range(3) for b in range(3) for c in range(3)], axis=0
    )


def around(point, radius, gain=1e3):
    """Density ``gain`` within ``radius`` of a point."""
    centre = ns.Array3f(*map(float, point))
    return lambda p, active: dr.select(active & (dr.norm(p - centre) < radius), ns.Float(gain), 0)


def rng():
    return np.random.default_rng(0)


def test_cells_that_enough_cameras_see_are_sampled():
    cameras = [camera_at(0, 0, 1.5), camera_at(3, 0, 1.5), camera_at(0, 0, 1.5)]
    p = centres()
    seen = []
    for camera in cameras:
        d = p - camera.center
        seen.append((d[..., 2] < 0) & (np.abs(d[..., :2]) < -1.1 * d[..., 2:]).all(axis=-1))
    for minimum in (1, 2, 3, 9):
        grid = MarchGrid(ns, BOX, R, 0.1, cameras, minimum)
        want = np.sum(seen, axis=0) >= min(minimum, 3)
        assert np.array_equal(cube(grid.seen), want) and grid.seen_count == want.sum()
        assert 0 < want.sum() < R**3


def test_cells_near_a_camera_are_not_sampled():
    near = 0.9
    grid = MarchGrid(
        ns, BOX, R, 0.1, [camera_at(0, 0, 1.5)], 1, free_space=FreeSpace(*np.full((2, 1), near, np.float32))
    )
    free = MarchGrid(ns, BOX, R, 0.1, [camera_at(0, 0, 1.5)], 1)
    far = np.linalg.norm(centres() - [0, 0, 1.5], axis=-1) > near
    assert np.array_equal(cube(grid.seen), cube(free.seen) & far) and (cube(free.seen) & ~far).any()


def test_free_space_in_view_of_a_camera_is_not_sampled():
    cameras = [camera_at(0, 0, 0.5), camera_at(0, 0, 30)]
    free_space = FreeSpace(np.float32([0.1, 0.1]), np.float32([0.8, 0.1]))
    seen = cube(MarchGrid(ns, BOX, R, 0.1, cameras, 1, free_space=free_space).seen)
    d = centres() - [0, 0, 0.5]
    is_in_view = np.abs(d[..., :2]).max(axis=-1) < -0.95 * d[..., 2]
    near = np.linalg.norm(d, axis=-1) < 0.8
    assert not seen[is_in_view & near].any() and seen[~is_in_view & near].any()
    everything = cube(MarchGrid(ns, BOX, R, 0.1, cameras, 1).seen)
    assert np.array_equal(seen[~(is_in_view & near)], everything[~(is_in_view & near)])


def test_space_that_is_no_longer_empty_is_sampled_where_density_is():
    camera = camera_at(0, 0, 1.5)
    grid = MarchGrid(ns, BOX, R, 0.1, [camera], 1, free_space=FreeSpace.within(1, 0.9))

    def left_half(p, active):
        return dr.select(p.x < 0, ns.Float(1e3), 0)

    grid.update(left_half, rng(), everywhere=True)
    before, bits = cube(grid.seen), cube(grid.bits)
    grid.set_free_space(FreeSpace.within(1, 0))
    reference = MarchGrid(ns, BOX, R, 0.1, [camera], 1)
    assert np.array_equal(cube(grid.seen), cube(reference.seen)) and grid.seen_count == reference.seen_count
    assert np.array_equal(cube(grid.bits), bits)
    for _ in range(8):
        grid.update(left_half, rng())
    is_left = centres()[..., 0] < 0
    assert np.array_equal(cube(grid.bits) > 0, cube(reference.seen) & is_left)
    assert (cube(grid.seen) & ~before & is_left).any()


def test_cells_outside_a_non_cubic_box_are_empty():
    """The grid spans a cube; cells with centres more than half a cell outside the box are empty."""
    for z, rows in ((0.3, [2, 3, 4, 5]), (0.2, [3, 4])):
        grid = MarchGrid(ns, Box((-1, -1, -z), (1, 1, z)), R, 0.1, above(), 1)
        assert np.unique(np.nonzero(cube(grid.seen))[0]).tolist() == rows


def test_points_map_to_their_cells():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    marked = rng().random((R, R, R)) < 0.3
    grid.bits = ns.UInt8(marked.ravel())
    p = rng().uniform(-1, 1, (500, 3))
    x, y, z = np.minimum(((p + 1) / 2 * R).astype(int), R - 1).T
    active = rng().random(500) < 0.5
    result = grid.is_occupied(ns.Array3f(np.ascontiguousarray(p.T, np.float32)), ns.Bool(active)).numpy()
    assert np.array_equal(result, marked[z, y, x] & active)
    assert grid.occupied_fraction == pytest.approx(marked.mean())


def test_surface_points_keep_their_cells_and_the_neighbours():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    points = np.array([[0.6, 0.1, -0.9], [-0.99, 0.99, 0.3]])
    grid.carve([ns.Array3f(*map(float, p)) for p in points])
    held = np.zeros((R, R, R), bool)
    x, y, z = ((points + 1) / 2 * R).astype(int).T
    held[z, y, x] = True
    assert np.array_equal(cube(grid.always), held) and np.array_equal(cube(grid.seen), grown(held))
    # Cells with a point stay sampled without density; their neighbours do not.
    grid.update(lambda p, active: dr.zeros(ns.Float, dr.width(p)), rng(), everywhere=True)
    assert np.array_equal(cube(grid.bits), held)


def test_an_update_turns_cells_on_where_density_is_and_off_where_it_was():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1, threshold=0.01)
    left = cube(np.arange(R**3) % R < 2)  # x < -0.5
    position = lambda p, active: dr.select(p.x < -0.5, ns.Float(5.0), 0.0)
    grid.update(position, rng(), everywhere=True)
    assert np.array_equal(cube(grid.bits) > 0, left)
    assert np.allclose(cube(grid.value), np.where(left, 0.5, 0))
    # Gone: an eighth of the cells is updated at a time, and 0.6 of the value is kept.
    nothing = lambda p, active: dr.zeros(ns.Float, dr.width(p))
    for turn in range(16):
        grid.update(nothing, rng())
        evaluated = np.minimum(np.maximum(turn + 8 - np.arange(R**3) % 8, 0) // 8, 2)
        assert np.allclose(grid.value.numpy(), np.where(left.ravel(), 0.5 * 0.6**evaluated, 0), atol=1e-6)
    # Back again at once.
    for _ in range(8):
        grid.update(position, rng())
    assert np.allclose(cube(grid.value), np.where(left, 0.5, 0))


def test_optical_depth_of_a_cell_is_bounded():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    grid.update(around((0, 0, 0), 9, gain=1e9), rng(), everywhere=True)
    assert np.array_equal(grid.value.numpy(), np.full(R**3, 10, np.float32))


@pytest.mark.parametrize("thick", [0.001, 0.01, 3.0])
def test_threshold_of_a_thin_field_is_half_its_mean(thick):
    """Slabs of x of optical depth 1, 0.3, 0.05 and 0 times ``thick``: cells above half of the mean are occupied, and
    all above the threshold.
    """
    grid = MarchGrid(ns, BOX, R, 1.0, above(), 1, threshold=0.3)
    shares = np.array([1, 0.3, 0.05, 0])

    def density(p, active):
        k = dr.minimum(ns.UInt32((p.x + 1) * 2), 3)
        return thick * dr.gather(ns.Float, ns.Float(shares), k)

    grid.update(density, rng(), everywhere=True)
    bound = min(0.3, 0.5 * thick * shares.mean())
    want = np.broadcast_to(np.repeat(thick * shares > bound, 2), (R, R, R))
    assert np.array_equal(cube(grid.bits) > 0, want)


def test_points_in_unsampled_cells():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    grid.update(lambda p, active: dr.select(p.x < -0.5, ns.Float(5.0), 0.0), rng(), everywhere=True)
    p = np.array(grid.empty_points(4000, rng()))
    assert p.shape == (3, 4000) and (p[0] >= -0.5).all() and (np.abs(p) <= 1).all()
    # In all of them, and anywhere in each.
    cell = np.floor((p + 1) / 2 * R).astype(int)
    assert len(set(map(tuple, cell.T))) == R * R * (R - 2)
    within = (p + 1) / 2 * R - cell
    assert np.allclose(within.mean(axis=1), 0.5, atol=0.03) and np.allclose(within.std(axis=1), 12**-0.5, atol=0.02)
    grid.update(around((0, 0, 0), 9), rng(), everywhere=True)
    assert grid.empty_points(10, rng()) is None


def everything(density, occupied):
    """All points contribute to some ray."""
    yield ns.Array3f(np.ascontiguousarray(centres().reshape(-1, 3).T, np.float32))


def test_occupancy_includes_neighbours_of_dense_cells():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    point = centres()[3, 4, 2]
    bound = grid.extract_occupancy(around(point, 0.1), rng(), everything)
    held = np.zeros((R, R, R), bool)
    held[3, 4, 2] = True
    assert np.array_equal(bound.bits, grown(held)) and bound.threshold == pytest.approx(0.01 / 0.1)


def test_occupancy_excludes_cells_that_do_not_contribute():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    fog = around((0, 0, 0), 9)
    calls = []

    def one(density, occupied):
        # Called with all dense cells.
        calls.append(occupied(ns.Array3f(0.3, 0.3, 0.3), True).numpy()[0])
        yield ns.Array3f(*map(float, centres()[5, 1, 6]))

    lit = np.zeros((R, R, R), bool)
    lit[5, 1, 6] = True
    assert np.array_equal(grid.extract_occupancy(fog, rng(), one).bits, grown(lit)) and calls == [True]


def test_occupancy_detects_density_in_a_small_part_of_a_cell():
    """One of three strata per axis: a corner that a single point in the cell would usually miss."""
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    corner = centres()[3, 4, 2] + 1 / R
    inside = lambda p, active: dr.select(
        (p.x > corner[0] - 0.25 / 3)
        & (p.x < corner[0])
        & (p.y > corner[1] - 0.25 / 3)
        & (p.y < corner[1])
        & (p.z > corner[2] - 0.25 / 3)
        & (p.z < corner[2]),
        ns.Float(5.0),
        0.0,
    )
    held = np.zeros((R, R, R), bool)
    held[3, 4, 2] = True
    for seed in range(5):
        assert np.array_equal(grid.extract_occupancy(inside, np.random.default_rng(seed), everything).bits, grown(held))


def test_cells_and_steps_of_a_contracted_box_grow_outwards():
    """The inner cube, 2 units wide, has half of the cells along each edge."""
    box = ContractedBox(BOX, 16)
    grid = MarchGrid(ns, box, R, 0.01, above(), 1, growth=1 / 128)
    p = ns.Array3f([0.5, 0.0, 4.0], [0.0, -0.9, 0.0], [0.0, 0.2, 3.0])
    assert np.allclose(grid.cell_size_at(p).numpy(), np.array([1, 1, 4]) * 2 / (R / 2))
    assert np.allclose(grid.step_length_at(p).numpy(), [0.01, 0.01, 5 / 128])
    plain = MarchGrid(ns, BOX, R, 0.01, above(), 1, growth=1 / 128)
    assert plain.cell_size_at(p) == 2 / R and plain.step_length_at(p) == pytest.approx(0.01)


# ---- Settling ----
#
# Cells that rendering will visit are extracted piece by piece and then always sampled.


def settle(grid, density, lit, settling=None):
    settling = settling or OccupancyExtraction(grid)
    while not settling.is_done:
        settling.advance(density, lit, 0)
    return settling


def empty(p, active):
    return dr.zeros(ns.Float, dr.width(p))


def everywhere(density, occupied, rng):
    """Points of contributing samples: the centres of all occupied cells."""
    p = ns.Array3f(np.ascontiguousarray(centres().reshape(-1, 3).T, np.float32))
    return dr.gather(ns.Array3f, p, dr.compress(occupied(p, True)))


def test_contributing_cells_and_neighbours_stay_sampled():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    settle(grid, around(centres()[3, 4, 2], 0.1), everywhere)
    grid.update(empty, np.random.default_rng(0), everywhere=True)
    held = np.zeros((R, R, R), bool)
    held[3, 4, 2] = True
    # Neighbours of the dense cell are occupied during the extraction and contribute here; only cells that touch none
    # are not.
    assert np.array_equal(cube(grid.bits) > 0, grown(held))


def test_cells_that_do_not_contribute_are_excluded():
    grid = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    one = ns.Array3f(*map(float, centres()[5, 1, 6]))
    settle(grid, around((0, 0, 0), 9), lambda density, occupied, rng: one)
    grid.update(empty, np.random.default_rng(0), everywhere=True)
    lit = np.zeros((R, R, R), bool)
    lit[5, 1, 6] = True
    assert np.array_equal(cube(grid.bits) > 0, grown(lit))
    none = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    settle(none, around((0, 0, 0), 9), lambda density, occupied, rng: None)
    assert not none.always.numpy().any()


def test_each_piece_evaluates_one_part_of_the_cells():
    grid, calls = MarchGrid(ns, BOX, R, 0.1, above(), 1), []

    def density(p, active):
        calls.append(dr.width(p))
        return empty(p, active)

    settling = settle(grid, density, everywhere)
    assert max(calls) <= R**3 / 8 and sum(calls) == 4 * R**3
    settling.advance(density, everywhere, 0)
    assert sum(calls) == 4 * R**3 and settling.pieces_done == OccupancyExtraction.NUM_PIECES


def test_extraction_resumes_from_a_stored_state():
    lit = lambda density, occupied, rng: ns.Array3f(
        *[ns.Float(x) for x in rng.uniform(-1, 1, (3, 2)).astype(np.float32)]
    )
    density, full, resumed = around((0.2, 0.1, 0), 0.6), *(MarchGrid(ns, BOX, R, 0.1, above(), 1) for _ in range(2))
    settle(full, density, lit)
    for stop in (5, 40):
        first, second = OccupancyExtraction(MarchGrid(ns, BOX, R, 0.1, above(), 1)), OccupancyExtraction(resumed)
        while first.pieces_done < stop:
            first.advance(density, lit, 0)
        second.restore(first.pieces_done, first.dense_cells.numpy(), first.contributing_cells.numpy())
        settle(resumed, density, lit, second)
        assert np.array_equal(full.always.numpy(), resumed.always.numpy())
        resumed = MarchGrid(ns, BOX, R, 0.1, above(), 1)
    assert full.always.numpy().any() and not full.always.numpy().all()
