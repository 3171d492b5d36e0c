"""The peak signal-to-noise ratio of pictures."""

from __future__ import annotations

import numpy as np


def decibels(mean_square: float, least: float = 1e-12) -> float:
    """PSNR in dB, of values in 0..1, for a ``mean_square`` error, which counts as ``least`` at least."""
    return float(-10 * np.log10(max(mean_square, least)))


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR in dB of values in 0..1, (h, w, c), over the pixels of ``mask`` (h, w); NaN if there is none.

    ``picture`` is clipped to 0..1.
    """
    error = (np.clip(picture, 0, 1).astype(np.float64) - truth) ** 2
    if mask is not None:
        error = error[mask]
    return decibels(float(np.mean(error))) if error.size else float("nan")
