"""Queries: quantities along rays, at points, and the attention on surfaces and boxes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.contents import from_trimesh, is_trimesh, load_content, load_mesh, load_mesh_child
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.files.values import FilePath
from nerg_mi.formats.areas import Region
from nerg_mi.formats.meshes import READERS, MeshFile
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.measures.shares import Shares, SummationRule, gaze_shares
from nerg_mi.measures.visits import MARGIN, Aoi, BoxAoi
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.ranges import MAX_COORDINATE, Range, check_number
from nerg_mi.rendering.scene import activate_mitsuba

from . import arrays
from .arrays import Floats, LabelledArrays, broadcast_to_observers
from .calls import Progress, report_progress
from .scene import COLOR, Scene, make_aov_context, resolve_quantities

if TYPE_CHECKING:
    from nerg_mi.aoi.scene import ShapeAoi
    from nerg_mi.transport.geometry import SceneGeometry

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

    def eval_gaze(self, p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
        """Evaluate the gaze density.

        The signature is that of `nerg_mi.probes.surface_attention`.

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

    def observe(self, points: Any, with_gaze: bool) -> dict[str, Any]:
        """Compute what the observer sees of points.

        Parameters
        ----------
        points : Point3f
            Points in scene units.
        with_gaze : bool
            Whether to compute the gaze.

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
        hit = trace_from_observer(
            self.geometry, ray, points, self.center, 0, active, i.falloff, i.observer_settings, cache=i.cache
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
        ``density`` of a gaze field is not (`load_gaze`).

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
    field (`load_gaze`) computes the integrals of many origins together, in about 10 ms per origin with its default
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
    o, d = arrays.as_rays(origins, directions)
    with report_progress(progress) as reporter, translate_mitsuba_errors():
        tracer = _Tracer(scene, requested, seed, reporter)
        positions = np.unique(o, axis=0) if observers is None else arrays.as_points(observers, "observers")
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
        parts = [self._trace_batch(o, d, a, lambda camera: map(camera.make_pixel, observers)) for a in _batch_starts(o)]
        values = {}
        for name in self.requested:
            value = np.concatenate([part[name] for part in parts], axis=-1 if name in self.per_observer else 0)
            values[name] = value if name in self.per_observer else broadcast_to_observers(value, len(positions))
        return values

    def trace_for_origins(self, o: Floats, d: Floats) -> dict[str, Floats]:
        """Compute quantities (N, ...) of rays for observers at their origins."""
        if not self.per_observer:
            parts = [self._trace_batch(o, d, a, lambda camera: ()) for a in _batch_starts(o)]
            return {name: np.concatenate([part[name] for part in parts]) for name in self.requested}
        gaze = self.context.gaze
        if self.context.views or (gaze is not None and gaze.field.config.normalized):
            return self._trace_each_origin(o, d)
        parts = [self._trace_batch(o, d, a, lambda camera: (camera.make_pixel_per_origin(),)) for a in _batch_starts(o)]
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
            for a in _batch_starts(rows):
                part = self._trace_batch(
                    o[rows], d[rows], a, lambda camera, who=observer: (camera.make_pixel(who, True),)
                )
                parts.append({name: v[0] if name in self.per_observer else v for name, v in part.items()})
            self.reporter.progress(number / len(origins), f"origin {number:,} of {len(origins):,}")
        inverse = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[inverse] for name in self.requested}

    def _trace_batch(
        self, o: Floats, d: Floats, start: int, make_pixels: Callable[[Any], Iterable[Any]]
    ) -> dict[str, Floats]:
        """Trace `BATCH_SIZE` rays from index ``start``; ``make_pixels`` returns the pixels of each observer."""
        import drjit as dr
        import mitsuba as mi

        o, d = o[start : start + BATCH_SIZE], d[start : start + BATCH_SIZE]
        ray = mi.RayDifferential3f(to_vector(mi.Point3f, o), to_vector(mi.Vector3f, d))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self.seed + start, len(o))
        with dr.suspend_grad():
            camera = self.context.trace(self.scene.mitsuba, [], sampler, ray, mi.Bool(True))
            shared = camera.compute_channels(self.shared)
            color = camera.compute_radiance(self.scene.mitsuba, sampler, None)[0]
            camera.eval_shared(color, shared)
            each = []
            for pixels in make_pixels(camera) if self.per_observer else ():
                channels = pixels.compute_channels(self.per_observer)
                dr.eval(channels)
                each.append(self._group_channels(self.per_observer, channels, len(o)))
        values = self._group_channels(self.shared, shared, len(o))
        if COLOR in self.requested:
            values[COLOR] = np.stack([_to_array(channel, len(o)) for channel in color], axis=-1)
        return values | {name: np.stack([one[name] for one in each]) for name in self.per_observer}

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
    p = arrays.as_points(points, "points")
    with report_progress(progress) as reporter, translate_mitsuba_errors():
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
        positions = arrays.as_points(observers, "observers")
    elif scene.observer is not None:
        positions = scene.observer[None]
    else:
        raise NergError("the scene has no observer; pass positions with observers=[(x, y, z), ...]")
    warn_extrapolation(reporter, scene, positions)
    return positions


def warn_extrapolation(reporter: Reporter, scene: Scene, positions: Floats) -> None:
    """Warn if values at ``positions`` (M, 3) are extrapolated; a silent reporter takes no time."""
    from nerg_mi.transport import extrapolation

    if not getattr(reporter, "is_silent", False):
        extrapolation.warn_extrapolation(reporter.warn, scene.geometry, scene.integrator.gaze, positions)


def _observe_points(observer: SceneObserver, p: Floats, with_gaze: bool) -> dict[str, Floats]:
    import drjit as dr
    import mitsuba as mi

    parts: dict[str, list[Floats]] = {}
    for a in range(0, len(p), BATCH_SIZE):
        part = p[a : a + BATCH_SIZE]
        with dr.suspend_grad():
            values = observer.observe(to_vector(mi.Point3f, part), with_gaze)
            dr.eval(values)
        for name, value in values.items():
            parts.setdefault(name, []).append(_to_array(value, len(part)))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _to_array(value: Any, count: int) -> Floats:
    """Convert a Dr.Jit Float to an array (count,); a single value is repeated."""
    return np.broadcast_to(np.array(value, np.float32).ravel(), (count,)).copy()


# ---- Attention ----
#
# An attention share is the fraction of the gaze whose first surface is in a box, or is a mesh or shape, summed over
# directions (`nerg_mi.measures.shares`): the size of triangles does not matter, and each direction meets one surface.
# Statistics, reports and the viewer use this definition. The distribution on a mesh is the integral over its patches
# (`nerg_mi.probes.surface_attention`), scaled to the share.


DEFAULT_SUM_RULE = SummationRule()
"""Default accuracy of attention shares."""

PATCH_SIZE_RATIO = 4
"""Ratio of an observer's distance from a surface and the size of the patches into which it is divided."""

MAX_AUTO_DIVISIONS = 32
"""Maximum number of automatic divisions per side of a triangle."""


@dataclass(frozen=True, eq=False, repr=False)
class Attention:
    """Attention that an object receives from M observers.

    Attributes
    ----------
    share : ndarray of shape (M,)
        Attention share: fraction of each observer's gaze whose first surface is in the box, or is the mesh or shape.
        The denominator includes gaze that hits no surface.
    observers : ndarray of shape (M, 3)
        Positions of the observers in scene units.
    error : ndarray of shape (M,)
        Estimate of the maximum error of the share.
    escaped : ndarray of shape (M,)
        Fraction of the gaze that hits no surface.
    """

    share: Floats
    observers: Floats
    error: Floats
    escaped: Floats

    @property
    def mean(self) -> float:
        """Mean attention share of the observers."""
        return float(np.mean(self.share, dtype=np.float64))

    def __repr__(self) -> str:
        return f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers>"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceAttention(Attention):
    """Attention that a surface, divided into K flat patches, receives from M observers.

    Attributes
    ----------
    density : ndarray of shape (M, K)
        Attention share per area, in 1 / (scene unit)²; ``density @ area`` equals ``share``, except where no centre of a
        patch is visible.
    points, normals : ndarray of shape (K, 3)
        Centres of the patches in scene units, and their outward unit normals.
    area : ndarray of shape (K,)
        Areas of the patches in (scene unit)².
    """

    density: Floats
    points: Floats
    normals: Floats
    area: Floats

    def __repr__(self) -> str:
        return (
            f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers "
            f"on {float(self.area.sum()):.4g} square units in {len(self.area):,} patches>"
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
    progress: Progress = None,
) -> Attention:
    """Compute which fraction of their gaze observers direct at an object.

    Parameters
    ----------
    scene : Scene or path
        The scene, or a scene file; it needs a gaze field.
    surface : array_like of shape (2, 3), str, path, mapping or mi.Mesh
        A box, as its lower and upper corner in scene units; the id of a mesh of the scene; a mesh file (.ply, .obj,
        .glb); a dict for ``mi.load_dict``; or a Mitsuba mesh.
    observers : array_like of shape (M, 3) or (3,), optional
        Positions of the observers in scene units. Default: the observer of the scene.
    margin : float
        Boxes only: a surface counts if it is at most this far outside the box along the ray, in scene units.
    tolerance : float
        Directions are added until the error of the share is below this fraction of it, or below 1e-5, or until 16
        million directions are used (a million for areas all around the observer).
    divisions : int, optional
        Meshes only: number of parts per side into which each triangle is divided for the distribution on the surface.
        The share does not depend on it. Default: patches of at most a quarter of the distance to the nearest observer,
        at most 32 parts.
    two_sided : bool
        Meshes only: count both sides of an open surface. Otherwise only the side with counterclockwise vertices counts.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

    Returns
    -------
    Attention
        For a mesh, a `SurfaceAttention`, which contains the distribution on the surface.

    Raises
    ------
    NergError
        An argument is invalid, or the scene has no gaze field or observer.

    Notes
    -----
    A box contains the gaze that ends on any surface inside it: a larger box never has a smaller share, and a box in
    empty space has none. With ``margin=0``, the shares of boxes that fill space without overlap, and whose faces do not
    coincide with surfaces, sum to 1 together with ``escaped``.

    The shares of all meshes of a closed room sum to 1 (with ``two_sided=True`` if faces are seen from behind).

    A mesh that is not part of the scene is treated as if it were there: the scene occludes it, and it occludes only
    itself. The fall-off of the scene is ignored: an occluded point receives no attention.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", falloff=0.05)
    >>> shelf = [(3.79, 5.4, 0.0), (5.31, 6.0, 1.9)]
    >>> result = nerg.attention(scene, shelf, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> result.share.shape, bool((result.share > 0).all() and (result.error < 0.1 * result.share).all())
    ((2,), True)
    """
    import drjit as dr

    from nerg_mi.probes.surface_attention import make_patches

    scene = Scene.coerce(scene)
    _check_has_gaze(scene)
    check_number(margin, Range(0, MAX_COORDINATE), "margin")
    check_number(tolerance, Range(1e-9, 1), "tolerance")
    rule = SummationRule(rtol=float(tolerance))
    if (region := _as_box(surface)) is not None:
        if divisions is not None or two_sided:
            raise NergError("divisions and two_sided apply to meshes only, but the surface is a box; omit them")
        with report_progress(progress) as reporter:
            positions = resolve_observers(scene, observers, reporter)
            shares = compute_box_shares(scene, [region], positions, margin=float(margin), rule=rule, reporter=reporter)
        return Attention(**_first_shares(shares), observers=positions)
    is_integer = isinstance(divisions, (int, np.integer)) and not isinstance(divisions, bool)
    if not (divisions is None or (is_integer and 1 <= divisions <= 4096)):
        raise NergError(f"divisions must be an integer from 1 to 4,096, got {divisions!r}")
    densities = []
    with report_progress(progress) as reporter, translate_mitsuba_errors(), dr.suspend_grad():
        positions = resolve_observers(scene, observers, reporter)
        mesh = _as_mesh(scene, surface)
        pieces = make_patches(mesh, _choose_divisions(mesh, positions) if divisions is None else int(divisions))
        arrays_of_patches = pieces.area, pieces.p, pieces.n
        area, centers, normals = (np.ascontiguousarray(np.array(v, np.float32).T) for v in arrays_of_patches)
        geometry = scene.geometry if _is_part(scene, mesh) else _add_mesh(scene, mesh)
        for number, position in enumerate(positions):
            densities.append(_compute_density(scene, geometry, position, pieces, two_sided))
            reporter.progress((number + 1) / len(positions), f"observer {number + 1} of {len(positions)}")
        density = np.stack(densities)
        sums = density.astype(np.float64) @ area.astype(np.float64)
        if not np.isfinite(sums).all():
            raise NergError("the attention on this mesh is not finite; check the scale of mesh and observers")
        aoi = _make_mesh_aoi(scene, mesh, two_sided)
        shares = _first_shares(compute_shares(scene, [aoi], positions, margin=0.0, rule=rule, geometry=geometry))
        if not two_sided and all((((eye - centers) * normals).sum(axis=1) <= 0).all() for eye in positions):
            reporter.warn(
                "the attention is 0, since the observers are behind all faces of the mesh (in front, vertices are "
                "counterclockwise); add two_sided=True to count both sides, as of a room seen from inside"
            )
    density *= np.divide(shares["share"], sums, out=np.zeros(len(sums)), where=sums > 0)[:, None].astype(np.float32)
    return SurfaceAttention(**shares, observers=positions, density=density, points=centers, normals=normals, area=area)


def _first_shares(shares: Shares) -> dict[str, Floats]:
    """Return share, error and escaped gaze (M,) of the first area."""
    columns = {"share": shares.share[:, 0], "error": shares.error[:, 0], "escaped": shares.escaped}
    return {name: np.ascontiguousarray(values, np.float32) for name, values in columns.items()}


def compute_shares(
    scene: Scene,
    aois: Sequence[Aoi],
    observers: Floats,
    *,
    margin: float = MARGIN,
    rule: SummationRule = DEFAULT_SUM_RULE,
    reporter: Reporter = SILENT,
    geometry: SceneGeometry | None = None,
) -> Shares:
    """Compute the attention shares of N areas for M observers: the function behind `attention` and the viewer.

    Parameters
    ----------
    scene : Scene
        The scene, with a gaze field.
    aois : sequence of Aoi
        The areas.
    observers : ndarray of shape (M, 3)
        Positions in scene units.
    margin, reporter
        As for `attention`.
    rule : SummationRule
        Accuracy of the sum over directions.
    geometry : SceneGeometry, optional
        What rays hit. Default: that of the scene.

    Returns
    -------
    Shares
        Shares of shape (M, N).
    """
    from nerg_mi.transport.observer_gaze import make_gaze_evaluator

    _check_has_gaze(scene)
    i, environment, count = scene.integrator, geometry or scene.geometry, len(observers)
    on_progress = lambda done: reporter.progress(done / count, f"observer {done} of {count}")
    with translate_mitsuba_errors():
        return gaze_shares(
            lambda eye: make_gaze_evaluator(i.gaze, environment, i.observer_settings, eye),
            observers,
            aois,
            [(k,) for k in range(len(aois))],
            margin,
            rule,
            on_progress,
        )


def compute_box_shares(scene: Scene, regions: Sequence[Region], observers: Floats, **options: Any) -> Shares:
    """Compute the attention shares of N boxes, which may be rotated; ``options`` are those of `compute_shares`."""
    return compute_shares(scene, [BoxAoi(region) for region in regions], observers, **options)


def make_shape_aois(scene: Scene, names: Sequence[str]) -> list[Aoi]:
    """Return the meshes of the scene with these ids as areas, which are hit from both sides."""
    _check_has_gaze(scene)
    with translate_mitsuba_errors():
        return [_make_mesh_aoi(scene, _as_mesh(scene, name), two_sided=True) for name in names]


def _make_mesh_aoi(scene: Scene, mesh: Any, two_sided: bool) -> ShapeAoi:
    """Return ``mesh`` as an area, with the tolerance of `transport.occlusion`."""
    from nerg_mi.aoi.scene import aoi_from_shape
    from nerg_mi.transport.occlusion import shape_tolerance

    part_of = scene.mitsuba if _is_part(scene, mesh) else None
    tolerance = shape_tolerance(scene.geometry, scene.integrator.observer_settings, mesh)
    return aoi_from_shape(mesh.id(), mesh, part_of, two_sided=two_sided, tolerance=tolerance)


def _is_part(scene: Scene, mesh: Any) -> bool:
    return any(shape is mesh for shape in scene.mitsuba.shapes())


def _add_mesh(scene: Scene, mesh: Any) -> SceneGeometry:
    """Return the geometry of the scene with ``mesh``."""
    from nerg_mi.aoi.scene import scene_from_shapes
    from nerg_mi.transport.geometry import SceneGeometry

    shapes = {str(k): shape for k, shape in enumerate([*scene.mitsuba.shapes(), mesh])}
    return SceneGeometry(scene.geometry.medium, scene_from_shapes(shapes))


def _check_has_gaze(scene: Scene) -> None:
    activate_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a scene with a gaze field; pass gaze= to make_scene")


def _compute_density(scene: Scene, geometry: SceneGeometry, position: Floats, pieces: Any, two_sided: bool) -> Floats:
    """Compute the attention per area (K,) of ``pieces`` for the observer at ``position`` (3,), up to a factor."""
    from nerg_mi.probes.surface_attention import attention_per_area

    observer = SceneObserver(scene, position, geometry)
    settings = observer.integrator.observer_settings
    density = attention_per_area(
        geometry, observer.eval_gaze, observer.center, pieces.p, pieces.n, 0.0, settings, two_sided
    )
    return np.array(density, np.float32)


def _choose_divisions(mesh: Any, positions: Floats) -> int:
    """Choose a power of two, so that meshes of different sizes share kernels."""
    from nerg_mi.transport.mitsuba_mesh import is_mesh, read_triangles

    if not is_mesh(mesh):
        return 1  # an error is raised later
    vertices, faces = read_triangles(mesh)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    distances = np.maximum(np.maximum(corners.min((0, 1)) - positions, positions - corners.max((0, 1))), 0)
    nearest = np.linalg.norm(distances, axis=1).min()
    divisions = PATCH_SIZE_RATIO * longest / nearest if nearest > 0 else np.inf
    return int(2 ** np.ceil(np.log2(np.clip(divisions, 1, MAX_AUTO_DIVISIONS))))


def _as_box(surface: Any) -> Region | None:
    """Return ``surface`` as a box; None if it is a mesh."""
    import mitsuba as mi

    if isinstance(surface, Region):
        return surface
    if isinstance(surface, (str, os.PathLike, Mapping, mi.Object)) or is_trimesh(surface):
        return None
    corners = arrays.as_points(surface, "the corners of a box").astype(np.float64)
    if len(corners) != 2 or not np.all(corners[0] < corners[1]):
        raise NergError(f"a box must be a lower and an upper corner, got {corners.tolist()}")
    return Region.create("box", *corners)


def _as_mesh(scene: Scene, surface: Any) -> Any:
    """Return ``surface`` as a Mitsuba mesh."""
    if isinstance(surface, str) and Path(surface).suffix.lower() not in READERS:
        by_id = {shape.id(): shape for shape in scene.mitsuba.shapes()}
        if surface not in by_id:
            available = f"its shapes are {', '.join(by_id)}" if by_id else "it has no shapes"
            raise NergError(f'the scene has no shape "{surface}"; {available}')
        return by_id[surface]
    if isinstance(surface, (str, os.PathLike)):
        surface = load_mesh_child(surface)
    elif is_trimesh(surface):
        meshes = from_trimesh(surface, "surface")
        if len(meshes) > 1:
            raise NergError(f"the surface is a trimesh.Scene of {len(meshes)} meshes; pass one of them")
        surface = next(iter(meshes.values()))
    if isinstance(surface, MeshFile):
        surface = load_mesh(surface, "surface")
    return load_content(surface) if isinstance(surface, Mapping) else surface
