"""The steps of a filter, of rays that nobody else holds and of those that somebody does."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows.rays import FilterOptions, FilterSteps, least_mask
from tests.rays.dataset.test_writing import crowd


def test_steps_and_what_is_kept_of_them():
    rays = crowd()
    steps = FilterSteps(rays, own=False)
    steps.select({"time": (10, 60)})
    steps.sample(100, seed=3)
    assert [(s.name, s.kept, s.of) for s in steps.taken] == [("filter", 500, 1000), ("sample", 100, 500)]
    assert steps.rays.metadata["steps"][1] == {"step": "sample", "kept": 100, "of": 500, "seed": 3}
    assert len(rays) == 1000 and "steps" not in rays.metadata and len(set(steps.rays.t)) == 100


def test_nothing_is_left():
    steps = FilterSteps(crowd(), own=True)
    with pytest.raises(NergError, match="filter leaves none of 1,000 rays"):
        steps.select({"time": (1e6, None)})
    steps = FilterSteps(crowd().select(np.zeros(1000, bool)), own=True, strict=False)
    for fixations, one_ray in (("ivt", False), ("idt", True)):
        assert steps.follow(FilterOptions(fixations=fixations, one_ray=one_ray, thin=2)) == 0
    assert [s.of for s in steps.taken] == [0] * 4


def test_the_least_numbers_are_any_as_likely():
    counts = np.zeros(20)
    for seed in range(2000):
        mask = least_mask(np.random.default_rng(seed).random(20), 5)
        assert mask.sum() == 5
        counts += mask
    assert ((counts - 500) ** 2 / 500).sum() < 43.8  # chi-square of 19 degrees of freedom at one in a thousand
    assert least_mask(np.zeros(3), 5).all() and not least_mask(np.arange(3.0), 0).any()
