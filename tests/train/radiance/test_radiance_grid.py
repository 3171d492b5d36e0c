"""Tests of `nerg_mi.train.radiance_grid`."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.train.radiance_grid import DensityGrid, OccupancyExtraction

# ---- Density grid ----
#
# Which cells a training samples: what cameras see, what has density, what surface points hold, and what is stored.

BOX = Box((-1, -1, -1), (1, 1, 1))
R = 8


def camera_at(x, y, z):
    """It looks along -z of the world and sees 45 degrees (and a tenth) to each side."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return PosedCamera(Intrinsics(20, 20, 10.0, 10.0, 10.0, 10.0), pose)


def above():
    return [camera_at(0, 0, 30.0)]


def centres():
    """World points (R, R, R, 3) of the cells' centres, indexed [z, y, x]."""
    c = (np.arange(R) + 0.5) / R * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def cube(values):
    return np.asarray(values).reshape(R, R, R)


def grown(cells):
    """``cells`` and all of their 26 neighbours, by hand."""
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
    for least in (1, 2, 3, 9):
        grid = DensityGrid(ns, BOX, R, 0.1, cameras, least)
        want = np.sum(seen, axis=0) >= min(least, 3)
        assert np.array_equal(cube(grid.seen), want) and grid.seen_count == want.sum()
        assert 0 < want.sum() < R**3


def test_cells_near_a_camera_are_not_sampled():
    near = 0.9
    grid = DensityGrid(ns, BOX, R, 0.1, [camera_at(0, 0, 1.5)], 1, near=near)
    free = DensityGrid(ns, BOX, R, 0.1, [camera_at(0, 0, 1.5)], 1)
    far = np.linalg.norm(centres() - [0, 0, 1.5], axis=-1) > near
    assert np.array_equal(cube(grid.seen), cube(free.seen) & far) and (cube(free.seen) & ~far).any()


def test_a_box_that_is_no_cube_ends_where_it_ends():
    """The grid spans a cube; cells whose centre is more than half a cell outside of the box hold nothing."""
    for z, rows in ((0.3, [2, 3, 4, 5]), (0.2, [3, 4])):
        grid = DensityGrid(ns, Box((-1, -1, -z), (1, 1, z)), R, 0.1, above(), 1)
        assert np.unique(np.nonzero(cube(grid.seen))[0]).tolist() == rows


def test_points_find_their_cells():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    marked = rng().random((R, R, R)) < 0.3
    grid.bits = ns.UInt8(marked.ravel())
    p = rng().uniform(-1, 1, (500, 3))
    x, y, z = np.minimum(((p + 1) / 2 * R).astype(int), R - 1).T
    active = rng().random(500) < 0.5
    found = grid.is_occupied(ns.Array3f(np.ascontiguousarray(p.T, np.float32)), ns.Bool(active)).numpy()
    assert np.array_equal(found, marked[z, y, x] & active)
    assert grid.occupied_fraction == pytest.approx(marked.mean())


def test_surface_points_keep_their_cells_and_the_neighbours():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    points = np.array([[0.6, 0.1, -0.9], [-0.99, 0.99, 0.3]])
    grid.carve([ns.Array3f(*map(float, p)) for p in points])
    held = np.zeros((R, R, R), bool)
    x, y, z = ((points + 1) / 2 * R).astype(int).T
    held[z, y, x] = True
    assert np.array_equal(cube(grid.always), held) and np.array_equal(cube(grid.seen), grown(held))
    # What holds a point stays on though nothing is found in it; its neighbours do not.
    grid.update(lambda p, active: dr.zeros(ns.Float, dr.width(p)), rng(), everywhere=True)
    assert np.array_equal(cube(grid.bits), held)


def test_an_update_turns_cells_on_where_density_is_and_off_where_it_was():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1, threshold=0.01)
    left = cube(np.arange(R**3) % R < 2)  # x < -0.5
    here = lambda p, active: dr.select(p.x < -0.5, ns.Float(5.0), 0.0)
    grid.update(here, rng(), everywhere=True)
    assert np.array_equal(cube(grid.bits) > 0, left)
    assert np.allclose(cube(grid.value), np.where(left, 0.5, 0))
    # Gone: an eighth of the cells is looked at in a turn, and remembers 0.6 of what it was.
    nothing = lambda p, active: dr.zeros(ns.Float, dr.width(p))
    for turn in range(16):
        grid.update(nothing, rng())
        looked = np.minimum(np.maximum(turn + 8 - np.arange(R**3) % 8, 0) // 8, 2)
        assert np.allclose(grid.value.numpy(), np.where(left.ravel(), 0.5 * 0.6**looked, 0), atol=1e-6)
    # Back again, at once.
    for _ in range(8):
        grid.update(here, rng())
    assert np.allclose(cube(grid.value), np.where(left, 0.5, 0))


def test_optical_depth_of_a_cell_is_bounded():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    grid.update(around((0, 0, 0), 9, gain=1e9), rng(), everywhere=True)
    assert np.array_equal(grid.value.numpy(), np.full(R**3, 10, np.float32))


@pytest.mark.parametrize("thick", [0.001, 0.01, 3.0])
def test_while_the_field_is_thin_half_of_its_mean_counts(thick):
    """Slabs of x of optical depth 1, 0.3, 0.05 and 0 times ``thick``: cells above half of the mean count, and all above
    the threshold."""
    grid = DensityGrid(ns, BOX, R, 1.0, above(), 1, threshold=0.3)
    shares = np.array([1, 0.3, 0.05, 0])

    def density(p, active):
        k = dr.minimum(ns.UInt32((p.x + 1) * 2), 3)
        return thick * dr.gather(ns.Float, ns.Float(shares), k)

    grid.update(density, rng(), everywhere=True)
    bound = min(0.3, 0.5 * thick * shares.mean())
    want = np.broadcast_to(np.repeat(thick * shares > bound, 2), (R, R, R))
    assert np.array_equal(cube(grid.bits) > 0, want)


def test_points_in_the_cells_that_are_left_out():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
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
    """All training rays see everything."""
    yield ns.Array3f(np.ascontiguousarray(centres().reshape(-1, 3).T, np.float32))


def test_the_stored_bound_holds_the_neighbours_of_what_has_density():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    point = centres()[3, 4, 2]
    bound = grid.extract_occupancy(around(point, 0.1), rng(), everything)
    held = np.zeros((R, R, R), bool)
    held[3, 4, 2] = True
    assert np.array_equal(bound.bits, grown(held)) and bound.threshold == pytest.approx(0.01 / 0.1)


def test_the_stored_bound_leaves_out_what_lights_no_ray_but_not_its_neighbours():
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    fog = around((0, 0, 0), 9)
    asked = []

    def one(density, occupied):
        # Asked with the cells that have density: all of them.
        asked.append(occupied(ns.Array3f(0.3, 0.3, 0.3), True).numpy()[0])
        yield ns.Array3f(*map(float, centres()[5, 1, 6]))

    lit = np.zeros((R, R, R), bool)
    lit[5, 1, 6] = True
    assert np.array_equal(grid.extract_occupancy(fog, rng(), one).bits, grown(lit)) and asked == [True]


def test_the_bound_finds_what_fills_a_small_part_of_a_cell():
    """One of three strata an axis: a corner that a single point in the cell would mostly miss."""
    grid = DensityGrid(ns, BOX, R, 0.1, above(), 1)
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
    """Its inner cube, 2 units wide, has half of the cells along each edge."""
    box = ContractedBox(BOX, 16)
    grid = DensityGrid(ns, box, R, 0.01, above(), 1, growth=1 / 128)
    p = ns.Array3f([0.5, 0.0, 4.0], [0.0, -0.9, 0.0], [0.0, 0.2, 3.0])
    assert np.allclose(grid.cell_size_at(p).numpy(), np.array([1, 1, 4]) * 2 / (R / 2))
    assert np.allclose(grid.step_length_at(p).numpy(), [0.01, 0.01, 5 / 128])
    plain = DensityGrid(ns, BOX, R, 0.01, above(), 1, growth=1 / 128)
    assert plain.cell_size_at(p) == 2 / R and plain.step_length_at(p) == 0.01


# ---- Settling ----
#
# Cells that rendering will visit are found a piece at a time, and are then sampled whatever is found in them.


def settle(grid, density, lit, settling=None):
    settling = settling or OccupancyExtraction(grid)
    while not settling.is_done:
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
    assert sum(asked) == 4 * R**3 and settling.pieces_done == OccupancyExtraction.NUM_PIECES


def test_settling_goes_on_from_a_stored_state():
    lit = lambda density, occupied, rng: ns.Array3f(
        *[ns.Float(x) for x in rng.uniform(-1, 1, (3, 2)).astype(np.float32)]
    )
    density, whole, resumed = around((0.2, 0.1, 0), 0.6), *(DensityGrid(ns, BOX, R, 0.1, above(), 1) for _ in range(2))
    settle(whole, density, lit)
    for stop in (5, 40):
        first, second = OccupancyExtraction(DensityGrid(ns, BOX, R, 0.1, above(), 1)), OccupancyExtraction(resumed)
        while first.pieces_done < stop:
            first.advance(density, lit, 0)
        second.restore(first.pieces_done, first.dense_cells.numpy(), first.contributing_cells.numpy())
        settle(resumed, density, lit, second)
        assert np.array_equal(whole.always.numpy(), resumed.always.numpy())
        resumed = DensityGrid(ns, BOX, R, 0.1, above(), 1)
    assert whole.always.numpy().any() and not whole.always.numpy().all()
