import tracemalloc

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.splats import read_splat
from nerg_mi.maths.sphere import C0
from tests.formats.splats.writers import random_splats, write_antimatter


def test_a_file_is_read_to_its_bytes(tmp_path):
    splats = random_splats(degree=1)
    write_antimatter(tmp_path / "a.splat", splats)
    read = read_splat(tmp_path / "a.splat")
    assert read.degree == 0
    assert np.array_equal(read.centers, splats.centers) and np.array_equal(read.scales, splats.scales)
    assert np.abs(read.opacities - splats.opacities).max() < 1 / 255
    seen = np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1)
    assert np.abs(0.5 + C0 * read.harmonics[:, 0] - seen).max() < 1 / 255
    # Up to its sign a quaternion is its rotation.
    assert np.abs(np.abs((read.rotations * splats.rotations).sum(axis=1)) - 1).max() < 1e-3


def test_what_is_no_such_file_is_refused(tmp_path):
    (tmp_path / "a.splat").write_bytes(b"x" * 33)
    with pytest.raises(NergError, match=r"a\.splat.*multiple of 32"):
        read_splat(tmp_path / "a.splat")
    (tmp_path / "a.splat").write_bytes(b"")
    with pytest.raises(NergError, match="no Gaussians"):
        read_splat(tmp_path / "a.splat")


def test_memory_is_a_small_multiple_of_the_file(tmp_path):
    rows = np.ones((1 << 19, 32), np.uint8)
    rows[:, :24] = np.full(6, 0.5, "<f4").view(np.uint8)
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    tracemalloc.start()
    assert len(read_splat(tmp_path / "a.splat")) == len(rows)
    assert tracemalloc.get_traced_memory()[1] < 2.7 * rows.nbytes
    tracemalloc.stop()
