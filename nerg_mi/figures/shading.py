"""Images of surfaces before they are drawn: outlines of surfaces without texture, and smoothing of gaze on surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

_BEND, _JUMP = (0.1, 0.3), (0.6, 0.8)
"""Bends of the surface and ratios of steps between neighbouring pixels, relative to their sum, from and up to which an
outline becomes visible."""

_INK = 0.7
_DEPTH_SCALE = 0.05
"""Relative change of depth that counts like one standard deviation of the smoothing."""

_PASSES = 3


def draw_outlines(color: ArrayLike, position: ArrayLike, mask: ArrayLike) -> np.ndarray:
    """Darken the linear image ``color`` (h, w, 3) where its surfaces bend or end.

    Parameters
    ----------
    color
        Linear image.
    position
        Position (h, w, 3) of the surface at each pixel, in any unit.
    mask
        Pixels (h, w) with a surface; there are no lines next to others.

    Returns
    -------
    numpy.ndarray
        The image with lines of two pixels.
    """
    return np.asarray(color) * (1 - _INK * _outline_strength(np.asarray(position, float), np.asarray(mask, bool)))


def _outline_strength(position: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the strength (h, w, 1) of outlines, 0..1."""
    strength = np.zeros((*mask.shape, 1))
    if min(mask.shape) < 3:
        return strength
    center = position[1:-1, 1:-1]
    neighbours = ((position[1:-1, 2:], position[1:-1, :-2]), (position[2:, 1:-1], position[:-2, 1:-1]))
    across, down = (after - before for after, before in neighbours)
    normal = np.cross(across, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    inside = strength[1:-1, 1:-1, 0]
    for after, before in neighbours:
        ahead, behind = after - center, center - before
        first, second = np.linalg.norm(ahead, axis=-1), np.linalg.norm(behind, axis=-1)
        total = np.maximum(first + second, 1e-30)
        # Along the normal: random samples within a pixel move its mean position along the surface only.
        bend = np.abs(((ahead - behind) * normal).sum(axis=-1)) / total
        jump = np.abs(first - second) / total
        for value, (low, high) in ((bend, _BEND), (jump, _JUMP)):
            np.maximum(inside, np.clip((value - low) / (high - low), 0, 1), out=inside)
    around = mask[1:-1, 2:] & mask[1:-1, :-2] & mask[2:, 1:-1] & mask[:-2, 1:-1] & mask[1:-1, 1:-1]
    inside *= around
    return strength


def smooth_on_surfaces(values: ArrayLike, weights: ArrayLike, depth: ArrayLike, sigma: float) -> np.ndarray:
    """Average ``values`` (h, w) with a Gaussian of ``sigma`` pixels that does not extend across steps of the depth.

    The recursive domain transform of Gastal and Oliveira (Domain transform for edge-aware image and video processing,
    SIGGRAPH 2011), in three passes.

    Parameters
    ----------
    values
        Values.
    weights
        Weights (h, w) of the values, such as the visibility; pixels with weight 0 do not contribute.
    depth
        Depth (h, w) in any unit.
    sigma
        Standard deviation in pixels; 0 returns the values.

    Returns
    -------
    numpy.ndarray
        The weighted mean (h, w), 0 where there is no weight.
    """
    values, weights = np.asarray(values, float), np.asarray(weights, float)
    if not sigma > 0:
        return np.where(weights > 0, values, 0.0)
    log_depth = np.log(np.maximum(np.asarray(depth, float), 1e-12))
    distances = [1 + sigma / _DEPTH_SCALE * np.abs(np.diff(log_depth, axis=axis)) for axis in (0, 1)]
    sums = np.stack([values * weights, weights], axis=-1)
    for k in range(_PASSES):
        # The variances of all passes add up to that of the Gaussian.
        part = sigma * np.sqrt(3) * 2 ** (_PASSES - 1 - k) / np.sqrt(4**_PASSES - 1)
        for axis, distance in enumerate(distances):
            lines, weight = np.moveaxis(sums, axis, 0), np.moveaxis(distance, axis, 0)[..., None]
            weight = np.exp(-np.sqrt(2) / part * weight)
            for i in range(1, len(lines)):
                lines[i] += weight[i - 1] * (lines[i - 1] - lines[i])
            for i in range(len(lines) - 2, -1, -1):
                lines[i] += weight[i] * (lines[i + 1] - lines[i])
    return np.divide(sums[..., 0], sums[..., 1], out=np.zeros_like(values), where=sums[..., 1] > 1e-9)
