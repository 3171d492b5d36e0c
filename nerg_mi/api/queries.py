"""Questions to a scene that are no pictures: what rays meet, and what observers see of points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.maths.arrays import vector_of
from nerg_mi.workflows.base import SILENT, Reporter

from . import arrays
from .arrays import Floats, Labelled, same_for_all
from .fields import FilePath
from .observed import ObserverOf
from .scene import COLOR, Scene, asked_quantities, context_for
from .variant import active_mitsuba

BATCH = 1 << 18
"""So many rays or points are computed at once."""

AT_POINTS = ("gaze", "visibility", "distance", "depth")
"""What `observe` answers."""


@dataclass(frozen=True, eq=False, repr=False)
class Traced(Labelled):
    """Quantities of `trace`, each (rays,) or, with channels, (rays, channels); for given observers with an axis
    ``observer`` in front."""


@dataclass(frozen=True, eq=False, repr=False)
class Observed(Labelled):
    """Quantities of `observe`, each (observers, points)."""


def trace(
    scene: Scene | FilePath,
    origins: ArrayLike,
    directions: ArrayLike,
    quantities: str | Sequence[str] | None = None,
    *,
    observers: ArrayLike | None = None,
    seed: int = 0,
    reporter: Reporter = SILENT,
) -> Traced:
    """What rays meet in a scene: the surface, its colour, and the gaze that it attracts.

    ``origins`` (N, 3) in scene units, or one (3,) for all; ``directions`` (N, 3), of any length but zero, or one.
    ``quantities``: as for `render`; depths count from the origins. ``observers``: positions (M, 3) of those whose gaze
    is shown, so that arrays are (M, N); None: whoever stands at a ray's origin looks along it, and arrays are (N,).
    ``seed``: of what is random (the light on shapes). Raises `NergError`.

    Without ``observers`` a normalised gaze field is integrated over the sphere around every other origin, over some
    8,000 directions or more: 30 to 40 ms of a processor's time each in the demo store, or half a minute for 1,000.
    ``reporter`` is told the progress. A scene with a wider ``integral_tolerance`` (``make_scene(...,
    integral_tolerance=0.02)``: gaze that errs by 2 % at most) takes half of that; ``quantities`` without gaze take
    none of it.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors")
    >>> seen = nerg.trace(scene, origins=(4.4, 2.8, 1.6), directions=[(0, 0, -1), (0.2, 1, -0.2)])
    >>> seen.depth.shape, seen.color.shape, bool(abs(seen.depth[0] - 1.6) < 0.1)
    ((2,), (2, 3), True)
    """
    scene = Scene.of(scene)
    active_mitsuba()
    asked = asked_quantities(scene, quantities)
    o, d = _rays(origins, directions)
    with mitsuba_says():
        tracer = _Tracer(scene, asked, seed, reporter)
        if observers is None:
            return Traced(tracer.of_origins(o, d), ("ray",), None)
        eyes = arrays.points(observers, "observers")
        return Traced(tracer.of_observers(o, d, eyes), ("observer", "ray"), eyes)


class _Tracer:
    """Rays through a scene that are ``asked`` for quantities."""

    def __init__(self, scene: Scene, asked: Sequence[str], seed: int, reporter: Reporter):
        self.scene, self.asked, self.seed, self.reporter = scene, asked, seed, reporter
        self.context = context_for(scene, asked)
        self.shared, self.own = self.context.shared, self.context.own

    def of_observers(self, o: Floats, d: Floats, eyes: Floats) -> dict[str, Floats]:
        """Quantities (M, N, ...) of rays as observers at ``eyes`` (M, 3) have them."""
        observers = [self.context.observer_at(eye, len(eyes) == 1) for eye in eyes] if self.own else []
        parts = [self._part(o, d, a, lambda camera: map(camera.for_observer, observers)) for a in _starts(o)]
        values = {}
        for name in self.asked:
            value = np.concatenate([part[name] for part in parts], axis=-1 if name in self.own else 0)
            values[name] = value if name in self.own else same_for_all(value, len(eyes))
        return values

    def of_origins(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """Quantities (N, ...) of rays as whoever stands at their origins has them."""
        if not self.own:
            parts = [self._part(o, d, a, lambda camera: ()) for a in _starts(o)]
            return {name: np.concatenate([part[name] for part in parts]) for name in self.asked}
        gaze = self.context.gaze
        if self.context.views or (gaze is not None and gaze.field.config.normalized):
            return self._of_each_origin(o, d)
        parts = [self._part(o, d, a, lambda camera: (camera.for_origins(),)) for a in _starts(o)]
        first = lambda name, value: value[0] if name in self.own else value
        return {name: np.concatenate([first(name, part[name]) for part in parts]) for name in self.asked}

    def _of_each_origin(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """The same, origin by origin: what is known of an observer is made for one position."""
        origins, of_ray = np.unique(o, axis=0, return_inverse=True)
        order = np.argsort(of_ray.ravel(), kind="stable")
        groups = np.split(order, np.cumsum(np.bincount(of_ray.ravel()))[:-1])
        parts = []
        for number, (origin, rows) in enumerate(zip(origins, groups), 1):
            who = self.context.observer_at(origin)
            for a in _starts(rows):
                part = self._part(o[rows], d[rows], a, lambda camera, who=who: (camera.for_observer(who, True),))
                parts.append({name: v[0] if name in self.own else v for name, v in part.items()})
            self.reporter.progress(number / len(origins), f"origin {number:,} of {len(origins):,}")
        back = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[back] for name in self.asked}

    def _part(self, o: Floats, d: Floats, first: int, observed: Callable[[Any], Iterable[Any]]) -> dict[str, Floats]:
        """Of the `BATCH` rays from ``first`` on; ``observed``: the pixels of their observers."""
        import drjit as dr
        import mitsuba as mi

        o, d = o[first : first + BATCH], d[first : first + BATCH]
        ray = mi.RayDifferential3f(vector_of(mi.Point3f, o), vector_of(mi.Vector3f, d))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self.seed + first, len(o))
        with dr.suspend_grad():
            camera = self.context.trace(self.scene.mitsuba, [], sampler, ray, mi.Bool(True))
            shared = camera.channels(self.shared)
            color = camera.radiance(self.scene.mitsuba, sampler, None)[0]
            camera.settle(color, shared)
            each = []
            for mine in observed(camera) if self.own else ():
                channels = mine.channels(self.own)
                dr.eval(channels)
                each.append(self._named(self.own, channels, len(o)))
        values = self._named(self.shared, shared, len(o))
        if COLOR in self.asked:
            values[COLOR] = np.stack([_lanes(channel, len(o)) for channel in color], axis=-1)
        return values | {name: np.stack([one[name] for one in each]) for name in self.own}

    def _named(self, names: Sequence[str], channels: Sequence[Any], count: int) -> dict[str, Floats]:
        """Channels as arrays (N,), or (N, C) where a quantity has several, by quantity."""
        columns: dict[str, list[Floats]] = {}
        for name, value in zip(self.context.channels(names), channels):
            columns.setdefault(name.rpartition(".")[0], []).append(_lanes(value, count))
        return {name: c[0] if len(c) == 1 else np.stack(c, axis=-1) for name, c in columns.items()}


def _starts(rows: Any) -> range:
    return range(0, len(rows), BATCH)


def observe(
    scene: Scene | FilePath,
    points: ArrayLike,
    observers: ArrayLike | None = None,
    quantities: str | Sequence[str] | None = None,
) -> Observed:
    """How observers see points of a scene: whether they do, and how much gaze they give what is there.

    ``points`` (N, 3) on surfaces, in scene units; ``observers`` (M, 3), or None for the scene's own. Arrays are (M, N).
    ``quantities``: ``gaze`` (1/sr, after occlusion), ``visibility`` (1 visible .. 0 hidden), ``distance`` from the
    observer to the point and ``depth`` of what the observer meets on the way to it (that distance where nothing is
    met), both in scene units; all of them without any. What stands nearer to the point than the integrator's
    ``tolerance`` does not hide it. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors")
    >>> seen = nerg.observe(scene, points=(4.4, 2.8, 0.02), observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> seen.visibility.round(2).tolist()
    [[1.0], [0.0]]
    """
    scene = Scene.of(scene)
    active_mitsuba()
    known = AT_POINTS if scene.has_gaze else AT_POINTS[1:]
    asked = known if quantities is None else asked_quantities(scene, quantities, known)
    p = arrays.points(points, "points")
    eyes = given_observers(scene, observers)
    with mitsuba_says():
        each = [_at_points(ObserverOf(scene, eye), p, "gaze" in asked) for eye in eyes]
    return Observed({name: np.stack([one[name] for one in each]) for name in asked}, ("observer", "point"), eyes)


def given_observers(scene: Scene, observers: ArrayLike | None) -> Floats:
    """``observers`` as positions (M, 3); None: the scene's own. Raises `NergError` where there is none."""
    if observers is not None:
        return arrays.points(observers, "observers")
    if scene.observer is None:
        raise NergError("the scene has no observer of its own; say where they are with observers=[(x, y, z), ...]")
    return scene.observer[None]


def _at_points(observer: ObserverOf, p: Floats, with_gaze: bool) -> dict[str, Floats]:
    import drjit as dr
    import mitsuba as mi

    parts: dict[str, list[Floats]] = {}
    for a in range(0, len(p), BATCH):
        part = p[a : a + BATCH]
        with dr.suspend_grad():
            values = observer.sees(vector_of(mi.Point3f, part), with_gaze)
            dr.eval(values)
        for name, value in values.items():
            parts.setdefault(name, []).append(_lanes(value, len(part)))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Floats, Floats]:
    o = arrays.points(origins, "origins")
    d = arrays.points(directions, "directions")
    count = max(len(o), len(d))
    if len(o) not in (1, count):
        raise NergError(f"there must be one origin or as many as directions, {count}, got {len(o)}")
    return np.ascontiguousarray(np.broadcast_to(o, (count, 3))), arrays.unit(directions, count, "directions")


def _lanes(value: Any, count: int) -> Floats:
    """A Dr.Jit Float as an array (count,); one lane stands for all."""
    return np.broadcast_to(np.array(value, np.float32).ravel(), (count,)).copy()
