from dataclasses import replace

import numpy as np

from nerg_mi.rays.direction_checks import head_frames
from tests.rays.checks.people import change, warnings_of, watch


def test_gaze_that_is_the_heads_of_a_moment_ago():
    rays = replace(watch(), hit=None)
    late = change(rays, slice(3000, 6000), direction=np.roll(rays.head, 1, axis=0)[3000:6000])
    assert "the gaze of bo stays at one place in the head, within 4 degrees" in warnings_of(late)
    # As well where it is turned, and not along the head.
    turned = np.einsum("nij,i->nj", head_frames(rays.head.astype(float)), (0.96, 0.0, -0.28))
    noisy = turned + np.random.default_rng(0).normal(0, 0.02, turned.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    assert "the gaze of ann, bo, cy stays at one place" in warnings_of(replace(rays, direction=noisy))


def test_who_keeps_the_head_still_may_keep_the_eyes_still():
    rays = replace(watch(), hit=None)
    rng, n = np.random.default_rng(1), len(rays)
    ahead = lambda spread: (v := rng.normal(0, spread, (n, 3)) + (1, 0, 0)) / np.linalg.norm(v, axis=1, keepdims=True)
    assert "one place in the head" not in warnings_of(replace(rays, head=ahead(0.02), direction=ahead(0.02)))
