"""What tests of several kinds of training share."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.train.geometry import TrainingGeometry
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.train.gaze.looks import BOX, looking_at
from tests.train.radiance.ball import ball_dataset


@pytest.fixture(scope="module")
def dataset():
    """Posed pictures of a ball."""
    return ball_dataset()


@pytest.fixture
def one_thread():
    """Sums come in one order, so that equal runs are equal bit for bit."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(threads)


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
    return TrainingGeometry(VolumeMedium(rgb.load_dict(volume)), BOX, "scene")


@pytest.fixture
def threads():
    """Sets the number of threads, which the end puts back."""
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)
