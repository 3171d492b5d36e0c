"""Gaze fields as their observers in an environment see it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.extrapolation import describe_extrapolation
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings, trace_depth
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance, make_gaze_evaluator

from .environment import Environment
from .gaze import GazeField

DirectionQuery = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | None]]
"""Maps unit directions (N, 3) to the gaze density (M, N) of an observer, by each of M ensemble members, in 1/sr or
proportional to it, and to the distance (N,) of the surface that is met: infinite if there is none, and None if surfaces
are unknown."""


@dataclass(frozen=True, eq=False)
class GazeSampler:
    """The gaze of observers in an environment.

    Attributes
    ----------
    gaze
        Gaze field in the environment.
    geometry
        What rays end on; empty if surfaces are unknown.
    settings
        How rays are traced.
    """

    gaze: GazeFieldInstance
    geometry: SceneGeometry
    settings: ObserverSettings

    @property
    def has_surfaces(self) -> bool:
        """Whether surfaces are known."""
        return self.geometry.medium is not None or self.geometry.scene is not None

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth (N,) along rays (N, 3) and whether each hits a surface (N,). Without surfaces, no ray
        hits."""
        if not self.has_surfaces:
            return np.zeros(len(origins), np.float32), np.zeros(len(origins), bool)
        depth, opacity = trace_depth(self.geometry, origins, directions, kind=self.settings.depth)
        return depth, (opacity >= self.settings.surface_opacity) & (depth > 0)

    def density(self, observer: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the gaze density (N,) of ``observer`` (3,) in unit ``directions`` (N, 3), in 1/sr."""
        mi = variant_types()
        center = mi.Point3f(*np.asarray(observer, float).tolist())
        observed = self.gaze.for_observers([center], self.geometry, self.settings)
        return np.array(observed.evaluate_along(center, to_vector(mi.Vector3f, directions)))

    def density_at_points(self, observer: np.ndarray, points: np.ndarray, spacing: float) -> np.ndarray:
        """Return the gaze density (N,) of ``observer`` (3,) towards surface ``points`` (N, 3), in 1/sr.

        Points that are hidden by a surface more than two ``spacing`` in front of them have density 0.
        """
        to_points = points - observer
        distance = np.linalg.norm(to_points, axis=1)
        directions = to_points / np.maximum(distance, 1e-9)[:, None]
        depth, is_hit = self.trace(np.broadcast_to(observer, points.shape), directions)
        is_visible = ~is_hit | (depth >= distance - 2 * spacing)
        return np.where(is_visible, self.density(observer, directions), 0)

    def query_from(self, observer: np.ndarray) -> DirectionQuery:
        """Return the `DirectionQuery` of an observer at a position (3,), as `gaze_shares` needs it."""
        query = make_gaze_evaluator(self.gaze, self.geometry, self.settings, observer)
        return query if self.has_surfaces else lambda directions: (query(directions)[0], None)

    def support_at(self, observer: np.ndarray) -> float:
        """Return the number of training samples around a position (3,); NaN if the field does not store it."""
        mi, support = variant_types(), self.gaze.field.support
        if support is None:
            return float("nan")
        p = self.gaze.to_world.point_to_local(mi.Point3f(*np.asarray(observer, float).tolist()))
        return float(np.array(support.evaluate(p)).ravel()[0])

    def describe_extrapolation(self, observers: np.ndarray) -> str:
        """Return a sentence on the ``observers`` (M, 3) whose values are extrapolated; "" if there are none."""
        return describe_extrapolation(self.geometry, self.gaze, observers)


def sample_field(field: GazeNetwork, environment: Environment, **settings: Any) -> GazeSampler:
    """Return the gaze of ``field`` in an environment; ``settings`` are those of `ObserverSettings`."""
    geometry = environment.scene_geometry
    march = default_march_settings(geometry)
    rays = ObserverSettings(march=march, **settings)
    return GazeSampler(GazeFieldInstance(field), geometry, rays)


def make_sampler(environment: Environment, field: GazeField | None = None) -> GazeSampler | None:
    """Return the gaze of ``field`` in an environment, by default of the gaze field of its scene; None without both."""
    nerg = environment.nerg
    if field is not None:
        return sample_field(field.network, environment)
    if nerg is None or nerg.gaze is None:
        return None
    return GazeSampler(nerg.gaze, environment.scene_geometry, nerg.observer_settings)
