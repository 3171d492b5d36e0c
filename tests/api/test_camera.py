"""A camera in a few numbers, and what is refused."""

import numpy as np
import pytest

import nerg_mi as nerg


def test01_the_middle_of_the_picture_is_the_target(rgb):
    camera = nerg.Camera(origin=(1, 2, 3), target=(4, 6, 3), up=(0, 0, 1), fov=40, width=64, height=32)
    sensor = rgb.load_dict(camera.to_dict(4))
    ray, _ = sensor.sample_ray(0, 0, (0.5, 0.5), (0.5, 0.5))
    assert np.allclose(np.ravel(ray.d), (0.6, 0.8, 0), atol=1e-6)
    assert np.allclose(np.ravel(sensor.world_transform() @ rgb.Point3f(0)), (1, 2, 3))
    assert tuple(sensor.film().size()) == (64, 32) and sensor.sampler().sample_count() == 4
    assert sensor.film().rfilter().is_box_filter()


def test02_fov_is_that_of_the_width_and_up_is_up(rgb):
    sensor = rgb.load_dict(nerg.Camera((0, 0, 0), (0, 1, 0), fov=90, width=20, height=10).to_dict())
    left, right, top = (np.ravel(sensor.sample_ray(0, 0, at, (0.5, 0.5))[0].d) for at in ((0, 0.5), (1, 0.5), (0.5, 0)))
    assert np.isclose(np.dot(left, right), 0, atol=1e-6)
    assert right[0] > 0 > left[0] and top[2] > 0


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"target": (1, 2, 3)}, "cannot look at the same point"),
        ({"target": (1, 2, 8)}, "cannot look along its own up"),
        ({"up": (0, 0, 0)}, "own up"),
        ({"fov": 180}, "must lie in 0.0001 .. 179.9, got 180"),
        ({"fov": float("nan")}, "got nan"),
        ({"width": 0}, "the width of a picture must lie in 1 .. "),
        ({"height": 2.5}, "must be a whole number, got 2.5"),
        ({"width": 1 << 20, "height": 1 << 20}, "at most 268,435,456 pixels"),
        ({"origin": (0, float("inf"), 0)}, "origin of a camera"),
        ({"origin": (0, 1)}, "origin of a camera must"),
        ({"origin": [(0, 1, 2)]}, "origin of a camera"),
    ],
)
def test03_what_is_no_camera(wrong, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.Camera(**{"origin": (1, 2, 3), "target": (4, 5, 6), **wrong})
