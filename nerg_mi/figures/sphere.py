"""Densities over directions as pictures: projections of the sphere, and figures of them."""

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
# Maps of the sphere: how a longitude and a latitude become a place on paper, and back.
#
# Longitude λ in (-π, π] is positive to the right of the front, latitude φ in [-π/2, π/2] positive upwards. Places (x,
# y) lie in [-1, 1] x [-1, 1], on paper twice as wide as it is high. One more map is one more entry of `PROJECTIONS`.

_STEPS = 60
_POLE = 1e-12


@dataclass(frozen=True)
class Projection:
    """``name``; ``summary`` for people; ``forward(longitude, latitude)`` gives (x, y), ``inverse(x, y)`` gives
    (longitude, latitude, inside), where ``inside`` tells whether the place belongs to the map."""

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
    wanted = np.pi * np.sin(latitude)
    # By halving: what Newton's method does at the poles, where the slope is 0, would be slow.
    low, high = np.full(wanted.shape, -np.pi / 2), np.full(wanted.shape, np.pi / 2)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        less = 2 * middle + np.sin(2 * middle) < wanted
        low, high = np.where(less, middle, low), np.where(less, high, middle)
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
    """The projection ``name``. Raises `NergError` for one that is not known."""
    if name not in PROJECTIONS:
        raise NergError(f'there is no projection "{name}"; there are {", ".join(PROJECTIONS)}')
    return PROJECTIONS[name]


def resample_panorama(panorama: Any, projection: Projection, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A full-sphere picture (h, w, ...), of the sensor `panorama`, on the paper of ``projection``, ``width`` pixels
    wide and half as high: the nearest pixel's value at each, and where the map is (width // 2, width), bool.

    Columns of a panorama are cells around its front, its first and last row lie at the poles
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


# ---- The gaze of an observer over all directions that they could turn to ----

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
    label: str = GAZE_LABEL,
    note: str = "",
) -> Any:
    """Pictures (h, w, ...) of a `panorama` sensor as a map of the observer's sphere, as wide as they are.

    ``color`` is linear, ``gaze`` in 1/sr; the heat stays away from where ``mask`` is false, and where ``unknown`` is
    true it is hatched. Azimuth 0 is the sensor's front, positive to the right; elevation 0 the horizon; both in
    degrees. ``projection``: one of `sphere.PROJECTIONS`, "mollweide" (equal areas) or "equirectangular".
    ``note``: what it rests on.
    """
    chosen = find_projection(projection)
    width = int(np.shape(gaze)[1]) // 2 * 2
    shown, inside = resample_panorama(overlay(color, gaze, heat, mask), chosen, width)
    hatched = unknown is not None and bool(np.any(unknown))
    if hatched:
        shown = hatch(shown, resample_panorama(unknown, chosen, width)[0])
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
