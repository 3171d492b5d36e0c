"""The slab tests against the same in float64, on ordinary and on awkward rays."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import box_interval, intersect_box
from tests.reference import march_numpy as reference

LOWER, UPPER = (-1, 0, 2), (3, 2, 4)


def intersect(o, d, lower=LOWER, upper=UPPER):
    """What both slab tests say, which must agree."""
    o, d = np.atleast_2d(np.asarray(o, np.float32)), np.atleast_2d(np.asarray(d, np.float32))
    near, far = intersect_box(ns.Array3f(o.T), ns.Array3f(d.T), lower, upper)
    near, far = np.broadcast_to(near.numpy(), len(o)), np.broadcast_to(far.numpy(), len(o))
    first, last = box_interval(o.astype(float), d.astype(float), lower, upper)
    scale, hit = np.abs(upper).max(), near < far
    with np.errstate(invalid="ignore"):
        clear = np.abs(far - near) > 1e-4 * scale
    assert np.array_equal((first < last)[clear], hit[clear])
    for float64, float32 in ((first, near), (last, far)):
        assert np.allclose(float64[hit], float32[hit], rtol=1e-4, atol=1e-5 * scale)
    return near, far


@pytest.mark.parametrize("scale", [1e-3, 1, 1e6])
def test01_random_rays(scale):
    rng = np.random.default_rng(0)
    o = (rng.uniform((-3, -1, 0), (5, 3, 6), (500, 3)) * scale).astype(np.float32)
    d = rng.normal(size=(500, 3))
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
    d[:100, 0] = 0
    d[50:120, 2] = 0
    lower, upper = np.multiply(LOWER, scale), np.multiply(UPPER, scale)
    near, far = intersect(o, d, lower, upper)
    hits = 0
    for i in range(500):
        expected = reference.box(o[i].astype(float), d[i].astype(float), lower, upper)
        if expected is None:
            assert near[i] >= far[i]
        else:
            hits += 1
            assert np.allclose([near[i], far[i]], expected, rtol=1e-5, atol=1e-5 * scale)
    assert 100 < hits < 400
    assert not np.any(np.isnan(near) | np.isnan(far))


@pytest.mark.parametrize(
    "o, d, expected",
    [
        ((1, 1, 0), (0, 0, 1), (2, 4)),  # along an axis
        ((1, 1, 3), (0, 0, 1), (-1, 1)),  # from inside
        ((1, 1, 6), (0, 0, -1), (2, 4)),  # backwards
        ((1, 1, 2), (0, 0, 1), (0, 2)),  # from on a face
        ((-1, 0, 2), (0, 0, 1), (0, 2)),  # along an edge, which belongs to the box
        ((-1, 1, 0), (0, 0, 1), (2, 4)),  # in the plane of a face
        ((1, 1, 0), (-0.0, -0.0, 1), (2, 4)),  # negative zeros
    ],
)
def test02_parallel_rays(o, d, expected):
    near, far = intersect(o, d)
    assert (near[0], far[0]) == expected


@pytest.mark.parametrize(
    "o, d",
    [((5, 1, 0), (0, 0, 1)), ((1, -1e-6, 3), (1, 0, 0)), ((-1.0001, 1, 0), (0, 0, 1)), ((1, 1, 5), (0.6, 0.8, 0))],
)
def test03_misses(o, d):
    near, far = intersect(o, d)
    assert near[0] >= far[0] and not np.isnan(near[0]) and not np.isnan(far[0])


def test04_behind_is_negative():
    near, far = intersect((1, 1, 6), (0, 0, 1))
    assert (near[0], far[0]) == (-4, -2)


def test05_a_corner_is_grazed_in_a_point():
    # Through the edge x = -1, z = 2 at 45 degrees: enters and leaves at one t.
    near, far = intersect((-2, 1, 3), (2**-0.5, 0, -(2**-0.5)))
    assert np.isclose(near[0], 2**0.5) and near[0] >= far[0] - 1e-6


def test06_tiny_components_do_not_overflow_into_nan():
    near, far = intersect([(1, 1, 0)] * 3, [(1e-30, 0, 1), (1e-38, 1e-38, 1), (-1e-38, 1e-42, 1)])
    assert np.allclose(near, 2) and np.allclose(far, 4)
