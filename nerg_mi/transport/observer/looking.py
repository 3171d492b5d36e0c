"""An observer who looks around: their gaze along any directions, and the surfaces that they meet there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import vector_of
from nerg_mi.transport.place import Place

from .cache import ObserverCache
from .gaze import PlacedGaze
from .settings import ObserverSettings

# Directions of the integral of a normalised field, at most: of one field it cancels out of shares of the gaze, and of
# an ensemble only the members' weights beside each other rest on it.
_INTEGRAL = 2048


def look_from(
    gaze: PlacedGaze, place: Place, settings: ObserverSettings, eye: np.ndarray
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function of unit directions (N, 3): the gaze (M, N) of the observer at ``eye`` (3,), in proportion to 1/sr, by
    each of M members of an ensemble or by one field, and the distance (N,) of the first surface, infinite where there
    is none; in scene units."""
    import mitsuba as mi

    settings = replace(settings, directions=min(settings.directions, _INTEGRAL))
    center = mi.Point3f(np.asarray(eye, np.float64).tolist())
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    cache = ObserverCache()
    observed = gaze.at([center], place, settings, cache)
    around = cache.peek((gaze, "surroundings"))
    filling = around[0].value.filling if around else None

    def look(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, distance = observed.look(center, vector_of(mi.Vector3f, directions), filling)
        dr.eval(found, distance)
        lanes = lambda v: np.broadcast_to(np.array(v, np.float64), (len(directions),))
        return np.array([lanes(g) for g in found]), lanes(distance)

    return look
