"""The share of pixels beyond a box, where depths are known in closed form."""

import numpy as np
import pytest

from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions
from nerg_mi.photos.images import View
from nerg_mi.train.radiance_run import share_beyond
from nerg_mi.train.radiance_trainer import Preview

LENS = Intrinsics(40, 20, 40.0, 40.0, 20.0, 10.0)


def made(x, opacity=1.0):
    """A camera at (x, 0, 0) that looks along -z at the plane z = -4, and what it sees."""
    pose = np.eye(4)
    pose[0, 3] = x
    depth = 4 / -pixel_directions(LENS)[..., 2]
    view = View("plane", Camera(LENS, pose), np.zeros((20, 40, 3), np.float32))
    return view, Preview(np.zeros((20, 40, 3)), np.full((20, 40), opacity), depth)


@pytest.mark.parametrize("every", [1, 2])
def test_half_of_a_plane_lies_beyond(every):
    core = Box((0, -9, -9), (9, 9, 0))
    part = slice(every // 2, None, every)
    views = {view.camera.center[0]: (view, seen) for view, seen in (made(0.0), made(-50.0))}

    def render(view):
        seen = views[view.camera.center[0]][1]
        return Preview(seen.color[part, part], seen.opacity[part, part], seen.depth[part, part])

    ahead, aside = (views[x][0] for x in (0.0, -50.0))
    assert share_beyond([ahead], render, core, every) == 0.5
    assert share_beyond([ahead, aside], render, core, every) == 0.75


def test_what_lets_light_through_shows_nothing_within():
    view, seen = made(0.0, opacity=0.3)
    assert share_beyond([view], lambda v: seen, Box((-9, -9, -9), (9, 9, 0))) == 1
