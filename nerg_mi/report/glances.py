"""What people could look at, and how much gaze a field says they give it: from places where they stood, in all
directions. Everything is in the coordinates of the place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.maths.arrays import vector_of
from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.shares import Look
from nerg_mi.statistics.visits import Landed, Thing, land, regroup
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.train.geometry import GazePlace
from nerg_mi.transport.geometry import Place, default_settings, trace_depth
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import PlacedGaze, look_from

_GOLDEN = (math.sqrt(5) - 1) / 2
# Directions of the integral of a normalised field: shares are divided by their own sum.
_INTEGRAL = 2048


@dataclass(frozen=True, eq=False)
class Eyes:
    """Where people stood: ``positions`` (P, 3), and whose they are, ``person`` (P,)."""

    positions: np.ndarray
    person: np.ndarray


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

    def look_from(self, eye: np.ndarray) -> Look:
        """What the observer at ``eye`` (3,) meets and gives their gaze, as `gaze_shares` wants it."""
        return look_from(self._gaze, self._place, self._settings, eye)


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


def land_rays(
    rays: Rays,
    place: GazePlace,
    onlooker: Onlooker,
    most: int,
    things: Sequence[Thing],
    members: Sequence[tuple[int, ...]],
    margin: float,
) -> tuple[Landed, np.ndarray]:
    """What up to ``most`` of the ``rays``, evenly chosen, are on of objects that consist of ``things`` by their
    numbers, ``members``, and whose each is (N,). Rays end at their own hit points, or else at what they meet in the
    place. ``margin``: as of `visits.land`."""
    some = rays if len(rays) <= most else rays.select(np.linspace(0, len(rays) - 1, most).round().astype(int))
    origins, directions = place.points_from_rays(some.origin), place.directions_from_rays(some.direction)
    met, hit = onlooker.meet(origins, directions)
    depth = np.where(hit, met, np.inf)
    if some.hit is not None:
        away = place.points_from_rays(some.hit) - origins
        far = np.linalg.norm(away, axis=1)
        ends = np.isfinite(far) & (far > 0)
        directions = np.where(ends[:, None], away / np.where(ends, far, 1)[:, None], directions)
        depth = np.where(ends, far, depth)
    return regroup(land(things, origins, directions, depth, margin), members), some.person
