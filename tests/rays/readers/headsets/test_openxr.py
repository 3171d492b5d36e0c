"""Gaze poses of OpenXR."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from tests.rays.readers.headset_examples import openxr
from tests.rays.readers.reading import dropped, read

N = 10
RNG = np.random.default_rng(1)
PLACE, TURN = RNG.normal(size=(N, 3)), Rotation.from_quat(RNG.normal(size=(N, 4)))
TIMES = 7_000_000_000 + 11_111_111 * np.arange(N)


def test_rays_look_along_minus_z(tmp_path):
    path = tmp_path / "ann.csv"
    flags, active = np.full(N, 15), np.array(["1"] * N)
    flags[2], flags[3], flags[4], active[5] = 1, 2, 3, "0"
    path.write_text(openxr(TIMES, PLACE, TURN, flags, active))
    rays = read("openxr", path)
    kept = [0, 1, 4, 6, 7, 8, 9]
    # y up to z up: x, -z, y; the third column of a rotation by its quaternion's formula.
    x, y, z, w = TURN.as_quat()[kept].T
    back = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.allclose(rays.direction, np.stack([-back[:, 0], back[:, 2], -back[:, 1]], axis=1))
    assert np.allclose(rays.origin, np.stack([PLACE[kept, 0], -PLACE[kept, 2], PLACE[kept, 1]], axis=1))
    assert np.allclose(rays.t, 0.011111111 * np.array(kept)) and rays.persons == ("ann",)
    assert dropped(rays) == {"the pose is not valid": [[4, 5]], "the gaze is not active": [[7, 7]]}


def test_bare_names(tmp_path):
    path = tmp_path / "ann.csv"
    path.write_text("time,x,y,z,qx,qy,qz,qw\n5000000000,1,1.6,-2,0,0,0,2\n")
    rays = read("openxr", path)
    assert np.allclose(rays.origin, [[1, 2, 1.6]]) and np.allclose(rays.direction, [[0, 1, 0]]) and rays.t[0] == 0
    path.write_text("x,y,z,qx,qy,qz,qw\n1,1.6,-2,0,0,0,2\n")
    with pytest.raises(NergError, match="has no time"):
        read("openxr", path)
