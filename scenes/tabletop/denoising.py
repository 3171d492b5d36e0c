"""Denoising of renderings with few samples: the irradiance is smoothed, textures are preserved.

An à-trous filter (Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global illumination
filtering") of irradiance, which is radiance over albedo, so that textures remain sharp.
"""

from __future__ import annotations

import numpy as np

_STEPS = (1, 2, 4, 8, 16)
# Relative difference of irradiance that is averaged; it is halved with each step.
_EDGE = 1.2
# Distance from the tangent plane of a pixel, relative to its distance along a step.
_PLANE_TOLERANCE = 0.15
_SHARPNESS = 32
# Surfaces with a lower albedo are not smoothed: sky, lamps.
_MIN_ALBEDO = 0.01
# Shorter mean normals indicate pixels that show more than one surface.
_MIN_NORMAL_LENGTH = 0.8


def denoise(radiance, guides, albedo) -> np.ndarray:
    """Denoise linear radiance (h, w, 3).

    ``guides`` (h, w, 9) are albedo, normal and position of the same samples as ``radiance`` (h, w, 3). ``albedo`` (h,
    w, 3) is converged and multiplied with the result.
    """
    radiance, guides = np.asarray(radiance, np.float32), np.asarray(guides, np.float32)
    guide_albedo, normal, position = (guides[..., k : k + 3] for k in (0, 3, 6))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # Pixels that are partly sky, or at an edge, have no irradiance in common with their neighbours.
    lit = (guide_albedo.mean(axis=-1) > _MIN_ALBEDO) & (length[..., 0] > _MIN_NORMAL_LENGTH)
    light = np.where(lit[..., None], radiance / np.maximum(guide_albedo, _MIN_ALBEDO), 0)
    normal = normal / np.maximum(length, 1e-6)
    for k, step in enumerate(_STEPS):
        light = _smooth(light, lit, normal, position, step, _EDGE / 2**k)
    return np.where(lit[..., None], light * np.maximum(albedo, _MIN_ALBEDO), radiance)


def _smooth(light, lit, normal, position, step: int, edge: float) -> np.ndarray:
    """One pass: weighted means over 3 x 3 pixels at a distance of ``step``."""
    height, width = lit.shape
    pad = lambda a: np.pad(a, [(step, step), (step, step)] + [(0, 0)] * (a.ndim - 2))
    # Single pixels are too noisy to detect the edge of a shadow.
    bright = _blur(light.mean(axis=-1)) + 1e-4
    padded = [pad(a) for a in (light, lit, normal, position, bright)]
    total, weights = np.zeros_like(light), np.zeros_like(bright)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            window = (
                slice(step + dy * step, step + dy * step + height),
                slice(step + dx * step, step + dx * step + width),
            )
            l, is_lit, n, p, b = (a[window] for a in padded)
            offset = p - position
            plane_distance = np.abs(np.einsum("ijk,ijk->ij", offset, normal))
            far = np.linalg.norm(offset, axis=-1) + 1e-4
            facing = np.clip(np.einsum("ijk,ijk->ij", n, normal), 0, 1) ** _SHARPNESS
            similarity = np.exp(-plane_distance / (_PLANE_TOLERANCE * far) - np.abs(b - bright) / (edge * bright))
            w = is_lit * facing * similarity * (2 - abs(dy)) * (2 - abs(dx))
            total += w[..., None] * l
            weights += w
    return np.where(weights[..., None] > 0, total / np.maximum(weights, 1e-12)[..., None], light)


def _blur(a: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(a, 1.0)
