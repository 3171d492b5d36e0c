"""Figures with scales and labels: depth, gaze, visibility, differences and the paper's occlusion figure.

Each function takes arrays as the integrator gives them (rows from the top) and returns a matplotlib ``Figure``, see
`sheet`; `saving.save` writes it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .colors import color_values
from .hatching import hatch
from .overlay import Heat, overlay, scale_strip
from .sheet import SMALL, Sheet
from .tonemap import LUMINANCE, srgb

HIDDEN = np.array([0.16, 0.20, 0.42])
"""Tint (display sRGB) of what the observer cannot see."""

GAZE = "gaze density [1/sr]"

_STEPS = 256


def depth_limits(depth, mask) -> tuple[float, float]:
    """The ends of a scale for ``depth`` (h, w) where ``mask`` (h, w) is true, but for the outermost half percents."""
    depth = np.asarray(depth, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(depth)
    low, high = (float(v) for v in np.percentile(depth[some], (0.5, 99.5))) if some.any() else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def depth_figure(
    depth,
    mask,
    title: str = "Depth",
    unit: str = "m",
    limits: tuple[float, float] | None = None,
    colors: str = "viridis_r",
):
    """``depth`` (h, w) in scene units, with a colour bar; hatched where ``mask`` (h, w) says that nothing is met.
    ``limits``: ends of the scale, by default those of `depth_limits`."""
    depth = np.asarray(depth, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(depth)
    low, high = limits or depth_limits(depth, mask)
    shown = color_values(colors, np.where(some, (depth - low) / (high - low), 0.0))
    sheet = Sheet([_hatched(shown, ~some)], [title], scale=True)
    inside = depth[some]
    above, below = bool(np.any(inside > high)), bool(np.any(inside < low))
    strip = color_values(colors, np.linspace(0, 1, _STEPS))
    label = f"distance from the camera [{unit}]"
    sheet.bar(strip, low, high, label, above=above, below=below, unknown=not some.all())
    return sheet.page


def gaze_figure(
    color, gaze, mask, heat: Heat, title: str = "Gaze", label: str = GAZE, marker=None, unknown=None, note: str = ""
) -> Any:
    """``gaze`` (h, w) in 1/sr over the linear picture ``color`` (h, w, 3), with its scale, which ``label`` explains.
    ``marker``: pixel (x, y) at which the observer stands; ``unknown`` (h, w) bool: where it is hatched, since nothing
    is known there; ``note``: what it rests on."""
    sheet = Sheet([overlay(color, gaze, heat, mask, unknown)], [title], scale=True, note=note)
    if marker is not None:
        mark_observer(sheet, 0, marker)
    add_scale(sheet, heat, label, [(gaze, mask)], unknown is not None and bool(np.any(unknown)))
    return sheet.page


def visibility_figure(color, visibility, mask, title: str = "Visible to the observer"):
    """``visibility`` (h, w): 1 in the colours of the picture, 0 in a dark blue; hatched where ``mask`` is false."""
    v = np.clip(np.asarray(visibility, np.float64), 0, 1)[..., None]
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    hidden = HIDDEN * (0.35 + 0.9 * luminance)
    unknown = ~np.asarray(mask, bool)
    sheet = Sheet([_hatched(hidden + v * (srgb(color) - hidden), unknown)], [title], scale=True)
    grey = np.linspace(0, 1, _STEPS)[:, None]
    strip = HIDDEN * 0.8 + grey * (0.85 - HIDDEN * 0.8)
    sheet.bar(strip, 0.0, 1.0, "0 hidden, 1 visible", unknown=bool(unknown.any()))
    return sheet.page


def difference_figure(
    first,
    second,
    mask=None,
    title: str = "Difference",
    label: str = "difference",
    limit=None,
    colors: str = "RdBu_r",
    note: str = "",
):
    """``first`` less ``second``, (h, w) each, in the colours of a diverging map whose middle is 0; hatched where
    ``mask`` (h, w) is false, or one of both is no number. ``limit``: both ends of the scale, by default that which 99.5
    percent of the pixels stay within; ``note``: what they rest on."""
    less = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    some = np.isfinite(less) if mask is None else np.isfinite(less) & np.asarray(mask, bool)
    size = np.abs(less[some])
    limit = float(limit or (np.percentile(size, 99.5) if size.size else 0.0) or (size.max() if size.size else 0.0) or 1)
    shown = color_values(colors, np.where(some, 0.5 + 0.5 * less / limit, 0.5), diverging=True)
    sheet = Sheet([_hatched(shown, ~some)], [title], scale=True, note=note)
    strip = color_values(colors, np.linspace(0, 1, _STEPS), diverging=True)
    over = dict(above=bool(np.any(less[some] > limit)), below=bool(np.any(less[some] < -limit)))
    sheet.bar(strip, -limit, limit, label, unknown=not some.all(), **over)
    return sheet.page


def occlusion_figure(own, moved_without, moved_with, heat: Heat, marker=None, hatched: bool = False, note: str = ""):
    """The paper's occlusion figure: three pictures with one scale.

    ``own``, ``moved_without``, ``moved_with``: tuples (color (h, w, 3) linear, gaze (h, w) in 1/sr, mask (h, w)): what
    the observer sees; another camera, gaze without occlusion; the same with it. ``marker``: pixel (x, y) at which the
    observer stands in the two pictures of the other camera. ``hatched``: hatch where there is no surface;
    ``note``: what it rests on.
    """
    parts = (own, moved_without, moved_with)
    void = [~np.asarray(m, bool) if hatched else None for _, _, m in parts]
    pictures = [overlay(c, g, heat, m, u) for (c, g, m), u in zip(parts, void)]
    titles = ["The observer's own view", "Another camera, without occlusion", "The same with occlusion"]
    sheet = Sheet(pictures, titles, scale=True, note=note)
    if marker is not None:
        for panel in (1, 2):
            mark_observer(sheet, panel, marker)
    add_scale(sheet, heat, GAZE, [(g, m) for _, g, m in parts], any(u is not None and u.any() for u in void))
    return sheet.page


def add_scale(sheet: Sheet, heat: Heat, label: str, values, unknown: bool = False) -> None:
    """The scale of ``heat`` on a ``sheet``; ``values``: pairs (values, mask) of all pictures that it explains."""
    above = any(float(np.max(v, where=np.asarray(m, bool), initial=0.0)) > heat.top for v, m in values)
    sheet.bar(scale_strip(heat), heat.low, heat.top, label, above=above, log=heat.decades > 0, unknown=unknown)


def mark_observer(sheet: Sheet, panel: int, at: tuple[float, float]) -> None:
    """Show in a picture of ``sheet`` that the observer stands at the pixel ``at`` (x, y)."""
    axes, unit = sheet.panels[panel], sheet.unit
    dot = dict(markerfacecolor="#35c2ff", markeredgecolor="white", markeredgewidth=1.2 * unit)
    axes.plot(*at, marker="o", markersize=6 * unit, **dot)
    height, width = sheet.images[panel].get_array().shape[:2]
    # Towards the middle, so that it stays within the picture.
    left, low = at[0] > 0.6 * width, at[1] < 0.15 * height
    axes.annotate(
        "observer",
        at,
        ((-6 if left else 6) * unit, (-6 if low else 5) * unit),
        textcoords="offset points",
        ha="right" if left else "left",
        va="top" if low else "bottom",
        fontsize=SMALL * unit,
        color="white",
        bbox=dict(boxstyle="round,pad=0.15", facecolor="black", alpha=0.45, linewidth=0),
    )


def _hatched(shown, unknown) -> np.ndarray:
    """``shown`` (h, w, 3), hatched over a middle grey where ``unknown`` (h, w)."""
    return hatch(np.where(np.asarray(unknown)[..., None], 0.5, shown), unknown) if np.any(unknown) else shown
