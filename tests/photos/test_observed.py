"""Tests of `nerg_mi.photos.observed`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.photos.observed import MatchedImage, PointTable


@pytest.mark.parametrize("spread", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("count", [2, 3, 20])
def test_errors_agree_with_the_covariance_of_a_triangulation(count, spread):
    """The covariance of a least-squares triangulation is the inverse of Σ f² / r² (1 - d dᵀ) for errors of a pixel."""
    rng = np.random.default_rng(count)
    focal, point = 500.0, np.array([[0.3, -0.2, 4.0]])
    centers = rng.normal(size=(count, 3)) * [4 * spread, 4 * spread, 0.01]
    table = PointTable(np.array([7]), point, [MatchedImage(c, focal, np.array([7, -1, 3])) for c in centers])
    rays = point - centers
    r = np.linalg.norm(rays, axis=1)
    d = rays / r[:, None]
    information = np.einsum("n,nij->ij", focal**2 / r**2, np.eye(3) - d[:, :, None] * d[:, None, :])
    axis = d.mean(axis=0) / np.linalg.norm(d.mean(axis=0))
    expected = np.sqrt(axis @ np.linalg.inv(information) @ axis) / r.mean()
    assert table.select(np.array([7])).relative_errors[0] == pytest.approx(expected, rel=0.3)


def test_points_of_one_image_have_no_distance():
    table = PointTable(np.array([5, 2]), np.eye(3)[:2], [MatchedImage(np.zeros(3), 100.0, np.array([5]))])
    points = table.select(np.array([2, 5, 5, 8]))
    assert np.array_equal(points.positions, np.eye(3)[[1, 0]]) and np.isinf(points.relative_errors).all()
    assert len(PointTable(np.zeros(0, np.int64), np.zeros((0, 3)), []).select(np.array([1]))) == 0
