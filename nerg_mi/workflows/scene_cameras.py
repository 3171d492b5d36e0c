"""Cameras and observers of a written scene: overviews, and positions of participants in rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.figures.overview import PinholeFrame, ScoredView, SeenSurfaces, ViewScorer, view_of_observer, view_of_scene
from nerg_mi.files.values import find_names
from nerg_mi.maths.geometry import Similarity, box_from_dict
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.scene_writer import LookAt, level_direction
from nerg_mi.transport.geometry import SceneGeometry, pixel_directions, pixel_solid_angles, trace_depth

from .scene_environments import PhotoCamera

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
    probe: SceneProbe, seen: SeenSurfaces | None, frame: PinholeFrame, field_box: dict | None
) -> ScoredView | None:
    """Return the best overview of what the observer of ``seen`` looks at, or of the whole scene.

    ``field_box`` is the stored box of a radiance field, None for other scenes.
    """
    mean = None if field_box is None else probe.mean
    if seen is not None:
        return view_of_observer(probe.trace, frame, seen, mean)
    if field_box is None:
        return view_of_scene(probe.trace, frame, *probe.bounds(), is_solid=probe.within)
    box = box_from_dict(field_box)
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


def check_point(values: tuple[float, ...] | None, option: str) -> np.ndarray | None:
    """Return the three numbers of ``option`` as an array (3,), or None. Raises `NergError` for another count."""
    if values is None:
        return None
    if len(values) != 3:
        raise NergError(f"{option} must be three numbers x,y,z, got {','.join(f'{v:g}' for v in values)}")
    return np.array(values, float)


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


# ---- Observers: persons in rays, or the position with most rays ----


RADIUS = 0.5
"""Radius in metres within which ray origins count as one position."""

MAX_FRAMES = 100_000
"""Maximum number of frames of a walk."""


@dataclass(frozen=True)
class ObserverPath:
    """Positions of a person at equidistant times: ``eyes`` at ``times`` (F,) in seconds.

    ``missing`` is the number of frames without data.
    """

    times: np.ndarray
    eyes: list[LookAt]
    missing: int


def find_eye(rays: Rays, person: str, time: float, gap: float, align: Similarity) -> tuple[LookAt, float]:
    """Return the eye of ``person`` in the scene at the ray nearest to ``time`` (seconds), and the time of that ray.

    ``align`` transforms from the rays to the scene. Raises `NergError` for an unknown person, and if there is no ray
    within ``gap`` seconds.
    """
    rows = _find_person_rows(rays, person)
    nearest = rows[np.argmin(np.abs(rays.t[rows] - time))]
    if abs(rays.t[nearest] - time) > gap:
        raise NergError(_describe_missing(rays, rows, person, f"at {time:g} s", gap))
    (eye,) = _make_eyes(rays.origin[nearest : nearest + 1], rays.direction[nearest : nearest + 1], align)
    return eye, float(rays.t[nearest])


def interpolate_walk(
    rays: Rays, person: str, first: float, last: float, fps: float, gap: float, align: Similarity
) -> ObserverPath:
    """Interpolate the eye of ``person`` from ``first`` to ``last`` (seconds) at ``fps`` frames per second.

    Positions are interpolated linearly between two rays, directions by their weighted mean. There is no frame between
    rays that are more than ``gap`` seconds apart, or farther than that from the first or last ray. Raises `NergError`
    if there is no frame.
    """
    if not first < last:
        raise NergError(f"{parameter('time_range')} must be two times, the earlier first, got {first:g},{last:g}")
    if (last - first) * fps > MAX_FRAMES:
        raise NergError(
            f"a walk can have at most {MAX_FRAMES:,} frames, and {last - first:g} s at {fps:g} frames per second "
            f"have more; reduce {parameter('fps')}, or the time range"
        )
    rows = _find_person_rows(rays, person)
    rows = rows[np.argsort(rays.t[rows], kind="stable")]
    times = first + np.arange(int(np.floor((last - first) * fps + 1e-9)) + 1) / fps
    t = rays.t[rows]
    after = np.searchsorted(t, times)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(rows) - 1)
    between = t[after] - t[before]
    outside = np.maximum(t[before] - times, times - t[after])
    # A time of a ray needs no interpolation.
    valid = ((between <= gap) & (outside <= gap)) | (t[after] == times)
    if not valid.any():
        raise NergError(_describe_missing(rays, rows, person, f"from {first:g} to {last:g} s", gap))
    share = np.clip(np.divide(times - t[before], between, out=np.zeros(len(times)), where=between > 0), 0, 1)[:, None]
    mix = lambda values: values[rows[before]] * (1 - share) + values[rows[after]] * share
    origin, direction = mix(rays.origin)[valid], mix(rays.direction)[valid]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    # Opposite directions have no mean: use that of the nearer ray.
    nearer = np.where(share < 0.5, rays.direction[rows[before]], rays.direction[rows[after]])[valid]
    direction = np.where(length > 1e-3, direction / np.maximum(length, 1e-3), nearer)
    return ObserverPath(times[valid], _make_eyes(origin, direction, align), int(np.sum(~valid)))


def support_of_rays(rays: Rays) -> RaySupport:
    """Return the support of rays at each position, in metres of their frame."""
    return RaySupport.from_origins(rays.origin, RADIUS)


def to_scene_frame(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Transform points (..., 3) from the frame of the rays to that of the scene."""
    return np.asarray(points, float) @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def _find_person_rows(rays: Rays, person: str) -> np.ndarray:
    """Return the indices of the rays of ``person``."""
    rows = np.flatnonzero(rays.person == find_names([person], rays.persons, "person")[0])
    if not len(rows):
        raise NergError(f'"{person}" has no rays; choose another person')
    return rows


def _describe_missing(rays: Rays, rows: np.ndarray, person: str, when: str, gap: float) -> str:
    first, last = float(rays.t[rows].min()), float(rays.t[rows].max())
    return (
        f'there is no ray of "{person}" within {gap:g} s {when}; its rays are from {first:.10g} to {last:.10g} s; '
        f"increase {parameter('max_gap')} to bridge longer pauses"
    )


def _make_eyes(origins: np.ndarray, directions: np.ndarray, align: Similarity) -> list[LookAt]:
    """Return eyes in scene coordinates with targets one metre ahead."""
    at, ahead = to_scene_frame(origins, align), to_scene_frame(origins + directions, align)
    return [LookAt(origin, target) for origin, target in zip(at, ahead)]
