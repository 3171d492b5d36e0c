"""What can be laid over a picture: a table of quantities, how each is drawn, and which scale several pictures share.

One more is one more entry. Values are the AOVs of the integrator `nerg`, (h, w) each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

from . import plots
from .overlay import Heat, top_of

Limits = tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Layers:
    """A picture and what lies over it: linear ``color`` (h, w, 3), ``values`` (h, w), ``mask`` (h, w) bool where there
    is a surface; ``marker``: pixel (x, y) of the observer, or None; ``supported``: whether anything was recorded around
    the observer, so that their gaze is known; ``basis``: rays and people that it rests on, in words, "" where that is
    not known."""

    color: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    marker: tuple[float, float] | None = None
    supported: bool = True
    basis: str = ""


@dataclass(frozen=True)
class Style:
    """How an overlay is drawn: the ``colors`` of its scale (None: those usual for it), over how many ``decades`` that
    is logarithmic (0: linear), whether what is not known is hatched (``hatched``), and the ``title`` (None: the usual
    one)."""

    colors: str | None = None
    decades: float = 0.0
    hatched: bool = True
    title: str | None = None


USUAL = Style()


@dataclass(frozen=True)
class Overlay:
    """``name`` of the AOV; ``summary`` for people; ``limits(layers)``: ends of the scale of one picture, None where it
    shows nothing of it; ``draw(layers, limits, style)``: a figure; ``scaled``: whether it needs a scale; ``low``: the
    lower end of every scale, or None where it depends on the pictures; ``of_gaze``: whether it is known only where rays
    were recorded; ``rests_on``: "gaze" or "kde", the part of the scene that was made of rays."""

    name: str
    summary: str
    limits: Callable[[Layers], Limits]
    draw: Callable[..., Any]
    scaled: bool = True
    low: float | None = 0.0
    of_gaze: bool = False
    rests_on: str | None = None


def _heat(name: str, summary: str, title: str, label: str, of_gaze: bool = False, rests_on: str = "gaze") -> Overlay:
    def limits(of: Layers) -> Limits:
        return (0.0, top_of(of.values, of.mask)) if np.any(of.values[of.mask] > 0) else None

    def draw(of: Layers, limits: Limits, style: Style = USUAL) -> Any:
        heat = Heat(1.0 if limits is None else limits[1], decades=style.decades)
        heat = heat if style.colors is None else replace(heat, colors=style.colors)
        shown = style.title or (title if of.supported or not of_gaze else f"{title}: nobody recorded around here")
        unknown = unknown_of(of, of_gaze) if style.hatched else None
        return plots.gaze_figure(of.color, of.values, of.mask, heat, shown, label, of.marker, unknown, of.basis)

    return Overlay(name, summary, limits, draw, of_gaze=of_gaze, rests_on=rests_on)


def unknown_of(layers: Layers, of_gaze: bool) -> np.ndarray:
    """Where nothing is known (h, w), bool: where there is no surface, and everywhere for gaze without support."""
    void = ~np.asarray(layers.mask, bool)
    return void if layers.supported or not of_gaze else np.ones_like(void)


def _draw_visibility(of: Layers, limits: Limits, style: Style = USUAL) -> Any:
    return plots.visibility_figure(of.color, of.values, of.mask, style.title or "Visible to the observer")


def _draw_depth(of: Layers, limits: Limits, style: Style = USUAL) -> Any:
    colors = style.colors or "viridis_r"
    return plots.depth_figure(of.values, of.mask, style.title or "Depth", "scene units", limits, colors)


OVERLAYS = {
    overlay.name: overlay
    for overlay in (
        _heat("gaze", "how much the observer attends to what is seen", "Gaze", plots.GAZE, of_gaze=True),
        _heat("kde", "where tracked people looked", "Where people looked", "tracked gaze [1/sr]", rests_on="kde"),
        _heat("gaze_std", "how sure that is", "Uncertainty of gaze", "standard deviation of gaze [1/sr]", of_gaze=True),
        _heat("emit", "how much surfaces attract", "What surfaces attract", "emitted attention"),
        _heat("capture", "how much the observer gives", "What the observer gives", "captured attention"),
        _heat("support", "how many rays the gaze rests on", "Support", "training rays around the observer"),
        Overlay("visibility", "what the observer sees", lambda of: None, _draw_visibility, scaled=False),
        Overlay(
            "depth",
            "distance from the camera",
            lambda of: plots.depth_limits(of.values, of.mask),
            _draw_depth,
            low=None,
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
