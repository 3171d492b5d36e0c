"""A place as rays meet it: its media and surfaces, panoramas, what is shaded where a ray ends, and rays traced to
it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.types import Bool, Color, Float, Point3f, Ray3f, Vector3f, variant_types

from .depth import DEPTHS, escape_distance, surface_depth
from .march import scouted_march
from .march_primal import MarchResult, MarchSettings, default_growth, default_step, default_stop
from .medium import Medium

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Ceiling ----
#
# A roof that is left out of views from above: where rays begin that start over it.

_LEAST_FALL = 1e-9
"""Cosine to straight down below which a ray runs along the plane, and is traced as it is."""


class Ceiling:
    """The plane of the points x with x · up = height; ``up`` (3,) of any length but zero, ``height`` in scene units.

    Rays that start above it and come below it begin there. Both numbers are kept opaque: another height is no other
    kernel. Raises `NergError` for an ``up`` that is no direction.
    """

    def __init__(self, height: float, up: ArrayLike = (0.0, 0.0, 1.0)):
        direction = np.asarray(up, float)
        length = float(np.linalg.norm(direction))
        if not (length > 0 and np.isfinite(length)):
            raise NergError(f'"up" must be a direction, three numbers that are not all 0, got {direction.tolist()}')
        self.height, self.up = float(height), direction / length
        mi = variant_types()
        self._height, self._up = mi.Float(self.height), mi.Vector3f(*self.up.tolist())
        dr.make_opaque(self._height, self._up)

    def cut(self, ray: Any) -> tuple[Any, Float]:
        """``ray`` (unit direction) from where it comes below the plane, and how far it went until then: 0 where it
        starts below, or never comes there. Differentiable in the ray."""
        over, fall = dr.dot(ray.o, self._up) - self._height, -dr.dot(ray.d, self._up)
        cuts = (over > 0) & (fall > _LEAST_FALL)
        ahead = dr.select(cuts, over / dr.select(cuts, fall, 1), 0)
        moved = type(ray)(ray)
        moved.o = dr.fma(ray.d, ahead, ray.o)
        moved.maxt = ray.maxt - ahead
        if isinstance(ray, variant_types().RayDifferential3f):
            moved.o_x, moved.o_y = dr.fma(ray.d_x, ahead, ray.o_x), dr.fma(ray.d_y, ahead, ray.o_y)
        return moved, ahead

    def __str__(self) -> str:
        x, y, z = self.up
        return f"{self.height:.6g} along ({x:.6g}, {y:.6g}, {z:.6g})"


# ---- Panorama ----
#
# The pixels of a full-sphere picture and the directions they stand for: the mapping of Mitsuba's `envmap`.
#
# A picture of W x H pixels covers the sphere by longitude φ and polar angle θ, in a frame whose +Y points up:
#
#     v = (sin φ sin θ, cos θ, -cos φ sin θ),    φ = 2π x / W,    θ = π (y - 1/2) / (H - 1)
#
# with (x, y) in pixels, the centre of pixel (i, j) at (i + 1/2, j + 1/2). Columns are cells, as usual. Rows are nodes:
# `envmap` interpolates between rows whose first and last lie *at* the poles, so that these two stand for half a row
# each. Plain NumPy in float64; the sensor plugin `panorama` evaluates the same formulas in Dr.Jit.


def _check(width: int, height: int) -> None:
    if width < 1 or height < 2:
        raise NergError(f"a panorama needs at least 1 x 2 pixels and {width} x {height} were asked for")


def pixel_directions(width: int, height: int) -> np.ndarray:
    """Unit direction of each pixel's centre, in the panorama's own frame: shape (height, width, 3), float64."""
    _check(width, height)
    φ = 2 * np.pi * (np.arange(width) + 0.5) / width
    θ = np.pi * np.arange(height) / (height - 1)
    θ, φ = np.meshgrid(θ, φ, indexing="ij")
    return np.stack([np.sin(φ) * np.sin(θ), np.cos(θ), -np.cos(φ) * np.sin(θ)], axis=-1)


def pixel_solid_angles(width: int, height: int) -> np.ndarray:
    """Solid angle in steradian that each pixel stands for: shape (height, width), float64; the sum is 4π.

    ω = 2π/W (cos θ₀ - cos θ₁) between the borders of the pixel's row, which end at the poles. A density per steradian
    that was rendered with the `panorama` sensor has the integral `(density * pixel_solid_angles(W, H)).sum()`.
    """
    _check(width, height)
    border = np.clip(np.pi * (np.arange(height + 1) - 0.5) / (height - 1), 0, np.pi)
    ω = 2 * np.pi / width * -np.diff(np.cos(border))
    return np.repeat(ω[:, None], width, axis=1)


# ---- What a ray meets in a place that consists of a medium, of shapes, or of both ----
#
# A shape hides the medium behind it; the medium in front attenuates the shape. What reaches a shape is
# absorbed there, all of it, at the exact distance of the ray cast: a shape is a jump of the optical depth
# to infinity, and every kind of depth means the same with and without one.


@dataclass
class SceneRay:
    """A ray for a place without shapes, which needs no Mitsuba: origin, unit direction and greatest distance, in the
    scene's frame."""

    o: Point3f
    d: Vector3f
    maxt: Float


@dataclass
class RayView:
    """What one ray meets. Attached to whatever carries derivatives."""

    # The medium's part; None without a medium.
    march: MarchResult | None
    # Whether a shape ends the ray, and its distance in scene units, infinite without one.
    hits_shape: Bool
    shape_distance: Float
    # Opacity of everything: 1 where a shape is hit.
    opacity: Float
    # Opacity of the medium in front of the shape.
    medium_opacity: Float
    # Mitsuba's preliminary intersection; None without shapes.
    shape_intersection: Any
    # What `depth` does.
    find_depth: Callable[[str, Bool], Float]

    def depth(self, kind: str, active: Bool) -> Float:
        """Depth of ``kind`` (a name in ``depth.DEPTHS``) in scene units from the ray's origin; 0 where nothing is
        met."""
        return self.find_depth(kind, active)

    def has_surface(self, surface_opacity: float) -> Bool:
        """Whether there is a surface: matter at all, and as much of it as ``surface_opacity``, which may be 0."""
        return (self.opacity > 0) & (self.opacity >= surface_opacity)

    def penetration(self, kind: str, depth: Float) -> Float | float:
        """How far light goes into the matter before the surface at ``depth`` (of ``kind``), in scene units; 0 on a
        shape."""
        return 0 if self.march is None else escape_distance(kind, self.march, depth)


class SceneGeometry:
    """A medium, the shapes of a Mitsuba scene, or both: all that rays are traced through.

    Positions and distances are the scene's. ``medium``: or None; ``scene``: the scene whose shapes are met, or None,
    which is what ``self.scene`` is for a scene without any. Holds nothing that a change of the medium's parameters or
    of a shape would make wrong. Raises ``NergError`` for shapes that `check_shape` refuses.
    """

    def __init__(self, medium: Medium | None, scene: mi.Scene | None = None):
        self.medium = medium
        shapes = [] if scene is None else scene.shapes()
        self.scene = scene if len(shapes) > 0 else None
        for shape in shapes:
            check_shape(shape)

    @property
    def shape_diagonal(self) -> float:
        """Diagonal of the bounding box of all shapes, in scene units."""
        return float(np.linalg.norm(np.subtract(*self.shape_bounds())))

    def shape_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box of all shapes, (3,) each. There must be shapes."""
        corners = [shape_corners(shape) for shape in ([] if self.scene is None else self.scene.shapes())]
        return np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)

    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corner (3,) of the medium and the shapes; of a medium without an end those of its inner cube.
        None where there is neither."""
        corners = [] if self.medium is None else [self.medium.bounds()]
        corners += [] if self.scene is None else [self.shape_bounds()]
        return (np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)) if corners else None

    def extent(self, *points: ArrayLike) -> float:
        """Length of the diagonal of a box around what there is and ``points`` (3,), in scene units."""
        return float(np.linalg.norm(np.ptp([*(self.bounds() or ()), *(np.asarray(p, float) for p in points)], axis=0)))

    def trace(self, ray: Ray3f | SceneRay, active: Bool, settings: MarchSettings, **options: Any) -> RayView:
        """What ``ray`` meets up to its ``maxt``; without shapes a ``SceneRay`` will do.

        ``settings``: of the march; ``options``: those of ``march.march``. Differentiable in the ray, in the medium's
        parameters and, through the distances of ray casts, in the positions of shapes (not over their silhouettes).
        """
        Float = type(ray.maxt)
        end = ray.maxt
        hit, distance, preliminary = dr.mask_t(Float)(False), Float(dr.inf), None
        if self.scene is not None:
            preliminary, distance = _cast(self.scene, ray, active)
            hit = active & (distance < end)
            distance = dr.select(hit, distance, dr.inf)
        if self.medium is None:
            opacity = dr.select(hit, Float(1), 0)
            at_shape = lambda kind, active: dr.select(active & hit, distance, 0)
            return RayView(None, hit, distance, opacity, Float(0), preliminary, at_shape)

        medium = self.medium
        local = medium.ray_to_local(ray.o, ray.d)
        t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(dr.minimum(local.t_far, end), distance)
        result = scouted_march(medium, local, t0, t1, active, settings, **options)
        front = result.opacity
        if self.scene is None:
            in_medium = lambda kind, active: surface_depth(kind, result, medium, local, t0, t1, active, settings)
            return RayView(result, hit, distance, front, front, None, in_medium)

        def in_both(kind, active):
            some = active & (front > 0)
            inside = surface_depth(kind, result, medium, local, t0, t1, some, settings, backed=hit)
            through = DEPTHS.find(kind).with_shape(result, front, inside, hit, distance)
            return dr.select(active & hit, through, dr.select(some, inside, 0))

        return RayView(result, hit, distance, dr.select(hit, 1, front), front, preliminary, in_both)


def as_place(subject: Medium | SceneGeometry) -> SceneGeometry:
    """``subject`` itself, or the place that consists of this medium alone."""
    return subject if isinstance(subject, SceneGeometry) else SceneGeometry(subject)


def check_shape(shape: Any, of: str = "", check_merged: bool = False) -> None:
    """Raise `NergError` for a mesh without faces and for a shape that is not finite, or reaches beyond `FARTHEST`.

    ``of``: what a message says of the scene that it is in. ``merged``: whether meshes that Mitsuba has merged, whose
    boxes are unset, are looked at by their vertices, which are computed for it.
    """
    if shape.is_mesh() and shape.face_count() == 0:
        # Mitsuba 3.9.1 builds a scene of it, but cannot shade what it does not meet.
        raise NergError(f'the mesh "{shape.id()}"{of} has no faces; take it out of the scene')
    if check_merged or shape.bbox().valid() or not shape.is_mesh():
        name = f'shape "{shape.id()}"' if shape.id() else shape.class_name()
        check_coordinates(np.array(shape_corners(shape), float), f"the corners of the {name}{of}")


def shape_corners(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the bounding box of ``shape``, (3,) each, in scene units."""
    box = shape.bbox()
    # Boxes of NaN are not valid, either.
    if box.valid() or not shape.is_mesh():
        return np.array(box.min), np.array(box.max)
    # Mitsuba 3.9.1 leaves the boxes of meshes that it has merged unset.
    import mitsuba as mi

    vertices = np.asarray(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
    return vertices.min(0), vertices.max(0)


def _cast(scene: Any, ray: Ray3f | SceneRay, active: Bool) -> tuple[Any, Float]:
    """The nearest intersection with a shape, and its distance with derivatives where any are tracked."""
    mi = variant_types()
    ray = mi.Ray3f(ray)
    with dr.suspend_grad():
        cast = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    distance = cast.t
    if dr.grad_enabled(ray.o, ray.d) or scene.shapes_grad_enabled():
        distance = cast.compute_surface_interaction(ray, mi.RayFlags.Minimal, active).t
    return cast, distance


# ---- Shading ----
#
# What light comes from behind a field: from shapes, lit by a nested integrator or in their plain albedo, or from the
# background.


class Shading:
    """``nested``: a Mitsuba sampling integrator that lights the shapes, or None: ``path`` where the scene has emitters
    and shapes, otherwise every shape shows its albedo.

    Raises ``NergError`` for integrators whose radiance is not to be had ray by ray.
    """

    def __init__(self, nested: mi.SamplingIntegrator | None = None):
        import mitsuba as mi

        # By name: each change of variant makes that class anew.
        whole = nested is not None and any(c.__name__ == "ADIntegrator" for c in type(nested).__mro__)
        if whole or not (nested is None or isinstance(nested, mi.SamplingIntegrator)):
            raise NergError(
                f'the integrator nested in "nerg" is a {type(nested).__name__}, which cannot be asked for the radiance '
                'of one ray; use "path", "direct", "volpath" or another one that samples pixels'
            )
        self.nested: mi.SamplingIntegrator | None = nested
        self._path: Any = None

    def radiance(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: Ray3f,
        medium: mi.Medium | None,
        view: RayView,
        background: Color,
        hide_emitters: bool,
        active: Bool,
    ) -> tuple[Color, list[Float], Bool]:
        """``(radiance, AOVs of the nested integrator, shown)`` from behind the field, or from a place without one.

        Radiance is a linear spectrum of the variant in use. ``medium``: Mitsuba's, that the camera stands in (or None);
        ``view``: of ``ray``; ``background``: radiance where nothing is, if the scene has no environment; ``shown``:
        whether there is anything but that background, as a nested integrator says or an environment makes it.
        Derivatives are those of the nested integrator, or of the albedo; ``path`` has none.
        """
        mi = variant_types()
        seen = active & (view.medium_opacity < 1)
        environment: Any = None if hide_emitters else scene.environment()
        nested: Any = self.nested
        if nested is not None:
            color, valid, aovs = nested.sample(scene, sampler, ray, medium, seen)
            if environment is None:
                # Directly seen emitters are shapes; where there is nothing at all, there is the background.
                color = dr.select(view.hits_shape | valid, color, background)
            return color, aovs, seen & valid
        behind = background if environment is None else environment.eval(_beyond(ray), seen)
        shown = active & (view.hits_shape | (environment is not None))
        if view.shape_intersection is None:
            return behind, [], shown
        hit = seen & view.hits_shape
        if len(scene.emitters()) > 0:
            # Paths are not differentiated: Dr.Jit has no reverse mode through their loop.
            with dr.suspend_grad():
                self._path = self._path or mi.load_dict({"type": "path", "hide_emitters": bool(hide_emitters)})
                shape = self._path.sample(scene, sampler, ray, None, hit)[0]
        else:
            si = view.shape_intersection.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, hit)
            shape = si.bsdf().eval_diffuse_reflectance(si, hit)
        return dr.select(hit, shape, behind), [], shown

    def aov_names(self) -> list[str]:
        """Names of the AOVs that the nested integrator adds."""
        return [] if self.nested is None else list(self.nested.aov_names())


def _beyond(ray: Ray3f) -> Any:
    """What of an interaction an environment asks for, where ``ray`` meets nothing."""
    si: Any = dr.zeros(variant_types().SurfaceInteraction3f)
    si.wi, si.wavelengths = -ray.d, ray.wavelengths
    return si


# ---- Trace ----
#
# Depths along many rays at once, outside of any render: where the surfaces are that people look at.

BATCH = 1 << 19
"""Rays that are marched in one launch."""


def default_march_settings(subject: Medium | SceneGeometry) -> MarchSettings:
    """The march of the integrator ``nerg`` with nothing set."""
    medium = as_place(subject).medium
    return MarchSettings(step=default_step(medium), dt_gamma=default_growth(medium), stop=default_stop(medium))


def trace_depth(
    subject: Medium | SceneGeometry,
    origins: np.ndarray | Point3f,
    directions: np.ndarray | Vector3f,
    settings: MarchSettings | None = None,
    kind: str = "median",
    batch: int = BATCH,
) -> tuple[Any, Any]:
    """Depth of the surface along rays, and the opacity that they meet: a density-only march, and a ray cast.

    ``subject``: a medium, or a ``Place`` (of shapes, which are met exactly, or of both). ``origins``, ``directions``:
    N rays in the scene's frame, directions unit, either as NumPy arrays (N, 3) or as Dr.Jit 3-arrays of N lanes.
    ``settings``: see ``default_march_settings``. ``kind``: a name in ``depth.DEPTHS``. Returns ``(depth, opacity)`` of
    the kind that the rays came in (float32 (N,), or Dr.Jit Floats, evaluated): depth is the distance from the origin in
    scene units, 0 where nothing absorbs; which opacity makes a surface is the caller's to say. At most ``batch`` rays
    are marched in one launch. Carries no derivatives. Raises ``NergError`` for an unknown kind and ``ValueError`` for
    shapes that do not fit.
    """
    DEPTHS.find(kind)
    if batch < 1:
        raise ValueError(f"a batch must hold at least 1 ray, got {batch}")
    place = as_place(subject)
    settings = settings or default_march_settings(place)
    if dr.is_array_v(origins):
        return _traced_jit(place, cast("Point3f", origins), cast("Vector3f", directions), settings, kind, batch)
    o, d = (np.asarray(v, np.float32) for v in (origins, directions))
    if o.shape != d.shape or o.ndim != 2 or o.shape[1] != 3:
        raise ValueError(f"origins {o.shape} and directions {d.shape} must both have shape (N, 3)")
    ns, array = _types(place)
    depth, opacity = np.empty((2, len(o)), np.float32)
    for a in range(0, len(o), batch):
        part = slice(a, a + batch)
        start, along = (array(np.ascontiguousarray(v[part].T)) for v in (o, d))
        found = _trace(place, start, along, settings, kind)
        depth[part], opacity[part] = (np.asarray(ns.Float(x)) for x in found)
    return depth, opacity


def _traced_jit(
    place: SceneGeometry, origins: Point3f, directions: Vector3f, settings: MarchSettings, kind: str, batch: int
) -> tuple[Float, Float]:
    count = max(dr.width(origins), dr.width(directions))
    array, Float = type(origins), type(origins.x)
    ns = namespace(Float)
    if count <= batch:
        return _trace(place, origins, array(directions), settings, kind)
    depth, opacity = dr.empty(Float, count), dr.empty(Float, count)
    origins, directions = (v + dr.zeros(array, count) for v in (origins, array(directions)))
    for a in range(0, count, batch):
        index = dr.arange(ns.UInt32, min(batch, count - a)) + dr.opaque(ns.UInt32, a)
        start, along = (dr.gather(array, v, index) for v in (origins, directions))
        for out, value in zip((depth, opacity), _trace(place, start, along, settings, kind)):
            dr.scatter(out, value, index)
    dr.eval(depth, opacity)
    return depth, opacity


def _types(place: SceneGeometry) -> tuple[ModuleType, type]:
    """Namespace and 3-array of the backend that a place's arrays belong to."""
    if place.scene is None and place.medium is not None:
        for value in place.medium.parameters():
            if dr.is_array_v(value):
                ns = namespace(value)
                return ns, ns.Array3f
    mi = variant_types()
    return namespace(mi.Float), mi.Point3f


def _trace(place: SceneGeometry, o: Point3f, d: Vector3f, settings: MarchSettings, kind: str) -> tuple[Float, Float]:
    Float, count = type(o.x), max(dr.width(o), dr.width(d))
    with dr.suspend_grad():
        ray = SceneRay(o, d, Float(dr.inf))
        if place.scene is not None:
            mi = variant_types()
            ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        view = place.trace(ray, dr.full(dr.mask_t(Float), True, count), settings)
        opacity = view.opacity + dr.zeros(Float, count)
        depth = view.depth(kind, opacity > 0)
    dr.eval(depth, opacity)
    return depth, opacity
