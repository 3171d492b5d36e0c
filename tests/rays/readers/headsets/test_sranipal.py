"""SRanipal's own values beside Unity's heads."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from tests.rays.readers.headset_examples import sranipal
from tests.rays.readers.reading import dropped, read

N = 12
RNG = np.random.default_rng(7)
HEAD, TURN = RNG.normal(size=(N, 3)) + [0, 1.6, 0], Rotation.from_quat(RNG.normal(size=(N, 4)))
ORIGIN, LOOK = 30 * RNG.normal(size=(N, 3)), RNG.normal(size=(N, 3)) * 0.2 + [0, 0, 1]


def world(origin, look):
    """What Unity makes of GetGazeRay's values, point by point, in the frame of rays: x, z, y."""
    o, d = np.empty((2, N, 3))
    for k in range(N):
        m = TURN[k].as_matrix()
        for i, j in enumerate((0, 2, 1)):
            o[k, i] = HEAD[k, j] + (m[j, 1] * origin[k, 1] + m[j, 2] * origin[k, 2] - m[j, 0] * origin[k, 0]) / 1000
            d[k, i] = m[j, 1] * look[k, 1] + m[j, 2] * look[k, 2] - m[j, 0] * look[k, 0]
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("style", ["verbose_data.{}.{}.{}", "{}_{}_{}", "{} {} [{}]"])
def test_x_is_negated(tmp_path, style):
    path = tmp_path / "s1.csv"
    mask = np.full(N, 3)
    mask[4], mask[9] = 1, 0
    path.write_text(sranipal(20.0 * np.arange(N), HEAD, TURN, {"combined": (ORIGIN, LOOK, mask)}, style))
    rays = read("sranipal", path)
    origin, direction = (np.delete(v, [4, 9], axis=0) for v in world(ORIGIN, LOOK))
    assert np.allclose(rays.origin, origin) and np.allclose(rays.direction, direction)
    assert np.allclose(rays.t, np.delete(0.02 * np.arange(N), [4, 9])) and rays.metadata["tick"] == 1e-3
    assert dropped(rays) == {"no eye is valid": [[6, 6], [11, 11]]}


def test_two_eyes_are_one_ray(tmp_path):
    """Where one is lost, the other alone; masks of 31 are all that there is to be valid."""
    left, right = (ORIGIN + [31, 0, 0], LOOK, np.full(N, 31)), (ORIGIN - [31, 0, 0], LOOK + [0, 0.1, 0], np.full(N, 31))
    right[2][3] = 8
    right[1][5] = 0
    path = tmp_path / "s1.csv"
    path.write_text(sranipal(np.arange(N), HEAD, TURN, {"left": left, "right": right}, "{}_{}_{}"))
    rays = read("sranipal", path, tick=1.0)
    alone = np.isin(np.arange(N), [3, 5])[:, None]
    want = world(np.where(alone, left[0], ORIGIN), np.where(alone, LOOK, LOOK + [0, 0.05, 0]))
    assert np.allclose(rays.origin, want[0]) and np.allclose(rays.direction, want[1])


def test_names_of_the_sdks_example(tmp_path):
    """gaze_origin_L.x(mm), gaze_direct_L.x, eye_valid_L."""
    names = ["time_stamp(ms)", *(f"head_pos_{a}" for a in "xyz"), *(f"head_rot_{a}" for a in "xyzw")]
    for side in "LR":
        names += [f"gaze_origin_{side}.{a}(mm)" for a in "xyz"] + [f"gaze_direct_{side}.{a}" for a in "xyz"]
        names.append(f"eye_valid_{side}")
    row = [0, 1, 1.6, 2, 0, 0, 0, 1, 31, 0, 0, 0.6, 0, 0.8, 31, -31, 0, 0, 0.6, 0, 0.8, 31]
    (tmp_path / "a.csv").write_text(",".join(names) + "\n" + ",".join(map(str, row)) + "\n")
    rays = read("sranipal", tmp_path / "a.csv")
    assert np.allclose(rays.origin, [[1, 2, 1.6]]) and np.allclose(rays.direction, [[-0.6, 0.8, 0]])


def test_what_is_missing_is_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,gaze_origin_mm_x\n")
    with pytest.raises(NergError, match="no gaze_origin_mm_{x,y,z} or no gaze_direction_normalized"):
        read("sranipal", path)
    eyes = {"combined": (ORIGIN, LOOK, np.full(N, 3))}
    path.write_text(sranipal(np.arange(N), HEAD, TURN, eyes).replace("time_stamp", "clock"))
    with pytest.raises(NergError, match="has no time"):
        read("sranipal", path)
