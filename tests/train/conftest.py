"""Common fixtures of the training tests."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.threads import set_thread_count
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.train.gaze.looks import BOX, looking_at
from tests.train.radiance.ball import ball_dataset


@pytest.fixture(scope="module")
def dataset():
    """Posed pictures of a ball."""
    return ball_dataset()


@pytest.fixture
def rays():
    """Rays of two participants who look at a point of the wall."""
    return looking_at((1.5, 0.4, 1.2))


@pytest.fixture
def wall(rgb):
    """An opaque slab behind x = 1.5, in BOX."""
    data = np.zeros((6, 8, 8, 1), np.float32)
    data[:, :, 7] = 200
    to_world = rgb.ScalarTransform4f().translate([-2, -2, 0]).scale([4, 4, 3])
    volume = {"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest", "to_world": to_world}
    return Environment(VolumeMedium(rgb.load_dict(volume)), BOX, "scene")


@pytest.fixture
def threads():
    """Set the number of threads, and restore it at the end."""
    before = dr.thread_count()
    yield set_thread_count
    set_thread_count(before)
