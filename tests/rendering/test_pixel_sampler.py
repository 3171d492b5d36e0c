"""A range of samples draws the numbers that it has in Mitsuba's whole picture."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rendering import bands


@pytest.mark.parametrize("base, seed", [(0, 0), (5, 9), (4294967295, 3)])
def test_numbers_are_those_of_the_whole(rgb, base, seed):
    sampler = rgb.load_dict({"type": "independent", "seed": base, "sample_count": 2})
    assert bands.base_seed(sampler) == base
    sampler.seed(seed, 1000)
    theirs = np.array([sampler.next_1d(), *sampler.next_2d()])
    part = bands.for_samples(2, base, seed, 137, 500)
    assert np.array_equal(np.array([part.next_1d(), *part.next_2d()]), theirs[:, 137:637])


def test_a_copy_goes_its_own_way(rgb):
    sampler = bands.for_samples(1, 0, 0, 0, 10)
    copy = sampler.clone()
    first = np.array(sampler.next_1d())
    assert np.array_equal(np.array(copy.next_1d()), first)
    assert not np.array_equal(np.array(copy.next_1d()), first)


def test_beyond_two_to_the_32_numbers_do_not_repeat(rgb):
    near, far = (np.array(bands.for_samples(1, 0, 0, first, 64).next_1d()) for first in (0, 1 << 32))
    assert not np.any(near == far)


def test_other_samplers_are_none_of_ours(rgb):
    assert bands.base_seed(rgb.load_dict({"type": "stratified"})) is None
