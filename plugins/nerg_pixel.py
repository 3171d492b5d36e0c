"""Evaluation of camera rays for :ref:`nerg <integrator-nerg>`: `CameraView`, which does not depend on an observer, and
`Pixel`, which adds an observer. Both use a `RenderContext`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, cast

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.maths.color import composite_to_linear
from nerg_mi.maths.types import Bool, Color, Float, Point3f, Ray3f, Vector3f
from nerg_mi.transport import aovs as nerg_aovs
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.field_medium import FeatureShader, make_color_shader
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.jit import is_recording
from nerg_mi.transport.march_primal import MarchResult
from nerg_mi.transport.medium import SampleShader
from nerg_mi.transport.observer import (
    CacheEntry,
    ObserverCache,
    ObserverView,
    camera_cells,
    center_of_ray,
    check_centers,
    distance_and_direction,
    have_same_center,
    observe_view,
    select_nearest,
    sensor_center,
    sensor_centers,
)
from nerg_mi.transport.observer_gaze import (
    GazeFieldInstance,
    ObservedGaze,
    list_geometry_inputs,
    require_listed_networks,
)
from nerg_mi.transport.occlusion import ObserverHit, ObserverMap, get_observer_map, trace_from_observer
from nerg_mi.transport.quadrature import RULES
from nerg_mi.transport.splat_medium import SplatMedium

# Mitsuba, with its arrays typed as in `maths.types`.
arrays: Any = mi


@dataclass(frozen=True)
class RenderContext:
    """Parameters of a rendering: those of the integrator ``nerg``, and the requested AOVs.

    ``required_data``: what must be decided before a pixel is computed:

    - ``counts``: count evaluations of density and colour;
    - ``features``: composite geometry features along the ray;
    - ``observer_depth``: find the depth along the observer's ray even if visibility does not need it;
    - ``gaze``: evaluate the gaze field; ``factors``: on all surfaces, including those hidden from the observer;
      ``spread``: with the standard deviation over its members.
    """

    nerg: Any
    aovs: Sequence[str]
    required_data: frozenset[str]
    # The observer views of the AOVs, by name.
    views: Mapping[str, ObserverView]
    # Whether colour is computed.
    radiance: bool
    # The geometry as seen from the camera, and from there only, if a recording needs it before: at most one.
    seen: list[SceneGeometry] = field(default_factory=list)

    @property
    def can_use_gaze_map(self) -> bool:
        """Whether a map can replace the gaze field: it stores no factors, standard deviation or features."""
        if self.nerg.gaze is None or "gaze" not in self.required_data or self.required_data & {"factors", "spread"}:
            return False
        return not self.nerg.gaze.field.config.features

    @property
    def needs_visibility(self) -> bool:
        """Whether an AOV depends on what the observer sees, other than the position of the observer alone."""
        views = self.views
        return any(name not in views or views[name].is_occluded for name in self.observer_aovs)

    @property
    def shared_aovs(self) -> list[str]:
        """AOVs that do not depend on the observer."""
        return [name for name in self.aovs if not nerg_aovs.AOVS[name].is_per_observer]

    @property
    def observer_aovs(self) -> list[str]:
        """AOVs that depend on the observer."""
        return [name for name in self.aovs if nerg_aovs.AOVS[name].is_per_observer]

    def channel_names(self, aovs: Sequence[str]) -> list[str]:
        """Names of the channels of AOVs."""
        return nerg_aovs.channel_names(aovs, self.nerg.medium)

    def check_scene(self, scene: mi.Scene) -> None:
        """Raise ``NergError`` for a scene without a medium and shapes."""
        if self.nerg.medium is None and len(scene.shapes()) == 0:
            raise NergError(
                'there is nothing to render; give "nerg" a "field" or a "density", or add shapes to the scene'
            )

    def trace(
        self,
        scene: mi.Scene,
        sensors: Sequence[mi.Sensor],
        sampler: mi.Sampler,
        ray: Ray3f,
        active: Bool,
        may_list: bool = True,
    ) -> CameraView:
        """Trace rays of ``sensors`` (``may_list``: see `CameraView`). Raises ``NergError`` for a scene without a medium
        and shapes."""
        self.check_scene(scene)
        offset = cast("Any", sampler).next_1d(active) if self.nerg.jitter else None
        return CameraView(self, scene, sensors, ray, active, offset, may_list)

    def view_surface(self, scene: mi.Scene, ray: Ray3f, surface: Sequence[Any]) -> CameraView:
        """Rays without sensors, whose `CameraView.surface` was computed before."""
        return CameraView(self, scene, [], ray, arrays.Bool(True), None, surface=surface)

    def list_inputs(
        self, scene: mi.Scene, sensors: Sequence[mi.Sensor], lanes: int, seen: SceneGeometry | None = None
    ) -> list[Any]:
        """All objects that ``lanes`` rays of ``sensors`` read, for a recording. Raises `NotRecordable`.

        ``seen``: the geometry as seen from the camera. Default: that of a single one of ``sensors``.
        """
        nerg = self.nerg
        geometry = seen or see_from_camera(SceneGeometry(nerg.medium, scene), sensors, count_pixels(sensors, lanes))
        self.seen[:] = [geometry]
        inputs = list_geometry_inputs(geometry)
        if nerg.gaze is not None:
            require_listed_networks(nerg.gaze.field)
        inputs.append(scene if len(scene.emitters()) > 0 else None)
        rules = [RULES.find(nerg.settings.quadrature), DEPTHS.find(nerg.observer_settings.depth)]
        return [*inputs, self, nerg.hide_emitters, rules, [nerg_aovs.AOVS[name].compute for name in self.aovs]]

    def make_own_observer(self, sensors: Sequence[mi.Sensor]) -> ObserverContext:
        """The observer of the integrator, or the centre of the only one of ``sensors``, evaluated."""
        is_camera = self.nerg.observer is None
        if is_camera:
            for sensor in sensors:
                check_centers(sensor)
            (center,) = sensor_centers(sensors)
        else:
            center = sensor_center(self.nerg.observer)
        p_o = arrays.Point3f(center)
        dr.make_opaque(p_o)
        return ObserverContext(p_o, [p_o], self.nerg.cache, True if is_camera else None)

    def make_observer(self, position: Sequence[float], is_only: bool = False) -> ObserverContext:
        """The observer at ``position`` (3,). ``is_only``: the only one, whose data is kept in the integrator's
        cache."""
        p_o = arrays.Point3f(*map(float, position))
        # A literal position would compile a new kernel for each observer.
        dr.make_opaque(p_o)
        return ObserverContext(p_o, [p_o], self.nerg.cache if is_only else ObserverCache(scalar_cache=self.nerg.cache))


@dataclass(eq=False)
class ObserverContext:
    """An observer, and the data that is cached for them during the lifetime of this object."""

    # A recording takes what `prepare` computes.
    UNRECORDED: ClassVar[tuple[str, ...]] = ("cache",)

    # Position per lane, and all distinct positions (one lane each).
    p_o: Point3f
    positions: list[Point3f]
    cache: ObserverCache
    # Whether the observer is at the camera; None if that is not known.
    is_at_camera: bool | None = None
    # The geometry as seen by the observer, if a recording needs it before.
    seen: SceneGeometry | None = None
    _gaze: ObservedGaze | None = None
    _map: ObserverMap | None = None
    _views: dict[str, list[CacheEntry]] = field(default_factory=dict)

    def gaze(self, context: RenderContext, geometry: SceneGeometry) -> ObservedGaze:
        """The gaze field for these positions, prepared once. ``context``: one with a gaze field."""
        if self._gaze is None:
            placed = cast("GazeFieldInstance", context.nerg.gaze)
            self._gaze = placed.for_observers(self.positions, geometry, context.nerg.observer_settings, self.cache)
        return self._gaze

    def map(self, context: RenderContext, geometry: SceneGeometry) -> ObserverMap | None:
        """The map around this observer, computed once; None unless visibility is decided by a map."""
        settings = context.nerg.observer_settings
        if self._map is None and settings.visibility == "map":
            gaze = self.gaze(context, geometry) if context.can_use_gaze_map else None
            self._map = get_observer_map(geometry, self.p_o, settings, gaze, self.cache)
        return self._map

    def view(self, name: str, view: ObserverView) -> list[CacheEntry]:
        """The ``view`` called ``name`` for these positions, computed once."""
        if name not in self._views:
            self._views[name] = observe_view(view, self.positions, self.cache)
        return self._views[name]

    def prepare(self, context: RenderContext, scene: mi.Scene, sensors: Sequence[mi.Sensor], lanes: int) -> None:
        """Compute all that an evaluation of ``lanes`` rays of ``sensors`` reads: a recording cannot compute it."""
        geometry = SceneGeometry(context.nerg.medium, scene)
        if self.is_at_camera is None:
            self.is_at_camera = have_same_center(sensors, self.p_o)
        if "gaze" in context.required_data:
            self.gaze(context, geometry).prepare(lanes)
        if context.nerg.occlusion and not self.is_at_camera and context.needs_visibility:
            self.map(context, geometry)
            self.seen = geometry.seen_from(self.p_o, count_pixels(sensors, lanes))
        for name, view in context.views.items():
            self.view(name, view)


def count_pixels(sensors: Sequence[mi.Sensor], lanes: int) -> int:
    """Pixels of whole images of ``sensors``; without any, ``lanes``."""
    return sum(int(dr.prod(s.film().crop_size())) for s in sensors) or lanes


def see_from_camera(geometry: SceneGeometry, sensors: Sequence[mi.Sensor], num_rays: int) -> SceneGeometry:
    """``geometry`` for ``num_rays`` rays of a single camera whose rays have cells; for others unchanged."""
    # Cells are computed for splats only.
    if len(sensors) != 1 or not isinstance(geometry.medium, SplatMedium):
        return geometry
    cells = camera_cells(sensors[0])
    return geometry if cells is None else geometry.seen_from(sensor_center(sensors[0]), num_rays, cells)


class CameraView:
    """The surfaces that camera rays meet, one lane per ray. The ray is traced at once; all other values are computed on
    first access.

    Parameters
    ----------
    sensors : sequence of mi.Sensor
        Sensors that rays may come from.
    offset : Float or None
        Shift of the march as a fraction of a step.
    may_list : bool
        Whether all rays certainly come from ``sensors``, so that splats can be listed.
    surface : sequence, optional
        `surface` of the same rays, which are then not traced: the view has no other values of its own.
    """

    def __init__(
        self,
        context: RenderContext,
        scene: mi.Scene,
        sensors: Sequence[mi.Sensor],
        ray: Ray3f,
        active: Bool,
        offset: Float | None,
        may_list: bool = True,
        surface: Sequence[Any] | None = None,
    ):
        self.context, self.sensors, self.camera_ray, self.active = context, sensors, ray, active
        # The traced ray, and the distance between both origins.
        self.ray, self.origin_offset = (
            (ray, None) if context.nerg.ceiling is None else context.nerg.ceiling.clip_ray(ray)
        )
        medium = context.nerg.medium
        self.geometry = SceneGeometry(medium, scene)
        # Rays of the whole image, of which this may be a strip.
        self.num_rays = count_pixels(sensors, dr.width(ray.o))
        self.counts_evaluations = "counts" in context.required_data
        if surface is not None:
            # The cached properties.
            vars(self).update(zip(("depth", "has_surface", "penetration"), surface))
            return
        traced = self.geometry
        if context.seen:
            (traced,) = context.seen
        elif may_list and not is_recording():
            traced = see_from_camera(self.geometry, sensors, self.num_rays)
        self.has_color = context.radiance and medium is not None and medium.has_color
        shader, features = None, "features" in context.required_data
        if medium is not None and self.has_color:
            color_type = mi.Spectrum if medium.color_space == "spectrum" else mi.Color3f
            shader = make_color_shader(medium, color_type, features)
        elif medium is not None and features:
            shader = FeatureShader(medium)
        self.shader = shader
        self.ray_hit = traced.trace(
            self.ray, active, context.nerg.settings, offset=offset, count=self.counts_evaluations, color=shader
        )
        self.has_matter = active & (self.ray_hit.opacity > 0)

    def make_pixel(self, observer: ObserverContext | None = None) -> Pixel:
        """These rays for an observer; None: that of the context."""
        return Pixel(self, observer)

    def make_pixel_per_origin(self) -> Pixel:
        """Each ray for an observer at its own origin, for fields that are not normalised per observer."""
        return Pixel(self, ObserverContext(self.camera_ray.o, [], ObserverCache(), True))

    def compute_channels(self, aovs: Sequence[str]) -> list[Float]:
        """All channels of AOVs that do not depend on the observer."""
        return self.make_pixel().compute_channels(aovs)

    def eval_shared(self, *extra: Any) -> None:
        """Evaluate the values that observers share, and ``extra`` ones, so that kernels of observers start from
        them."""
        rays = [self.camera_ray.o, self.ray.o, self.ray.d]
        common = [*rays, self.active, self.depth, self.has_surface, self.p_d, self.penetration]
        if self.counts_evaluations and self.ray_hit.march is not None:
            common.append(self.ray_hit.march.density_evals)
        dr.eval(common, extra)

    @cached_property
    def color(self) -> Color | None:
        """Colour of the medium along the ray, times its opacity; None without colour."""
        medium = self.context.nerg.medium
        if medium is None or not self.has_color:
            return None
        ray = medium.ray_to_local(self.ray.o, self.ray.d)
        shader, sums = cast("SampleShader", self.shader), cast("MarchResult", self.ray_hit.march).color
        return shader.resolve_color(medium, sums, self.ray_hit.medium_opacity, ray, self.active)

    @property
    def accumulated_features(self) -> list[Float]:
        """Geometry features, composited along the ray."""
        shader, march = cast("FeatureShader", self.shader), cast("MarchResult", self.ray_hit.march)
        return [dr.select(self.active, f, 0) for f in shader.features(march.color)]

    @cached_property
    def depth(self) -> Float:
        """Distance along the traced ray to its surface; 0 without absorption."""
        return self.ray_hit.depth(self.context.nerg.observer_settings.depth, self.has_matter)

    @property
    def camera_depth(self) -> Float:
        """The same from the origin of the camera ray."""
        return (
            self.depth if self.origin_offset is None else dr.select(self.has_matter, self.depth + self.origin_offset, 0)
        )

    @cached_property
    def has_surface(self) -> Bool:
        """Whether the ray meets a surface."""
        return self.active & self.ray_hit.has_surface(self.context.nerg.observer_settings.surface_opacity)

    @cached_property
    def p_d(self) -> Point3f:
        """The surface point, if there is a surface."""
        return self.ray.o + self.ray.d * self.depth

    @cached_property
    def penetration(self) -> Float | float:
        """Penetration depth of light in front of the surface."""
        return self.ray_hit.penetration(self.context.nerg.observer_settings.depth, self.depth)

    @property
    def surface(self) -> tuple[Float, Bool, Float]:
        """Depth, whether there is a surface, and penetration: all that an observer needs of the march, unless
        evaluations are counted."""
        return self.depth, self.has_surface, arrays.Float(self.penetration)

    def compute_radiance(
        self, scene: mi.Scene, sampler: mi.Sampler, medium: mi.Medium | None
    ) -> tuple[Color, Bool, list]:
        """``(radiance, shown, AOVs of the nested integrator)`` of the field and of what is behind it.

        ``shown``: whether there is anything but the background; ``medium``: Mitsuba's medium around the camera (or
        None).
        """
        context, view, front, color = self.context, self.ray_hit, self.ray_hit.medium_opacity, self.color
        if not context.radiance:
            # A nested integrator has its AOVs even if colour is not computed.
            return mi.Spectrum(0), self.has_matter, [arrays.Float(0)] * len(context.nerg.shading.aov_names())
        behind, nested, shown = context.nerg.shading.radiance(
            scene, sampler, self.ray, medium, view, context.nerg.background, context.nerg.hide_emitters, self.active
        )
        field = context.nerg.medium
        if field is None or not self.has_color:
            return (1 - front) * behind, self.has_matter | shown, nested
        learned = field.background(self.ray.o, self.ray.d) if scene.environment() is None else None
        if learned is not None:
            # The background network was trained with the field and is composited in the field's colour space.
            color = dr.select(view.hits_shape, color, dr.fma(1 - front, mi.Color3f(learned), color))
            front = dr.select(view.hits_shape, front, 1)
        L = (1 - front) * behind + composite_to_linear(color, front, field.color_space)
        return L, self.has_matter | shown, nested


@dataclass(frozen=True)
class SurfaceGaze:
    """Gaze on a surface: ``gaze`` and its ``std`` (None unless required) after occlusion, the factors ``emit`` and
    ``capture`` (None if a map provided the gaze), and the number of network evaluations."""

    gaze: Float
    evaluations: Float
    emit: Float | None = None
    capture: Float | None = None
    std: Float | None = None


class Pixel:
    """What ``camera`` sees, combined with an observer; computed part by part on first access. One object per observer.
    Arguments: see `CameraView.make_pixel`."""

    def __init__(self, camera: CameraView, observer: ObserverContext | None):
        self.camera, self.context = camera, camera.context
        self._observer = observer
        self._evaluations: Float = arrays.Float(0)

    def compute_channels(self, aovs: Sequence[str]) -> list[Float]:
        """All channels of AOVs, in order."""
        # Evaluation counts come last, when all other AOVs have been computed.
        order = sorted((nerg_aovs.AOVS[name] for name in aovs), key=lambda aov: "counts" in aov.required_data)
        channels = {aov.name: aov.compute(self if aov.is_per_observer else self.camera) for aov in order}
        return [channel for name in aovs for channel in channels[name]]

    @cached_property
    def observer(self) -> ObserverContext:
        """The given observer, that of the integrator, or the centre of the camera."""
        if self._observer is not None:
            return self._observer
        context, camera = self.context, self.camera
        if context.nerg.observer is None:
            p_o = center_of_ray(camera.sensors, camera.camera_ray)
            return ObserverContext(p_o, sensor_centers(camera.sensors), context.nerg.cache, True)
        p_o = sensor_center(context.nerg.observer)
        return ObserverContext(p_o, [p_o], context.nerg.cache)

    @cached_property
    def is_aligned(self) -> bool:
        """Whether the observer is at the camera and therefore sees the same surfaces."""
        if self.observer.is_at_camera is None:
            self.observer.is_at_camera = have_same_center(self.camera.sensors, self.observer.p_o)
        return self.observer.is_at_camera

    @cached_property
    def distance_and_direction(self) -> tuple[Float, Vector3f]:
        """Distance and unit direction from the observer to the surface."""
        return distance_and_direction(self.observer.p_o, self.camera.p_d)

    @property
    def r_o(self) -> Vector3f:
        """Unit direction from the observer to the surface."""
        return self.distance_and_direction[1]

    @cached_property
    def observer_hit(self) -> ObserverHit:
        """What the observer sees towards the surface; without occlusion the surface itself."""
        context, camera = self.context, self.camera
        if not context.nerg.occlusion or self.is_aligned:
            return ObserverHit(camera.p_d, self.distance_and_direction[0], arrays.Float(1), arrays.Float(0))
        sight = trace_from_observer(
            self.observer.seen or camera.geometry,
            camera.ray,
            camera.p_d,
            self.observer.p_o,
            camera.penetration,
            camera.has_surface,
            context.nerg.falloff,
            context.nerg.observer_settings,
            count=camera.counts_evaluations,
            observer_map=self.observer.map(context, camera.geometry),
            needs_depth=bool(context.required_data & {"factors", "observer_depth"}),
            num_rays=camera.num_rays,
        )
        if sight.density_evals is not None:
            self._evaluations = sight.density_evals
        return sight

    @cached_property
    def gaze(self) -> ObservedGaze:
        """The gaze field for the observer."""
        gaze = self.observer.gaze(self.context, self.camera.geometry)
        gaze.prepare(dr.width(self.r_o))
        return gaze

    @cached_property
    def surface_gaze(self) -> SurfaceGaze:
        """Gaze of the observer on the surface that they see in the direction of this one."""
        sight, gaze, p_o, r_o, surface = (
            self.observer_hit,
            self.gaze,
            self.observer.p_o,
            self.r_o,
            self.camera.has_surface,
        )
        networks = arrays.Float(gaze.field.networks)
        # Gaze is 0 where the observer cannot see, for any field.
        visible = surface & (sight.visibility > 0)
        occlude = lambda value: dr.select(visible, value * sight.visibility, 0)
        if sight.gaze is not None:
            unknown = visible & (sight.gaze < 0)
            density = dr.if_stmt(
                (unknown, sight.gaze),
                unknown,
                lambda unknown, _: gaze.evaluate(sight.p_od, p_o, r_o, unknown)[0],
                lambda _, density: density,
                label="gaze",
            )
            return SurfaceGaze(occlude(density), dr.select(unknown, networks, 0))
        needed = surface if "factors" in self.context.required_data else visible
        density, emit, capture, *spread = self._evaluate_gaze(needed)
        return SurfaceGaze(
            occlude(density),
            dr.select(needed, networks, 0),
            dr.select(surface, emit, 0),
            dr.select(surface, capture, 0),
            occlude(spread[0]) if spread else None,
        )

    def _evaluate_gaze(self, needed: Bool) -> tuple:
        """``(gaze, emit, capture)``, and the standard deviation if required, on the lanes ``needed``."""
        gaze, p_od, p_o, r_o = self.gaze, self.observer_hit.p_od, self.observer.p_o, self.r_o
        with_spread = "spread" in self.context.required_data
        evaluate = gaze.evaluate_with_std if with_spread else gaze.evaluate
        if gaze.field.config.features or dr.grad_enabled(p_od, p_o, r_o, *gaze.parameters()):
            return evaluate(p_od, p_o, r_o, needed)
        # Hidden surfaces are contiguous in the image: packets without needed lanes skip the networks.
        return dr.if_stmt(
            (needed,),
            needed,
            lambda needed: tuple(arrays.Float(v) for v in evaluate(p_od, p_o, r_o, needed)),
            lambda needed: (arrays.Float(0),) * (4 if with_spread else 3),
            label="gaze",
        )

    def evaluate_observer_view(self, name: str) -> Float:
        """The observer view ``name`` on the surface, 0 elsewhere."""
        view, observer = self.context.views[name], self.observer
        value = select_nearest(observer.view(name, view), observer.p_o, lambda value: value.evaluate(self.r_o))
        return dr.select(
            self.camera.has_surface, value * self.observer_hit.visibility if view.is_occluded else value, 0
        )

    def count_density_evaluations(self) -> Float:
        """Density evaluations so far, if ``counts`` is required."""
        # Finding the depth can add to the evaluations of the march.
        march = self.camera.ray_hit.march
        evals = None if march is None else march.density_evals
        return self._evaluations if evals is None else self._evaluations + evals
