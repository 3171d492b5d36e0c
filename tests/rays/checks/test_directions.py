from dataclasses import replace

from tests.rays.checks.people import walk, warnings_of


def test_directions_against_hit_points():
    rays = walk(frame={"up": "y", "handedness": "left"})  # the file's z is our y
    assert "with z of the directions negated they would" in warnings_of(
        replace(rays, direction=rays.direction * (1, -1, 1))
    )
    swapped = replace(rays, direction=rays.direction[:, [1, 0, 2]])
    assert "miss the hit points" in warnings_of(swapped) and "one frame" in warnings_of(swapped)
