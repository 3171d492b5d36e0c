"""A picture taken apart: its colour and its AOVs as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .bands import render_bands

if TYPE_CHECKING:
    import mitsuba as mi

SURFACE = 0.5
"""Opacity from which on a pixel shows a surface, as the integrator has it by default."""


@dataclass(frozen=True, eq=False)
class Channels:
    """``color`` (h, w, 3): linear radiance; ``aovs``: (h, w) each, by name, a vector's as ``position.X``; ``bitmap``:
    Mitsuba's, with all channels."""

    color: np.ndarray
    aovs: dict[str, np.ndarray]
    bitmap: mi.Bitmap

    @property
    def mask(self) -> np.ndarray:
        """Where there is a surface (h, w), bool; needs the AOV ``opacity``."""
        return self.aovs["opacity"] >= SURFACE


def render_channels(
    scene, sensor, spp: int = 0, seed: int = 0, on_strip: Callable[[int, int], None] | None = None
) -> Channels:
    """Render what ``sensor`` sees of ``scene`` (`mi.Scene`) with the scene's integrator, as ``mi.render`` does.

    ``spp``: samples a pixel, 0 for those of the sensor's sampler. ``on_strip`` is told the samples done and those of
    all, several times a second, and may raise.
    """
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip)
    return channels_of(band.film, scene.integrator().aov_names())


def channels_of(film, aov_names: Sequence[str]) -> Channels:
    """What a developed ``film`` holds, whose last channels are those of AOVs, with these names."""
    names = [name.split(".") for name in aov_names]
    pixels = np.array(film.develop())
    color = pixels[..., : pixels.shape[2] - len(names)]
    first = color.shape[2]
    several = {parts[0] for parts in names if [p[0] for p in names].count(parts[0]) > 1}
    key = lambda parts: ".".join(parts) if parts[0] in several else parts[0]
    aovs = {key(parts): pixels[..., first + k] for k, parts in enumerate(names)}
    # Mono variants render one channel.
    return Channels(np.broadcast_to(color[..., :3], (*color.shape[:2], 3)), aovs, film.bitmap())
