"""Smallest regions of densities on the sphere, and the shares to ask for."""

from __future__ import annotations

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.probes import LEVELS, asked_level, calibrated_levels, level_name, region_levels


def test_regions_of_a_cap_hold_what_they_say():
    """A density that falls with the angle from z: the region that ends at cos a holds (e^k - e^ka) / (e^k - e^-k)."""
    d, kappa = fibonacci_directions(20_000), 3.0
    maps, at = np.exp(kappa * d[None, :, 2]), np.array([[1.0, 0.5, 0.0, -1.0]])
    level = region_levels(maps, np.exp(kappa * at))
    expected = (np.exp(kappa) - np.exp(kappa * at)) / (2 * np.sinh(kappa))
    np.testing.assert_allclose(level, expected, atol=1e-3)
    assert region_levels(np.ones((1, 5)), np.ones((1, 2))).tolist() == [[0.5, 0.5]]
    assert region_levels(np.zeros((1, 5)), np.zeros((1, 2))).tolist() == [[0.5, 0.5]]


def test_calibrated_levels_are_weighted_quantiles():
    rng = np.random.default_rng(0)
    # Of a density whose looks lie at the square root of a uniform level, the share q holds q^2 of them.
    levels = np.sqrt(rng.random(40_000))
    found = calibrated_levels(levels, np.ones(len(levels)))
    np.testing.assert_allclose([found[level_name(q)] for q in LEVELS], np.sqrt(LEVELS), atol=0.01)
    # A look of weight 3 is three looks; those of weight zero are none.
    some = levels[:999]
    times = rng.integers(0, 4, len(some))
    assert calibrated_levels(some, times.astype(float)) == calibrated_levels(
        np.repeat(some, times), np.ones(times.sum())
    )
    assert calibrated_levels(np.array([0.3]), np.ones(1)) == {"50%": 0.3, "80%": 0.3, "95%": 0.3}


def test_nothing_calibrated_is_asked_for_as_it_is():
    assert asked_level(0.8, None) == 0.8 and asked_level(0.8, {"80%": 0.7}) == 0.7
