"""Scene geometry as rays see it: medium and shapes, panoramas, radiance behind the medium, and batched ray tracing."""

from __future__ import annotations

import re
from copy import copy
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.types import Bool, Color, Float, Point3f, Ray3f, Vector3f, variant_types

from .depth import DEPTHS, MarchContext, penetration_depth
from .jit import is_recording
from .march import march_with_prepass
from .march_primal import MarchResult, MarchSettings, default_color_cutoff, default_dt_gamma, default_step, default_stop
from .medium import Medium
from .mitsuba_mesh import count_faces, read_vertices
from .ray_cells import CubeCells, RayCells
from .splat_lists import list_splats
from .splat_medium import SplatMedium

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Ceiling ----
#
# A clipping plane for views from above: rays that start above it begin at the plane.

_MIN_FALL = 1e-9
"""Cosine to the downward normal below which a ray counts as parallel to the plane and is not clipped."""


class Ceiling:
    """The plane of the points x with x · up = height; ``up`` (3,) of any non-zero length, ``height`` in scene units.

    Rays that start above the plane and cross it begin there. Both numbers are opaque to Dr.Jit: another height uses the
    same kernel. Raises `NergError` if ``up`` is not a direction.
    """

    UNRECORDED = ("height", "up")

    def __init__(self, height: float, up: ArrayLike = (0.0, 0.0, 1.0)):
        direction = np.asarray(up, float)
        length = float(np.linalg.norm(direction))
        if not (length > 0 and np.isfinite(length)):
            raise NergError(f'"up" must be a direction of three numbers that are not all 0, got {direction.tolist()}')
        self.height, self.up = float(height), direction / length
        mi = variant_types()
        self._height, self._up = mi.Float(self.height), mi.Vector3f(*self.up.tolist())
        dr.make_opaque(self._height, self._up)

    def clip_ray(self, ray: Any) -> tuple[Any, Float]:
        """Move the origin of ``ray`` to the plane x · up = height, if it starts above (x · up > height) and crosses it.

        Returns the ray (unit direction) and the distance by which its origin was moved: 0 for a ray that starts below
        the plane or never crosses it. Differentiable in the ray.
        """
        over, fall = dr.dot(ray.o, self._up) - self._height, -dr.dot(ray.d, self._up)
        cuts = (over > 0) & (fall > _MIN_FALL)
        distance = dr.select(cuts, over / dr.select(cuts, fall, 1), 0)
        clipped = type(ray)(ray)
        clipped.o = dr.fma(ray.d, distance, ray.o)
        clipped.maxt = ray.maxt - distance
        if isinstance(ray, variant_types().RayDifferential3f):
            clipped.o_x, clipped.o_y = dr.fma(ray.d_x, distance, ray.o_x), dr.fma(ray.d_y, distance, ray.o_y)
        return clipped, distance

    def __str__(self) -> str:
        x, y, z = self.up
        return f"{self.height:.6g} along ({x:.6g}, {y:.6g}, {z:.6g})"


# ---- Panorama ----
#
# Pixels of a full-sphere image and their directions: the mapping of Mitsuba's `envmap`.
#
# An image of W x H pixels covers the sphere by longitude φ and polar angle θ, in a frame with +Y up:
#
#     v = (sin φ sin θ, cos θ, -cos φ sin θ),    φ = 2π x / W,    θ = π (y - 1/2) / (H - 1)
#
# with (x, y) in pixels and the centre of pixel (i, j) at (i + 1/2, j + 1/2). Columns are cells. Rows are nodes:
# `envmap` interpolates between rows, and the first and the last one lie at the poles, so that these cover half a row
# each. NumPy in float64; the sensor plugin `panorama` evaluates the same formulas in Dr.Jit.


def _check(width: int, height: int) -> None:
    if width < 1 or height < 2:
        raise NergError(f"a panorama needs at least 1 x 2 pixels, got {width} x {height}")


def pixel_directions(width: int, height: int) -> np.ndarray:
    """Unit direction of each pixel's centre in the panorama's own frame: shape (height, width, 3), float64."""
    _check(width, height)
    φ = 2 * np.pi * (np.arange(width) + 0.5) / width
    θ = np.pi * np.arange(height) / (height - 1)
    θ, φ = np.meshgrid(θ, φ, indexing="ij")
    return np.stack([np.sin(φ) * np.sin(θ), np.cos(θ), -np.cos(φ) * np.sin(θ)], axis=-1)


def pixel_solid_angles(width: int, height: int) -> np.ndarray:
    """Solid angle of each pixel in steradian: shape (height, width), float64; the sum is 4π.

    ω = 2π/W (cos θ₀ - cos θ₁) between the borders of the pixel's row, which end at the poles. The integral of a density
    per steradian that was rendered with the `panorama` sensor is `(density * pixel_solid_angles(W, H)).sum()`.
    """
    _check(width, height)
    border = np.clip(np.pi * (np.arange(height + 1) - 0.5) / (height - 1), 0, np.pi)
    ω = 2 * np.pi / width * -np.diff(np.cos(border))
    return np.repeat(ω[:, None], width, axis=1)


# ---- Rays through a medium, shapes, or both ----
#
# A shape hides the medium behind it; the medium in front attenuates the shape. A shape absorbs all light that reaches
# it, at the exact distance of the ray cast: optical depth becomes infinite there, and each kind of depth keeps its
# definition.


@dataclass
class SceneRay:
    """A ray for geometry without shapes, which does not need Mitsuba: origin, unit direction and maximum distance in
    the scene frame."""

    o: Point3f
    d: Vector3f
    maxt: Float


@dataclass
class RayHit:
    """The result of tracing a ray. Attached to whatever carries gradients."""

    # March through the medium; None without a medium. Its ``ends_opaque`` is None without shapes.
    context: MarchContext | None
    # Whether a shape ends the ray, and its distance in scene units, infinite without one.
    hits_shape: Bool
    shape_distance: Float
    # Total opacity; 1 if a shape is hit.
    opacity: Float
    # Opacity of the medium in front of the shape.
    medium_opacity: Float
    # Mitsuba's preliminary intersection; None without shapes.
    shape_intersection: Any

    @property
    def march(self) -> MarchResult | None:
        """The result of the march; None without a medium."""
        return None if self.context is None else self.context.result

    def depth(self, kind: str, active: Bool) -> Float:
        """Depth of ``kind`` (a name in `depth.DEPTHS`) in scene units from the origin of the ray; 0 without
        absorption."""
        context, hit, distance = self.context, self.hits_shape, self.shape_distance
        if context is None:
            return dr.select(active & hit, distance, 0)
        find = DEPTHS.find(kind)
        if context.ends_opaque is None:
            return find.inside(replace(context, active=active))
        some = active & (self.medium_opacity > 0)
        inside = find.inside(replace(context, active=some))
        through = find.combine_with_shape(context.result, self.medium_opacity, inside, hit, distance)
        return dr.select(active & hit, through, dr.select(some, inside, 0))

    def has_surface(self, surface_opacity: float) -> Bool:
        """Whether there is a surface: a positive opacity of at least ``surface_opacity``, which may be 0."""
        return (self.opacity > 0) & (self.opacity >= surface_opacity)

    def penetration(self, kind: str, depth: Float) -> Float | float:
        """Penetration depth of light in front of the surface at ``depth`` (of ``kind``), in scene units; 0 on a
        shape."""
        return 0 if self.march is None else penetration_depth(kind, self.march, depth)


class SceneGeometry:
    """A medium, the shapes of a Mitsuba scene, or both: everything that rays are traced through.

    Positions and distances are those of the scene. No state is derived from the medium's parameters or the shapes, so
    both may change. Raises ``NergError`` for shapes that `check_shape` rejects.

    Parameters
    ----------
    medium : Medium or None
        The medium.
    scene : mi.Scene, optional
        The scene with the shapes; ``self.scene`` is None if it has none.
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
        """Lower and upper corner of the bounding box of all shapes, (3,) each. Requires at least one shape."""
        corners = [shape_corners(shape) for shape in ([] if self.scene is None else self.scene.shapes())]
        return np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)

    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corner (3,) of the medium and the shapes, with the inner cube of an unbounded medium; None
        without either."""
        corners = [] if self.medium is None else [self.medium.bounds()]
        corners += [] if self.scene is None else [self.shape_bounds()]
        return (np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)) if corners else None

    def extent(self, *points: ArrayLike) -> float:
        """Diagonal of the bounding box of the geometry and ``points`` (3,), in scene units."""
        return float(np.linalg.norm(np.ptp([*(self.bounds() or ()), *(np.asarray(p, float) for p in points)], axis=0)))

    def seen_from(self, center: Point3f, rays: int, cells: RayCells | None = None) -> SceneGeometry:
        """This geometry for ``rays`` rays around ``center`` (one lane).

        Gaussian splats are listed by cells (`splat_lists.list_splats`), unless there are too few rays; other media are
        traced alike from everywhere. ``cells``: the rays in the scene; default: those through ``center``, which is in
        front of their origins, in all directions.
        """
        # Lists are made outside of kernels.
        is_symbolic = is_recording() or dr.flag(dr.JitFlag.SymbolicScope)
        if not isinstance(self.medium, SplatMedium) or is_symbolic or dr.width(center) != 1:
            return self
        to_world = self.medium.to_world
        local = (cells or CubeCells()).to_local(to_world)
        seen = copy(self)
        seen.medium = list_splats(self.medium, to_world.point_to_local(center), rays, local)
        return seen

    def trace(self, ray: Ray3f | SceneRay, active: Bool, settings: MarchSettings, **options: Any) -> RayHit:
        """Trace ``ray`` up to its ``maxt``; without shapes a `SceneRay` suffices.

        ``settings``: of the march; ``options``: further arguments of `march.march`. Differentiable in the ray, in the
        medium's parameters and, through the distances of ray casts, in the positions of shapes (not across
        silhouettes).
        """
        Float = type(ray.maxt)
        end = ray.maxt
        hit, distance, preliminary = dr.mask_t(Float)(False), Float(dr.inf), None
        if self.scene is not None:
            preliminary, distance = _cast(self.scene, ray, active)
            hit = active & (distance < end)
            distance = dr.select(hit, distance, dr.inf)
        if self.medium is None:
            return RayHit(None, hit, distance, dr.select(hit, Float(1), 0), Float(0), preliminary)

        medium = self.medium
        local = medium.ray_to_local(ray.o, ray.d)
        t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(dr.minimum(local.t_far, end), distance)
        result = march_with_prepass(medium, local, t0, t1, active, settings, **options)
        front, ends_opaque = result.opacity, None if self.scene is None else hit
        context = MarchContext(result, medium, local, t0, t1, active, settings, ends_opaque)
        opacity = front if self.scene is None else dr.select(hit, 1, front)
        return RayHit(context, hit, distance, opacity, front, preliminary)


def as_scene_geometry(subject: Medium | SceneGeometry) -> SceneGeometry:
    """``subject`` itself, or the geometry that consists of this medium alone."""
    return subject if isinstance(subject, SceneGeometry) else SceneGeometry(subject)


def check_shape(shape: Any, context: str = "", check_merged: bool = False) -> None:
    """Raise `NergError` for a mesh without faces, or a shape that is not finite or extends beyond `MAX_COORDINATE`.

    ``context``: suffix of the message that names the scene. ``check_merged``: whether meshes that Mitsuba has merged,
    which have no bounding box, are checked by their vertices, which are computed for this purpose.
    """
    if shape.is_mesh() and count_faces(shape) == 0:
        # Mitsuba 3.9.1 builds a scene with such a mesh but cannot shade it.
        raise NergError(f'the mesh "{shape.id()}"{context} has no faces; remove it from the scene')
    if check_merged or shape.bbox().valid() or not shape.is_mesh():
        name = f'shape "{shape.id()}"' if shape.id() else shape.class_name()
        check_coordinates(np.array(shape_corners(shape), float), f"the corners of the {name}{context}")


def shape_corners(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the bounding box of ``shape``, (3,) each, in scene units."""
    box = shape.bbox()
    # Bounding boxes with NaN are not valid, either.
    if box.valid() or not shape.is_mesh():
        return np.array(box.min), np.array(box.max)
    # Mitsuba 3.9.1 does not set the bounding boxes of meshes that it has merged.
    vertices = read_vertices(shape)
    return vertices.min(0), vertices.max(0)


def _cast(scene: Any, ray: Ray3f | SceneRay, active: Bool) -> tuple[Any, Float]:
    """The nearest intersection with a shape, and its distance, attached if anything carries gradients."""
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
# Radiance behind a medium: shapes lit by a nested integrator or, without light, by a headlight, or the background.

SURFACE_OPACITY = 0.5
"""Opacity from which a ray hits a surface; the default of the integrator."""

HEADLIGHT = 0.7
"""Default fraction of the brightness of shapes without light that depends on their orientation."""


class Shading:
    """Radiance from behind the medium.

    Parameters
    ----------
    nested : mi.SamplingIntegrator, optional
        Lights the shapes. None: ``path`` if the scene has emitters and shapes, otherwise a headlight.
    headlight : float
        Shapes without light have the radiance albedo * (1 - headlight + headlight * |cos θ|), with the angle θ between
        the normal and the ray. 0: the albedo.

    Raises
    ------
    NergError
        For integrators that do not compute radiance per ray.
    """

    UNRECORDED = ("_path",)  # Depends on the scene, and has no arrays.

    def __init__(self, nested: mi.SamplingIntegrator | None = None, headlight: float = HEADLIGHT):
        import mitsuba as mi

        # By name: each change of the variant creates these classes again.
        names = {c.__name__ for c in type(nested).__mro__}
        is_refused = not names.isdisjoint(("ADIntegrator", "NergIntegrator"))
        if is_refused or not (nested is None or isinstance(nested, mi.SamplingIntegrator)):
            raise NergError(
                f'the integrator nested in "nerg" is of the type {type(nested).__name__}, which does not light shapes '
                'along single rays; use "path", "direct", "volpath" or another sampling integrator'
            )
        if nested is not None and re.search(r"integrators = \[\s*\]", str(nested)):
            raise NergError(
                'the integrator nested in "nerg" ("aov" or "moment") contains no integrator, and shapes would be '
                'black; put "path" into it'
            )
        self.nested: mi.SamplingIntegrator | None = nested
        self.headlight = headlight
        self._path: Any = None

    def radiance(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: Ray3f,
        medium: mi.Medium | None,
        ray_hit: RayHit,
        background: Color,
        hide_emitters: bool,
        active: Bool,
    ) -> tuple[Color, list[Float], Bool]:
        """``(radiance, AOVs of the nested integrator, shown)`` from behind the medium, or from geometry without one.

        Derivatives are those of the nested integrator, of the default ``path`` (in a derivative of an image), or of the
        headlight.

        Parameters
        ----------
        medium : mi.Medium or None
            Mitsuba's medium around the camera.
        ray_hit : RayHit
            Result of tracing ``ray``.
        background : Color
            Radiance without a surface, if the scene has no environment emitter.

        Returns
        -------
        radiance : Color
            A linear spectrum of the current variant.
        shown : Bool
            Whether there is anything but the background, according to the nested integrator or the environment emitter.
        """
        mi = variant_types()
        visible = active & (ray_hit.medium_opacity < 1)
        environment: Any = None if hide_emitters else scene.environment()
        nested: Any = self.nested
        if nested is not None:
            color, valid, aovs = _sample(nested, scene, sampler, ray, medium, visible)
            if environment is None:
                # Directly visible emitters are shapes; without any surface there is the background.
                color = dr.select(ray_hit.hits_shape | valid, color, background)
            return color, aovs, visible & valid
        behind = background
        if environment is not None:
            # The parts of an interaction that an emitter needs, for a ray that meets no surface.
            beyond = dr.zeros(mi.SurfaceInteraction3f)
            beyond.wi, beyond.wavelengths = -ray.d, ray.wavelengths
            behind = environment.eval(beyond, visible)
        shown = active & (ray_hit.hits_shape | (environment is not None))
        if ray_hit.shape_intersection is None:
            return behind, [], shown
        hit = visible & ray_hit.hits_shape
        if len(scene.emitters()) > 0:
            # Dr.Jit has no reverse mode through a symbolic loop of paths; derivatives of an image evaluate loops.
            with dr.suspend_grad(when=dr.flag(dr.JitFlag.SymbolicLoops)):
                self._path = self._path or mi.load_dict({"type": "path", "hide_emitters": bool(hide_emitters)})
                shape = _sample(self._path, scene, sampler, ray, None, hit)[0]
        else:
            si = ray_hit.shape_intersection.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, hit)
            facing = dr.abs(dr.dot(si.sh_frame.n, ray.d))
            shape = si.bsdf().eval_diffuse_reflectance(si, hit) * dr.fma(self.headlight, facing, 1 - self.headlight)
        return dr.select(hit, shape, behind), [], shown

    def aov_names(self) -> list[str]:
        """Names of the AOVs of the nested integrator."""
        return [] if self.nested is None else list(self.nested.aov_names())


def _sample(integrator: Any, scene: Any, sampler: Any, ray: Ray3f, medium: Any, active: Bool) -> tuple[Any, Any, list]:
    """Sample radiance along ``ray`` with ``integrator``.

    The derivative of an image with respect to materials and lights replays the paths of ``path``: Dr.Jit would store
    all their bounces, 4 kB a path, and the process would end when memory is full. Replayed paths have no derivatives of
    rays and positions of shapes.
    """
    mi = variant_types()
    is_path = integrator.class_name() == "PathIntegrator" and not dr.flag(dr.JitFlag.SymbolicLoops)
    if not is_path or dr.grad_enabled(ray.o, ray.d) or scene.shapes_grad_enabled():
        return integrator.sample(scene, sampler, ray, medium, active)
    values = [value for child in (*scene.shapes(), *scene.emitters()) for _, value in mi.traverse(child)]
    limits = {name: int(value) for name, value in re.findall(r"(max_depth|rr_depth) = (\d+)", str(integrator))}
    # No limit is the largest integer.
    limits = {name: value if value < 1 << 31 else -1 for name, value in limits.items()}
    replay = mi.load_dict({"type": "prb", "hide_emitters": integrator.hide_emitters, **limits})
    parameters = [value for value in values if dr.grad_enabled(value)]
    color, valid = dr.custom(_PathReplay, replay, scene, sampler, ray, active, parameters)
    return color, valid, []


class _PathReplay(dr.CustomOp):
    """Radiance of paths as one node of the AD graph: paths for the values, and the same paths for the derivatives."""

    def eval(self, integrator, scene, sampler, ray, active, parameters):
        for parameter in parameters:
            self.add_input(parameter)
        self.paths = integrator, scene, sampler.clone(), ray, active
        self.color, valid = self._trace(dr.ADMode.Primal, sampler, None)[:2]
        return self.color, valid

    def _trace(self, mode, sampler, gradient):
        integrator, scene, _, ray, active = self.paths
        state = None if mode == dr.ADMode.Primal else self.color
        with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            return integrator.sample(mode, scene, sampler, ray, δL=gradient, state_in=state, active=active)

    def backward(self):
        adjoint: Any = self.grad_out()
        self._trace(dr.ADMode.Backward, self.paths[2].clone(), adjoint[0])

    def forward(self):
        self.set_grad_out((self._trace(dr.ADMode.Forward, self.paths[2].clone(), None)[0], False))

    def name(self):
        return "path replay"


# ---- Batched tracing ----
#
# Depths along many rays outside of a rendering.

RAYS_PER_LAUNCH = 1 << 19
"""Rays per kernel launch."""


def default_march_settings(subject: Medium | SceneGeometry) -> MarchSettings:
    """The march settings of the integrator ``nerg`` with default parameters."""
    medium = as_scene_geometry(subject).medium
    return MarchSettings(
        step=default_step(medium),
        dt_gamma=default_dt_gamma(medium),
        stop=default_stop(medium),
        color_cutoff=default_color_cutoff(medium),
    )


def trace_depth(
    subject: Medium | SceneGeometry,
    origins: np.ndarray | Point3f,
    directions: np.ndarray | Vector3f,
    settings: MarchSettings | None = None,
    kind: str = "median",
    batch: int = RAYS_PER_LAUNCH,
) -> tuple[Any, Any]:
    """Depth of the surface along rays, and their opacity: a density-only march and a ray cast.

    Carries no derivatives.

    Parameters
    ----------
    subject : Medium or SceneGeometry
        What is traced; shapes are intersected exactly.
    origins, directions : array
        N rays in the scene frame with unit directions, as NumPy arrays (N, 3) or as Dr.Jit 3-arrays of N lanes.
    settings : MarchSettings, optional
        Default: `default_march_settings`.
    kind : str
        A name in `depth.DEPTHS`.
    batch : int
        Maximum number of rays per kernel launch.

    Returns
    -------
    depth, opacity : array
        float32 (N,) or evaluated Dr.Jit Floats, like the rays. Depth is the distance from the origin in scene units, 0
        without absorption; the caller decides which opacity makes a surface.

    Raises
    ------
    NergError
        For an unknown kind.
    ValueError
        For shapes of arrays that do not match.
    """
    DEPTHS.find(kind)
    if batch < 1:
        raise ValueError(f"a batch needs at least 1 ray, got {batch}")
    geometry = as_scene_geometry(subject)
    settings = settings or default_march_settings(geometry)
    if dr.is_array_v(origins):
        return _trace_depth_jit(geometry, cast("Point3f", origins), cast("Vector3f", directions), settings, kind, batch)
    o, d = (np.asarray(v, np.float32) for v in (origins, directions))
    if o.shape != d.shape or o.ndim != 2 or o.shape[1] != 3:
        raise ValueError(f"origins {o.shape} and directions {d.shape} must both have shape (N, 3)")
    ns, array = _types(geometry)
    depth, opacity = np.empty((2, len(o)), np.float32)
    for a in range(0, len(o), batch):
        part = slice(a, a + batch)
        start, along = (array(np.ascontiguousarray(v[part].T)) for v in (o, d))
        result = _trace(geometry, start, along, settings, kind)
        depth[part], opacity[part] = (np.asarray(ns.Float(x)) for x in result)
    return depth, opacity


def _trace_depth_jit(
    geometry: SceneGeometry, origins: Point3f, directions: Vector3f, settings: MarchSettings, kind: str, batch: int
) -> tuple[Float, Float]:
    count = max(dr.width(origins), dr.width(directions))
    array, Float = type(origins), type(origins.x)
    ns = namespace(Float)
    if count <= batch:
        return _trace(geometry, origins, array(directions), settings, kind)
    depth, opacity = dr.empty(Float, count), dr.empty(Float, count)
    origins, directions = (v + dr.zeros(array, count) for v in (origins, array(directions)))
    for a in range(0, count, batch):
        index = dr.arange(ns.UInt32, min(batch, count - a)) + dr.opaque(ns.UInt32, a)
        start, along = (dr.gather(array, v, index) for v in (origins, directions))
        for out, value in zip((depth, opacity), _trace(geometry, start, along, settings, kind)):
            dr.scatter(out, value, index)
    dr.eval(depth, opacity)
    return depth, opacity


def _types(geometry: SceneGeometry) -> tuple[ModuleType, type]:
    """Namespace and 3-array type of the backend that the geometry's arrays belong to."""
    if geometry.scene is None and geometry.medium is not None:
        for value in geometry.medium.parameters():
            if dr.is_array_v(value):
                ns = namespace(value)
                return ns, ns.Array3f
    mi = variant_types()
    return namespace(mi.Float), mi.Point3f


def _trace(geometry: SceneGeometry, o: Point3f, d: Vector3f, settings: MarchSettings, kind: str) -> tuple[Float, Float]:
    Float, count = type(o.x), max(dr.width(o), dr.width(d))
    with dr.suspend_grad():
        ray = SceneRay(o, d, Float(dr.inf))
        if geometry.scene is not None:
            mi = variant_types()
            ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        ray_hit = geometry.trace(ray, dr.full(dr.mask_t(Float), True, count), settings)
        opacity = ray_hit.opacity + dr.zeros(Float, count)
        depth = ray_hit.depth(kind, opacity > 0)
    dr.eval(depth, opacity)
    return depth, opacity
