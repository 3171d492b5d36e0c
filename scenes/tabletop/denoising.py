"""Pictures of few samples without their noise: light on surfaces is smoothed, what is painted on them is not.

An à-trous filter (Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global illumination
filtering") of irradiance, which is radiance over albedo, so that textures stay as sharp as they are.
"""

from __future__ import annotations

import numpy as np

_STEPS = (1, 2, 4, 8, 16)
# How much irradiance, relative to its mean, may differ between what is averaged; it halves with every step.
_EDGE = 1.2
# Distance from a pixel's tangent plane, as a share of its distance along a step.
_OFF_PLANE = 0.15
_SHARPNESS = 32
# Less reflects nothing that could be smoothed: sky, lamps.
_DARK = 0.01
# Mean normals that are shorter are of pixels that show more than one surface.
_WHOLE = 0.8


def denoise(radiance, guides, albedo) -> np.ndarray:
    """Linear radiance (h, w, 3) without its noise.

    ``guides`` (h, w, 9): albedo, normal and position, of the very samples that ``radiance`` (h, w, 3) is of;
    ``albedo`` (h, w, 3): of as many samples as it takes, which the result shows.
    """
    radiance, guides = np.asarray(radiance, np.float32), np.asarray(guides, np.float32)
    seen, normal, position = (guides[..., k : k + 3] for k in (0, 3, 6))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # What is partly sky, or an edge, has no one light that its neighbours could share.
    lit = (seen.mean(axis=-1) > _DARK) & (length[..., 0] > _WHOLE)
    light = np.where(lit[..., None], radiance / np.maximum(seen, _DARK), 0)
    normal = normal / np.maximum(length, 1e-6)
    for k, step in enumerate(_STEPS):
        light = _smooth(light, lit, normal, position, step, _EDGE / 2**k)
    return np.where(lit[..., None], light * np.maximum(albedo, _DARK), radiance)


def _smooth(light, lit, normal, position, step: int, edge: float) -> np.ndarray:
    """One pass: weighted means over 3 x 3 pixels, ``step`` apart."""
    height, width = lit.shape
    pad = lambda a: np.pad(a, [(step, step), (step, step)] + [(0, 0)] * (a.ndim - 2))
    # Single pixels are too noisy to say where a shadow ends.
    bright = _blurred(light.mean(axis=-1)) + 1e-4
    padded = [pad(a) for a in (light, lit, normal, position, bright)]
    total, weights = np.zeros_like(light), np.zeros_like(bright)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            there = (
                slice(step + dy * step, step + dy * step + height),
                slice(step + dx * step, step + dx * step + width),
            )
            l, is_lit, n, p, b = (a[there] for a in padded)
            apart = p - position
            off = np.abs(np.einsum("ijk,ijk->ij", apart, normal))
            far = np.linalg.norm(apart, axis=-1) + 1e-4
            facing = np.clip(np.einsum("ijk,ijk->ij", n, normal), 0, 1) ** _SHARPNESS
            same = np.exp(-off / (_OFF_PLANE * far) - np.abs(b - bright) / (edge * bright))
            w = is_lit * facing * same * (2 - abs(dy)) * (2 - abs(dx))
            total += w[..., None] * l
            weights += w
    return np.where(weights[..., None] > 0, total / np.maximum(weights, 1e-12)[..., None], light)


def _blurred(a: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(a, 1.0)
