"""From linear radiance to the bytes of a picture.

The sRGB transfer function of IEC 61966-2-1; nothing is scaled or compressed, so that equal radiance has equal bytes in
every picture. What is brighter than white is clipped.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.files import png
from nerg_mi.maths.color import encode_srgb

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear sRGB for the luminance (Rec. 709)."""


def srgb(linear) -> np.ndarray:
    """sRGB values in 0..1 (float64) of linear ones of any shape; clipped to 0..1, NaN becomes 0."""
    x = np.clip(np.nan_to_num(np.asarray(linear, np.float64), nan=0.0), 0.0, 1.0)
    return encode_srgb(x)


def to_bytes(display) -> np.ndarray:
    """Display values in 0..1 as uint8, rounded to the nearest."""
    return (np.clip(display, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_png(path, display, text: dict[str, str] | None = None) -> None:
    """Write display values (h, w, 3) in 0..1 as an 8-bit PNG. ``text``: what its header says (tEXt chunks)."""
    import mitsuba as mi

    png.write_png(path, mi.Bitmap(to_bytes(display)), text)
