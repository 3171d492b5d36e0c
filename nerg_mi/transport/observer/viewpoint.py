"""Where a camera's, or an observer's, eye is.

The eye is the centre of the sensor, not the origin of its rays: Mitsuba starts those at the near plane.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.transport.freezing import recording

_CENTERED = {"PerspectiveCamera", "ThinLensCamera", "Panorama", "RadianceMeter"}


def center(sensor):
    """Centre of ``sensor`` in the scene (Point3f); attached to its ``to_world``."""
    import mitsuba as mi

    return sensor.world_transform() @ mi.Point3f(0)


def is_batch(sensor) -> bool:
    """Whether ``sensor`` consists of several."""
    return _kind(sensor) == "BatchSensor"


def _members(sensor) -> list:
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


def _kind(sensor) -> str:
    # Sensors written in Python carry their own class name.
    name = type(sensor).__name__
    return sensor.class_name() if name in ("Sensor", "ProjectiveCamera") else name


def require_center(sensor, role: str) -> None:
    """Raise ``ValueError`` when ``sensor`` (called ``role`` in the message) has no single centre."""
    if _kind(sensor) not in _CENTERED:
        raise NergError(
            f"{role} is a {_kind(sensor)}, which has no centre to look from: "
            'give the integrator an explicit "observer" such as a perspective sensor'
        )


def same_center(sensors, p_o) -> bool:
    """Whether every sensor's centre is exactly ``p_o`` (which costs a look at both values).

    False while a function is recorded by ``dr.freeze``: it will be replayed wherever they stand then.
    """
    if recording():
        return False
    centers = [center(m) for s in sensors for m in _members(s) if _kind(m) in _CENTERED]
    count = sum(len(_members(s)) for s in sensors)
    return len(centers) == count > 0 and all(bool(dr.all(dr.detach(c) == dr.detach(p_o))) for c in centers)


def centers(sensors) -> list:
    """Centre (Point3f) of each of ``sensors`` and of the members of batches."""
    return [center(m) for s in sensors for m in _members(s)]


def center_of_ray(sensors, ray):
    """Centre (Point3f) of the one of ``sensors`` that ``ray`` comes from.

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
        near = member.near_clip() if hasattr(member, "near_clip") else 0
        off_plane = dr.abs(dr.dot(v, axis) - near)
        error = dr.detach(off_line + off_plane)
        closer = error < miss
        best = dr.select(closer, c, best)
        miss = dr.select(closer, error, miss)
    return best
