"""Values of fields without pictures: along rays, at points, of observers, and attention on surfaces and boxes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.formats.areas import Region
from nerg_mi.formats.meshes import READERS
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.ranges import MAX_COORDINATE, Range, check_number
from nerg_mi.statistics.shares import Shares, QuadratureRule, gaze_shares
from nerg_mi.statistics.visits import MARGIN, BoxAoi
from nerg_mi.workflows.base import SILENT, Reporter

from . import arrays
from .arrays import Floats, LabelledArrays, broadcast_to_observers
from .scene import COLOR, FilePath, Scene, activate_mitsuba, resolve_quantities, make_aov_context, load_mesh_child

# ---- One observer of a scene: what they see of points, and the density of their gaze ----


class SceneObserver:
    """The observer of ``scene`` at ``position`` (3,), in scene units.

    The settings of the march, of depths and of visibility are those of the scene's integrator. What a normalised gaze
    field has to know of the observer is computed once.
    """

    def __init__(self, scene: Scene, position: Floats):
        import drjit as dr
        import mitsuba as mi

        self.scene, self.geometry, self.integrator = scene, scene.geometry, scene.integrator
        self.center: Any = mi.Point3f(position.tolist())
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(self.center)
        self.gaze = None
        if scene.has_gaze:
            i = self.integrator
            self.gaze = i.gaze.for_observers([self.center], self.geometry, i.observer_settings, i.cache)

    def eval_gaze(self, p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
        """Gaze (Float, 1/sr) along the unit direction ``r_o``, in which the observer, who is at ``p_o`` in all lanes,
        sees the surface ``p_od``; as `nerg_mi.probes.surface_attention` wants it."""
        if self.gaze is None:
            raise ValueError("a scene without a gaze field has no gaze")
        return self.gaze.evaluate(p_od, p_o, r_o, active)[0]

    def observe(self, p: Any, with_gaze: bool) -> dict[str, Any]:
        """Of points ``p`` (Point3f): ``distance``, ``depth`` and ``visibility``, and ``gaze`` where wanted (Floats)."""
        import drjit as dr

        mi = variant_types()
        from nerg_mi.transport.observer import distance_and_direction
        from nerg_mi.transport.occlusion import trace_from_observer

        i = self.integrator
        distance, r_o = distance_and_direction(self.center, p)
        active = dr.full(mi.Bool, True, dr.width(p))
        ray = mi.Ray3f(self.center, r_o)
        sight = trace_from_observer(self.geometry, ray, p, self.center, 0, active, i.falloff, i.observer_settings, cache=i.cache)
        values = {"distance": distance, "depth": sight.depth, "visibility": sight.visibility}
        if with_gaze:
            seen = active & (sight.visibility > 0)
            p_o = self.center + dr.zeros(mi.Point3f, dr.width(p))
            gaze = self.eval_gaze(sight.p_od, p_o, r_o, seen)
            values["gaze"] = dr.select(seen, gaze * sight.visibility, 0)
        return values


# ---- Questions to a scene that are no pictures: what rays meet, and what observers see of points ----


BATCH_SIZE = 1 << 18
"""So many rays or points are computed at once."""

POINT_QUANTITIES = ("gaze", "visibility", "distance", "depth")
"""What `observe` answers."""


@dataclass(frozen=True, eq=False, repr=False)
class TraceResult(LabelledArrays):
    """Quantities of `trace`, each (rays,) or, with channels, (rays, channels); for given observers with an axis
    ``observer`` in front."""


@dataclass(frozen=True, eq=False, repr=False)
class ObserveResult(LabelledArrays):
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
) -> TraceResult:
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
    scene = Scene.coerce(scene)
    activate_mitsuba()
    asked = resolve_quantities(scene, quantities)
    o, d = _rays(origins, directions)
    with translate_mitsuba_errors():
        tracer = _Tracer(scene, asked, seed, reporter)
        if observers is None:
            return TraceResult(tracer.of_origins(o, d), ("ray",), None)
        eyes = arrays.as_points(observers, "observers")
        return TraceResult(tracer.of_observers(o, d, eyes), ("observer", "ray"), eyes)


class _Tracer:
    """Rays through a scene that are ``asked`` for quantities."""

    def __init__(self, scene: Scene, asked: Sequence[str], seed: int, reporter: Reporter):
        self.scene, self.asked, self.seed, self.reporter = scene, asked, seed, reporter
        self.context = make_aov_context(scene, asked)
        self.shared, self.own = self.context.shared_aovs, self.context.observer_aovs

    def of_observers(self, o: Floats, d: Floats, eyes: Floats) -> dict[str, Floats]:
        """Quantities (M, N, ...) of rays as observers at ``eyes`` (M, 3) have them."""
        observers = [self.context.make_observer(eye, len(eyes) == 1) for eye in eyes] if self.own else []
        parts = [self._part(o, d, a, lambda camera: map(camera.make_pixel, observers)) for a in _starts(o)]
        values = {}
        for name in self.asked:
            value = np.concatenate([part[name] for part in parts], axis=-1 if name in self.own else 0)
            values[name] = value if name in self.own else broadcast_to_observers(value, len(eyes))
        return values

    def of_origins(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """Quantities (N, ...) of rays as whoever stands at their origins has them."""
        if not self.own:
            parts = [self._part(o, d, a, lambda camera: ()) for a in _starts(o)]
            return {name: np.concatenate([part[name] for part in parts]) for name in self.asked}
        gaze = self.context.gaze
        if self.context.views or (gaze is not None and gaze.field.config.normalized):
            return self._of_each_origin(o, d)
        parts = [self._part(o, d, a, lambda camera: (camera.make_pixel_per_origin(),)) for a in _starts(o)]
        first = lambda name, value: value[0] if name in self.own else value
        return {name: np.concatenate([first(name, part[name]) for part in parts]) for name in self.asked}

    def _of_each_origin(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """The same, origin by origin: what is known of an observer is made for one position."""
        origins, of_ray = np.unique(o, axis=0, return_inverse=True)
        order = np.argsort(of_ray.ravel(), kind="stable")
        groups = np.split(order, np.cumsum(np.bincount(of_ray.ravel()))[:-1])
        parts = []
        for number, (origin, rows) in enumerate(zip(origins, groups), 1):
            who = self.context.make_observer(origin)
            for a in _starts(rows):
                part = self._part(o[rows], d[rows], a, lambda camera, who=who: (camera.make_pixel(who, True),))
                parts.append({name: v[0] if name in self.own else v for name, v in part.items()})
            self.reporter.progress(number / len(origins), f"origin {number:,} of {len(origins):,}")
        back = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[back] for name in self.asked}

    def _part(self, o: Floats, d: Floats, first: int, observed: Callable[[Any], Iterable[Any]]) -> dict[str, Floats]:
        """Of the `BATCH` rays from ``first`` on; ``observed``: the pixels of their observers."""
        import drjit as dr
        import mitsuba as mi

        o, d = o[first : first + BATCH_SIZE], d[first : first + BATCH_SIZE]
        ray = mi.RayDifferential3f(to_vector(mi.Point3f, o), to_vector(mi.Vector3f, d))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self.seed + first, len(o))
        with dr.suspend_grad():
            camera = self.context.trace(self.scene.mitsuba, [], sampler, ray, mi.Bool(True))
            shared = camera.compute_channels(self.shared)
            color = camera.compute_radiance(self.scene.mitsuba, sampler, None)[0]
            camera.eval_shared(color, shared)
            each = []
            for mine in observed(camera) if self.own else ():
                channels = mine.compute_channels(self.own)
                dr.eval(channels)
                each.append(self._named(self.own, channels, len(o)))
        values = self._named(self.shared, shared, len(o))
        if COLOR in self.asked:
            values[COLOR] = np.stack([_lanes(channel, len(o)) for channel in color], axis=-1)
        return values | {name: np.stack([one[name] for one in each]) for name in self.own}

    def _named(self, names: Sequence[str], channels: Sequence[Any], count: int) -> dict[str, Floats]:
        """Channels as arrays (N,), or (N, C) where a quantity has several, by quantity."""
        columns: dict[str, list[Floats]] = {}
        for name, value in zip(self.context.channel_names(names), channels):
            columns.setdefault(name.rpartition(".")[0], []).append(_lanes(value, count))
        return {name: c[0] if len(c) == 1 else np.stack(c, axis=-1) for name, c in columns.items()}


def _starts(rows: Any) -> range:
    return range(0, len(rows), BATCH_SIZE)


def observe(
    scene: Scene | FilePath,
    points: ArrayLike,
    observers: ArrayLike | None = None,
    quantities: str | Sequence[str] | None = None,
) -> ObserveResult:
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
    scene = Scene.coerce(scene)
    activate_mitsuba()
    known = POINT_QUANTITIES if scene.has_gaze else POINT_QUANTITIES[1:]
    asked = known if quantities is None else resolve_quantities(scene, quantities, known)
    p = arrays.as_points(points, "points")
    eyes = resolve_observers(scene, observers)
    with translate_mitsuba_errors():
        each = [_at_points(SceneObserver(scene, eye), p, "gaze" in asked) for eye in eyes]
    return ObserveResult({name: np.stack([one[name] for one in each]) for name in asked}, ("observer", "point"), eyes)


def resolve_observers(scene: Scene, observers: ArrayLike | None) -> Floats:
    """``observers`` as positions (M, 3); None: the scene's own. Raises `NergError` where there is none."""
    if observers is not None:
        return arrays.as_points(observers, "observers")
    if scene.observer is None:
        raise NergError("the scene has no observer of its own; say where they are with observers=[(x, y, z), ...]")
    return scene.observer[None]


def _at_points(observer: SceneObserver, p: Floats, with_gaze: bool) -> dict[str, Floats]:
    import drjit as dr
    import mitsuba as mi

    parts: dict[str, list[Floats]] = {}
    for a in range(0, len(p), BATCH_SIZE):
        part = p[a : a + BATCH_SIZE]
        with dr.suspend_grad():
            values = observer.observe(to_vector(mi.Point3f, part), with_gaze)
            dr.eval(values)
        for name, value in values.items():
            parts.setdefault(name, []).append(_lanes(value, len(part)))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Floats, Floats]:
    o = arrays.as_points(origins, "origins")
    d = arrays.as_points(directions, "directions")
    count = max(len(o), len(d))
    if len(o) not in (1, count):
        raise NergError(f"there must be one origin or as many as directions, {count}, got {len(o)}")
    return np.ascontiguousarray(np.broadcast_to(o, (count, 3))), arrays.as_unit_vectors(directions, count, "directions")


def _lanes(value: Any, count: int) -> Floats:
    """A Dr.Jit Float as an array (count,); one lane stands for all."""
    return np.broadcast_to(np.array(value, np.float32).ravel(), (count,)).copy()


# ---- Attention ----
#
# Attention on things: the share of observers' gaze that lands on a box, a mesh or a shape of the scene.
#
# Of a box it is the share of the gaze whose first surface lies in it, summed over directions
# (`nerg_mi.statistics.shares`), as statistics, reports and the viewer have it. Of a mesh or a shape it is the share
# that ends on its own surface, in area form (`nerg_mi.probes.surface_attention`), which also tells where on it.


DEFAULT_SUM_RULE = QuadratureRule()
"""How finely the share of a box is summed, unless another tolerance is asked for."""

PATCH_SIZE_RATIO = 4
"""A piece of a surface is so many times shorter than its distance from the nearest observer."""

MAX_AUTO_DIVISIONS = 32
"""A triangle is cut into so many parts a side at most, unless more are asked for."""


@dataclass(frozen=True, eq=False, repr=False)
class Attention:
    """Attention that a thing receives from M observers.

    ``share`` (M,): of each observer's gaze, the part whose first surface lies in the box, or is the mesh or the shape;
    all of the gaze, with what meets no surface, is 1. ``error`` (M,): the one that a share of a box is likely to have
    at most; None for meshes. ``escaped`` (M,): the share that meets no surface at all; None for meshes. ``observers``
    (M, 3).
    """

    share: Floats
    observers: Floats
    error: Floats | None = None
    escaped: Floats | None = None

    @property
    def mean(self) -> float:
        """Mean share over the observers."""
        return float(np.mean(self.share, dtype=np.float64))

    def __repr__(self) -> str:
        return f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers>"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceAttention(Attention):
    """Attention that a surface, cut into K flat pieces, receives from M observers.

    ``density`` (M, K): in area form, in 1 / square scene unit; times ``area`` (K,) it adds up to ``share``. ``points``,
    ``normals`` (K, 3): centres of the pieces and their outward unit normals.
    """

    density: Floats
    points: Floats
    normals: Floats
    area: Floats

    def __repr__(self) -> str:
        return (
            f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers "
            f"on {float(self.area.sum()):.4g} square units in {len(self.area):,} pieces>"
        )


def attention(
    scene: Scene | FilePath,
    surface: ArrayLike | os.PathLike[str] | str | Mapping[str, Any] | object,
    observers: ArrayLike | None = None,
    *,
    margin: float = MARGIN,
    tolerance: float = DEFAULT_SUM_RULE.rtol,
    divisions: int | None = None,
    two_sided: bool = False,
    reporter: Reporter = SILENT,
) -> Attention:
    """How much of their gaze observers give a thing.

    ``surface``: a box, as its lower and upper corner (2, 3); the id of a mesh of the scene; a mesh file (.ply, .obj,
    .glb); a dict for ``mi.load_dict``, or a Mitsuba mesh. ``observers`` (M, 3), or None for the scene's own.

    A box has the gaze whose first surface lies in it, whatever stands there, so that a larger box never has less, and
    one in free air has none. ``margin``, in scene units: how far in front of the box, or behind it, on a ray that
    crosses it, that surface may lie; with 0, boxes that fill space without overlap, none of whose faces runs along a
    surface, add up to 1 with ``escaped``.
    ``tolerance``: directions are added until the error of a share is less than this part of it (or 1e-5), or until a
    million lie around the observer.

    A mesh is a surface of its own, and the result a `SurfaceAttention`, which says where on it: one that is not of the
    scene is looked at as if it stood there: the scene hides it, and it hides nothing but its own back. ``divisions``:
    each triangle is cut into so many parts a side, whose centres stand for them; None: so many that pieces are no
    longer than a quarter of the distance to the nearest observer, which is right to some thousandths, and 32 at most.
    ``two_sided``: count both sides of an open surface; otherwise the one whose vertices run counter-clockwise. The
    scene's fall-off has no part in it: what is hidden is not looked at. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", falloff=0.05)
    >>> shelf = [(3.79, 5.4, 0.0), (5.31, 6.0, 1.9)]
    >>> seen = nerg.attention(scene, shelf, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> seen.share.shape, bool((seen.share > 0).all() and (seen.error < 0.1 * seen.share).all())
    ((2,), True)
    """
    import drjit as dr

    from nerg_mi.probes.surface_attention import make_patches

    scene = Scene.coerce(scene)
    _check(scene)
    check_number(margin, Range(0, MAX_COORDINATE), "margin")
    check_number(tolerance, Range(1e-9, 1), "tolerance")
    if (region := _box(surface)) is not None:
        if divisions is not None or two_sided:
            raise NergError("divisions and two_sided are of meshes, and this is a box; leave them out, or give a mesh")
        eyes = resolve_observers(scene, observers)
        rule = QuadratureRule(rtol=float(tolerance))
        found = compute_box_shares(scene, [region], eyes, margin=float(margin), rule=rule, reporter=reporter)
        single = lambda v: np.ascontiguousarray(v, np.float32)
        return Attention(single(found.share[:, 0]), eyes, single(found.error[:, 0]), single(found.escaped))
    whole = isinstance(divisions, (int, np.integer)) and not isinstance(divisions, bool)
    if not (divisions is None or (whole and 1 <= divisions <= 4096)):
        raise NergError(f"divisions must be a whole number from 1 to 4,096, got {divisions!r}")
    eyes = resolve_observers(scene, observers)
    each = []
    with translate_mitsuba_errors(), dr.suspend_grad():
        mesh = _mesh(scene, surface)
        pieces = make_patches(mesh, _enough_divisions(mesh, eyes) if divisions is None else int(divisions))
        area = np.array(pieces.area, np.float32)
        for number, eye in enumerate(eyes):
            each.append(_density(scene, eye, pieces, two_sided))
            reporter.progress((number + 1) / len(eyes), f"observer {number + 1} of {len(eyes)}")
        where, normals = (np.ascontiguousarray(np.array(v, np.float32).T) for v in (pieces.p, pieces.n))
    density = np.stack(each)
    share = (density.astype(np.float64) @ area.astype(np.float64)).astype(np.float32)
    if not np.isfinite(share).all():
        raise NergError("the attention on this mesh is not finite; give one, and observers, of the scene's size")
    return SurfaceAttention(share, eyes, density=density, points=where, normals=normals, area=area)


def compute_box_shares(
    scene: Scene,
    regions: Sequence[Region],
    observers: Floats,
    *,
    margin: float = MARGIN,
    rule: QuadratureRule = DEFAULT_SUM_RULE,
    reporter: Reporter = SILENT,
) -> Shares:
    """The shares of ``observers`` (M, 3) on N boxes, which may be turned, all of them at once, (M, N), as finely as
    the ``rule`` says; arguments and errors as of `attention`."""
    from nerg_mi.transport.observer_gaze import make_gaze_evaluator

    _check(scene)
    i, place, count = scene.integrator, scene.geometry, len(observers)
    told = lambda done: reporter.progress(done / count, f"observer {done} of {count}")
    with translate_mitsuba_errors():
        return gaze_shares(
            lambda eye: make_gaze_evaluator(i.gaze, place, i.observer_settings, eye),
            observers,
            [BoxAoi(region) for region in regions],
            [(k,) for k in range(len(regions))],
            margin,
            rule,
            told,
        )


def compute_mesh_shares(
    scene: Scene, surfaces: Sequence[Any], observer: ArrayLike, *, divisions: int, two_sided: bool = False
) -> Floats:
    """The share (N,) of one observer's gaze that each of N meshes, ``surfaces``, receives, all of them at once.

    Arguments and errors as of `attention`; ``observer`` (3,).
    """
    import drjit as dr

    mi = variant_types()
    from nerg_mi.probes.surface_attention import Patches, make_patches

    _check(scene)
    if not len(surfaces):
        return np.zeros(0, np.float32)
    eye = resolve_observers(scene, observer)[0]
    with translate_mitsuba_errors(), dr.suspend_grad():
        each = [make_patches(_mesh(scene, surface), divisions) for surface in surfaces]
        area = [np.array(pieces.area, np.float64) for pieces in each]
        lanes = lambda name: np.concatenate([np.array(getattr(pieces, name), np.float32) for pieces in each], axis=1)
        pieces = Patches(mi.Point3f(lanes("p")), mi.Vector3f(lanes("n")), mi.Float(np.concatenate(area)))
        density = _density(scene, eye, pieces, two_sided)
    starts = np.cumsum([0, *(len(a) for a in area[:-1])])
    return np.add.reduceat(density * np.concatenate(area), starts).astype(np.float32)


def _check(scene: Scene) -> None:
    activate_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a gaze field; give make_scene gaze=")


def _density(scene: Scene, eye: Floats, pieces: Any, two_sided: bool) -> Floats:
    """Share of the gaze (K,) per area that ``pieces`` receive from the observer at ``eye`` (3,)."""
    from nerg_mi.probes.surface_attention import attention_per_area

    observer = SceneObserver(scene, eye)
    settings = observer.integrator.observer_settings
    found = attention_per_area(observer.geometry, observer.eval_gaze, observer.center, pieces.p, pieces.n, 0.0, settings, two_sided)
    if not observer.integrator.gaze.field.config.normalized:
        whole = compute_box_shares(scene, [], eye[None]).integral[0]
        found /= whole if whole > 0 else 1
    return np.array(found, np.float32)


def _enough_divisions(mesh: Any, eyes: Floats) -> int:
    """A power of two, so that meshes of different sizes have kernels in common."""
    import mitsuba as mi

    if not isinstance(mesh, mi.Mesh):
        return 1  # no mesh, as will be said
    positions, faces = (np.reshape(np.array(v), (-1, 3)) for v in (mesh.vertex_positions_buffer(), mesh.faces_buffer()))
    corners = positions[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    beside = np.maximum(np.maximum(corners.min((0, 1)) - eyes, eyes - corners.max((0, 1))), 0)
    nearest = np.linalg.norm(beside, axis=1).min()
    wanted = PATCH_SIZE_RATIO * longest / nearest if nearest > 0 else np.inf
    return int(2 ** np.ceil(np.log2(np.clip(wanted, 1, MAX_AUTO_DIVISIONS))))


def _box(surface: Any) -> Region | None:
    """``surface`` as a box; None for what is a mesh, or the name of one."""
    import mitsuba as mi

    if isinstance(surface, Region):
        return surface
    if isinstance(surface, (str, os.PathLike, Mapping, mi.Object)):
        return None
    corners = arrays.as_points(surface, "the corners of a box").astype(np.float64)
    if len(corners) != 2 or not np.all(corners[0] < corners[1]):
        raise NergError(f"a box is a lower corner and an upper one, got {corners.tolist()}")
    return Region.create("box", *corners)


def _mesh(scene: Scene, surface: Any) -> Any:
    """``surface`` as a Mitsuba mesh."""
    import mitsuba as mi

    if isinstance(surface, str) and Path(surface).suffix.lower() not in READERS:
        by_id = {shape.id(): shape for shape in scene.mitsuba.shapes()}
        if surface not in by_id:
            known = f"it has {', '.join(by_id)}" if by_id else "it has none"
            raise NergError(f'the scene has no shape "{surface}"; {known}')
        return by_id[surface]
    if isinstance(surface, (str, os.PathLike)):
        surface = load_mesh_child(surface)
    return mi.load_dict(dict(surface)) if isinstance(surface, Mapping) else surface
