"""Fixtures of the tests of gaze training."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.train.geometry import GazePlace
from nerg_mi.transport.volume_medium import VolumeMedium

from .looks import BOX, looking_at


@pytest.fixture
def rays():
    """Of two people who look at a point of the wall."""
    return looking_at((1.5, 0.4, 1.2))


@pytest.fixture
def wall(rgb):
    """An opaque slab behind x = 1.5, in BOX."""
    data = np.zeros((6, 8, 8, 1), np.float32)
    data[:, :, 7] = 200
    to_world = rgb.ScalarTransform4f().translate([-2, -2, 0]).scale([4, 4, 3])
    volume = {"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest", "to_world": to_world}
    return GazePlace(VolumeMedium(rgb.load_dict(volume)), BOX, "scene")


@pytest.fixture
def threads():
    """Sets the number of threads, which the end puts back."""
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)
