from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays.direction_checks import head_frames
from tests.rays.checks.people import change, warnings_of, watch

BO = slice(3000, 6000)


def bare(rays):
    """Nothing but heads to go by."""
    return replace(rays, hit=None)


def own(rays):
    return np.einsum("nij,nj->ni", head_frames(rays.head.astype(float)), rays.direction)


def test_frames_of_heads():
    """Against the cross products written out: right of somebody who looks along x is -y."""
    ahead = np.array([[1.0, 0, 0], [0, 1, 0], [0.6, 0, 0.8]])
    found = head_frames(ahead)
    assert np.allclose(found[0], [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    assert np.allclose(found[1], [[0, 1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(found[2], [[0.6, 0, 0.8], [0, -1, 0], [-0.8, 0, 0.6]])


@pytest.mark.parametrize("rows, who", [(slice(None), ""), (BO, " of bo"), (slice(5400, 6000), " of bo")])
def test_gaze_in_the_head_taken_for_the_worlds(rows, who):
    """As in a log of Unity: right, up and ahead of the head as if they were x, y and z of the world."""
    rays = bare(watch())
    local = own(rays)[:, [1, 0, 2]]
    said = warnings_of(change(rays, rows, direction=local[rows]))
    assert f"of the directions{who} lie more than 60 degrees" in said
    assert "in the head's frame? (--preset unity_local" in said


def test_another_axis_ahead():
    rays = bare(watch())
    assert "they look right from the head" in warnings_of(
        replace(rays, direction=np.einsum("nij,ni->nj", head_frames(rays.head.astype(float)), own(rays)[:, [2, 0, 1]]))
    )
    said = warnings_of(replace(rays, direction=-rays.direction))
    assert "100 % of the directions lie more than 60 degrees" in said and "with x and y and z of the dir" in said


@pytest.mark.parametrize("axis", [0, 1])
def test_an_axis_negated(axis):
    rays = bare(watch())
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    assert f"with {'xy'[axis]} of the directions negated they would not" in warnings_of(
        replace(rays, direction=rays.direction * signs)
    )
    # By the names of the file's axes: its z is our y.
    unity = replace(rays, metadata={**rays.metadata, "transform": np.eye(4)[[0, 2, 1, 3]].tolist()})
    assert f"with {'xz'[axis]} of the directions negated" in warnings_of(
        replace(unity, direction=unity.direction * signs)
    )


def test_quaternions_in_another_order():
    """Read with w where x is: the gaze is anywhere."""
    rng = np.random.default_rng(0)
    rays = bare(watch())
    d = rng.normal(size=rays.direction.shape)
    said = warnings_of(replace(rays, direction=d / np.linalg.norm(d, axis=1, keepdims=True)))
    assert (
        "75 % of the directions lie more than 60 degrees" in said and "order of the quaternion (xyzw or wxyz)" in said
    )


def test_gaze_that_goes_against_the_head_or_pays_no_heed():
    rays = bare(watch())
    flat = lambda v: v * (1, 1, 0.6) / np.linalg.norm(v * (1, 1, 0.6), axis=1, keepdims=True)
    level = replace(rays, direction=flat(rays.direction), head=flat(rays.head))
    assert warnings_of(level) == ""
    up = change(level, BO, direction=lambda d: d * (1, 1, -1))
    assert "along z of the file the gaze of bo goes where the head turns away from: negate z" in warnings_of(up)
    # A head that looks ahead within 40 degrees, and gaze that does too, each by itself.
    rng, n = np.random.default_rng(0), len(rays)
    around = lambda: np.repeat(rng.uniform(-0.5, 0.5, n // 16 + 1), 16)[:n]
    about = lambda yaw: np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    assert "does not follow the head" in warnings_of(replace(rays, direction=about(around()), head=about(around())))


def test_heads_that_are_not_known_say_nothing():
    rays = bare(watch())
    assert warnings_of(change(rays, slice(None), head=np.nan)) == ""
    assert warnings_of(change(rays, slice(0, 3500), head=np.nan)) == ""
