from dataclasses import replace

import numpy as np
import pytest

from tests.rays.checks.people import walk, warnings_of


@pytest.mark.parametrize("scale, word", [(1000, "--units mm"), (100, "--units cm")])
def test_units(scale, word):
    rays = walk(hit=False)
    assert word in warnings_of(replace(rays, origin=rays.origin * scale))


def test_the_axis_that_is_up():
    # A file with y up that was declared with z up: heights stand in y.
    rays = walk(hit=False)
    assert "--up y" in warnings_of(replace(rays, origin=rays.origin[:, [0, 2, 1]]))
    assert "--up -x" in warnings_of(replace(rays, origin=rays.origin[:, [2, 0, 1]] * (-1, 1, 1)))
    assert "floor is not at height 0" in warnings_of(replace(rays, origin=rays.origin - (0, 0, 1.6)))


@pytest.mark.parametrize("along", [0, 1])
def test_a_kilometre_is_the_most_that_origins_in_metres_span(along):
    """Heads at eye height: nothing but how far they are apart gives the unit away."""
    rays = walk(hit=False)
    for span, warned in ((999.5, False), (1000.5, True)):
        origin = rays.origin.copy()
        origin[:, along] *= span / np.ptp(origin[:, along])
        slow = replace(rays, origin=origin, t=rays.t * 40)  # nobody runs
        assert ("--units mm" in warnings_of(slow)) == warned


def test_heights_over_a_floor_that_is_not_known():
    rays = walk(hit=False)
    low = replace(rays, origin=rays.origin - (0, 0, 1.8), metadata={**rays.metadata, "floor": "unknown"})
    assert warnings_of(low) == ""


def test_a_moment_says_nothing_of_extents_and_elevations():
    down = np.array([0.1, 0.1, -1.0]) / np.linalg.norm([0.1, 0.1, -1.0])
    moment = walk(hit=False).select(slice(0, 2))
    moment = replace(moment, direction=np.tile(down, (2, 1)))
    assert warnings_of(moment) == ""
