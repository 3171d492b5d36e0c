"""A classical model of salience: the spectral residual of Hou & Zhang (CVPR 2007).

What is salient is what a photo's spectrum does not share with others': the log amplitude less its local mean, with the
phase kept, transformed back, squared and blurred. On scipy alone (a library with salience models, OpenCV's contributed
modules, weighs 70 MB and replaces the cv2 of whoever has one). It looks for contrast and oddity, and knows nothing of
people, faces or tasks: an example, not a measure of where people look.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.capture.resize import area_average
from nerg_mi.errors import NergError

# The authors' scale of attention, and their blur in pixels at that width.
WIDTH = 64
_SIGMA = 2.5


def spectral_residual(photo: np.ndarray, width: int = WIDTH) -> np.ndarray:
    """Salience (h, w), float64, at most 1, of ``photo`` (H, W, 3) in 0..1, sRGB; computed and returned ``width`` pixels
    wide.

    As the authors' own script has it: grey, 3 x 3 mean of the log amplitude with repeated edges, Gaussian of 2.5
    pixels. Raises `NergError` for a photo of one colour, which has no salience.
    """
    from scipy.fft import fft2, ifft2
    from scipy.ndimage import gaussian_filter, uniform_filter

    H, W = photo.shape[:2]
    w = min(width, W)
    grey = np.asarray(photo, np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    grey = area_average(grey[..., None], w, max(1, round(H * w / W)))[..., 0].astype(np.float64)
    if not np.ptp(grey) > 1e-6:
        raise NergError("it has one colour everywhere, and no spectrum to find salience in")
    spectrum = np.asarray(fft2(grey))
    # The logarithm of an amplitude of zero is none; rounding decides about smaller ones anyway.
    amplitude = np.log(np.maximum(np.abs(spectrum), 1e-9 * np.abs(spectrum).max()))
    residual = amplitude - uniform_filter(amplitude, 3, mode="nearest")
    salience = np.abs(np.asarray(ifft2(np.exp(residual + 1j * np.angle(spectrum))))) ** 2
    salience = gaussian_filter(salience, _SIGMA, mode="constant", truncate=2.0)
    return salience / salience.max()
