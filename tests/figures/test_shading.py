"""Outlines of surfaces and smoothing on surfaces, on analytic scenes."""

from __future__ import annotations

import numpy as np

from nerg_mi.figures.shading import draw_outlines, smooth_on_surfaces


def directions(size=96, half_width=0.7):
    x, y = np.meshgrid(*[((np.arange(size) + 0.5) / size * 2 - 1) * half_width] * 2)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def test_outlines_are_where_surfaces_bend_or_end_and_nowhere_else():
    d = directions()
    rng = np.random.default_rng(0)
    # Two walls that meet at x = 0, at right angles, in front of the right one a panel parallel to the image.
    depth = 4 / (1 + np.abs(d[..., 0]))
    panel = (np.abs(d[..., 0] - 0.35) < 0.2) & (np.abs(d[..., 1]) < 0.3)
    depth = np.where(panel, 1.5, depth)
    position = d * depth[..., None]
    # Samples within a pixel differ, as in a rendering with few of them.
    noisy = d + 0.1 * (2 * 0.7 / 96) * rng.normal(size=d.shape) * (1, 1, 0)
    position = noisy * np.where(panel, 1.5, 4 / (1 + np.abs(noisy[..., 0])))[..., None]
    lines = 1 - draw_outlines(np.ones_like(d), position, np.ones(depth.shape, bool))[..., 0]
    column = np.arange(96)
    assert (lines[4, 46:50].max() > 0.5) and (lines[4, (column < 44) & (column > 0)] < 0.05).all()
    border = panel ^ np.roll(panel, 1, axis=0) | panel ^ np.roll(panel, 1, axis=1)
    assert np.median(lines[border]) > 0.5
    inside = panel & np.roll(panel, 3, axis=0) & np.roll(panel, -3, axis=0)
    inside &= np.roll(panel, 3, axis=1) & np.roll(panel, -3, axis=1)
    assert lines[inside].max() < 0.05


def test_outlines_avoid_pixels_without_a_surface():
    d = directions(32)
    mask = d[..., 0] > 0
    position = d * np.where(mask, 2.0, 0.0)[..., None]
    assert np.allclose(draw_outlines(np.full(d.shape, 0.4), position, mask), 0.4)


def test_smoothing_is_a_gaussian_on_a_plane():
    size, sigma = 161, 6.0
    impulse = np.zeros((size, size))
    impulse[80, 80] = 1
    weights = np.ones_like(impulse)
    smooth = smooth_on_surfaces(impulse, weights, weights, sigma)
    x = np.arange(size) - 80
    assert np.isclose(smooth.sum(), 1, rtol=1e-3)
    for axis in (0, 1):
        assert np.isclose((smooth.sum(axis=axis) * x**2).sum(), sigma**2, rtol=0.06)
    # Round: the same value in all directions, unlike the diamonds of linear interpolation.
    assert np.isclose(smooth[80, 86], smooth[80 + 4, 80 + 4], rtol=0.15)
    assert np.array_equal(smooth_on_surfaces(impulse, weights, weights, 0.0), impulse)


def test_smoothing_keeps_to_the_surface_and_to_visible_pixels():
    values = np.tile(np.where(np.arange(80) < 40, 1.0, 0.0), (20, 1))
    depth = np.where(values > 0, 2.0, 4.0)
    weights = np.ones_like(values)
    assert np.allclose(smooth_on_surfaces(values, weights, depth, 5.0), values, atol=1e-3)
    # Pixels without weight take the mean of the others.
    weights[:, 10:15] = 0
    values[:, 10:15] = 1e3
    assert np.allclose(smooth_on_surfaces(values, weights, depth, 5.0)[:, :40], 1, atol=1e-3)
