"""Observers: their position, visibility, cached data and views."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Ray3f, Vector3f, variant_types

from .geometry import SURFACE_OPACITY, SceneGeometry
from .jit import Fingerprint, fingerprint_shapes, is_recording
from .march_primal import MarchSettings
from .ray_cells import CubeCells, LensCells, ParallelCells, RayCells
from .recording import Recorder, kind_of_sensor
from .splat_lists import CAMERA_CELLS

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Cache ----
#
# Data of observers that is computed once and kept between frames.
#
# An observer stays at one position for many pixels and often for many frames, and what is computed for the full sphere
# around them (depths, a map, the integral of a gaze field, the nearest rays) costs more than a frame. An entry is valid
# for exactly the same position, as long as its dependencies are unchanged. Dependencies are compared by the identity of
# arrays (`Fingerprint`), so a change of a parameter needs no explicit invalidation; `clear` is for changes that no
# array shows.


@dataclass(frozen=True)
class CacheEntry:
    """``value``: computed for the observer at ``center`` (one lane, detached)."""

    # Only needed to choose between several observers. It can be the array of the observer's position, or one of an
    # earlier observer at the same place, which are different inputs of a recording.
    UNRECORDED: ClassVar[tuple[str, ...]] = ("center",)

    center: Point3f
    value: Any


# Maximum number of observers whose scalars are cached.
_MAX_SCALARS = 256
_Position = tuple[float, float, float]


@dataclass(frozen=True)
class _CacheSlot:
    """The cached entries of one key by observer position, most recently used last."""

    dependencies: Any
    entries: dict[_Position, CacheEntry]


class ObserverCache:
    """The cache of one integrator, or of a caller that evaluates gaze for several observers in turn.

    For each key the entries of the most recent observers are kept; scalars are kept for many more observers, in
    ``scalar_cache`` if given: a cache that outlives this one. ``recorder``: recordings of what is computed for
    observers; default: those of the ``scalar_cache``, or none.
    """

    def __init__(self, scalar_cache: ObserverCache | None = None, recorder: Recorder | None = None) -> None:
        self.recorder = scalar_cache.recorder if recorder is None and scalar_cache is not None else recorder
        self._slots: dict[Hashable, _CacheSlot] = {}
        self._values: dict[Hashable, tuple[Any, Any]] = {}
        # None, and not this cache: a cycle would keep its arrays until the next garbage collection.
        self._scalar_cache = scalar_cache

    def get_or_compute_each(
        self, key: Hashable, observers: list[Point3f], dependencies: Any, compute: Callable[[Point3f], Any]
    ) -> list[CacheEntry]:
        """``compute(center)`` for each of ``observers`` (one lane each), or its cached result.

        Parameters
        ----------
        key : Hashable
            What is cached, and for which object.
        dependencies : object
            What the value depends on besides the position, comparable with ``==`` (settings, a `Fingerprint`).

        Notes
        -----
        While ``dr.freeze`` records a function, the cache is neither read nor written: values belong to the recording.
        """
        entries = [CacheEntry(type(p_o)(dr.detach(p_o)), None) for p_o in observers]
        for entry in entries:
            # A literal position would compile a new kernel for each observer.
            dr.make_opaque(entry.center)
        return self.get_or_compute(key, entries, dependencies, lambda k: compute(k.center))

    def get_or_compute_scalar(
        self, key: Hashable, entries: list[CacheEntry], dependencies: Any, compute: Callable[[CacheEntry], Any]
    ) -> list[CacheEntry]:
        """`get_or_compute` of a few scalars per observer; the entries of 256 earlier observers are kept, too."""
        cache = self if self._scalar_cache is None else self._scalar_cache
        return cache.get_or_compute(key, entries, dependencies, compute, _MAX_SCALARS)

    def get_or_compute(
        self,
        key: Hashable,
        entries: list[CacheEntry],
        dependencies: Any,
        compute: Callable[[CacheEntry], Any],
        max_others: int = 0,
    ) -> list[CacheEntry]:
        """``compute(entry)`` for each of ``entries``, or its cached result; otherwise as `get_or_compute_each`.

        ``max_others``: maximum number of entries of earlier observers that are kept.
        """
        if is_recording():
            return [CacheEntry(k.center, compute(k)) for k in entries]
        slot = self._slots.get(key)
        cached = slot.entries if slot is not None and slot.dependencies == dependencies else {}
        requested: dict[_Position, CacheEntry] = {}
        out = []
        for entry in entries:
            # Read one by one: an array of all three would need its own kernel.
            position = entry.center.x[0], entry.center.y[0], entry.center.z[0]
            if position not in requested:
                requested[position] = (
                    cached[position] if position in cached else CacheEntry(entry.center, compute(entry))
                )
            out.append(requested[position])
        other_entries = [(position, k) for position, k in cached.items() if position not in requested]
        self._slots[key] = _CacheSlot(dependencies, dict(other_entries[-max_others:] if max_others else []) | requested)
        return out

    def get_or_compute_value(self, key: Hashable, dependencies: Any, compute: Callable[[], Any]) -> Any:
        """``compute()``, or its last result if the ``dependencies`` were equal; reads no positions."""
        slot = self._values.get(key)
        if slot is None or slot[0] != dependencies:
            slot = self._values[key] = dependencies, compute()
        return slot[1]

    def peek(self, key: Hashable) -> list[CacheEntry]:
        """The cached entries of ``key``; computes none."""
        slot = self._slots.get(key)
        return [] if slot is None else list(slot.entries.values())

    def clear(self) -> None:
        """Remove all entries, after a change that no array shows."""
        self._slots.clear()
        self._values.clear()


def fingerprint_geometry(geometry: SceneGeometry) -> tuple[Fingerprint, Fingerprint]:
    """Fingerprints of the shapes and of the medium's arrays."""
    values = [] if geometry.medium is None else [v for v in geometry.medium.parameters() if dr.is_array_v(v)]
    return fingerprint_shapes(geometry), Fingerprint(values)


# ---- Settings of an observer's rays ----

VISIBILITIES = ("depth", "transmittance", "map")
MAX_DIRECTIONS = 1 << 17
"""Maximum number of directions of an integral over the sphere: accurate to 1e-3 for depths with discontinuities."""


@dataclass(frozen=True, kw_only=True)
class ObserverSettings:
    """Settings of all rays that are traced from an observer; lengths in scene units."""

    # March through a medium.
    march: MarchSettings
    # Kind of depth of a surface (a name in `depth.DEPTHS`).
    depth: str = "median"
    # Minimum opacity of a surface.
    surface_opacity: float = SURFACE_OPACITY
    # One of ``VISIBILITIES``: how occlusion is decided.
    visibility: str = "depth"
    # Depth tolerance of a surface; 0: two steps, or without a medium a fraction of the scene.
    tolerance: float = 0.0
    # Rows of a map; it has twice as many columns.
    map_height: int = 512
    # Maximum number of directions of the integral that a normalised gaze field is divided by.
    directions: int = MAX_DIRECTIONS
    # Relative error of that integral at which fewer directions suffice; 0: always the maximum number.
    integral_tolerance: float = 5e-3

    @property
    def surface_settings(self) -> tuple:
        """The settings that determine where a ray meets a surface."""
        return self.march, self.depth, self.surface_opacity


# ---- Centre of a camera or an observer, and the direction from there to a point ----
#
# The centre of a sensor is not the origin of its rays: Mitsuba starts those at the near plane.

_CENTERED = {"PerspectiveCamera", "ThinLensCamera", "Panorama", "RadianceMeter"}


def sensor_center(sensor: mi.Sensor) -> Point3f:
    """Centre of ``sensor`` in the scene (one lane); attached to its ``to_world``."""
    return cast("Any", sensor).world_transform() @ variant_types().Point3f(0)


def is_batch(sensor: mi.Sensor) -> bool:
    """Whether ``sensor`` is a batch of sensors."""
    return kind_of_sensor(sensor) == "BatchSensor"


def _members(sensor: mi.Sensor) -> list[mi.Sensor]:
    """The sensor itself, or the members of a batch."""
    if not is_batch(sensor):
        return [sensor]
    import mitsuba as mi

    members = []

    class SensorCollector(mi.TraversalCallback):
        def put(self, name, value, *rest):
            if isinstance(value, mi.Sensor):
                members.extend(_members(value))

    sensor.traverse(SensorCollector())
    return members


def check_center(sensor: mi.Sensor, role: str) -> None:
    """Raise ``NergError`` if ``sensor`` (called ``role`` in the message) has no single centre."""
    if kind_of_sensor(sensor) not in _CENTERED:
        raise NergError(
            f"{role} is of the type {kind_of_sensor(sensor)}, which has no centre; "
            'give the integrator an explicit "observer" such as a perspective sensor'
        )


def check_centers(sensor: mi.Sensor) -> None:
    """Raise ``NergError`` if ``sensor``, or a member of a batch, has no single centre."""
    for member in _members(sensor):
        check_center(member, "the rendering sensor")


def have_same_center(sensors: Sequence[mi.Sensor], p_o: Point3f) -> bool:
    """Whether the centre of every sensor is exactly ``p_o``; reads both values.

    False while ``dr.freeze`` records a function, which is replayed with other positions.
    """
    if is_recording():
        return False
    centers = [sensor_center(m) for s in sensors for m in _members(s) if kind_of_sensor(m) in _CENTERED]
    count = sum(len(_members(s)) for s in sensors)
    return len(centers) == count > 0 and all(bool(dr.all(dr.detach(c) == dr.detach(p_o))) for c in centers)


def sensor_centers(sensors: Sequence[mi.Sensor]) -> list[Point3f]:
    """The centre of each sensor, and of each member of a batch."""
    return [sensor_center(m) for s in sensors for m in _members(s)]


def camera_cells(sensor: mi.Sensor) -> RayCells | None:
    """The rays of ``sensor`` around its `sensor_center`, in cells of a few pixels; None for other kinds of sensors, and
    for a lens without an aperture or a distance in focus."""
    import mitsuba as mi

    kind, film, camera = kind_of_sensor(sensor), sensor.film(), cast("Any", sensor)
    if kind == "Panorama":
        return CubeCells()
    if kind not in ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera"):
        return None
    read = lambda v: np.array(dr.detach(v), np.float64).reshape(3, -1)
    corners = camera.sample_ray(0, 0.5, mi.Point2f([0, 1, 0, 1], [0, 0, 1, 1]), mi.Point2f(0.5))[0]
    forward, right = (camera.world_transform() @ mi.Vector3f(*axis) for axis in ((0, 0, 1), (1, 0, 0)))
    # An orthographic camera may be sheared.
    axes, _ = np.linalg.qr(np.hstack([read(forward), read(right)]), mode="complete")
    axes = axes[:, [1, 2, 0]].T * np.sign(read(forward).ravel() @ axes[:, 0])
    o, d = axes @ (read(corners.o) - read(sensor_center(sensor))), axes @ read(corners.d)
    positions = o[:2] if kind == "OrthographicCamera" else d[:2] / d[2]
    size = film.crop_size()
    pixels = int(np.clip(round(np.sqrt(int(dr.prod(size)) / CAMERA_CELLS)), 4, 16))
    # One more cell on both sides: a film can sample its border.
    count = np.array([-(-int(n) // pixels) for n in size])
    first, last = positions.min(axis=1), positions.max(axis=1)
    edge = (last - first) / np.array(size) * pixels
    lower, upper, cells = (tuple(v.tolist()) for v in (first - edge, first + (count + 1) * edge, count + 2))
    if kind == "PerspectiveCamera":
        return RayCells(axes, lower, upper, cells)
    if kind == "OrthographicCamera":
        return ParallelCells(axes, lower, upper, cells, forward=forward)
    parameters = mi.traverse(sensor)
    radius, focus = (np.array(dr.detach(parameters[name])).item() for name in ("aperture_radius", "focus_distance"))
    return LensCells(axes, lower, upper, cells, radius=radius, focus=focus) if radius > 0 and focus > 0 else None


def center_of_ray(sensors: Sequence[mi.Sensor], ray: Ray3f) -> Point3f:
    """Centre of the sensor among ``sensors`` that ``ray`` comes from.

    A ray belongs to the camera on whose axis-aligned near plane it starts and through whose centre its line passes.
    This distinguishes the members of a batch.
    """
    members = [m for s in sensors for m in _members(s)]
    for sensor in sensors:
        check_centers(sensor)
    if not members:
        raise NergError('no sensor defines the position of the observer; give the integrator an "observer"')
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
        # Only projective cameras have a near plane; rays of other sensors start at their centre.
        near = cast("Any", member).near_clip() if isinstance(member, mi.ProjectiveCamera) else 0
        off_plane = dr.abs(dr.dot(v, axis) - near)
        error = dr.detach(off_line + off_plane)
        closer = error < miss
        best = dr.select(closer, c, best)
        miss = dr.select(closer, error, miss)
    return best


def distance_and_direction(p_o: Point3f, p: Point3f) -> tuple[Float, Vector3f]:
    """Distance and unit direction from ``p_o`` to ``p``, finite with finite derivatives where both coincide."""
    v = p - p_o
    square = dr.squared_norm(v)
    # Below 1e-15 units the derivative of the direction exceeds single precision.
    is_separate = square > 1e-30
    distance = dr.select(is_separate, dr.sqrt(dr.select(is_separate, square, 1)), 0)
    # For an observer exactly on the surface the direction is arbitrary.
    return distance, dr.select(is_separate, v / dr.select(is_separate, distance, 1), type(v)(0, 0, 1))


def select_nearest(entries: list[CacheEntry], p_o: Point3f, get_value: Callable[[Any], Float]) -> Float:
    """``get_value(entry.value)`` of the `CacheEntry` whose ``center`` is nearest to ``p_o``, lane by lane."""
    best, best_square = get_value(entries[0].value), None
    for entry in entries if len(entries) > 1 else ():
        square = dr.detach(dr.squared_norm(p_o - entry.center))
        best = best if best_square is None else dr.select(square < best_square, get_value(entry.value), best)
        best_square = square if best_square is None else dr.minimum(square, best_square)
    return best


# ---- Views ----
#
# Data of an observer other than visibility, e.g. how much training data is near them.


class ObservedView(Protocol):
    """The view of one observer."""

    def evaluate(self, r_o: Vector3f) -> Float:
        """Its value along unit scene directions ``r_o``, without derivatives."""
        ...


class ObserverView(Protocol):
    """A quantity that depends on the observer's position; immutable."""

    @property
    def is_occluded(self) -> bool:
        """Whether its value is 0 on surfaces that are hidden from the observer."""
        ...

    def for_position(self, p_o: Point3f) -> ObservedView:
        """The view of the observer at the scene position ``p_o`` (one lane)."""
        ...


def observe_view(view: ObserverView, observers: list[Point3f], cache: ObserverCache) -> list[CacheEntry]:
    """``view`` for each of ``observers`` (one lane each), kept in ``cache``.

    Raises
    ------
    NergError
        In a function that ``dr.freeze`` records, where positions cannot be read.
    """
    if is_recording():
        raise NergError(
            "an AOV depends on the position of the observer, which cannot be read while dr.freeze records a function; "
            'remove it from "aovs"'
        )
    return cache.get_or_compute_each(view, observers, (), view.for_position)


class SupportView:
    """Number of training rays that started near an observer (`fields.gaze_base.RaySupport`): one number per
    observer."""

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
        """The support; it does not depend on ``r_o``."""
        return self.total
