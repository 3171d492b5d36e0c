"""What can be laid over a picture: a table of quantities, how each is drawn, and which scale several pictures share.

One more is one more entry. Values are the AOVs of the integrator `nerg`, (h, w) each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

from . import plots
from .overlay import Heat, top_of

Limits = tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Layers:
    """A picture and what lies over it: linear ``color`` (h, w, 3), ``values`` (h, w), ``mask`` (h, w) bool where there
    is a surface; ``marker``: pixel (x, y) of the observer, or None."""

    color: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    marker: tuple[float, float] | None = None


@dataclass(frozen=True)
class Overlay:
    """``name`` of the AOV; ``summary`` for people; ``limits(layers)``: ends of the scale of one picture, None where it
    shows nothing of it; ``draw(layers, limits)``: a figure; ``scaled``: whether it needs a scale."""

    name: str
    summary: str
    limits: Callable[[Layers], Limits]
    draw: Callable[[Layers, Limits], Any]
    scaled: bool = True


def _heat(name: str, summary: str, title: str, label: str) -> Overlay:
    def limits(of: Layers) -> Limits:
        return (0.0, top_of(of.values, of.mask)) if np.any(of.values[of.mask] > 0) else None

    def draw(of: Layers, limits: Limits) -> Any:
        heat = Heat(1.0 if limits is None else limits[1])
        return plots.gaze_figure(of.color, of.values, of.mask, heat, title, label, of.marker)

    return Overlay(name, summary, limits, draw)


OVERLAYS = {
    overlay.name: overlay
    for overlay in (
        _heat("gaze", "how much the observer attends to what is seen", "Gaze", "gaze density [1/sr]"),
        _heat("kde", "where tracked people looked", "Where people looked", "tracked gaze [1/sr]"),
        _heat("gaze_std", "how sure that is", "Uncertainty of gaze", "standard deviation of gaze [1/sr]"),
        _heat("emit", "how much surfaces attract", "What surfaces attract", "emitted attention"),
        _heat("capture", "how much the observer gives", "What the observer gives", "captured attention"),
        _heat("support", "how many rays the gaze rests on", "Support", "training rays around the observer"),
        Overlay(
            "visibility",
            "what the observer sees",
            lambda of: None,
            lambda of, limits: plots.visibility_figure(of.color, of.values, of.mask),
            scaled=False,
        ),
        Overlay(
            "depth",
            "distance from the camera",
            lambda of: plots.depth_limits(of.values, of.mask),
            lambda of, limits: plots.depth_figure(of.values, of.mask, unit="scene units", limits=limits),
        ),
    )
}


def find_overlay(name: str) -> Overlay:
    """The overlay ``name``. Raises `NergError` for one that is not known."""
    if name not in OVERLAYS:
        raise NergError(f'there is no overlay "{name}"; there are {", ".join(OVERLAYS)}')
    return OVERLAYS[name]


def shared_limits(each: Sequence[Limits], top: float | None) -> Limits:
    """Ends of one scale for all pictures, of the ends of ``each``, with the upper end ``top`` where one is given."""
    known = [limits for limits in each if limits is not None]
    if top is not None:
        low = min((limits[0] for limits in known), default=0.0)
        return min(low, 0.0) if low >= top else low, top
    return (min(limits[0] for limits in known), max(limits[1] for limits in known)) if known else None
