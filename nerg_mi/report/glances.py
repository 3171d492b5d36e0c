"""What people could look at, and how much gaze a field says they give it: from places where they stood, in all
directions. Everything is in the coordinates of the place."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerg_mi.field.gaze.protocol import AnyGazeField
from nerg_mi.maths.arrays import vector_of
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.training.geometry.places import GazePlace
from nerg_mi.training.geometry.surfaces import SURFACE_OPACITY
from nerg_mi.transport.observer.gaze import PlacedGaze
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings, trace_depth

DIRECTIONS = 4096
"""Directions of equal area around an eye."""

_GOLDEN = (math.sqrt(5) - 1) / 2
# Directions of the integral of a normalised field: shares are divided by their own sum.
_INTEGRAL = 2048


@dataclass(frozen=True, eq=False)
class Eyes:
    """Where people stood: ``positions`` (P, 3), and whose they are, ``person`` (P,)."""

    positions: np.ndarray
    person: np.ndarray


@dataclass(frozen=True, eq=False)
class Glances:
    """From each of the ``eyes`` in D directions of equal area: ``points`` (P, D, 3) of surfaces, whether there is one,
    ``met`` (P, D), and the ``share`` (P, D) of the gaze, which adds up to one for each eye."""

    eyes: Eyes
    points: np.ndarray
    met: np.ndarray
    share: np.ndarray


class Onlooker:
    """A gaze field in its place, asked about observers in the place's coordinates.

    ``kind``: of the depth at which a ray meets its surface.
    """

    def __init__(self, field: AnyGazeField, place: GazePlace, kind: str = "median"):
        self.field, self._kind = field, kind
        self._place = place.medium if isinstance(place.medium, Place) else Place(place.medium)
        self._known = place.medium is not None
        march = default_settings(self._place)
        self._settings = ObserverSettings(
            march=march, depth=kind, surface_opacity=SURFACE_OPACITY, directions=_INTEGRAL
        )
        self._gaze = PlacedGaze(field)

    def meet(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (N,) along rays (N, 3), and whether they meet a surface; nothing is met where no place is known."""
        if not self._known:
            return np.zeros(len(origins), np.float32), np.zeros(len(origins), bool)
        depth, opacity = trace_depth(self._place, origins, directions, kind=self._kind)
        return depth, (opacity >= SURFACE_OPACITY) & (depth > 0)

    def density(self, observer: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Gaze (N,) in 1/sr of the ``observer`` (3,) in unit ``directions`` (N, 3)."""
        import mitsuba as mi

        center = mi.Point3f(*np.asarray(observer, float).tolist())
        observed = self._gaze.at([center], self._place, self._settings)
        return np.array(observed.along(center, vector_of(mi.Vector3f, directions)))

    def on_points(self, observer: np.ndarray, points: np.ndarray, spacing: float) -> np.ndarray:
        """Gaze (N,) in 1/sr that the ``observer`` (3,) gives ``points`` (N, 3) of surfaces, none to those that are
        hidden by more than twice the ``spacing``."""
        away = points - observer
        distance = np.linalg.norm(away, axis=1)
        directions = away / np.maximum(distance, 1e-9)[:, None]
        depth, met = self.meet(np.broadcast_to(observer, points.shape), directions)
        seen = ~met | (depth >= distance - 2 * spacing)
        return np.where(seen, self.density(observer, directions), 0)

    def glances(self, eyes: Eyes, count: int = DIRECTIONS, on_eye: Callable[[int, int], None] | None = None) -> Glances:
        """What is looked at from all ``eyes``, in ``count`` directions. ``on_eye`` is told the eyes done, and of how
        many."""
        d, eye = fibonacci_directions(count), np.asarray(eyes.positions, float)
        # All at once, since a launch takes as long to prepare as to run.
        depth, met = self.meet(np.repeat(eye, count, axis=0), np.tile(d, (len(eye), 1)))
        points = eye[:, None] + depth.reshape(len(eye), count, 1) * d
        share = np.zeros((len(eye), count))
        for number, position in enumerate(eye):
            gaze = np.maximum(self.density(position, d).astype(np.float64), 0)
            share[number] = gaze / gaze.sum() if gaze.sum() > 0 else 0
            if on_eye is not None:
                on_eye(number + 1, len(eye))
        return Glances(eyes, points, met.reshape(len(eye), count), share)


def eyes_of(rays: Rays, place: GazePlace, most: int) -> Eyes:
    """About ``most`` of the positions of ``rays``, in the place's coordinates, as many of each person: evenly chosen
    among theirs in the order of time, and begun at another part of it for each person, so that all together are spread
    over whole visits even where each person has only one. Of more people than that so many, evenly chosen."""
    there = np.unique(rays.person)
    if len(there) > most:
        there = there[np.linspace(0, len(there) - 1, most).astype(int)]
    each, chosen = max(1, most // len(there)), []
    # Multiples of the golden ratio, modulo one, are spread evenly however many there are; the first is one half.
    starts = (0.5 + np.arange(len(there)) * _GOLDEN) % 1
    for person, start in zip(there, starts):
        own = np.flatnonzero(rays.person == person)
        own = own[np.argsort(rays.t[own], kind="stable")]
        count = min(each, len(own))
        # At the same share of as many equal stretches.
        chosen.append(own[((np.arange(count) + start) * len(own) / count).astype(int)])
    rows = np.concatenate(chosen)
    return Eyes(place.points_from_rays(rays.origin[rows]), rays.person[rows])


def points_of_rays(rays: Rays, place: GazePlace, onlooker: Onlooker, most: int) -> tuple[np.ndarray, np.ndarray]:
    """``(points (N, 3), person (N,))``: what up to ``most`` of the ``rays``, evenly chosen, end at: their own hit
    point, or what they meet in the place. Those that end at nothing are NaN."""
    some = rays if len(rays) <= most else rays.select(np.linspace(0, len(rays) - 1, most).round().astype(int))
    origins, directions = place.points_from_rays(some.origin), place.directions_from_rays(some.direction)
    depth, met = onlooker.meet(origins, directions)
    points = np.where(met[:, None], origins + depth[:, None] * directions, np.nan)
    if some.hit is not None:
        points = np.where(np.isfinite(some.hit), place.points_from_rays(some.hit), points)
    return points, some.person
