from dataclasses import replace

import numpy as np

from tests.rays.checks.people import walk, warnings_of


def test_times_and_steep_gaze():
    rays = walk(hit=False)
    assert "a ray comes every 20 s" in warnings_of(replace(rays, t=rays.t * 1000))
    down = np.tile([0.1, 0.1, -1.0], (len(rays), 1)) / np.linalg.norm([0.1, 0.1, -1.0])
    assert "degrees down" in warnings_of(replace(rays, direction=down))
