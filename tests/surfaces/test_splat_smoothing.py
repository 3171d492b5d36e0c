"""Smoothing over Gaussians: as wide as is said, nothing lost, nothing through the air, around an edge or a board."""

import numpy as np
import pytest

from nerg_mi.fields.splats import Splats, joined
from nerg_mi.surfaces.splats import SplatSmoother, shortest_axes
from tests.surfaces.walls import TURN_X, wall

TOLERANCE = 0.002


def smoother(splats, length, areas=None):
    each = np.full((2, len(splats)), 0.02**2) if areas is None else areas
    return SplatSmoother(
        splats.centers, shortest_axes(splats), each, np.full(len(splats), 1e-6), length, TOLERANCE
    ), each


def spike(splats, at, side=0):
    start = np.zeros((2, len(splats)))
    start[side, np.argmin(np.linalg.norm(splats.centers - np.asarray(at), axis=1))] = 1
    return start


@pytest.mark.parametrize("length", [0.03, 0.05, 0.1])
def test01_a_point_becomes_a_gaussian_of_that_width(length):
    rng = np.random.default_rng(0)
    plain = wall(side=1.2)
    plain.centers[:, :2] += rng.uniform(-0.004, 0.004, (len(plain), 2))
    flow, areas = smoother(plain, length)
    start = spike(plain, (0, 0, 0))
    found = flow(start)
    assert np.isclose(found.sum(), 1, rtol=1e-12) and (found >= 0).all() and not found[1].any()
    apart = plain.centers - plain.centers[start[0].argmax()]
    for axis in (0, 1):
        width = np.sqrt((found[0] * apart[:, axis] ** 2).sum())
        assert abs(width / length - 1) < 0.08
    square = (apart**2).sum(axis=1)
    exact = np.exp(-square / (2 * length**2)) / (2 * np.pi * length**2) * areas[0]
    assert np.abs(found[0] - exact).sum() < 0.25
    # What is even stays even, whatever the areas.
    flow, areas = smoother(plain, length, rng.uniform(0.5, 1.5, (2, len(plain))) * areas)
    assert np.allclose(flow(areas), areas, rtol=1e-9)


@pytest.mark.parametrize("turned", [(1.0, 0.0, 0.0, 0.0), TURN_X])
@pytest.mark.parametrize("length", [0.05, 0.2])
def test02_walls_5_cm_apart_stay_apart(turned, length):
    """Parallel ones and such that face each other, whichever side is looked at."""
    both = joined([wall(0.0, 0.8), wall(0.05, 0.8, turned=turned)])
    flow, _ = smoother(both, length)
    n = len(both) // 2
    for side in (0, 1):
        found = flow(spike(both, (0, 0, 0), side))
        assert np.isclose(found[side, :n].sum(), 1, rtol=1e-12) and not found[1 - side].any() and not found[:, n:].any()


def test03_neither_through_a_board_nor_around_its_edge():
    board = joined([wall(0.0, 0.4), wall(0.001, 0.4, turned=TURN_X)])
    n = len(board) // 2
    front = spike(board, (0.1, 0.1, 0))
    found = smoother(board, 0.05)[0](front)
    # Seen along +z are side 0 of the first and side 1 of the other.
    assert not found[1, :n].any() and not found[0, n:].any() and found[1, n:].sum() > 0.1
    hidden = np.full((2, len(board)), 0.02**2)
    hidden[1, n:] = hidden[1, :n] = 1e-7
    found = smoother(board, 0.05, hidden)[0](front)
    assert np.isclose(found[0, :n].sum(), 1)
    upright = Splats(
        wall(0.0, 0.4).centers[:, [2, 1, 0]] + [0.2, 0, 0.2],
        np.tile([1e-3, 0.014, 0.014], (n, 1)),
        [[1, 0, 0, 0]] * n,
        [0.9] * n,
        np.zeros((n, 1, 3)),
    )
    corner = joined([wall(0.0, 0.4), upright])
    assert not smoother(corner, 0.1)[0](spike(corner, (0.19, 0, 0)))[:, n:].any()


def test04_many_in_one_cell_have_one_density_and_a_length_has_to_be_positive():
    many = wall(0.0, 0.1, apart=0.001)
    areas = np.full((2, len(many)), 0.001**2)
    flow, _ = smoother(many, 0.02, areas)
    start = spike(many, (0, 0, 0))
    start[1] = 0.3
    found = flow(start)
    assert np.isclose(found.sum(), start.sum(), rtol=1e-12) and len(np.unique((found / areas)[0])) < len(many) / 2
    with pytest.raises(ValueError, match="positive length"):
        smoother(many, 0.0, areas)
    none = SplatSmoother(many.centers, shortest_axes(many), areas, np.full(len(many), 1.0), 0.02, TOLERANCE)
    assert np.array_equal(none(start), start)
