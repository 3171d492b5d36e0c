"""What people have around them: surfaces that rays meet, and the gaze that a field foretells there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.fields import load_gaze
from nerg_mi.jobs.gaze_places import align_of_training, place_of_training
from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rendering.asked import is_nerg
from nerg_mi.rendering.pictures import load_scene
from nerg_mi.statistics.shares import Look
from nerg_mi.training.geometry import places
from nerg_mi.training.geometry.places import GazePlace
from nerg_mi.training.geometry.surfaces import SURFACE_OPACITY
from nerg_mi.transport.observer.gaze import PlacedGaze
from nerg_mi.transport.observer.looking import look_from
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings, trace_depth

if TYPE_CHECKING:
    import mitsuba as mi


@dataclass(frozen=True, eq=False)
class Surroundings:
    """``place``: what rays meet, None where nothing is known; ``gaze`` of a field, or None; ``align``: from the rays'
    frame; ``scene``: whose shapes they are, or None; ``observer`` (3,): the scene's own; ``kind`` of depth."""

    place: Place | None
    gaze: PlacedGaze | None
    align: Similarity
    scene: mi.Scene | None = None
    settings: ObserverSettings | None = None
    observer: np.ndarray | None = None
    kind: str = "median"

    @property
    def scale(self) -> float:
        """Units of the place a metre."""
        return float(self.align.scale)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the rays' frame in the place."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the rays' frame in the place."""
        return directions @ (self.align.matrix[:3, :3] / self.scale).T

    def depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Distance (N,) to the first surface along rays (N, 3) of the place, infinite where there is none."""
        if self.place is None:
            return np.full(len(o), np.inf)
        depth, opacity = trace_depth(self.place, o, d, kind=self.kind)
        return np.where((opacity >= SURFACE_OPACITY) & (depth > 0), depth, np.inf).astype(np.float64)

    def look_from(self, eye: np.ndarray) -> Look:
        """A function of unit directions (D, 3), as `nerg_mi.statistics.shares.gaze_shares` wants it of an observer at
        ``eye`` (3,)."""
        assert self.gaze is not None
        place = self.place if self.place is not None else Place(None)
        settings = self.settings or ObserverSettings(
            march=default_settings(place), depth=self.kind, surface_opacity=SURFACE_OPACITY
        )
        look = look_from(self.gaze, place, settings, eye)
        if self.place is not None:
            return look
        return lambda directions: (look(directions)[0], None)

    def support(self, eye: np.ndarray) -> float:
        """Rays that the field learnt from around ``eye`` (3,); NaN where it does not say."""
        import mitsuba as mi

        if self.gaze is None or self.gaze.field.support is None:
            return float("nan")
        p = self.gaze.to_world.point_to_local(mi.Point3f(*np.asarray(eye, float).tolist()))
        return float(np.array(self.gaze.field.support.at(p)).ravel()[0])

    def bounds(self) -> np.ndarray:
        """Corners (2, 3) of the place. Raises `NergError` where none is known."""
        bounds = None if self.place is None else self.place.bounds()
        if bounds is None:
            raise NergError("there is no place whose bounds are known; give a scene or a radiance field")
        return np.array(bounds, float)

    def within(self, scene: mi.Scene) -> Surroundings:
        """The same with the shapes of another ``scene``."""
        assert self.place is not None
        return replace(self, place=Place(self.place.medium, scene), scene=scene)


def surroundings_of_scene(path: Path, gaze: Path | None, align: Similarity | None, ns: ModuleType) -> Surroundings:
    """A scene's shapes, and the field and gaze of its integrator where that is a ``nerg``; ``gaze``: another gaze field
    in their stead. Raises `NergError` for a scene with neither shapes nor a field."""
    from nerg_mi.transport.observer.viewpoint import center

    scene = load_scene(path, merge=False)
    integrator: Any = scene.integrator()
    own = is_nerg(integrator)
    medium = integrator.medium if own else None
    place = Place(medium, scene)
    if medium is None and place.scene is None:
        raise NergError(f'the scene "{path}" has neither shapes nor a field; name one that has')
    sensor = integrator.observer if own else None
    observer = None if sensor is None else np.ravel(np.array(center(sensor), np.float64))
    if gaze is not None:
        field, about = load_gaze(gaze, ns)
        provenance = about.get("provenance", about)
        return Surroundings(place, PlacedGaze(field), align or align_of_training(provenance), scene, observer=observer)
    settings = integrator.observer_settings if own and integrator.gaze is not None else None
    found = integrator.gaze if own else None
    return Surroundings(place, found, align or Similarity(), scene, settings, observer)


def surroundings_of_files(
    scene: Path | None, field: Path | None, gaze: Path | None, align: Similarity | None, ns: ModuleType
) -> Surroundings:
    """What the files that are given say. Raises `NergError` for those that cannot be used together."""
    if scene is not None:
        if field is not None:
            raise NergError(f'"{scene}" and "{field}" are both a place; a scene names its field itself')
        return surroundings_of_scene(scene, gaze, align, ns)
    if gaze is not None:
        network, about = load_gaze(gaze, ns)
        options = GazeEvaluationOptions(field=field)
        made = place_of_training(gaze, about.get("provenance", about), network.box, options, ns)
        return _of_place(made, PlacedGaze(network), align or made.align)
    if field is not None:
        return _of_place(places.place_of_field(field, ns), None, align or Similarity())
    return Surroundings(None, None, align or Similarity())


def _of_place(place: GazePlace, gaze: PlacedGaze | None, align: Similarity) -> Surroundings:
    medium = place.medium
    inside = medium if isinstance(medium, Place) or medium is None else Place(medium)
    return Surroundings(inside, gaze, align, None if inside is None else inside.scene)
