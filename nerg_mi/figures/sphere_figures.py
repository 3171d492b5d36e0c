"""The gaze of an observer over all directions that they could turn to."""

from __future__ import annotations

from typing import Any

import numpy as np

from .hatching import hatch
from .overlay import Heat, overlay
from .plots import GAZE, add_scale
from .projections import Projection, find_projection, resample
from .sheet import INK, SMALL, Sheet

_LINES = dict(color="white", alpha=0.3, linewidth=0.6)
_FINE = 181
_LEFT = 0.2


def sphere_figure(
    color,
    gaze,
    mask,
    heat: Heat,
    title: str = "All that the observer could turn to",
    projection: str = "equirectangular",
    unknown=None,
    label: str = GAZE,
    note: str = "",
) -> Any:
    """Pictures (h, w, ...) of a `panorama` sensor as a map of the observer's sphere, as wide as they are.

    ``color`` is linear, ``gaze`` in 1/sr; the heat stays away from where ``mask`` is false, and where ``unknown`` is
    true it is hatched. Azimuth 0 is the sensor's front, positive to the right; elevation 0 the horizon; both in
    degrees. ``projection``: one of `projections.PROJECTIONS`, "mollweide" (equal areas) or "equirectangular".
    ``note``: what it rests on.
    """
    chosen = find_projection(projection)
    width = int(np.shape(gaze)[1]) // 2 * 2
    shown, inside = resample(overlay(color, gaze, heat, mask), chosen, width)
    hatched = unknown is not None and bool(np.any(unknown))
    if hatched:
        shown = hatch(shown, resample(unknown, chosen, width)[0])
    sheet = Sheet([np.where(inside[..., None], shown, 1.0)], [title], scale=True, axes=True, note=note)
    axes = sheet.panels[0]
    sheet.images[0].set_extent((-1, 1, -1, 1))
    axes.set_aspect("auto")
    _graticule(axes, chosen, 45 if width >= 360 else 90, sheet.unit)
    add_scale(sheet, heat, label, [(gaze, mask)], hatched)
    return sheet.page


def _graticule(axes: Any, projection: Projection, step: int, unit: float) -> None:
    """Meridians and parallels every ``step`` degrees, with their numbers at the lower and the left edge of the map."""
    along, across = np.radians(np.linspace(-90, 90, _FINE)), np.radians(np.linspace(-180, 180, _FINE))
    meridians, parallels = range(-180, 181, step), range(-90, 91, 45)
    for degrees in meridians:
        axes.plot(*projection.forward(np.full(_FINE, np.radians(degrees)), along), **_LINES)
    for degrees in parallels:
        axes.plot(*projection.forward(across, np.full(_FINE, np.radians(degrees))), **_LINES)
    axes.set_xlim(-1, 1)
    axes.set_ylim(-1, 1)
    # Meridians meet at the poles of some maps: they are numbered where they cross the horizon.
    crossing = projection.forward(np.radians(list(meridians)), np.zeros(len(meridians)))[0]
    axes.set_xticks(crossing, [_degrees(d) for d in meridians])
    axes.set_yticks([])
    for degrees in parallels:
        x, y = (float(v) for v in projection.forward(-np.pi, np.radians(degrees)))
        if x > -_LEFT:
            continue  # a pole that is a point, where the title is
        where = dict(textcoords="offset points", ha="right", va="center", annotation_clip=False)
        axes.annotate(_degrees(degrees), (x, y), (-4 * unit, 0), fontsize=SMALL * unit, color=INK, **where)
    axes.tick_params(labelsize=SMALL * unit, colors=INK, length=2 * unit, pad=2 * unit)
    axes.set_xlabel("azimuth, to the right of the front", fontsize=SMALL * unit, color=INK, labelpad=2 * unit)
    room = 30 * unit / 72 * axes.figure.dpi / axes.bbox.width
    text = dict(rotation=90, ha="right", va="center", transform=axes.transAxes, fontsize=SMALL * unit, color=INK)
    axes.text(-room, 0.5, "elevation", **text)


def _degrees(value: int) -> str:
    return f"{value}°".replace("-", "−")
