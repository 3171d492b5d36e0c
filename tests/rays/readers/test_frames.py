import numpy as np
import pytest

from nerg_mi.rays.readers.base import UPS, Frame


def test_usual_frames():
    assert np.array_equal(Frame().to_rays(), np.eye(4))
    point = np.array([1.0, 2.0, 3.0])
    for (up, hand), want in {
        ("y", "right"): (1, -3, 2),
        ("y", "left"): (1, 3, 2),
        ("z", "left"): (1, -2, 3),
        ("-y", "right"): (1, 3, -2),
    }.items():
        assert np.array_equal(Frame(up=up, handedness=hand).to_rays()[:3, :3] @ point, want)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("hand, sign", [("right", 1), ("left", -1)])
def test_up_goes_up_and_hands_are_kept(up, hand, sign):
    R = Frame(up=up, handedness=hand).to_rays()[:3, :3]
    assert np.isclose(np.linalg.det(R), sign) and np.array_equal(R @ R.T, np.eye(3))
    assert np.array_equal(R @ np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1), [0, 0, 1])


def test_units_and_refusals():
    assert np.isclose(Frame(units="mm").to_rays()[0, 0], 1e-3)
    for wrong in ({"up": "w"}, {"handedness": "both"}, {"units": "inch"}):
        with pytest.raises(ValueError, match="known"):
            Frame(**wrong).to_rays()
