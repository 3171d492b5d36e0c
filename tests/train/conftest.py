"""What tests of several kinds of training share."""

import drjit as dr
import pytest

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
