"""The contraction against its formula in float64, and the way back."""

import numpy as np
import pytest

from nerg_mi.maths.geometry import Box, ContractedBox, box_of

CORE = Box((-1.0, 2.0, -0.5), (3.0, 5.0, 1.5))


def points(rgb, p):
    return rgb.Array3f(np.asarray(p, np.float32).T)


@pytest.fixture
def rgb():
    import drjit.llvm.ad as ns

    return ns


def expected(p, box):
    x = (np.asarray(p, float) - box.center) * 2 / box.side
    m = np.abs(x).max(axis=1, keepdims=True)
    return np.where(m <= 1, x, (2 - 1 / np.maximum(m, 1)) * x / np.maximum(m, 1)) / 4 + 0.5


def test_is_the_formula_and_comes_back(rgb):
    box, rng = ContractedBox(CORE, 64), np.random.default_rng(0)
    away = rng.normal(size=(2000, 3))
    p = box.center + away / np.abs(away).max(axis=1, keepdims=True) * np.geomspace(1e-3, 120, 2000)[:, None]
    u = box.to_unit(points(rgb, p))
    np.testing.assert_allclose(u.numpy().T, expected(p, box), atol=3e-7)
    back = box.from_unit(u).numpy().T
    # Near the far end a spacing of single precision of u is m² / 2 of them of the position.
    m = np.maximum(np.abs((p - box.center) * 2 / box.side).max(axis=1), 1)
    assert np.all(np.abs(back - p).max(axis=1) <= 4e-6 * m**2)


def test_the_inner_cube_keeps_its_shape(rgb):
    box = ContractedBox(CORE, 8)
    p = np.random.default_rng(1).uniform(CORE.lower, CORE.upper, (500, 3))
    u = box.to_unit(points(rgb, p)).numpy().T
    np.testing.assert_allclose((u - 0.5) * 2 * box.side + box.center, p, atol=2e-6)
    assert np.all(box.distance_scale(points(rgb, p)).numpy() == 1)


def test_bounds_and_the_straight_cube(rgb):
    box = ContractedBox(CORE, 8)
    assert box.side == 4 and box.cube_side == 32 and box.diagonal == pytest.approx(32 * 3**0.5)
    assert box.lower == (-15, -12.5, -15.5) and box.upper == (17, 19.5, 16.5)
    inside = box.contains(points(rgb, [box.center, [16.9, 19.4, 16.4], [17.1, 0, 0]]))
    assert inside.numpy().tolist() == [True, True, False]
    corners = box.to_cube(points(rgb, [box.lower, box.upper])).numpy().T
    np.testing.assert_allclose(corners, [[0, 0, 0], [1, 1, 1]], atol=1e-6)
    # What is encoded beyond the outer cube stands on its face.
    assert box.contains(box.from_unit(rgb.Array3f(0.99999, 0.5, 0.5))).numpy().all()


def test_its_dictionary_makes_it_again():
    for box in (ContractedBox(CORE, 16), CORE, Box((-1, -1, -1), (1, 1, 1), 2.0)):
        assert box_of(box.to_dict()) == box


@pytest.mark.parametrize("reach", [1, 3, 0.5, float("nan"), float("inf"), 2**13])
def test_the_reach_is_a_power_of_two(reach):
    with pytest.raises(ValueError, match="power of two"):
        ContractedBox(CORE, reach)


def test_the_core_is_bounded_by_its_corners():
    with pytest.raises(ValueError, match="own corners"):
        ContractedBox(Box((-1, -1, -1), (1, 1, 1), 2.0))
