"""Tests of `nerg_mi.environment.arrays`."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.arrays import LabelledArrays, as_points, as_unit_vectors, broadcast_to_observers
from nerg_mi.errors import NergError

# ---- Conversion from and to NumPy ----


def test01_points_of_every_shape():
    assert as_points((1, 2, 3), "x").shape == (1, 3)
    assert as_points([[1, 2, 3], [4, 5, 6]], "x").dtype == np.float32
    assert as_points(np.ones((5, 3), int)[::2], "x").flags.c_contiguous


@pytest.mark.parametrize(
    "wrong, said",
    [
        ((1, 2), r"eyes must have the shape \(3,\) or \(N, 3\), N at least 1, got \(2,\)"),
        (np.zeros((0, 3)), r"shape .* got \(0, 3\)"),
        ("here", "eyes must be x, y, z"),
        ([(0, 0, 0), (0, np.nan, 0)], r"row 1 is \[0.0, nan, 0.0\]"),
        ([(0, 0, 0), (0, 0, 1.1e7)], "coordinates from -1e.07 to 1e.07, but row 1"),
        ((1e308, 0, 0), "row 0 is"),
        ((10**400, 0, 0), "eyes must have coordinates from"),
        ([(0, 0), (0, 0, 1)], "eyes must be x, y, z"),
    ],
)
def test02_errors_name_the_invalid_points(wrong, said):
    with pytest.raises(NergError, match=said):
        as_points(wrong, "eyes")


def test03_directions_are_normalised_and_broadcast():
    d = as_unit_vectors((0, 3, 4), 5, "d")
    assert d.shape == (5, 3) and np.allclose(d, (0, 0.6, 0.8))
    with pytest.raises(NergError, match="d must not be zero, but row 1 is"):
        as_unit_vectors([(1, 0, 0), (0, 0, 0)], 2, "d")
    with pytest.raises(NergError, match=r"that of the origins \(3\), got 2"):
        as_unit_vectors([(1, 0, 0), (0, 1, 0)], 3, "d")


def make():
    depth = broadcast_to_observers(np.arange(6, dtype=np.float32).reshape(2, 3), 4)
    color = np.zeros((4, 2, 3, 3), np.float32)
    return LabelledArrays({"depth": depth, "color": color}, ("observer", "row", "column"), np.zeros((4, 3), np.float32))


def test04_arrays_have_names():
    result = make()
    assert result.names == ("depth", "color") and list(result) == ["depth", "color"] and len(result) == 2
    assert result.depth is result["depth"] and "color" in result and "gaze" not in result
    assert "depth" in dir(result)
    assert repr(result).splitlines() == [
        "LabelledArrays(observer 4, row 2, column 3)",
        "  depth  (4, 2, 3), float32",
        "  color  (4, 2, 3, 3), float32",
    ]


def test05_missing_arrays_are_errors():
    with pytest.raises(KeyError, match='"gaze"'):
        make()["gaze"]
    with pytest.raises(AttributeError, match='has no "gaze"'):
        make().gaze  # noqa: B018


def test06_broadcast_arrays_are_read_only():
    with pytest.raises(ValueError):
        make().depth[0, 0, 0] = 1


def test07_copies():
    result = make()
    assert np.array_equal(copy.copy(result).depth, result.depth)
    assert np.array_equal(pickle.loads(pickle.dumps(result)).color, result.color)


# ---- Cameras from a few numbers, and refused values ----


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
        ({"target": (1, 2, 3)}, "must differ from its origin"),
        ({"target": (1, 2, 8)}, "is parallel"),
        ({"up": (0, 0, 0)}, "is parallel"),
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
def test03_invalid_cameras_are_refused(wrong, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.Camera(**{"origin": (1, 2, 3), "target": (4, 5, 6), **wrong})
