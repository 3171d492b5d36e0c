"""From where a scene is shown: what an observer meets around, and the best camera for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.figures.overview import Frame, Judge, Seen, Shot, around_observer, of_place
from nerg_mi.maths.geometry import box_of
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.scene_writer import Eye, ahead_level
from nerg_mi.transport.geometry import Place, pixel_directions, pixel_solid_angles, trace_depth

from .photos import PhotoCamera

GLANCE = (48, 32)
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
class Probe:
    """A scene as it is before its camera is chosen, loaded to look around in: ``scene``; ``quantity``: the AOV of
    attention, or None; ``up`` (3,)."""

    scene: Any
    quantity: str | None
    up: np.ndarray

    @property
    def place(self) -> Place:
        """What its rays meet."""
        return Place(self.scene.integrator().medium, self.scene)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Median depth, and opacity, along rays (N, 3)."""
        with mitsuba_says():
            return trace_depth(self.place, origins, directions)

    def mean(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean depth at which light ends, and opacity, along rays (N, 3)."""
        with mitsuba_says():
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
        with mitsuba_says():
            found = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
        met, normal = np.array(found.is_valid()), np.array(found.n).T
        back = (met & ((normal * directions).sum(axis=1) > 0)).reshape(len(points), -1).sum(axis=1)
        return back > 0.5 * _AROUND

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of what there is; of a field without an end those of its inner cube."""
        bounds = self.place.bounds()
        assert bounds is not None, "a scene that is written shows something"
        return bounds

    def extent(self, *eyes: Eye | None) -> float:
        """Length of the diagonal of a box around what there is and ``eyes``."""
        return self.place.extent(*(eye.origin for eye in eyes if eye is not None))

    def around(self, eye: Eye) -> Seen:
        """What somebody at ``eye`` meets, as the sensor of the sphere shows it."""
        with mitsuba_says():
            found = render_channels(self.scene, self.scene.sensors()[SPHERE], spp=1)
        width, height = PANORAMA
        front, up = ahead_level(eye, self.up), self.up / np.linalg.norm(self.up)
        # The panorama's own frame: x to the left, y up, z to the front.
        directions = pixel_directions(width, height).reshape(-1, 3) @ np.stack([np.cross(up, front), up, front])
        even = np.where(np.abs(directions @ up) < np.sin(np.radians(35)), _LEVEL, _STEEP)
        attention = even if self.quantity is None else found.aovs[self.quantity].reshape(-1).astype(float)
        return Seen(
            np.asarray(eye.origin, float),
            directions,
            found.aovs["depth"].reshape(-1).astype(float),
            found.mask.reshape(-1),
            attention if attention.any() else even,
            pixel_solid_angles(width, height).reshape(-1),
        )


def probe_values() -> dict[str, str]:
    """Values of `<default>`s for the scene of a `Probe`."""
    sizes = dict(zip(("width", "height", "sphere_width", "sphere_height"), map(str, (*GLANCE, *PANORAMA))))
    return {**sizes, "radiance": "false", "spp": "1"}


def shows_anything(scene: Any) -> bool:
    """Whether the first camera of ``scene``, loaded with `probe_values`, sees anything at all."""
    with mitsuba_says():
        return bool(render_channels(scene, scene.sensors()[0], spp=1).aovs["opacity"].any())


def turned_ahead(eye: Eye, seen: Seen) -> Eye:
    """The observer at ``eye``, turned to where most of the attention goes."""
    towards = seen.main_direction
    at = int(np.argmax(seen.directions @ towards))
    # An observer within matter meets it at once, and a direction needs a length.
    away = seen.depth[at] if seen.met[at] and seen.depth[at] > 0 else seen.usual or 1.0
    return replace(eye, target=eye.origin + away * towards, up=None)


def best_camera(probe: Probe, seen: Seen | None, frame: Frame, field_box: dict | None) -> Shot | None:
    """The best overview: of what the observer of ``seen`` looks at, or of the whole place. ``field_box``: the box of
    the radiance field, as its checkpoint has it, or None where the place is none."""
    mean = None if field_box is None else probe.mean
    if seen is not None:
        return around_observer(probe.trace, frame, seen, mean)
    if field_box is None:
        return of_place(probe.trace, frame, *probe.bounds(), solid=probe.within)
    box = box_of(field_box)
    lower, upper = np.array(box.core.lower), np.array(box.core.upper)
    return of_place(probe.trace, frame, lower, upper, not box.contracted, mean)


def best_photo(probe: Probe, seen: Seen | None, cameras: Sequence[PhotoCamera]) -> PhotoCamera:
    """That of the ``cameras`` of photos which shows best what the observer of ``seen`` looks at, or the place. They are
    compared as if all had the lens of the first and were held level."""
    lens = cameras[0].lens
    origins, targets = (np.array([getattr(c.eye, name) for c in cameras]) for name in ("origin", "target"))
    ahead = targets - origins
    usual = seen.usual if seen is not None else float(np.median(probe.trace(origins, ahead)[0]))
    judge = Judge(probe.trace, Frame(lens.fov, lens.aspect, probe.up), max(usual, 1e-6), seen, probe.mean)
    return cameras[judge.best_of(origins, targets)]


def given_point(values: tuple[float, ...] | None, option: str) -> np.ndarray | None:
    """Three numbers that were given by ``option``, (3,), or None. Raises `NergError` for other ones."""
    if values is None:
        return None
    if len(values) != 3:
        raise NergError(f"{option} is three numbers x,y,z, got {','.join(f'{v:g}' for v in values)}")
    return np.array(values, float)


# Share of a coordinate that is some thousand times what single precision resolves of it.
_APART = 1e-4


def upright(eye: Eye, up: np.ndarray) -> Eye:
    """``eye`` with an up of its own where it looks straight up or down, along ``up``, and with a target so far ahead
    that single precision tells it from the origin. Raises `NergError` for one that looks at where it is."""
    ahead = np.subtract(eye.target, eye.origin)
    if not np.any(np.abs(ahead) > 1e-9 * (1 + np.abs(eye.origin))):
        raise NergError("a camera cannot look at the point at which it stands; give --to another one")
    nearest = _APART * float(np.abs(eye.origin).max())
    if np.linalg.norm(ahead) < nearest:
        eye = replace(eye, target=eye.origin + ahead * (nearest / np.linalg.norm(ahead)))
    if eye.up is None and np.linalg.norm(np.cross(ahead, up)) < 1e-3 * np.linalg.norm(ahead) * np.linalg.norm(up):
        return replace(eye, up=ahead_level(eye, up))
    return eye
