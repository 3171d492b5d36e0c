"""The observer: where one stands, what is visible from there, and the views that are cached for each."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Ray3f, Vector3f, variant_types

from .geometry import SceneGeometry
from .jit import Fingerprint, of_shapes, recording
from .march_primal import MarchSettings

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Cache ----
#
# What is known of observers: made once for each, and kept between frames.
#
# An observer stays where they are for many pixels and often for many frames, and what they see all around (depths, a
# map, the integral of a gaze field, the rays that started near them) costs more than a frame. All of it is kept here,
# under one rule: it serves the same position to the bit, for as long as what it was made of is the same. That is told
# by the identity of arrays (``fingerprint``), so that nothing has to be invalidated by whoever changes a parameter;
# ``forget`` is for changes that no array shows.


@dataclass(frozen=True)
class Known:
    """``value``: what was made for the observer at ``center`` (one lane, without derivatives)."""

    center: Point3f
    value: Any


# Observers whose numbers are kept.
_MANY = 256
_Position = tuple[float, float, float]


@dataclass(frozen=True)
class _Kept:
    """What is known of a thing, by observers' positions, the last asked for at the end."""

    made_of: Any
    known: dict[_Position, Known]


class ObserverCache:
    """The cache of one integrator, or of whoever evaluates gaze for several observers in turn.

    Of each thing the entries of those observers are kept who were asked for last; of numbers those of many more, in
    ``numbers`` where that is given: a cache that outlives this one.
    """

    def __init__(self, numbers: ObserverCache | None = None) -> None:
        self._kept: dict[Hashable, _Kept] = {}
        self._numbers = numbers or self

    def get_or_compute_each(
        self, thing: Hashable, observers: list[Point3f], made_of: Any, make: Callable[[Point3f], Any]
    ) -> list[Known]:
        """For each of ``observers`` (one lane each) what ``make(center)`` makes, or made before.

        ``thing``: what it is and whose. ``made_of``: what it depends on besides the position, comparable with ``==``
        (settings, a ``Fingerprint``). While a function is being recorded by ``dr.freeze`` nothing is looked up, and
        nothing that is made is kept: it belongs to the recording.
        """
        known = [Known(_detached(p_o), None) for p_o in observers]
        return self.of_known(thing, known, made_of, lambda k: make(k.center))

    def of_known(self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any]) -> list[Known]:
        """For each of ``known`` what ``make`` makes of it, or made before; otherwise as ``get_or_compute_each``."""
        return self._of_known(thing, known, made_of, make, 0)

    def of_numbers(
        self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any]
    ) -> list[Known]:
        """``of_known`` of what is a few numbers for each observer, so that those of 256 who are asked for no more are
        kept, too."""
        return self._numbers._of_known(thing, known, made_of, make, _MANY)

    def _of_known(
        self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any], others: int
    ) -> list[Known]:
        if recording():
            return [Known(k.center, make(k)) for k in known]
        kept = self._kept.get(thing)
        before = kept.known if kept is not None and kept.made_of == made_of else {}
        asked: dict[_Position, Known] = {}
        out = []
        for k in known:
            # Read one by one: an array of the three would take a kernel of its own.
            position = k.center.x[0], k.center.y[0], k.center.z[0]
            if position not in asked:
                asked[position] = before[position] if position in before else Known(k.center, make(k))
            out.append(asked[position])
        rest = [(position, k) for position, k in before.items() if position not in asked]
        self._kept[thing] = _Kept(made_of, dict(rest[-others:] if others else []) | asked)
        return out

    def peek(self, thing: Hashable) -> list[Known]:
        """What is kept of ``thing``, without making any."""
        kept = self._kept.get(thing)
        return [] if kept is None else list(kept.known.values())

    def clear(self) -> None:
        """Drop everything: something has changed that no array shows."""
        self._kept.clear()


def fingerprint_of(place: SceneGeometry) -> tuple[Fingerprint, Fingerprint]:
    """Of all that rays meet in ``place``: its shapes and its medium's arrays."""
    values = [] if place.medium is None else [v for v in place.medium.parameters() if dr.is_array_v(v)]
    return of_shapes(place), Fingerprint(values)


def _detached(p_o: Point3f) -> Point3f:
    center = type(p_o)(dr.detach(p_o))
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    return center


# ---- How an observer's rays are traced, and what they decide ----

VISIBILITIES = ("depth", "transmittance", "map")
DIRECTIONS = 1 << 17
"""Of an integral over an observer's sphere at most: enough for a thousandth at depths that jump from surface to
surface."""


@dataclass(frozen=True, kw_only=True)
class ObserverSettings:
    """Settings of everything that is traced from an observer; lengths in scene units."""

    # Of the rays through a medium.
    march: MarchSettings
    # Kind of the depth at which a ray meets its surface (``march.depth.KINDS``).
    depth: str = "median"
    # Opacity from which on a ray meets a surface.
    surface_opacity: float = 0.5
    # One of ``VISIBILITIES``: what decides whether a point is hidden.
    visibility: str = "depth"
    # How far apart two ideas of one surface may be; 0 for two steps (without a medium, for a share of the scene).
    tolerance: float = 0.0
    # Rows of a map; it has twice as many columns.
    map_height: int = 512
    # Directions, at most, of the integral that a normalised gaze field is divided by.
    directions: int = DIRECTIONS
    # Error of that integral, as a share of it, below which fewer will do; 0: always as many.
    integral_tolerance: float = 5e-3

    @property
    def surfaces(self) -> tuple:
        """What decides where a ray meets a surface."""
        return self.march, self.depth, self.surface_opacity


# ---- Where a camera's, or an observer's, eye is, and where a point lies from there ----
#
# The eye is the centre of the sensor, not the origin of its rays: Mitsuba starts those at the near plane.

_CENTERED = {"PerspectiveCamera", "ThinLensCamera", "Panorama", "RadianceMeter"}


def sensor_center(sensor: mi.Sensor) -> Point3f:
    """Centre of ``sensor`` in the scene (one lane); attached to its ``to_world``."""
    return cast("Any", sensor).world_transform() @ variant_types().Point3f(0)


def is_batch(sensor: mi.Sensor) -> bool:
    """Whether ``sensor`` consists of several."""
    return _kind(sensor) == "BatchSensor"


def _members(sensor: mi.Sensor) -> list[mi.Sensor]:
    """The sensors that ``sensor`` consists of: itself, or those of a batch."""
    if not is_batch(sensor):
        return [sensor]
    import mitsuba as mi

    found = []

    class SensorCollector(mi.TraversalCallback):
        def put(self, name, value, *rest):
            if isinstance(value, mi.Sensor):
                found.extend(_members(value))

    sensor.traverse(SensorCollector())
    return found


def _kind(sensor: mi.Sensor) -> str:
    # Sensors written in Python carry their own class name.
    name = type(sensor).__name__
    return sensor.class_name() if name in ("Sensor", "ProjectiveCamera") else name


def check_center(sensor: mi.Sensor, role: str) -> None:
    """Raise ``ValueError`` when ``sensor`` (called ``role`` in the message) has no single centre."""
    if _kind(sensor) not in _CENTERED:
        raise NergError(
            f"{role} is a {_kind(sensor)}, which has no centre to look from: "
            'give the integrator an explicit "observer" such as a perspective sensor'
        )


def same_center(sensors: Sequence[mi.Sensor], p_o: Point3f) -> bool:
    """Whether every sensor's centre is exactly ``p_o`` (which costs a look at both values).

    False while a function is recorded by ``dr.freeze``: it will be replayed wherever they stand then.
    """
    if recording():
        return False
    centers = [sensor_center(m) for s in sensors for m in _members(s) if _kind(m) in _CENTERED]
    count = sum(len(_members(s)) for s in sensors)
    return len(centers) == count > 0 and all(bool(dr.all(dr.detach(c) == dr.detach(p_o))) for c in centers)


def centers(sensors: Sequence[mi.Sensor]) -> list[Point3f]:
    """Centre of each of ``sensors`` and of the members of batches."""
    return [sensor_center(m) for s in sensors for m in _members(s)]


def center_of_ray(sensors: Sequence[mi.Sensor], ray: Ray3f) -> Point3f:
    """Centre of the one of ``sensors`` that ``ray`` comes from.

    A ray belongs to the camera on whose axis-aligned near plane it starts and through whose centre
    its line passes, which tells the members of a batch apart.
    """
    members = [m for s in sensors for m in _members(s)]
    for member in members:
        check_center(member, "the rendering sensor")
    if not members:
        raise NergError('there is no sensor to take the observer from: give the integrator an "observer"')
    best = sensor_center(members[0])
    if len(members) == 1:
        return best
    mi = variant_types()
    miss = mi.Float(dr.inf)
    for member in members:
        c = sensor_center(member)
        v = ray.o - c
        along = dr.dot(v, ray.d)
        off_line = dr.norm(v - ray.d * along)
        axis = dr.normalize(cast("Any", member).world_transform() @ mi.Vector3f(0, 0, 1))
        # Only projective cameras have a near plane; others start at their centre.
        near = cast("Any", member).near_clip() if isinstance(member, mi.ProjectiveCamera) else 0
        off_plane = dr.abs(dr.dot(v, axis) - near)
        error = dr.detach(off_line + off_plane)
        closer = error < miss
        best = dr.select(closer, c, best)
        miss = dr.select(closer, error, miss)
    return best


def distance_and_direction(p_o: Point3f, p: Point3f) -> tuple[Float, Vector3f]:
    """Distance and unit direction from ``p_o`` to ``p``, finite with their derivatives where both coincide."""
    v = p - p_o
    square = dr.squared_norm(v)
    # Nearer than 1e-15 units the derivative of the direction leaves single precision.
    apart = square > 1e-30
    distance = dr.select(apart, dr.sqrt(dr.select(apart, square, 1)), 0)
    # Any direction will do for an observer exactly on the surface.
    return distance, dr.select(apart, v / dr.select(apart, distance, 1), type(v)(0, 0, 1))


def select_nearest(known: list[Known], p_o: Point3f, of: Callable[[Any], Float]) -> Float:
    """``of(k.value)`` of that one ``k`` of ``known`` (``observer.Known``) whose ``center`` is nearest to ``p_o``, lane
    by lane."""
    best, apart = of(known[0].value), None
    for k in known if len(known) > 1 else ():
        here = dr.detach(dr.squared_norm(p_o - k.center))
        best = best if apart is None else dr.select(here < apart, of(k.value), best)
        apart = here if apart is None else dr.minimum(here, apart)
    return best


# ---- Views ----
#
# What else there is to know of an observer than what they see: protocol, and how much training data is near them.


class ObservedView(Protocol):
    """A view of one observer."""

    def evaluate(self, r_o: Vector3f) -> Float:
        """What it is along unit scene directions ``r_o``, without derivatives."""
        ...


class ObserverView(Protocol):
    """Something that is known of every observer, once their position is; it never changes itself."""

    @property
    def is_occluded(self) -> bool:
        """Whether what the observer cannot see has a value of 0."""
        ...

    def for_position(self, p_o: Point3f) -> ObservedView:
        """The view of the observer at ``p_o`` (in the scene, one lane)."""
        ...


def evaluate_view(
    view: ObserverView, observers: list[Point3f], p_o: Point3f, r_o: Vector3f, cache: ObserverCache
) -> Float:
    """``view`` along ``r_o`` of that one of ``observers`` (one lane each) who is nearest to ``p_o``, lane by
    lane. Raises ``NergError`` in a function that is being frozen, where the observers' positions cannot be read."""
    if recording():
        raise NergError(
            "one of the AOVs depends on where the observer is, which a frozen function does not know while it is "
            'recorded: leave it out of "aovs"'
        )
    known = cache.get_or_compute_each(view, observers, (), view.for_position)
    return select_nearest(known, p_o, lambda value: value.evaluate(r_o))


class SupportView:
    """How many training rays started around an observer (``fields.gaze_base``): one number each."""

    is_occluded = False

    def __init__(self, support: RaySupport, to_world: Similarity | None = None):
        self.support, self.to_world = support, to_world or Similarity()

    def for_position(self, p_o: Point3f) -> ObservedSupport:
        """The support of the observer at ``p_o``."""
        with dr.suspend_grad():
            total = self.support.evaluate(self.to_world.point_to_local(p_o))
            dr.eval(total)
        return ObservedSupport(total)


class ObservedSupport:
    """The support of one observer: ``total`` (one lane)."""

    def __init__(self, total: Float):
        self.total = total

    def evaluate(self, r_o: Vector3f) -> Float:
        """The number; ``r_o`` makes no difference."""
        return self.total


# ---- Visibility ----
#
# Whether an observer sees a point: the shadow factor of the paper, with its sign corrected.
#
# The paper's section "Surface Visibility and Gaze Occlusion" compares the depth d_o that the
# observer's ray meets with the distance d_o* to the point. s = clip((d_o* - d_o - tol) / d_f, 0, 1)
# is 1 where something stands in between; gaze is multiplied by the visibility 1 - s. (The text
# multiplies by s, which would show gaze only where it is hidden.)


def visibility(d_expected: Float, d_met: Float, falloff: Float, tolerance: Float | float) -> Float:
    """1 visible .. 0 hidden. ``d_expected``: d_o*, ``d_met``: d_o, ``falloff``: d_f >= 0 (0: a step
    function), ``tolerance``: how much nearer than the point a surface may lie and still be it. All in
    scene units."""
    excess = d_expected - d_met - tolerance
    sharp = falloff <= 0
    soft = dr.clip(excess / dr.select(sharp, 1, falloff), 0, 1)
    return 1 - dr.select(sharp, dr.select(excess > 0, 1.0, 0.0), soft)
