"""Cameras and observers of a written scene: views of a place, and people of rays at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, translate_mitsuba_errors, sanitize
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.figures.overview import ViewScorer, PinholeFrame, SeenSurfaces, CameraView, view_of_observer, view_of_scene
from nerg_mi.maths.geometry import Similarity, box_from_dict
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.scene_writer import LookAt, level_direction
from nerg_mi.transport.geometry import SceneGeometry, pixel_directions, pixel_solid_angles, trace_depth

from .scene_places import PhotoCamera

# ---- From where a scene is shown: what an observer meets around, and the best camera for it ----


PROBE_SIZE = (48, 32)
"""Pixels of the picture by which it is found out whether a camera shows anything."""

PANORAMA = (96, 48)
"""Pixels of the picture of what an observer meets."""

SPHERE = 2
"""Number of the sensor that takes it."""

# Directions in which it is found out whether a point lies inside of a shape.
_AROUND = 32
# Where nothing is known of attention: how much more level directions count than those beyond 35 degrees.
_LEVEL, _STEEP = 1.0, 0.2


@dataclass(frozen=True, eq=False)
class SceneProbe:
    """A scene as it is before its camera is chosen, loaded to look around in: ``scene``; ``quantity``: the AOV of
    attention, or None; ``up`` (3,)."""

    scene: Any
    quantity: str | None
    up: np.ndarray

    @property
    def place(self) -> SceneGeometry:
        """What its rays meet."""
        return SceneGeometry(self.scene.integrator().medium, self.scene)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Median depth, and opacity, along rays (N, 3)."""
        with translate_mitsuba_errors():
            return trace_depth(self.place, origins, directions)

    def mean(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean depth at which light ends, and opacity, along rays (N, 3)."""
        with translate_mitsuba_errors():
            return trace_depth(self.place, origins, directions, kind="expected")

    def within(self, points: np.ndarray) -> np.ndarray:
        """Whether ``points`` (N, 3) lie inside closed shapes: most of what they see are backs of surfaces. (N,) bool;
        nowhere where a field or volumes are marched, whose surfaces have no backs."""
        import mitsuba as mi

        if self.place.medium is not None or not len(points):
            return np.zeros(len(points), bool)
        around = fibonacci_directions(_AROUND)
        origins, directions = np.repeat(points, _AROUND, axis=0), np.tile(around, (len(points), 1))
        o, d = (np.ascontiguousarray(v.T, np.float32) for v in (origins, directions))
        with translate_mitsuba_errors():
            found = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
        met, normal = np.array(found.is_valid()), np.array(found.n).T
        back = (met & ((normal * directions).sum(axis=1) > 0)).reshape(len(points), -1).sum(axis=1)
        return back > 0.5 * _AROUND

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of what there is; of a field without an end those of its inner cube."""
        bounds = self.place.bounds()
        assert bounds is not None, "a scene that is written shows something"
        return bounds

    def extent(self, *eyes: LookAt | None) -> float:
        """Length of the diagonal of a box around what there is and ``eyes``."""
        return self.place.extent(*(eye.origin for eye in eyes if eye is not None))

    def around(self, eye: LookAt) -> SeenSurfaces:
        """What somebody at ``eye`` meets, as the sensor of the sphere shows it."""
        with translate_mitsuba_errors():
            found = render_channels(self.scene, self.scene.sensors()[SPHERE], spp=1)
        width, height = PANORAMA
        front, up = level_direction(eye, self.up), self.up / np.linalg.norm(self.up)
        # The panorama's own frame: x to the left, y up, z to the front.
        directions = pixel_directions(width, height).reshape(-1, 3) @ np.stack([np.cross(up, front), up, front])
        even = np.where(np.abs(directions @ up) < np.sin(np.radians(35)), _LEVEL, _STEEP)
        attention = even if self.quantity is None else found.aovs[self.quantity].reshape(-1).astype(float)
        return SeenSurfaces(
            np.asarray(eye.origin, float),
            directions,
            found.aovs["depth"].reshape(-1).astype(float),
            found.mask.reshape(-1),
            attention if attention.any() else even,
            pixel_solid_angles(width, height).reshape(-1),
        )


def probe_values() -> dict[str, str]:
    """Values of `<default>`s for the scene of a `Probe`."""
    sizes = dict(zip(("width", "height", "sphere_width", "sphere_height"), map(str, (*PROBE_SIZE, *PANORAMA))))
    return {**sizes, "radiance": "false", "spp": "1"}


def sees_anything(scene: Any) -> bool:
    """Whether the first camera of ``scene``, loaded with `probe_values`, sees anything at all."""
    with translate_mitsuba_errors():
        return bool(render_channels(scene, scene.sensors()[0], spp=1).aovs["opacity"].any())


def turn_to_attention(eye: LookAt, seen: SeenSurfaces) -> LookAt:
    """The observer at ``eye``, turned to where most of the attention goes."""
    towards = seen.main_direction
    at = int(np.argmax(seen.directions @ towards))
    # An observer within matter meets it at once, and a direction needs a length.
    away = seen.depth[at] if seen.is_hit[at] and seen.depth[at] > 0 else seen.median_depth or 1.0
    return replace(eye, target=eye.origin + away * towards, up=None)


def find_best_camera(probe: SceneProbe, seen: SeenSurfaces | None, frame: PinholeFrame, field_box: dict | None) -> CameraView | None:
    """The best overview: of what the observer of ``seen`` looks at, or of the whole place. ``field_box``: the box of
    the radiance field, as its checkpoint has it, or None where the place is none."""
    mean = None if field_box is None else probe.mean
    if seen is not None:
        return view_of_observer(probe.trace, frame, seen, mean)
    if field_box is None:
        return view_of_scene(probe.trace, frame, *probe.bounds(), is_solid=probe.within)
    box = box_from_dict(field_box)
    lower, upper = np.array(box.core.lower), np.array(box.core.upper)
    return view_of_scene(probe.trace, frame, lower, upper, not box.is_contracted, mean)


def find_best_photo(probe: SceneProbe, seen: SeenSurfaces | None, cameras: Sequence[PhotoCamera]) -> PhotoCamera:
    """That of the ``cameras`` of photos which shows best what the observer of ``seen`` looks at, or the place. They are
    compared as if all had the lens of the first and were held level."""
    lens = cameras[0].lens
    origins, targets = (np.array([getattr(c.eye, name) for c in cameras]) for name in ("origin", "target"))
    ahead = targets - origins
    usual = seen.median_depth if seen is not None else float(np.median(probe.trace(origins, ahead)[0]))
    judge = ViewScorer(probe.trace, PinholeFrame(lens.fov, lens.aspect, probe.up), max(usual, 1e-6), seen, probe.mean)
    return cameras[judge.best_index(origins, targets)]


def check_point(values: tuple[float, ...] | None, option: str) -> np.ndarray | None:
    """Three numbers that were given by ``option``, (3,), or None. Raises `NergError` for other ones."""
    if values is None:
        return None
    if len(values) != 3:
        raise NergError(f"{option} is three numbers x,y,z, got {','.join(f'{v:g}' for v in values)}")
    return np.array(values, float)


# Share of a coordinate that is some thousand times what single precision resolves of it.
_APART = 1e-4


def make_upright(eye: LookAt, up: np.ndarray) -> LookAt:
    """``eye`` with an up of its own where it looks straight up or down, along ``up``, and with a target so far ahead
    that single precision tells it from the origin. Raises `NergError` for one that looks at where it is."""
    ahead = np.subtract(eye.target, eye.origin)
    if not np.any(np.abs(ahead) > 1e-9 * (1 + np.abs(eye.origin))):
        raise NergError("a camera cannot look at the point at which it stands; give --to another one")
    nearest = _APART * float(np.abs(eye.origin).max())
    if np.linalg.norm(ahead) < nearest:
        eye = replace(eye, target=eye.origin + ahead * (nearest / np.linalg.norm(ahead)))
    if eye.up is None and np.linalg.norm(np.cross(ahead, up)) < 1e-3 * np.linalg.norm(ahead) * np.linalg.norm(up):
        return replace(eye, up=level_direction(eye, up))
    return eye


# ---- Who looks, and where: people of the rays, or the place where most of them were ----


RADIUS = 0.5
"""Rays that started within so many metres of each other are counted as of one place."""

MAX_FRAMES = 100_000
"""A walk may have so many frames."""

_NAMED = 8


@dataclass(frozen=True)
class ObserverPath:
    """Where somebody was, and looked, at moments of equal distance: ``eyes`` of each frame, at ``times`` (F,) in
    seconds; ``missing``: how many more frames there would be where nothing is known of them."""

    times: np.ndarray
    eyes: list[LookAt]
    missing: int


def find_eye(rays: Rays, person: str, time: float, gap: float, align: Similarity) -> tuple[LookAt, float]:
    """The eye of ``person`` in the place at the ray nearest to ``time`` (seconds), and when that was.

    ``align``: from the rays to the place. Raises `NergError` where there is nobody of that name, and no ray of theirs
    within ``gap`` seconds.
    """
    own = _own(rays, person)
    nearest = own[np.argmin(np.abs(rays.t[own] - time))]
    if abs(rays.t[nearest] - time) > gap:
        raise NergError(_not_then(rays, own, person, f"at {time:g} s", gap))
    (eye,) = _eyes(rays.origin[nearest : nearest + 1], rays.direction[nearest : nearest + 1], align)
    return eye, float(rays.t[nearest])


def interpolate_walk(
    rays: Rays, person: str, first: float, last: float, fps: float, gap: float, align: Similarity
) -> ObserverPath:
    """Where ``person`` was from ``first`` to ``last`` (seconds), ``fps`` times a second.

    Positions are linear between two rays, directions the mean of theirs, weighted alike. A moment between two rays
    that are more than ``gap`` seconds apart has no frame, nor has one that is farther than that from the first or the
    last ray. Raises `NergError` where no frame is left.
    """
    if not first < last:
        raise NergError(f"--times is two times, the earlier first, got {first:g},{last:g}")
    if (last - first) * fps > MAX_FRAMES:
        raise NergError(
            f"a walk has at most {MAX_FRAMES:,} frames, and {last - first:g} s with {fps:g} frames a second have "
            "more; give a smaller --fps, or a shorter time"
        )
    own = _own(rays, person)
    own = own[np.argsort(rays.t[own], kind="stable")]
    times = first + np.arange(int(np.floor((last - first) * fps + 1e-9)) + 1) / fps
    t = rays.t[own]
    after = np.searchsorted(t, times)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(own) - 1)
    between = t[after] - t[before]
    outside = np.maximum(t[before] - times, times - t[after])
    # A moment of a ray is not between any.
    known = ((between <= gap) & (outside <= gap)) | (t[after] == times)
    if not known.any():
        raise NergError(_not_then(rays, own, person, f"from {first:g} to {last:g} s", gap))
    share = np.clip(np.divide(times - t[before], between, out=np.zeros(len(times)), where=between > 0), 0, 1)[:, None]
    mix = lambda values: values[own[before]] * (1 - share) + values[own[after]] * share
    origin, direction = mix(rays.origin)[known], mix(rays.direction)[known]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    # Two opposite directions have no mean: that of the nearer ray.
    nearer = np.where(share < 0.5, rays.direction[own[before]], rays.direction[own[after]])[known]
    direction = np.where(length > 1e-3, direction / np.maximum(length, 1e-3), nearer)
    return ObserverPath(times[known], _eyes(origin, direction, align), int(np.sum(~known)))


def support_of_rays(rays: Rays) -> RaySupport:
    """How many rays started where, in metres of their own frame."""
    return RaySupport.from_origins(rays.origin, RADIUS)


def to_scene_frame(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Points (..., 3) of the rays' frame in the place's."""
    return np.asarray(points, float) @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def _own(rays: Rays, person: str) -> np.ndarray:
    """Indices of the rays of ``person``."""
    if person not in rays.persons:
        some = ", ".join(sanitize(name, 40) for name in rays.persons[:_NAMED])
        more = "" if len(rays.persons) <= _NAMED else f" and {len(rays.persons) - _NAMED} more"
        raise NergError(f'nobody in the rays is called "{person}"; they are of {some}{more}')
    own = np.flatnonzero(rays.person == rays.persons.index(person))
    if not len(own):
        raise NergError(f'"{person}" has no rays any more; choose somebody else')
    return own


def _not_then(rays: Rays, own: np.ndarray, person: str, when: str, gap: float) -> str:
    first, last = float(rays.t[own].min()), float(rays.t[own].max())
    return (
        f'there is no ray of "{person}" within {gap:g} s {when}; theirs are from {first:.10g} to {last:.10g} s, and '
        "--gap bridges longer pauses"
    )


def _eyes(origins: np.ndarray, directions: np.ndarray, align: Similarity) -> list[LookAt]:
    """Eyes in the place, which look at points a metre away."""
    at, ahead = to_scene_frame(origins, align), to_scene_frame(origins + directions, align)
    return [LookAt(origin, target) for origin, target in zip(at, ahead)]
