"""Colour: the sRGB transfer function, composited samples as linear radiance, PSNR, and colour-corrected PSNR."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

# ---- Color ----
#
# The sRGB transfer function (IEC 61966-2-1) for NumPy and Dr.Jit arrays, and composited samples as linear radiance.
#
# The NumPy version keeps the dtype of its argument; the Dr.Jit version guards the derivative of the power.


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values of linear values, floats of any shape; linear extrapolation below 0."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: np.ndarray) -> np.ndarray:
    """Linear values of sRGB values, floats of any shape; linear extrapolation below 0."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(c):
    """sRGB values of linear values from 0 to 1 in a Dr.Jit array."""
    power: Any = dr.power(dr.maximum(c, 0.0031308), 1 / 2.4)
    return dr.select(c <= 0.0031308, 12.92 * c, 1.055 * power - 0.055)


def srgb_to_linear(c):
    """Linear values of sRGB values in a Dr.Jit array, per component; differentiable."""
    low = c <= 0.04045
    return dr.select(low, c / 12.92, dr.power((dr.select(low, 1, c) + 0.055) / 1.055, 2.4))


def srgb_to_linear_slope(c):
    """Derivative of `srgb_to_linear`, per component."""
    low = c <= 0.04045
    power: Any = dr.power((dr.select(low, 1, c) + 0.055) / 1.055, 1.4)
    return dr.select(low, 1 / 12.92, 2.4 / 1.055 * power)


def composite_to_linear(total, alpha, color_space: str):
    """α lin(C / α) as a spectrum of the current variant; 0 with finite gradients where α = 0.

    ``total``: the weighted sum C of the samples' colours in ``color_space``: ``srgb``, ``linear`` (rgb, Color3f), or
    ``spectrum`` (of the current variant).
    """
    import mitsuba as mi

    if color_space == "spectrum":
        return total
    if color_space == "srgb":
        # Written as its own tangent, with the same value and derivative, but only one division by α: the derivative of
        # C / α divides by α², which underflows in single precision for faint samples.
        some = alpha > 0
        c = dr.detach(dr.select(some, total / dr.select(some, alpha, 1), 0))
        slope = srgb_to_linear_slope(c)
        total = dr.fma(slope, total, alpha * (srgb_to_linear(c) - slope * c))
    return mi.Spectrum(mi.luminance(total)) if mi.is_monochromatic else mi.Spectrum(total)


# ---- Peak signal-to-noise ratio ----


def psnr_from_mse(mse: float, min_mse: float = 1e-12) -> float:
    """PSNR in dB of values in 0..1 with the mean squared error ``mse``, clamped to at least ``min_mse``."""
    return float(-10 * np.log10(max(mse, min_mse)))


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR in dB of values in 0..1, (h, w, c), over the pixels of ``mask`` (h, w); NaN without pixels.

    ``image`` is clipped to 0..1.
    """
    error = (np.clip(image, 0, 1).astype(np.float64) - reference) ** 2
    if mask is not None:
        error = error[mask]
    return psnr_from_mse(float(np.mean(error))) if error.size else float("nan")


def mean_ignoring_nan(scores: Sequence[float]) -> float:
    """The mean of all values that are not NaN; NaN if there are none."""
    valid = [score for score in scores if not math.isnan(score)]
    return float(np.mean(valid)) if valid else math.nan


# ---- PSNR up to exposure and white balance ----

# Regularisation towards the identity. Suits images that agree to 30 dB, with errors correlated over about a hundred
# pixels, and corrections of a tenth.
_WEIGHT = 1e-3


def fit_color_correction(
    image: np.ndarray, reference: np.ndarray, coverage: np.ndarray | None = None, mask: np.ndarray | None = None
) -> np.ndarray:
    """The affine colour correction [A | b] (3, 4): A c + b fits the colours c of ``image`` to ``reference``, both (h,
    w, 3).

    Regularised least squares over the pixels of ``mask`` (h, w). ``coverage`` (h, w): fraction of the background that
    each pixel covers, a factor of b; default: 1. Without pixels, or for constant colours, the correction is the
    identity.
    """
    ones = np.ones(image.shape[:2]) if coverage is None else coverage
    inputs = np.dstack([image, ones]).astype(np.float64)
    selected = np.ones(image.shape[:2], bool) if mask is None else mask
    x, y = inputs[selected], np.asarray(reference, np.float64)[selected]
    weight = _WEIGHT * max(len(x), 1)
    return np.linalg.solve(x.T @ x + weight * np.eye(4), x.T @ y + weight * np.eye(4, 3)).T


def color_corrected_psnr(
    image: np.ndarray, reference: np.ndarray, coverage: np.ndarray | None = None, mask: np.ndarray | None = None
) -> float:
    """PSNR in dB of the right half of ``image`` after a colour correction that is fitted on the left half.

    No scored pixel enters the fit (Martin-Brualla et al. 2021, NeRF in the Wild, sec. 4.2). As in NerfBaselines'
    protocol "nerfw", an odd column belongs to the left half. Arguments as in `fit_color_correction`, values in 0..1;
    NaN if no pixel is scored.
    """
    width = image.shape[1]
    left, right = np.s_[:, : width - width // 2], np.s_[:, width - width // 2 :]
    part = lambda a, half: None if a is None else a[half]
    clipped = np.clip(image, 0, 1)
    m = fit_color_correction(clipped[left], reference[left], part(coverage, left), part(mask, left))
    ones = np.ones(image.shape[:2]) if coverage is None else coverage
    fitted = clipped[right] @ m[:, :3].T + ones[right][..., None] * m[:, 3]
    return psnr(fitted, reference[right], part(mask, right))
