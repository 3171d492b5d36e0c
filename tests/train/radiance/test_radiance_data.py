"""Tests of `nerg_mi.train.radiance_data`: pixels that show points, and free space."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.photos.images import PhotoView
from nerg_mi.photos.observed import ObservedPoints
from nerg_mi.train.radiance_data import FreeSpace, PixelBank
from tests.tiny import ball_pose

LENS = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)


def view(center, points=None, mask=None):
    pixels = np.zeros((30, 40, 3), np.uint8)
    observed = None if points is None else ObservedPoints(points, np.full(len(points), 0.01))
    return PhotoView("v", PosedCamera(LENS, ball_pose(np.array(center, float))), pixels, mask=mask, points=observed)


def test_pixels_of_points_pass_through_them():
    rng = np.random.default_rng(0)
    points, mask = rng.normal(size=(80, 3)) * 0.5, rng.random((30, 40)) < 0.5
    views = [view([0, 0.1, 3]), view([2, 0.5, 2], points, mask), view([-3, 1, 0], points)]
    bank = PixelBank(ns, views)
    batch = bank.gather_batch(ns.UInt32(bank.points.index))
    o, d = (np.array(x.numpy()).T for x in (batch.o, batch.d))
    reached = o + d * bank.points.distance[:, None]
    nearest = np.linalg.norm(reached[:, None] - points, axis=-1).min(axis=1)
    assert (nearest < 0.8 / 35 * bank.points.distance).all()  # Half of a pixel, to its corner
    assert np.allclose(bank.points.error, 0.01 * bank.points.distance)
    count = [int((batch.frame.numpy() == k).sum()) for k in range(3)]
    assert count[0] == 0 and 20 < count[1] < 60 < count[2]


def test_imprecise_points_are_not_used():
    points = ObservedPoints(np.zeros((2, 3)), np.array([0.01, 0.5]))
    assert len(PixelBank(ns, [replace(view([0, 0.1, 3]), points=points)]).points) == 1


def test_cameras_see_through_free_space_in_front_of_points():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * 0.05
    views = [view([0, 0.1, 3], points), view([4, 0, 0], points), view([0, 2, 1], points[:20])]
    space = FreeSpace.find(views, 0.1, 0.6, 0.35)
    assert space.near == pytest.approx([0.35 * 3, 0.35 * 4, 0.35 * 5**0.5], abs=0.02)
    assert space.clear == pytest.approx([0.6 * 2.9, 0.6 * 3.9, 0], abs=0.05)
    assert space.ray_starts == pytest.approx([0.6 * 2.9, 0.6 * 3.9, 0.35 * 5**0.5], abs=0.05)
    # A point near the second camera, that only the first photo shows.
    views[0] = view([0, 0.1, 3], np.concatenate([points, [[3.5, 0, 0]]]))
    space = FreeSpace.find(views, 0.1, 0.6, 0.35)
    assert space.near[1] == pytest.approx(0.8 * 0.5, abs=1e-3) == space.ray_starts[1]


def test_cameras_around_a_common_point_are_in_free_space():
    views = [view(c) for c in ([0, 0.1, 3], [4, 0, 0], [0, -2, 0.1])]
    space = FreeSpace.find(views, 0.1, 0.25, 0.35)
    assert space.near == pytest.approx([1.05, 1.4, 0.7], abs=0.02) and not space.clear.any()
    # Not with depth, and not in a room whose cameras look outwards.
    with_depth = [replace(v, depth=np.ones((30, 40), np.float32)) for v in views]
    outwards = [replace(v, camera=PosedCamera(LENS, v.camera.to_world @ np.diag([-1.0, 1, -1, 1]))) for v in views]
    for other in (with_depth, outwards):
        assert np.allclose(FreeSpace.find(other, 0.1, 0.25, 0.35).near, 0.1)
