"""What an observer meets all around, and what is made of the directions in which that is nothing."""

import numpy as np
import pytest

from nerg_mi.transport.observer_gaze import nearest_depth


@pytest.mark.parametrize("count", [1, 5, 8, 40])
def test_depths_of_what_escapes_are_those_of_its_neighbours(count):
    """By hand: the weighted mean of the logarithm over the eight nearest, or all where there are fewer."""
    rng = np.random.default_rng(count)
    unit = lambda n: (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(rng.normal(size=(n, 3)))
    known, wanted, depth = unit(count), unit(30), rng.uniform(0.2, 9.0, count)
    expected = []
    for w in wanted:
        apart = np.linalg.norm(known - w, axis=1)
        near = np.argsort(apart)[:8]
        weight = 1 / (apart[near] ** 2 + 1e-3)
        expected.append(np.exp(np.sum(weight * np.log(depth[near])) / weight.sum()))
    np.testing.assert_allclose(nearest_depth(known, depth, wanted), expected, rtol=1e-5)
    # A depth of zero has a logarithm too.
    assert nearest_depth(known, np.zeros(count), wanted) == pytest.approx(1e-6)
