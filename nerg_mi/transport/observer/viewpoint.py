"""Where a camera's, or an observer's, eye is, and where a point lies from there.

The eye is the centre of the sensor, not the origin of its rays: Mitsuba starts those at the near plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.types import Float, Point3f, Ray3f, Vector3f
from nerg_mi.transport.freezing import recording

if TYPE_CHECKING:
    import mitsuba as mi

    from .cache import Known

_CENTERED = {"PerspectiveCamera", "ThinLensCamera", "Panorama", "RadianceMeter"}


def center(sensor: mi.Sensor) -> Point3f:
    """Centre of ``sensor`` in the scene (one lane); attached to its ``to_world``."""
    import mitsuba as mi

    return sensor.world_transform() @ mi.Point3f(0)


def is_batch(sensor: mi.Sensor) -> bool:
    """Whether ``sensor`` consists of several."""
    return _kind(sensor) == "BatchSensor"


def _members(sensor: mi.Sensor) -> list[mi.Sensor]:
    """The sensors that ``sensor`` consists of: itself, or those of a batch."""
    if not is_batch(sensor):
        return [sensor]
    import mitsuba as mi

    found = []

    class Collect(mi.TraversalCallback):
        def put(self, name, value, *rest):
            if isinstance(value, mi.Sensor):
                found.extend(_members(value))

    sensor.traverse(Collect())
    return found


def _kind(sensor: mi.Sensor) -> str:
    # Sensors written in Python carry their own class name.
    name = type(sensor).__name__
    return sensor.class_name() if name in ("Sensor", "ProjectiveCamera") else name


def require_center(sensor: mi.Sensor, role: str) -> None:
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
    centers = [center(m) for s in sensors for m in _members(s) if _kind(m) in _CENTERED]
    count = sum(len(_members(s)) for s in sensors)
    return len(centers) == count > 0 and all(bool(dr.all(dr.detach(c) == dr.detach(p_o))) for c in centers)


def centers(sensors: Sequence[mi.Sensor]) -> list[Point3f]:
    """Centre of each of ``sensors`` and of the members of batches."""
    return [center(m) for s in sensors for m in _members(s)]


def center_of_ray(sensors: Sequence[mi.Sensor], ray: Ray3f) -> Point3f:
    """Centre of the one of ``sensors`` that ``ray`` comes from.

    A ray belongs to the camera on whose axis-aligned near plane it starts and through whose centre
    its line passes, which tells the members of a batch apart.
    """
    import mitsuba as mi

    members = [m for s in sensors for m in _members(s)]
    for member in members:
        require_center(member, "the rendering sensor")
    if not members:
        raise NergError('there is no sensor to take the observer from: give the integrator an "observer"')
    best = center(members[0])
    if len(members) == 1:
        return best
    miss = mi.Float(dr.inf)
    for member in members:
        c = center(member)
        v = ray.o - c
        along = dr.dot(v, ray.d)
        off_line = dr.norm(v - ray.d * along)
        axis = dr.normalize(member.world_transform() @ mi.Vector3f(0, 0, 1))
        # Only projective cameras have a near plane; others start at their centre.
        near = member.near_clip() if isinstance(member, mi.ProjectiveCamera) else 0
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
    """``of(k.value)`` of that one ``k`` of ``known`` (``cache.Known``) whose ``center`` is nearest to ``p_o``, lane by
    lane."""
    best, apart = of(known[0].value), None
    for k in known if len(known) > 1 else ():
        here = dr.detach(dr.squared_norm(p_o - k.center))
        best = best if apart is None else dr.select(here < apart, of(k.value), best)
        apart = here if apart is None else dr.minimum(here, apart)
    return best
