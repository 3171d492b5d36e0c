"""Colours: the sRGB transfer function, composited samples as linear radiance, PSNR, and how alike two pictures are
whatever their exposure and white balance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

# ---- Color ----
#
# The sRGB transfer function (IEC 61966-2-1) of NumPy and of Dr.Jit arrays, and composited samples as linear radiance.
#
# The one of NumPy keeps the type of its argument; the one of Dr.Jit guards the derivative of its power.


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


# ---- The peak signal-to-noise ratio of pictures ----


def psnr_from_mse(mean_square: float, least: float = 1e-12) -> float:
    """PSNR in dB, of values in 0..1, for a ``mean_square`` error, which counts as ``least`` at least."""
    return float(-10 * np.log10(max(mean_square, least)))


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR in dB of values in 0..1, (h, w, c), over the pixels of ``mask`` (h, w); NaN if there is none.

    ``picture`` is clipped to 0..1.
    """
    error = (np.clip(picture, 0, 1).astype(np.float64) - truth) ** 2
    if mask is not None:
        error = error[mask]
    return psnr_from_mse(float(np.mean(error))) if error.size else float("nan")


def mean_ignoring_nan(scores: Sequence[float]) -> float:
    """The mean of those that are not NaN; NaN if there is none."""
    known = [score for score in scores if not math.isnan(score)]
    return float(np.mean(known)) if known else math.nan


# ---- How alike two pictures are, whatever exposure and white balance they were taken with ----

# Of the squares of how far the fit is from no change at all: pictures that are alike to 30 dB, whose errors hang
# together over some hundred pixels, and corrections of a tenth.
_WEIGHT = 1e-3


def fit_colors(
    picture: np.ndarray, truth: np.ndarray, coverage: np.ndarray | None = None, mask: np.ndarray | None = None
) -> np.ndarray:
    """[A | b] (3, 4) for which A c + b takes the colours c of ``picture`` nearest to ``truth``, both (h, w, 3), by
    least squares over the pixels of ``mask`` (h, w).

    ``coverage`` (h, w): how much of the background each pixel covers, by which b is multiplied; None: all of it. No
    pixel at all, or colours that do not differ, leave things as they are.
    """
    ones = np.ones(picture.shape[:2]) if coverage is None else coverage
    known = np.dstack([picture, ones]).astype(np.float64)
    keep = np.ones(picture.shape[:2], bool) if mask is None else mask
    x, y = known[keep], np.asarray(truth, np.float64)[keep]
    weight = _WEIGHT * max(len(x), 1)
    return np.linalg.solve(x.T @ x + weight * np.eye(4), x.T @ y + weight * np.eye(4, 3)).T


def color_corrected_psnr(
    picture: np.ndarray, truth: np.ndarray, coverage: np.ndarray | None = None, mask: np.ndarray | None = None
) -> float:
    """PSNR in dB of the right half of ``picture`` once its colours were fitted to ``truth`` on the left half, so that
    nothing that is scored was looked at (Martin-Brualla et al. 2021, NeRF in the Wild, sec. 4.2; as NerfBaselines'
    protocol "nerfw" divides pictures, an odd column falls to the left). Arguments as `fit_colors` has them, values
    in 0..1; NaN where no pixel is scored.
    """
    width = picture.shape[1]
    left, right = np.s_[:, : width - width // 2], np.s_[:, width - width // 2 :]
    part = lambda a, half: None if a is None else a[half]
    clipped = np.clip(picture, 0, 1)
    m = fit_colors(clipped[left], truth[left], part(coverage, left), part(mask, left))
    ones = np.ones(picture.shape[:2]) if coverage is None else coverage
    fitted = clipped[right] @ m[:, :3].T + ones[right][..., None] * m[:, 3]
    return psnr(fitted, truth[right], part(mask, right))
