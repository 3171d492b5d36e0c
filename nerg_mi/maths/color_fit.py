"""How alike two pictures are, whatever exposure and white balance they were taken with."""

from __future__ import annotations

import numpy as np

from .psnr import psnr

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


def psnr_of_fitted_half(
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
