"""The sRGB transfer function (IEC 61966-2-1) of NumPy and of Dr.Jit arrays, and composited samples as linear radiance.

The one of NumPy keeps the type of its argument; the one of Dr.Jit guards the derivative of its power.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values of linear ones, any shape of floats; below 0 the curve goes on as a line."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones, any shape of floats; below 0 the curve goes on as a line."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_to_linear(c):
    """Linear values of the components of a Dr.Jit array of sRGB ones; with derivatives."""
    low = c <= 0.04045
    return dr.select(low, c / 12.92, dr.power((dr.select(low, 1, c) + 0.055) / 1.055, 2.4))


def srgb_slope(c):
    """Derivative of ``srgb_to_linear``, per component."""
    low = c <= 0.04045
    power: Any = dr.power((dr.select(low, 1, c) + 0.055) / 1.055, 1.4)
    return dr.select(low, 1 / 12.92, 2.4 / 1.055 * power)


def composite_to_linear(total, alpha, color_space: str):
    """α lin(C / α) as a spectrum of the variant in use; 0, with finite gradients, where α = 0.

    ``total``: weighted sum C of the samples' colours in ``color_space``: ``srgb``, ``linear``
    (rgb, Color3f), or ``spectrum`` (already in the variant's own).
    """
    import mitsuba as mi

    if color_space == "spectrum":
        return total
    if color_space == "srgb":
        # Written as its own tangent, which has the same value and derivative but divides by α only once:
        # the derivative of C / α divides by its square, which is 0 in single precision for faint samples.
        some = alpha > 0
        c = dr.detach(dr.select(some, total / dr.select(some, alpha, 1), 0))
        slope = srgb_slope(c)
        total = dr.fma(slope, total, alpha * (srgb_to_linear(c) - slope * c))
    return mi.Spectrum(mi.luminance(total)) if mi.is_monochromatic else mi.Spectrum(total)
