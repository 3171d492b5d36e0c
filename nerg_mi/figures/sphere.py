"""Spherical densities as figures: map projections of the sphere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

from .overlay import GAZE_LABEL, Heat, add_scale, overlay
from .style import INK, SMALL, Sheet, hatch

# ---- Projections ----
#
# A projection maps longitude and latitude to the plane and back.
#
# Longitude λ in (-π, π] is positive to the right of the front, latitude φ in [-π/2, π/2] is positive upwards. Plane
# coordinates are in [-1, 1] x [-1, 1] and are drawn twice as wide as high. Add a projection to `PROJECTIONS`.

_STEPS = 60
_POLE = 1e-12


@dataclass(frozen=True)
class Projection:
    """A map projection.

    ``summary``: description for help texts; ``forward(longitude, latitude)`` returns (x, y); ``inverse(x, y)`` returns
    (longitude, latitude, inside), where ``inside`` is whether the point belongs to the map.
    """

    name: str
    summary: str
    forward: Callable[[Any, Any], tuple[np.ndarray, np.ndarray]]
    inverse: Callable[[Any, Any], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _equirectangular(longitude: Any, latitude: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(longitude, np.float64) / np.pi, np.asarray(latitude, np.float64) / (np.pi / 2)


def _from_equirectangular(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    return np.pi * x, np.pi / 2 * y, (np.abs(x) <= 1) & (np.abs(y) <= 1)


def _mollweide(longitude: Any, latitude: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mollweide 1805, in Snyder, Map projections: a working manual (1987), p. 249: 2θ + sin 2θ = π sin φ."""
    longitude, latitude = np.broadcast_arrays(np.asarray(longitude, np.float64), np.asarray(latitude, np.float64))
    target = np.pi * np.sin(latitude)
    # Bisection: Newton's method converges slowly at the poles, where the derivative is 0.
    low, high = np.full(target.shape, -np.pi / 2), np.full(target.shape, np.pi / 2)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        is_below = 2 * middle + np.sin(2 * middle) < target
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    θ = 0.5 * (low + high)
    return longitude / np.pi * np.cos(θ), np.sin(θ)


def _from_mollweide(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    inside = x**2 + y**2 <= 1
    θ = np.arcsin(np.clip(y, -1, 1))
    latitude = np.arcsin(np.clip((2 * θ + np.sin(2 * θ)) / np.pi, -1, 1))
    longitude = np.pi * x / np.maximum(np.cos(θ), _POLE)
    return np.where(inside, np.clip(longitude, -np.pi, np.pi), 0.0), latitude, inside


PROJECTIONS = {
    projection.name: projection
    for projection in (
        Projection("mollweide", "an ellipse with equal areas", _mollweide, _from_mollweide),
        Projection("equirectangular", "latitude and longitude", _equirectangular, _from_equirectangular),
    )
}


def find_projection(name: str) -> Projection:
    """Return the projection ``name``. Raises `NergError` for an unknown name."""
    if name not in PROJECTIONS:
        raise NergError(f'unknown projection "{name}"; choose one of {", ".join(PROJECTIONS)}')
    return PROJECTIONS[name]


def resample_panorama(panorama: Any, projection: Projection, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Resample a full-sphere image (h, w, ...) of the sensor `panorama` to a projection by nearest neighbours.

    The result is ``width`` pixels wide and half as high. Returns the image and the mask of pixels inside the map.
    Columns of a panorama are cells around its front; the first and last rows are at the poles
    (`nerg_mi.transport.geometry`).
    """
    panorama = np.asarray(panorama)
    rows, columns = panorama.shape[:2]
    height = width // 2
    x = (2 * np.arange(width) + 1) / width - 1
    y = 1 - (2 * np.arange(height) + 1) / height
    longitude, latitude, inside = projection.inverse(*np.meshgrid(x, y))
    column = np.floor((longitude / (2 * np.pi) + 0.5) * columns).astype(int) % columns
    row = np.clip(np.rint((0.5 - latitude / np.pi) * (rows - 1)).astype(int), 0, rows - 1)
    return panorama[row, column], inside


# ---- Figure ----

_LINES = dict(color="white", alpha=0.3, linewidth=0.6)
_CURVE_POINTS = 181
_MAX_LABEL_X = 0.2


def sphere_figure(
    color,
    gaze,
    mask,
    heat: Heat,
    title: str = "Gaze in all directions",
    projection: str = "equirectangular",
    unknown=None,
    label: str = GAZE_LABEL,
    note: str = "",
    axes: Any = None,
) -> Any:
    """Draw images (h, w, ...) of a `panorama` sensor as a map of the observer's sphere. Return the axes.

    Azimuth 0 is the front of the sensor, positive to the right; elevation 0 is the horizon; both are in degrees.

    Parameters
    ----------
    color
        Linear colour.
    gaze
        Gaze density in 1/sr.
    mask
        Whether there is a surface; gaze is drawn on surfaces only.
    heat
        Appearance of the gaze.
    title
        Title of the figure.
    projection
        "mollweide" (equal area) or "equirectangular".
    unknown
        Pixels without data, which are hatched.
    label
        Label of the scale.
    note
        Note below the figure.
    axes
        Axes to draw in. Default: a new figure.
    """
    map_projection = find_projection(projection)
    width = int(np.shape(gaze)[1]) // 2 * 2
    shown, inside = resample_panorama(overlay(color, gaze, heat, mask), map_projection, width)
    has_unknown = unknown is not None and bool(np.any(unknown))
    if has_unknown:
        shown = hatch(shown, resample_panorama(unknown, map_projection, width)[0])
    sheet = Sheet([np.where(inside[..., None], shown, 1.0)], [title], scale=True, axes=True, note=note, panels=axes)
    aspect, axes = "auto" if axes is None else 0.5, sheet.panels[0]
    sheet.images[0].set_extent((-1, 1, -1, 1))
    axes.set_aspect(aspect)
    _draw_graticule(axes, map_projection, 45 if width >= 360 else 90, sheet.unit)
    add_scale(sheet, heat, label, [(gaze, mask)], has_unknown)
    return axes


def _draw_graticule(axes: Any, projection: Projection, step: int, unit: float) -> None:
    """Draw meridians and parallels every ``step`` degrees, with labels at the lower and left border."""
    along, across = np.radians(np.linspace(-90, 90, _CURVE_POINTS)), np.radians(np.linspace(-180, 180, _CURVE_POINTS))
    meridians, parallels = range(-180, 181, step), range(-90, 91, 45)
    for degrees in meridians:
        axes.plot(*projection.forward(np.full(_CURVE_POINTS, np.radians(degrees)), along), **_LINES)
    for degrees in parallels:
        axes.plot(*projection.forward(across, np.full(_CURVE_POINTS, np.radians(degrees))), **_LINES)
    axes.set_xlim(-1, 1)
    axes.set_ylim(-1, 1)
    # Label meridians at the horizon, since they meet at the poles in some projections.
    crossing = projection.forward(np.radians(list(meridians)), np.zeros(len(meridians)))[0]
    axes.set_xticks(crossing, [_format_degrees(d) for d in meridians])
    axes.set_yticks([])
    for degrees in parallels:
        x, y = (float(v) for v in projection.forward(-np.pi, np.radians(degrees)))
        if x > -_MAX_LABEL_X:
            continue  # a pole that is a point, below the title
        where = dict(textcoords="offset points", ha="right", va="center", annotation_clip=False)
        axes.annotate(_format_degrees(degrees), (x, y), (-4 * unit, 0), fontsize=SMALL * unit, color=INK, **where)
    axes.tick_params(labelsize=SMALL * unit, colors=INK, length=2 * unit, pad=2 * unit)
    axes.set_xlabel("azimuth, to the right of the front", fontsize=SMALL * unit, color=INK, labelpad=2 * unit)
    offset = 30 * unit / 72 * axes.figure.dpi / axes.bbox.width
    label_style = dict(rotation=90, ha="right", va="center", transform=axes.transAxes, fontsize=SMALL * unit, color=INK)
    axes.text(-offset, 0.5, "elevation", **label_style)


def _format_degrees(value: int) -> str:
    return f"{value}°".replace("-", "−")
