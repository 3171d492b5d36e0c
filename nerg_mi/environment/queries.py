"""Queries of a scene: quantities along rays, and what observers see of points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.files.values import FilePath
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter

from .arrays import Floats, LabelledArrays, as_points, as_rays, broadcast_to_observers
from .bands import make_sampler
from .scene import COLOR, Scene, make_aov_context, resolve_quantities
from .scene_loading import activate_mitsuba

if TYPE_CHECKING:
    from nerg_mi.transport.geometry import SceneGeometry
    from nerg_mi.transport.occlusion import ObserverMap

# ---- One observer of a scene ----


class SceneObserver:
    """An observer in a scene.

    Ray marching, depth and visibility use the settings of the scene's integrator. Values that a normalised gaze field
    needs for this observer are computed once.

    Parameters
    ----------
    scene : Scene
        The scene.
    position : ndarray of shape (3,)
        Position of the observer in scene units.
    geometry : SceneGeometry, optional
        What rays hit. Default: that of the scene.
    """

    def __init__(self, scene: Scene, position: Floats, geometry: SceneGeometry | None = None):
        import drjit as dr
        import mitsuba as mi

        self.scene, self.geometry, self.integrator = scene, geometry or scene.geometry, scene.integrator
        self.center: Any = mi.Point3f(position.tolist())
        # A literal position would be compiled into the kernel, which would be recompiled for each observer.
        dr.make_opaque(self.center)
        self.gaze = None
        if scene.has_gaze:
            i = self.integrator
            self.gaze = i.gaze.for_observers([self.center], self.geometry, i.observer_settings, i.cache)

    @cached_property
    def map(self) -> ObserverMap | None:
        """The depth map around the observer; None unless visibility is decided by a map."""
        from nerg_mi.transport.occlusion import get_observer_map

        settings = self.integrator.observer_settings
        if settings.visibility != "map":
            return None
        return get_observer_map(self.geometry, self.center, settings, None, self.integrator.cache)

    def eval_gaze(self, p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
        """Evaluate the gaze density.

        The signature is that of `nerg_mi.environment.surface_attention`.

        Parameters
        ----------
        p_od : Point3f
            Point on the surface that the observer sees in direction ``r_o``.
        p_o : Point3f
            Position of the observer in all lanes.
        r_o : Vector3f
            Unit direction.
        active : Bool
            Mask.

        Returns
        -------
        Float
            Gaze density in 1/sr.
        """
        if self.gaze is None:
            raise ValueError("a scene without a gaze field has no gaze")
        return self.gaze.evaluate(p_od, p_o, r_o, active)[0]

    def observe(self, points: Any, with_gaze: bool, seen: SceneGeometry | None = None) -> dict[str, Any]:
        """Compute what the observer sees of points.

        Parameters
        ----------
        points : Point3f
            Points in scene units.
        with_gaze : bool
            Whether to compute the gaze.
        seen : SceneGeometry, optional
            The geometry as seen from the observer (`SceneGeometry.seen_from`).

        Returns
        -------
        dict of str to Float
            ``distance``, ``depth``, ``visibility`` and, if requested, ``gaze`` (1/sr).
        """
        import drjit as dr

        mi = variant_types()
        from nerg_mi.transport.observer import distance_and_direction
        from nerg_mi.transport.occlusion import trace_from_observer

        i = self.integrator
        distance, r_o = distance_and_direction(self.center, points)
        active = dr.full(mi.Bool, True, dr.width(points))
        ray = mi.Ray3f(self.center, r_o)
        geometry = seen or self.geometry
        hit = trace_from_observer(
            geometry, ray, points, self.center, 0, active, i.falloff, i.observer_settings, observer_map=self.map
        )
        values = {"distance": distance, "depth": hit.depth, "visibility": hit.visibility}
        if with_gaze:
            is_visible = active & (hit.visibility > 0)
            p_o = self.center + dr.zeros(mi.Point3f, dr.width(points))
            gaze = self.eval_gaze(hit.p_od, p_o, r_o, is_visible)
            values["gaze"] = dr.select(is_visible, gaze * hit.visibility, 0)
        return values


# ---- Queries along rays and at points ----


BATCH_SIZE = 1 << 18
"""Number of rays or points computed at once."""

POINT_QUANTITIES = ("gaze", "visibility", "distance", "depth")
"""The quantities of `observe`."""


@dataclass(frozen=True, eq=False, repr=False)
class TraceResult(LabelledArrays):
    """Result of `trace`.

    The arrays have the shape (rays,) or (rays, channels); if positions of observers were passed, an axis ``observer``
    precedes.
    """


@dataclass(frozen=True, eq=False, repr=False)
class ObserveResult(LabelledArrays):
    """Result of `observe`; the arrays have the shape (observers, points)."""


def trace(
    scene: Scene | FilePath,
    origins: ArrayLike,
    directions: ArrayLike,
    quantities: str | Sequence[str] | None = None,
    *,
    observers: ArrayLike | None = None,
    seed: int = 0,
    progress: Progress = None,
) -> TraceResult:
    """Compute quantities along rays: the surface that they hit, its colour, and its gaze.

    Parameters
    ----------
    scene : Scene or path
        The scene, or a scene file.
    origins : array_like of shape (N, 3) or (3,)
        Origins of the rays in scene units.
    directions : array_like of shape (N, 3) or (3,)
        Directions of any length except zero, in the frame of the scene.
    quantities : str or sequence of str, optional
        Names of quantities as for `render`. Depths are measured from the origins.
    observers : array_like of shape (M, 3), optional
        Positions of the observers whose gaze is computed, in scene units. Default: the observer of each ray is at its
        origin.
    seed : int
        Seed of random quantities, such as the light on shapes.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

    Returns
    -------
    TraceResult
        Arrays (M, N, ...), or (N, ...) without ``observers``. ``gaze`` is 0 where a ray meets no surface; the method
        ``density`` of a gaze field is not (`GazeField`).

    Raises
    ------
    NergError
        An argument is invalid, or the scene cannot compute a quantity.

    Notes
    -----
    Without ``observers``, a normalised gaze field is integrated over the sphere around each distinct origin, with about
    8,000 directions or more. In the demo store this takes 30 to 50 ms of CPU time per origin, or half a minute to a
    minute for 1,000 origins. A larger ``integral_tolerance`` of the scene (``make_scene(...,
    integral_tolerance=0.02)``: a relative error of at most 2 %) halves this time. The method ``density`` of a gaze
    field (`GazeField`) computes the integrals of many origins together, in about 10 ms per origin with its default
    tolerance. Quantities other than gaze do not need the integral.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors")
    >>> result = nerg.trace(scene, origins=(4.4, 2.8, 1.6), directions=[(0, 0, -1), (0.2, 1, -0.2)])
    >>> result.depth.shape, result.color.shape, bool(abs(result.depth[0] - 1.6) < 0.1)
    ((2,), (2, 3), True)
    """
    scene = Scene.coerce(scene)
    activate_mitsuba()
    requested = resolve_quantities(scene, quantities)
    o, d = as_rays(origins, directions)
    with open_reporter(progress) as reporter, translate_mitsuba_errors():
        tracer = _Tracer(scene, requested, seed, reporter)
        positions = np.unique(o, axis=0) if observers is None else as_points(observers, "observers")
        if tracer.per_observer:
            warn_extrapolation(reporter, scene, positions)
        if observers is None:
            return TraceResult(tracer.trace_for_origins(o, d), ("ray",), None)
        return TraceResult(tracer.trace_for_observers(o, d, positions), ("observer", "ray"), positions)


class _Tracer:
    """Traces rays through a scene to compute the ``requested`` quantities."""

    def __init__(self, scene: Scene, requested: Sequence[str], seed: int, reporter: Reporter):
        self.scene, self.requested, self.seed, self.reporter = scene, requested, seed, reporter
        self.context = make_aov_context(scene, requested)
        self.shared, self.per_observer = self.context.shared_aovs, self.context.observer_aovs

    def trace_for_observers(self, o: Floats, d: Floats, positions: Floats) -> dict[str, Floats]:
        """Compute quantities (M, N, ...) of rays for observers at ``positions`` (M, 3)."""
        observers = (
            [self.context.make_observer(eye, len(positions) == 1) for eye in positions] if self.per_observer else []
        )
        make_pixels = lambda camera: map(camera.make_pixel, observers)
        parts = [self._trace_batch(o, d, a, make_pixels, observers) for a in _batch_starts(o)]
        values = {}
        for name in self.requested:
            value = np.concatenate([part[name] for part in parts], axis=-1 if name in self.per_observer else 0)
            values[name] = value if name in self.per_observer else broadcast_to_observers(value, len(positions))
        return values

    def trace_for_origins(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """Compute quantities (N, ...) of rays for observers at their origins."""
        if not self.per_observer:
            parts = [self._trace_batch(o, d, a, lambda camera: (), ()) for a in _batch_starts(o)]
            return {name: np.concatenate([part[name] for part in parts]) for name in self.requested}
        gaze = self.context.nerg.gaze
        if self.context.views or (gaze is not None and gaze.field.config.normalized):
            return self._trace_each_origin(o, d)
        make_pixels = lambda camera: (camera.make_pixel_per_origin(),)
        parts = [self._trace_batch(o, d, a, make_pixels, ()) for a in _batch_starts(o)]
        first = lambda name, value: value[0] if name in self.per_observer else value
        return {name: np.concatenate([first(name, part[name]) for part in parts]) for name in self.requested}

    def _trace_each_origin(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """Compute the same one origin after the other, since the observer context belongs to one position."""
        origins, origin_of_ray = np.unique(o, axis=0, return_inverse=True)
        order = np.argsort(origin_of_ray.ravel(), kind="stable")
        groups = np.split(order, np.cumsum(np.bincount(origin_of_ray.ravel()))[:-1])
        parts = []
        for number, (origin, rows) in enumerate(zip(origins, groups), 1):
            observer = self.context.make_observer(origin)
            observer.is_at_camera = True
            for a in _batch_starts(rows):
                make_pixels = lambda camera, who=observer: (camera.make_pixel(who),)
                part = self._trace_batch(o[rows], d[rows], a, make_pixels, [observer])
                parts.append({name: v[0] if name in self.per_observer else v for name, v in part.items()})
            self.reporter.progress(number / len(origins), f"origin {number:,} of {len(origins):,}")
        inverse = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[inverse] for name in self.requested}

    def _trace_batch(
        self, o: Floats, d: Floats, start: int, make_pixels: Callable[[Any], Iterable[Any]], observers: Sequence[Any]
    ) -> dict[str, Floats]:
        """Trace `BATCH_SIZE` rays from index ``start``, or replay a recording of it.

        ``make_pixels`` returns the pixels of each of ``observers``; without any, those of rays whose observers are at
        their origins.
        """
        import drjit as dr
        import mitsuba as mi

        context, scene = self.context, self.scene.mitsuba
        o, d = o[start : start + BATCH_SIZE], d[start : start + BATCH_SIZE]
        origin, direction = to_vector(mi.Point3f, o), to_vector(mi.Vector3f, d)
        key, first = dr.opaque(mi.UInt32, (self.seed + start) & 0xFFFFFFFF), dr.opaque(mi.UInt64, 0)

        def list_inputs() -> list[Any]:
            for observer in observers:
                observer.prepare(context, scene, [], len(o))
            return [*context.list_inputs(scene, [], len(o)), observers]

        def trace() -> tuple[list[Any], list[Any], list[list[Any]]]:
            with dr.suspend_grad():
                sampler = make_sampler(1, key, first, len(o))
                ray = mi.RayDifferential3f(origin, direction)
                camera = context.trace(scene, [], sampler, ray, mi.Bool(True))
                shared = camera.compute_channels(self.shared)
                color = list(camera.compute_radiance(scene, sampler, None)[0])
                camera.eval_shared(color, shared)
                each = []
                for pixels in make_pixels(camera) if self.per_observer else ():
                    each.append(pixels.compute_channels(self.per_observer))
                    dr.eval(each[-1])
            return shared, color, each

        kind = "trace", len(o), *self.shared, *self.per_observer
        shared, color, each = context.nerg.recorder.run(trace, kind, list_inputs, [origin, direction, key, first])
        values = self._group_channels(self.shared, shared, len(o))
        if COLOR in self.requested:
            values[COLOR] = np.stack([_to_array(channel, len(o)) for channel in color], axis=-1)
        by_observer = [self._group_channels(self.per_observer, channels, len(o)) for channels in each]
        return values | {name: np.stack([one[name] for one in by_observer]) for name in self.per_observer}

    def _group_channels(self, names: Sequence[str], channels: Sequence[Any], count: int) -> dict[str, Floats]:
        """Return channels by quantity, as arrays (N,), or (N, C) for several channels."""
        columns: dict[str, list[Floats]] = {}
        for name, value in zip(self.context.channel_names(names), channels):
            columns.setdefault(name.rpartition(".")[0], []).append(_to_array(value, count))
        return {name: c[0] if len(c) == 1 else np.stack(c, axis=-1) for name, c in columns.items()}


def _batch_starts(rows: Any) -> range:
    return range(0, len(rows), BATCH_SIZE)


def observe(
    scene: Scene | FilePath,
    points: ArrayLike,
    observers: ArrayLike | None = None,
    quantities: str | Sequence[str] | None = None,
    *,
    progress: Progress = None,
) -> ObserveResult:
    """Compute what observers see of points: visibility and gaze.

    Parameters
    ----------
    scene : Scene or path
        The scene, or a scene file.
    points : array_like of shape (N, 3) or (3,)
        Points on surfaces, in scene units. Surfaces closer to a point than the ``tolerance`` of the integrator do not
        occlude it.
    observers : array_like of shape (M, 3) or (3,), optional
        Positions of the observers in scene units. Default: the observer of the scene.
    quantities : str or sequence of str, optional
        Any of ``gaze`` (1/sr, after occlusion), ``visibility`` (1 visible to 0 occluded), ``distance`` from the
        observer to the point, and ``depth`` of the first surface in that direction, or the distance if there is none
        (both in scene units). Default: all.
    progress : bool, Reporter or None
        A `Reporter` receives warnings, which are Python warnings otherwise.

    Returns
    -------
    ObserveResult
        Arrays (M, N).

    Raises
    ------
    NergError
        An argument is invalid, or the scene has no observer.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors")
    >>> result = nerg.observe(scene, points=(4.4, 2.8, 0.02), observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> result.visibility.round(2).tolist()
    [[1.0], [0.0]]
    """
    scene = Scene.coerce(scene)
    activate_mitsuba()
    allowed = POINT_QUANTITIES if scene.has_gaze else POINT_QUANTITIES[1:]
    requested = allowed if quantities is None else resolve_quantities(scene, quantities, allowed)
    p = as_points(points, "points")
    with open_reporter(progress) as reporter, translate_mitsuba_errors():
        positions = resolve_observers(scene, observers, reporter)
        each = [_observe_points(SceneObserver(scene, eye), p, "gaze" in requested) for eye in positions]
    return ObserveResult(
        {name: np.stack([one[name] for one in each]) for name in requested}, ("observer", "point"), positions
    )


def resolve_observers(scene: Scene, observers: ArrayLike | None, reporter: Reporter) -> Floats:
    """Return the positions (M, 3) of ``observers``, or of the scene's observer for None. Warn of extrapolated ones.

    Raises
    ------
    NergError
        The scene has no observer.
    """
    if observers is not None:
        positions = as_points(observers, "observers")
    elif scene.observer is not None:
        positions = scene.observer[None]
    else:
        raise NergError("the scene has no observer; pass positions with observers=[(x, y, z), ...]")
    warn_extrapolation(reporter, scene, positions)
    return positions


def warn_extrapolation(reporter: Reporter, scene: Scene, positions: Floats) -> None:
    """Warn if values at ``positions`` (M, 3) are extrapolated; a silent reporter takes no time."""
    from nerg_mi.transport.extrapolation import describe_extrapolation
    from nerg_mi.transport.observer import fingerprint_geometry

    if reporter is SILENT:
        return
    geometry, integrator = scene.geometry, scene.integrator
    dependencies = positions.tobytes(), integrator.gaze, fingerprint_geometry(geometry)
    describe = lambda: describe_extrapolation(geometry, integrator.gaze, positions)
    if sentence := integrator.cache.get_or_compute_value("extrapolation", dependencies, describe):
        reporter.warn(sentence)


def _observe_points(observer: SceneObserver, p: Floats, with_gaze: bool) -> dict[str, Floats]:
    import drjit as dr
    import mitsuba as mi

    from nerg_mi.transport.observer_gaze import list_geometry_inputs

    context, scene = observer.integrator.context(), observer.scene.mitsuba
    recorder, parts = observer.integrator.recorder, dict[str, list[Floats]]()

    def list_inputs() -> list[Any]:
        if observer.gaze is not None:
            observer.gaze.prepare(len(part))
        inputs = [*context.list_inputs(scene, [], len(part)), *list_geometry_inputs(seen)]
        return [*inputs, observer.center, observer.gaze, observer.map]

    def observe() -> dict[str, Any]:
        with dr.suspend_grad():
            values = observer.observe(points, with_gaze, seen)
            dr.eval(values)
        return values

    for a in range(0, len(p), BATCH_SIZE):
        part = p[a : a + BATCH_SIZE]
        seen = observer.geometry.seen_from(observer.center, len(part))
        points = to_vector(mi.Point3f, part)
        values = recorder.run(observe, ("observe", len(part), with_gaze), list_inputs, [points])
        for name, value in values.items():
            parts.setdefault(name, []).append(_to_array(value, len(part)))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _to_array(value: Any, count: int) -> Floats:
    """Convert a Dr.Jit Float to an array (count,); a single value is repeated."""
    return np.broadcast_to(np.array(value, np.float32).ravel(), (count,)).copy()
