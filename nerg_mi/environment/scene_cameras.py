"""Cameras of a written scene: given ones, those of photos, the observer's eye, and the best overview."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.progress import Reporter
from nerg_mi.transport.geometry import SceneGeometry, pixel_directions, pixel_solid_angles, trace_depth

from .arrays import check_point
from .bands import render_channels
from .environment import Environment
from .overview import PinholeFrame, ScoredView, SeenSurfaces, ViewScorer, view_of_observer, view_of_scene
from .photo_cameras import PhotoCamera, load_photo_camera, load_photo_cameras
from .scene_writer import Lens, LookAt, level_direction

# ---- Choice of the camera, by probing what the observer sees ----


PROBE_SIZE = (48, 32)
"""Size in pixels of the image that tests whether a camera sees anything."""

PANORAMA = (96, 48)
"""Size in pixels of the image of the observer's surroundings."""

SPHERE = 2
"""Index of the sensor of that image."""

# Number of directions for testing whether a point is inside a shape.
_AROUND = 32
# Weights of directions within and beyond 35 degrees of the horizon, if attention is unknown.
_LEVEL, _STEEP = 1.0, 0.2


@dataclass(frozen=True, eq=False)
class SceneProbe:
    """A loaded scene without its final camera: ``scene``, ``quantity`` (the AOV of attention, or None), ``up`` (3,)."""

    scene: Any
    quantity: str | None
    up: np.ndarray

    @property
    def environment(self) -> SceneGeometry:
        """Geometry for tracing."""
        return SceneGeometry(self.scene.integrator().medium, self.scene)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return median depth and opacity along rays (N, 3)."""
        with translate_mitsuba_errors():
            return trace_depth(self.environment, origins, directions)

    def mean(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return expected depth and opacity along rays (N, 3)."""
        with translate_mitsuba_errors():
            return trace_depth(self.environment, origins, directions, kind="expected")

    def within(self, points: np.ndarray) -> np.ndarray:
        """Return whether ``points`` (N, 3) are inside closed shapes, (N,) bool: most visible surfaces show their back.

        Always False for fields and volumes, whose surfaces have no back.
        """
        import mitsuba as mi

        if self.environment.medium is not None or not len(points):
            return np.zeros(len(points), bool)
        around = fibonacci_directions(_AROUND)
        origins, directions = np.repeat(points, _AROUND, axis=0), np.tile(around, (len(points), 1))
        o, d = (np.ascontiguousarray(v.T, np.float32) for v in (origins, directions))
        with translate_mitsuba_errors():
            intersection = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
        hit, normal = np.array(intersection.is_valid()), np.array(intersection.n).T
        back = (hit & ((normal * directions).sum(axis=1) > 0)).reshape(len(points), -1).sum(axis=1)
        return back > 0.5 * _AROUND

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corner (3,) of the scene; of an unbounded field, of its inner cube."""
        bounds = self.environment.bounds()
        assert bounds is not None, "a written scene has bounds"
        return bounds

    def extent(self, *eyes: LookAt | None) -> float:
        """Return the diagonal of a box around the scene and ``eyes``."""
        return self.environment.extent(*(eye.origin for eye in eyes if eye is not None))

    def around(self, eye: LookAt) -> SeenSurfaces:
        """Return what an observer at ``eye`` sees, from the image of the sphere sensor."""
        with translate_mitsuba_errors():
            channels = render_channels(self.scene, self.scene.sensors()[SPHERE], spp=1)
        width, height = PANORAMA
        front, up = level_direction(eye, self.up), self.up / np.linalg.norm(self.up)
        # Frame of the panorama: x to the left, y up, z forward.
        directions = pixel_directions(width, height).reshape(-1, 3) @ np.stack([np.cross(up, front), up, front])
        even = np.where(np.abs(directions @ up) < np.sin(np.radians(35)), _LEVEL, _STEEP)
        attention = even if self.quantity is None else channels.aovs[self.quantity].reshape(-1).astype(float)
        return SeenSurfaces(
            np.asarray(eye.origin, float),
            directions,
            channels.aovs["depth"].reshape(-1).astype(float),
            channels.mask.reshape(-1),
            attention if attention.any() else even,
            pixel_solid_angles(width, height).reshape(-1),
        )


def probe_values() -> dict[str, str]:
    """Return values of `<default>`s for the scene of a `SceneProbe`."""
    sizes = dict(zip(("width", "height", "sphere_width", "sphere_height"), map(str, (*PROBE_SIZE, *PANORAMA))))
    return {**sizes, "radiance": "false", "spp": "1"}


def sees_anything(scene: Any) -> bool:
    """Return whether the first camera of ``scene``, loaded with `probe_values`, sees anything."""
    with translate_mitsuba_errors():
        return bool(render_channels(scene, scene.sensors()[0], spp=1).aovs["opacity"].any())


def turn_to_attention(eye: LookAt, seen: SeenSurfaces) -> LookAt:
    """Turn the observer at ``eye`` to the main direction of attention."""
    towards = seen.main_direction
    at = int(np.argmax(seen.directions @ towards))
    # Inside matter the depth is 0, but a direction needs a length.
    distance = seen.depth[at] if seen.is_hit[at] and seen.depth[at] > 0 else seen.median_depth or 1.0
    return replace(eye, target=eye.origin + distance * towards, up=None)


def find_best_camera(
    probe: SceneProbe, seen: SeenSurfaces | None, frame: PinholeFrame, box: AnyBox | None
) -> ScoredView | None:
    """Return the best overview of what the observer of ``seen`` looks at, or of the whole scene.

    ``box`` is that of a radiance field, None for other scenes.
    """
    mean = None if box is None else probe.mean
    if seen is not None:
        return view_of_observer(probe.trace, frame, seen, mean)
    if box is None:
        return view_of_scene(probe.trace, frame, *probe.bounds(), is_solid=probe.within)
    lower, upper = np.array(box.core.lower), np.array(box.core.upper)
    return view_of_scene(probe.trace, frame, lower, upper, not box.is_contracted, mean)


def find_best_photo(probe: SceneProbe, seen: SeenSurfaces | None, cameras: Sequence[PhotoCamera]) -> PhotoCamera:
    """Return the camera of the photo with the best view of what the observer of ``seen`` looks at, or of the scene.

    Cameras are compared as if all were level and had the lens of the first.
    """
    lens = cameras[0].lens
    origins, targets = (np.array([getattr(c.eye, name) for c in cameras]) for name in ("origin", "target"))
    ahead = targets - origins
    usual = seen.median_depth if seen is not None else float(np.median(probe.trace(origins, ahead)[0]))
    judge = ViewScorer(probe.trace, PinholeFrame(lens.fov, lens.aspect, probe.up), max(usual, 1e-6), seen, probe.mean)
    return cameras[judge.best_index(origins, targets)]


# Relative distance, about a thousand times the resolution of single precision.
_MIN_DISTANCE = 1e-4


def make_upright(eye: LookAt, up: np.ndarray) -> LookAt:
    """Return ``eye`` with an explicit up direction if it looks along ``up``, and with a target at a resolvable
    distance.

    Raises `NergError` if the target is the origin.
    """
    ahead = np.subtract(eye.target, eye.origin)
    if not np.any(np.abs(ahead) > 1e-9 * (1 + np.abs(eye.origin))):
        raise NergError(f"camera position and target are the same; choose another {parameter('target')}")
    nearest = _MIN_DISTANCE * float(np.abs(eye.origin).max())
    if np.linalg.norm(ahead) < nearest:
        eye = replace(eye, target=eye.origin + ahead * (nearest / np.linalg.norm(ahead)))
    if eye.up is None and np.linalg.norm(np.cross(ahead, up)) < 1e-3 * np.linalg.norm(ahead) * np.linalg.norm(up):
        return replace(eye, up=level_direction(eye, up))
    return eye


# ---- The camera of a scene ----


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera: its pose ``eye``, its ``lens``, and a sentence on how they were chosen."""

    eye: LookAt
    lens: Lens
    note: str


@dataclass(frozen=True)
class CameraChoice:
    """What the camera of a written scene is, as in `nerg_mi.environment.scene_file.write_scene`."""

    point: Sequence[float] | None
    target: Sequence[float] | None = None
    first_person: bool = False
    photos: FilePath | None = None
    photo: str | None = None
    allow_outside: bool = False
    fov: float | None = None

    def __post_init__(self) -> None:
        check_point(self.point, parameter("camera"))
        check_point(self.target, parameter("target"))
        if self.photo is not None and self.photos is None:
            raise NergError(
                f"{parameter('photo')} needs the photos of the training; add {parameter('photos', 'DATASET')}"
            )
        choices = [self.point is not None, self.photos is not None, self.first_person]
        if sum(choices) > 1 or (self.target is not None and self.point is None):
            raise NergError(
                f"the camera is set by {parameter('camera')} and {parameter('target')}, by {parameter('photos')} or by "
                f"{parameter('first_person', True)}; give one of these"
            )

    def place(
        self,
        environment: Environment,
        observer: LookAt | None,
        probe: SceneProbe,
        seen: SeenSurfaces | None,
        reporter: Reporter,
    ) -> PlacedCamera:
        """Return the camera in the scene of ``probe``. The ``observer`` sees ``seen``; both are None without one."""
        if self.photos is not None:
            return self._take_photo(to_path(self.photos), environment.provenance, probe, seen, reporter)
        lens = Lens() if self.fov is None else Lens(self.fov)
        origin, target = check_point(self.point, parameter("camera")), check_point(self.target, parameter("target"))
        if origin is not None:
            if target is None:
                target = None if seen is None else seen.mean_target()
            if target is None:
                target = np.mean(probe.bounds(), axis=0)
            return PlacedCamera(LookAt(origin, target), lens, "The camera of sensor 0, and its target.")
        if self.first_person or (observer is not None and not environment.has_surfaces):
            if observer is None:
                raise NergError(
                    f"{parameter('first_person', True)} needs an observer; add {parameter('observer')} or "
                    f"{parameter('person')}"
                )
            return PlacedCamera(observer, lens, "The camera of sensor 0: the observer's eye.")
        if environment.kind in ("field", "splats") and seen is None:
            reporter.message(
                f"a field looks best from the positions of its photos: {parameter('photos', 'DATASET')} uses the "
                "camera of one of them"
            )
        return _find_overview(environment, probe, seen, lens)

    def _take_photo(
        self,
        photos: Path,
        provenance: Mapping[str, Any],
        probe: SceneProbe,
        seen: SeenSurfaces | None,
        reporter: Reporter,
    ) -> PlacedCamera:
        """Return the camera of a photo of the training with this ``provenance``."""
        if self.photo is None:
            photo = find_best_photo(probe, seen, load_photo_cameras(photos, provenance, self.allow_outside))
            words = f"that of the photo {photo.name}, which has the best view"
        else:
            photo = load_photo_camera(photos, self.photo, provenance, self.allow_outside)
            words = f"that of the photo {photo.name}"
        if photo.has_distortion:
            reporter.message(f"the lens of {photo.name} has distortion, which this camera has not")
        lens = photo.lens if self.fov is None else replace(photo.lens, fov=self.fov)
        return PlacedCamera(photo.eye, lens, f"The camera of sensor 0: {words}.")


def _find_overview(environment: Environment, probe: SceneProbe, seen: SeenSurfaces | None, lens: Lens) -> PlacedCamera:
    """Return the camera with the best overview. Raises `NergError` if none sees the scene."""
    box = None if environment.radiance is None else environment.radiance.network.box
    shot = find_best_camera(probe, seen, PinholeFrame(lens.fov, lens.aspect, probe.up), box)
    if shot is None:
        raise NergError(
            f"no camera position with a view of the scene was found; set one with {parameter('camera')} and "
            f"{parameter('target')}"
        )
    whose = "what the observer looks at" if probe.quantity else "the surroundings of the observer"
    attended = "" if shot.attention_share is None else f" and {100 * shot.attention_share:.0f} % of {whose}"
    words = f"The camera of sensor 0: the best overview; it shows surfaces in {100 * shot.surface_fraction:.0f} %"
    return PlacedCamera(LookAt(shot.origin, shot.target), lens, f"{words} of the image{attended}.")
