"""Areas of Gaussians: closed forms, and what they add up to where many overlap."""

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.splats import Splats, joined
from nerg_mi.surfaces.splats import HIDDEN, shortest_axes, sides_of, splat_areas, whole_areas
from nerg_mi.transport.splat_medium import SplatArrays
from tests.surfaces.walls import TURN_X, wall


def areas(splats, tolerance=0.002):
    return splat_areas(splats, SplatArrays(splats, ns), tolerance)


def test01_one_that_nothing_hides_and_its_sides(rgb):
    turn = [np.cos(0.4), np.sin(0.4), 0.1, 0]
    one = Splats([[1, 2, 3]], [[0.2, 0.01, 0.1]], [turn], [0.5], np.zeros((1, 1, 3)))
    expected = 2 * np.pi * 0.2 * 0.1 * 0.5 * (1 - np.exp(-4.5))
    assert np.allclose(areas(one), expected, rtol=1e-6) and np.allclose(whole_areas(one, 3.0), expected)
    axis = shortest_axes(one)
    assert np.allclose(axis[0], one.axes()[0, :, 1]) and list(sides_of(np.r_[axis, -axis], np.r_[axis, axis])) == [0, 1]


def test02_overlapping_ones_share_what_there_is(rgb):
    """A wall that lets no light through has its area, however many Gaussians it is made of."""
    plain = wall(jitter=0.0005)
    found = areas(plain)
    edge = 4 * 0.014  # the last of the disks lie over the edge
    assert whole_areas(plain, 3.0).sum() > 2.5
    assert (found.sum(axis=1) > 0.99).all() and (found.sum(axis=1) < (1 + edge) ** 2).all()


def test03_one_behind_another_is_hidden_from_there_and_what_stands_before_it_hides_nothing(rgb):
    both = joined([wall(0.0, 0.2), wall(0.003, 0.2, turned=TURN_X)])
    found, n = areas(both, 0.004), len(both) // 2
    # Along +z the first wall is seen: that is side 0 of it, whose axis is +z, and side 1 of the other.
    assert (found[0, :n] > 4 * found[1, n:]).mean() > 0.8 and found[1, n:].sum() < 0.3 * found[0, :n].sum()
    far = joined([wall(0.0, 0.2), wall(0.05, 0.2)])
    assert np.allclose(areas(far, 0.004)[:, :n], areas(wall(0.0, 0.2), 0.004)) and 0 < HIDDEN < 1
