"""Colours as each photo has them: a camera chooses exposure and white balance anew for every picture.

Where the scene's colour is c, a photo has A c + b in sRGB values, with a matrix A (3, 3) and an offset b of its own
(Rematas et al. 2022, Urban Radiance Fields, sec. 4.1, there decoded from a latent code). Over the photos their mean is
no change at all, so that the scene has the colours of the average photo.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Float, UInt32

PHOTOS = "photos"
"""Name of the optimiser's parameter."""
# The optimiser moves a number by up to its learning rate a step, which is much for a colour.
_UNIT = 0.01
_GREY = 0.5


class PhotoColors:
    """What becomes of colours in each of ``frames`` photos; 12 numbers each, which the optimiser holds as `PHOTOS`."""

    def __init__(self, ns, frames: int):
        self.ns, self.frames = ns, frames

    def start(self) -> Float:
        """The parameter where no photo changes anything."""
        return dr.zeros(self.ns.Float, 12 * self.frames)

    def changes(self, parameter: Float) -> Float:
        """The entries of [A - 1 | b], photo by photo and row by row."""
        ns, each = self.ns, dr.arange(self.ns.UInt32, 12 * self.frames) % 12
        mean = dr.zeros(ns.Float, 12)
        dr.scatter_add(mean, parameter / self.frames, each)
        return _UNIT * (parameter - dr.gather(ns.Float, mean, each))

    def apply(self, changes: Float, color: list[Float], opacity: Float, frame: UInt32) -> list[Float]:
        """``color`` (3 Floats), composited with ``opacity``, as it is in the photos ``frame``."""
        rows = [dr.gather(self.ns.Array4f, changes, 3 * frame + k) for k in range(3)]
        return [c + r[0] * color[0] + r[1] * color[1] + r[2] * color[2] + r[3] * opacity for c, r in zip(color, rows)]

    def decay(self, changes: Float) -> Float:
        """Mean over the photos of the squares of their ``changes``, summed."""
        return dr.sum(dr.square(changes)) / self.frames

    def stops(self, parameter: Float) -> float:
        """How far the photos' exposures are apart: the standard deviation of what becomes of a middle grey, in f-stops.

        A stop, twice the light, multiplies sRGB values of middle greys by about 2^(1/2.2).
        """
        m = self.matrices(parameter)
        grey = (m[..., :3].sum(axis=-1) * _GREY + m[..., 3]).mean(axis=-1) / _GREY
        return float(2.2 * np.std(np.log2(np.maximum(grey, 1e-3))))

    def matrices(self, parameter: Float) -> np.ndarray:
        """[A | b] of every photo, (frames, 3, 4)."""
        return np.eye(3, 4) + self.changes(parameter).numpy().reshape(-1, 3, 4)
