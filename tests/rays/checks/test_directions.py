from dataclasses import replace

import numpy as np

from tests.rays.checks.people import walk, warnings_of


def test_directions_against_hit_points():
    rays = walk(frame={"up": "y", "handedness": "left"})  # the file's z is our y
    assert "with z of the directions negated they would" in warnings_of(
        replace(rays, direction=rays.direction * (1, -1, 1))
    )
    swapped = replace(rays, direction=rays.direction[:, [1, 0, 2]])
    assert "miss the hit points" in warnings_of(swapped) and "one frame" in warnings_of(swapped)


def test_directions_of_some_against_hit_points():
    rays = walk()
    two = replace(rays, person=np.repeat([0, 1], [4500, 1500]), persons=("ann", "bo"))
    part = two.direction.copy()
    part[4500:] *= (1, -1, 1)
    said = warnings_of(replace(two, direction=part))
    assert "of the directions, those of bo, miss the hit points" in said and "with y of the directions negated" in said
    part[:4650] = two.direction[:4650]
    part[4800:] = two.direction[4800:]
    assert "miss" not in warnings_of(replace(two, direction=part))
