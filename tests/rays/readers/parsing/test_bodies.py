"""Head poses of skeletons, and bodies for given ones."""

import numpy as np
import pytest

from nerg_mi.rays.readers import skeleton


def heads(n=200, seed=0):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    d[0], d[1] = (0, 0, -1), (0, 0, 1)  # straight down and up
    return rng.uniform([0, 0, 1.2], [8, 6, 1.9], (n, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def poses_of(body, ears=(skeleton.LEFT_EAR, skeleton.RIGHT_EAR), nose=skeleton.NOSE, pitch=0.0):
    return skeleton.head_poses(*(body[:, k] for k in (*ears, nose)), pitch=pitch)


def test_body_gives_exactly_its_head_pose():
    origin, direction = heads()
    body = skeleton.keypoints_from_head(origin, direction)
    o, d = poses_of(body)
    assert np.abs(o - origin).max() < 1e-6 and np.abs(d - direction).max() < 1e-6
    assert np.isfinite(body).all() and body[..., 2].min() > -0.05
    # The left ear is on the left of where the head looks.
    side = body[2:, skeleton.LEFT_EAR] - body[2:, skeleton.RIGHT_EAR]
    left = np.cross([0, 0, 1.0], direction[2:])
    assert np.all(np.sum(side * left, axis=1) > 0)
    assert np.allclose(np.linalg.norm(side, axis=1), skeleton.EAR_DISTANCE)


def test_unseen_keypoints_and_bad_heads():
    origin, direction = heads(3)
    body = skeleton.keypoints_from_head(origin, direction)
    body[0, skeleton.NOSE] = np.nan
    body[1, skeleton.NOSE] = 0.5 * (body[1, skeleton.LEFT_EAR] + body[1, skeleton.RIGHT_EAR])
    _, d = poses_of(body)
    assert np.isnan(d[:2]).all() and np.isfinite(d[2]).all()
    with pytest.raises(ValueError, match="head pose 1"):
        skeleton.keypoints_from_head(origin, direction * [[1], [0], [1]])


def test_other_keypoints_and_pitch():
    origin, direction = (v[2:] for v in heads(40))  # those that can be turned up
    body = skeleton.keypoints_from_head(origin, direction)
    swapped = body[:, ::-1]
    o, d = poses_of(swapped, ears=(21 - skeleton.LEFT_EAR, 21 - skeleton.RIGHT_EAR), nose=21 - skeleton.NOSE)
    assert np.allclose(o, origin) and np.allclose(d, direction)
    _, up = poses_of(body, pitch=10)
    elevation = lambda v: np.degrees(np.arcsin(v[:, 2]))
    low = elevation(direction) < 75
    assert np.allclose(elevation(up)[low] - elevation(direction)[low], 10)


def test_a_body_is_the_same_on_both_sides():
    origin, heading = np.array([[2.0, 3.0, 1.58], [0.0, -1.0, 0.79], [0.5, 0.0, 1.7]]), np.array([0.3, 2.0, -1.1])
    direction = np.stack([np.cos(heading), np.sin(heading), np.zeros(3)], axis=1)
    body = skeleton.keypoints_from_head(origin, direction)
    left = np.cross([0, 0, 1.0], direction)
    pairs = np.array(
        [
            (skeleton.LEFT_EAR, skeleton.RIGHT_EAR),
            (4, 15),
            (0, 12),
            (3, 14),
            (5, 16),
            (6, 17),
            (7, 18),
            (8, 19),
            (9, 20),
        ]
    )
    # Mirrored in the plane through the middle of the ears in which the head looks.
    aside = np.einsum("nkj,nj->nk", body - origin[:, None], left)[..., None]
    mirrored = body - 2 * aside * left[:, None]
    assert np.allclose(body[:, pairs[:, 0]], mirrored[:, pairs[:, 1]], atol=1e-12)
    assert (aside[:, pairs[:, 0], 0] > 0.01).all()
    assert np.allclose(aside[:, [10, skeleton.NOSE, 21]], 0)
    # The eyes lie between the ears; heels, knees, hips and shoulders one above the other, in proportion to the height.
    eyes, ears = (
        np.linalg.norm(body[:, i] - body[:, j], axis=1) for i, j in ((4, 15), (skeleton.LEFT_EAR, skeleton.RIGHT_EAR))
    )
    assert (eyes < 0.6 * ears).all()
    heights = body[:, [5, 7, 6, 8], 2] / origin[:, 2:]
    assert (np.diff(heights, axis=1) > 0.1).all() and np.allclose(heights, heights[0])


@pytest.mark.parametrize(
    "origin, bad", [((0, 0, 1.6), False), ((1, 0, 0), False), ((np.nan, 1, 1.6), True), ((1, 1, np.inf), True)]
)
def test_a_head_may_be_at_zero_but_not_nowhere(origin, bad):
    if bad:
        with pytest.raises(ValueError, match="head pose 0"):
            skeleton.keypoints_from_head([origin], [(1, 0, 0)])
    else:
        assert np.allclose(poses_of(skeleton.keypoints_from_head([origin], [(1, 0, 0)]))[0], [origin])
