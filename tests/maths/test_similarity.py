"""What places a field in a scene: rotations, uniform scales and translations, and no other transform."""

import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity


def turn(scale=1.0, angle=40, move=(1, -2, 3)):
    axis = np.array([0.6, 0.0, 0.8])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    a = np.radians(angle)
    m = np.eye(4)
    m[:3, :3] = scale * (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k)
    m[:3, 3] = np.multiply(move, scale)
    return m


@pytest.mark.parametrize("scale", [1e-3, 1, 1e3])
def test01_similarity(rgb, scale):
    m = turn(scale)
    s = Similarity(m)
    p = np.array([0.3, -0.2, 0.9])
    world = m @ [*p, 1]
    assert np.isclose(s.scale, scale) and not s.identity
    assert np.allclose(np.array(s.point_to_local(rgb.Point3f(world[:3].tolist()))).ravel(), p, atol=2e-6)
    w = m[:3, :3] @ p
    assert np.allclose(np.array(s.vector_to_local(rgb.Vector3f(w.tolist()))).ravel(), p, rtol=1e-5, atol=1e-6)
    unit = w / np.linalg.norm(w)
    assert np.allclose(
        np.array(s.direction_to_local(rgb.Vector3f(unit.tolist()))).ravel(), p / np.linalg.norm(p), atol=1e-6
    )


def test02_bounds_hold_the_corners():
    m = turn(2.0)
    lower, upper = Similarity(m).bounds((0, 0, 0), (1, 1, 2))
    corners = np.array([m[:3] @ [x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
    assert np.allclose(lower, corners.min(0)) and np.allclose(upper, corners.max(0))


SHEAR, UNEVEN, MIRROR, FLAT = (np.eye(4) for _ in range(4))
SHEAR[0, 1] = 0.3
UNEVEN[2, 2] = 1.5
MIRROR[0, 0] = -1
FLAT[1, 1] = 0
NAN = np.eye(4)
NAN[0, 0] = np.nan
PROJECTIVE = np.eye(4)
PROJECTIVE[3, 0] = 0.5
MOVED_TO_NAN = np.eye(4)
MOVED_TO_NAN[0, 3] = np.nan
FAR_AWAY = np.eye(4)
FAR_AWAY[1, 3] = -1.1e7


@pytest.mark.parametrize("matrix", [SHEAR, UNEVEN, MIRROR, FLAT, NAN, PROJECTIVE, MOVED_TO_NAN, FAR_AWAY])
def test03_other_transforms_are_refused(matrix):
    with pytest.raises(ValueError, match='"to_world"'):
        Similarity(matrix)


def test04_the_identity_returns_what_it_is_given(rgb):
    p = rgb.Point3f(1, 2, 3)
    s = Similarity()
    assert s.identity and s.scale == 1 and s.point_to_local(p) is p and s.direction_to_local(p) is p


def test05_the_inverse_leads_back():
    s = Similarity(turn(3.0))
    assert np.allclose(s.inverse @ s.matrix, np.eye(4), atol=1e-12)
