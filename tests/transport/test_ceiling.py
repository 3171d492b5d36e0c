"""Where rays begin that start above a ceiling."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Ceiling


def ray(mi, origins, directions, kind="RayDifferential3f"):
    o, d = (np.array(v, np.float32).T for v in np.broadcast_arrays(origins, directions))
    return getattr(mi, kind)(mi.Point3f(np.ascontiguousarray(o)), mi.Vector3f(np.ascontiguousarray(d)))


@pytest.mark.parametrize("scale", [1.0, 7.0])
def test01_they_begin_where_they_come_below(rgb, scale):
    directions = [[0, 0, -1], [0.6, 0, -0.8], [1, 0, 0], [0, 0, 1], [0.6, 0, -0.8]]
    origins = [[0, 0, 3]] * 4 + [[0, 0, 0.5]]
    given = ray(rgb, origins, directions)
    given.maxt = rgb.Float(10)
    moved, ahead = Ceiling(1.0, (0, 0, scale)).cut(given)
    assert np.allclose(ahead, [2, 2.5, 0, 0, 0])
    assert np.allclose(np.array(moved.o).T[:2], [[0, 0, 1], [1.5, 0, 1]]) and np.allclose(
        moved.maxt, [8, 7.5, 10, 10, 10]
    )
    assert np.allclose(np.array(moved.o).T[2:], origins[2:]) and np.array_equal(moved.d, given.d)


def test02_along_any_direction_and_with_neighbouring_rays(rgb):
    rng = np.random.default_rng(3)
    up, o, d = rng.normal(size=3), rng.normal(size=(50, 3)) * 4, rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    given = ray(rgb, o, d)
    given.o_x, given.d_x, given.o_y, given.d_y = given.o + 1, given.d, given.o, given.d
    moved, ahead = Ceiling(0.3, up).cut(given)
    unit = up / np.linalg.norm(up)
    over, fall = o @ unit - 0.3, -(d @ unit)
    cuts = (over > 0) & (fall > 0)
    expected = np.where(cuts, over / np.where(cuts, fall, 1), 0)
    assert 5 < cuts.sum() < 45 and np.allclose(ahead, expected, rtol=1e-4)
    assert np.allclose(np.array(moved.o).T, o + expected[:, None] * d, rtol=1e-4, atol=1e-4)
    assert np.allclose(moved.o_x - moved.o, 1, atol=1e-4) and np.allclose(moved.o_y - moved.o, 0, atol=1e-4)


def test03_another_height_is_no_other_kernel(rgb):
    given = ray(rgb, [[0, 0, 3]] * 4, [[0, 0, -1]] * 4, "Ray3f")
    kernels = []
    for height in (1.0, 1.5, 2.0):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(Ceiling(height).cut(given)[1])
            kernels.append({k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])})
    assert kernels[0] == kernels[1] == kernels[2] and kernels[0]


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0)])
def test04_up_is_a_direction(rgb, up):
    with pytest.raises(NergError, match='"up" must be a direction'):
        Ceiling(1.0, up)
