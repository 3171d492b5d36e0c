"""What :ref:`nerg <integrator-nerg>` finds along camera rays: `CameraView`, which knows of no observer, and `Pixel`,
what an observer makes of it. Both are computed with a `RenderContext`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.maths.color import composite_to_linear
from nerg_mi.maths.types import Bool, Color, Float, Point3f, Ray3f, Vector3f
from nerg_mi.transport import aovs as nerg_aovs
from nerg_mi.transport import observer
from nerg_mi.transport.field_medium import FeaturePainter, make_color_shader
from nerg_mi.transport.geometry import Ceiling, SceneGeometry, Shading
from nerg_mi.transport.march_primal import MarchResult, MarchSettings
from nerg_mi.transport.medium import Medium, Painter
from nerg_mi.transport.observer import ObserverCache, ObserverSettings, ObserverView, evaluate_view
from nerg_mi.transport.observer_gaze import ObservedGaze, GazeFieldInstance
from nerg_mi.transport.occlusion import Sight, trace_from_observer

# Mitsuba with its arrays as `maths.types` has them.
arrays: Any = mi


@dataclass(frozen=True, kw_only=True)
class RenderContext:
    """What pictures are computed with: the integrator's parameters, and the AOVs that are wanted of it.

    ``demands``: what has to be decided before the first part of a pixel is computed:

    - ``counts``: evaluations of density and colour are counted;
    - ``features``: geometry features are accumulated along the ray;
    - ``observer_depth``: the depth that the observer meets is found also where visibility does not need it;
    - ``gaze``: the gaze field is evaluated; ``factors``: on every surface, also where the observer does not see it;
      ``spread``: with the standard deviation over its members.
    """

    aovs: Sequence[str]
    demands: frozenset[str]
    # The views of an observer that the AOVs show, by their names.
    views: Mapping[str, ObserverView]
    # Whether colour is computed.
    radiance: bool
    medium: Medium | None
    gaze: GazeFieldInstance | None
    shading: Shading
    # Whose gaze it is where `CameraView.make_pixel` names nobody; None: the camera's.
    observer: mi.Sensor | None
    cache: ObserverCache
    occlusion: bool
    falloff: Float
    settings: MarchSettings
    observer_settings: ObserverSettings
    ceiling: Ceiling | None
    background: Color
    hide_emitters: bool
    jitter: bool

    @property
    def shared_aovs(self) -> list[str]:
        """Those of the AOVs that all observers have in common."""
        return [name for name in self.aovs if not nerg_aovs.AOVS[name].is_per_observer]

    @property
    def observer_aovs(self) -> list[str]:
        """Those that depend on the observer."""
        return [name for name in self.aovs if nerg_aovs.AOVS[name].is_per_observer]

    def channel_names(self, aovs: Sequence[str]) -> list[str]:
        """Names of the channels of some of the AOVs."""
        return nerg_aovs.channel_names(aovs, self.medium)

    def check_place(self, scene: mi.Scene) -> None:
        """Raise ``NergError`` for a scene with nothing in it."""
        if self.medium is None and len(scene.shapes()) == 0:
            raise NergError('there is nothing to render: give "nerg" a "field" or a "density", or the scene shapes')

    def trace(
        self, scene: mi.Scene, sensors: Sequence[mi.Sensor], sampler: mi.Sampler, ray: Ray3f, active: Bool
    ) -> CameraView:
        """What rays of ``sensors`` meet. Raises ``NergError`` for a scene with nothing in it."""
        self.check_place(scene)
        offset = cast("Any", sampler).next_1d(active) if self.jitter else None
        return CameraView(self, scene, sensors, ray, active, offset)

    def make_observer(self, position: Sequence[float], alone: bool = False) -> Observer:
        """The observer at ``position`` (3,). ``alone``: the only one, whom the integrator remembers."""
        p_o = arrays.Point3f(*map(float, position))
        # A position that is a constant of the kernel would be compiled again for every observer.
        dr.make_opaque(p_o)
        return Observer(p_o, [p_o], self.cache if alone else ObserverCache(numbers=self.cache))


@dataclass(eq=False)
class Observer:
    """Who looks, and what is known of them for as long as this object lives."""

    # Position, lane by lane, and each position that occurs there (one lane each).
    p_o: Point3f
    positions: list[Point3f]
    cache: ObserverCache
    _gaze: ObservedGaze | None = None

    def gaze(self, context: RenderContext, place: SceneGeometry) -> ObservedGaze:
        """The gaze field for these positions, prepared once. ``context``: one that has a gaze field."""
        if self._gaze is None:
            placed = cast("GazeFieldInstance", context.gaze)
            self._gaze = placed.for_observers(self.positions, place, context.observer_settings, self.cache)
        return self._gaze


class CameraView:
    """What camera rays meet, one lane a ray. The ray is traced at once; all else is found when it is first read, so
    that nothing is traced that nobody reads.

    ``sensors``: those that rays may come from; ``offset``: by which share of a step the march is shifted, or None.
    """

    def __init__(
        self,
        context: RenderContext,
        scene: mi.Scene,
        sensors: Sequence[mi.Sensor],
        ray: Ray3f,
        active: Bool,
        offset: Float | None,
    ):
        self.context, self.sensors, self.camera_ray, self.active = context, sensors, ray, active
        # What is traced, and how far the camera's ray went before it.
        self.ray, self.ahead = (ray, None) if context.ceiling is None else context.ceiling.cut(ray)
        medium = context.medium
        self.place = SceneGeometry(medium, scene)
        self.lit = context.radiance and medium is not None and medium.has_color
        painter, features = None, "features" in context.demands
        if medium is not None and self.lit:
            color_type = mi.Spectrum if medium.color_space == "spectrum" else mi.Color3f
            painter = make_color_shader(medium, color_type, features)
        elif medium is not None and features:
            painter = FeaturePainter(medium)
        self.painter = painter
        self.counting = "counts" in context.demands
        self.view = self.place.trace(
            self.ray, active, context.settings, offset=offset, count=self.counting, color=painter
        )
        self.some = active & (self.view.opacity > 0)

    def make_pixel(self, who: Observer | None = None, aligned: bool = False) -> Pixel:
        """These rays as ``who`` sees them; None: the context's own observer. ``aligned``: whether they are known to
        stand where the camera does."""
        return Pixel(self, who, aligned)

    def make_pixel_per_origin(self) -> Pixel:
        """Each ray for an observer at its own origin: of fields that need not be normalised for them."""
        return Pixel(self, Observer(self.camera_ray.o, [], ObserverCache()), True)

    def compute_channels(self, aovs: Sequence[str]) -> list[Float]:
        """All channels of AOVs that observers have in common."""
        return nerg_aovs.compute(aovs, self.make_pixel())

    def eval_shared(self, *more: Any) -> None:
        """Compute now what observers have in common, and ``more``, so that their kernels begin with it."""
        rays = [self.camera_ray.o, self.ray.o, self.ray.d]
        common = [*rays, self.active, self.depth, self.surface, self.p_d, self.penetration]
        if self.counting and self.view.march is not None:
            common.append(self.view.march.density_evals)
        dr.eval(common, more)

    @cached_property
    def color(self) -> Color | None:
        """The medium's colour along the ray, times its opacity; None where there is none."""
        medium = self.context.medium
        if medium is None or not self.lit:
            return None
        ray = medium.ray_to_local(self.ray.o, self.ray.d)
        painter, sums = cast("Painter", self.painter), cast("MarchResult", self.view.march).color
        return painter.resolve_color(medium, sums, self.view.medium_opacity, ray, self.active)

    @property
    def accumulated_features(self) -> list[Float]:
        """Geometry features, accumulated along the ray."""
        painter, march = cast("FeaturePainter", self.painter), cast("MarchResult", self.view.march)
        return [dr.select(self.active, f, 0) for f in painter.features(march.color)]

    @cached_property
    def depth(self) -> Float:
        """Distance along the traced ray to its surface, 0 where nothing absorbs."""
        return self.view.depth(self.context.observer_settings.depth, self.some)

    @property
    def camera_depth(self) -> Float:
        """The same from where the camera's ray starts."""
        return self.depth if self.ahead is None else dr.select(self.some, self.depth + self.ahead, 0)

    @cached_property
    def surface(self) -> Bool:
        """Whether the ray meets a surface."""
        return self.active & self.view.has_surface(self.context.observer_settings.surface_opacity)

    @cached_property
    def p_d(self) -> Point3f:
        """The surface, wherever there is one."""
        return self.ray.o + self.ray.d * self.depth

    @cached_property
    def penetration(self) -> Float | float:
        """How far light goes into the matter before the surface."""
        return self.view.penetration(self.context.observer_settings.depth, self.depth)

    def compute_radiance(self, scene: mi.Scene, sampler: mi.Sampler, medium: mi.Medium | None) -> tuple[Color, Bool, list]:
        """``(radiance, shown, AOVs of the nested integrator)``: of the field, and of what shows through it; whether
        there is anything but the background. ``medium``: Mitsuba's, that the camera stands in (or None)."""
        context, view, front, color = self.context, self.view, self.view.medium_opacity, self.color
        if not context.radiance:
            # A nested integrator has its AOVs also where it lights nothing.
            return mi.Spectrum(0), self.some, [arrays.Float(0)] * len(context.shading.aov_names())
        behind, nested, shown = context.shading.radiance(
            scene, sampler, self.ray, medium, view, context.background, context.hide_emitters, self.active
        )
        field = context.medium
        if field is None or not self.lit:
            return (1 - front) * behind, self.some | shown, nested
        learnt = field.background(self.ray.o, self.ray.d) if scene.environment() is None else None
        if learnt is not None:
            # Trained together, composited together: in the field's colour space.
            color = dr.select(view.hits_shape, color, dr.fma(1 - front, mi.Color3f(learnt), color))
            front = dr.select(view.hits_shape, front, 1)
        L = (1 - front) * behind + composite_to_linear(color, front, field.color_space)
        return L, self.some | shown, nested


@dataclass(frozen=True)
class SurfaceGaze:
    """What a gaze field says of a surface: ``gaze`` and its ``spread`` (None unless demanded) after occlusion, the
    factors ``emit`` and ``capture`` (None where a map knew the gaze), and the networks evaluated."""

    gaze: Float
    evaluations: Float
    emit: Float | None = None
    capture: Float | None = None
    spread: Float | None = None


class Pixel:
    """What an observer makes of what ``camera`` sees: found, part by part, when it is first read. Another observer is
    another object. ``who``, ``aligned``: see `CameraView.make_pixel`."""

    def __init__(self, camera: CameraView, who: Observer | None, aligned: bool):
        self.camera, self.context = camera, camera.context
        self._who, self._aligned = who, aligned
        self._evaluations: Float = arrays.Float(0)

    def compute_channels(self, aovs: Sequence[str]) -> list[Float]:
        """All channels of some of the AOVs."""
        return nerg_aovs.compute(aovs, self)

    @cached_property
    def observer(self) -> Observer:
        """Who looks: whoever was named, the integrator's observer, or those who take the picture."""
        if self._who is not None:
            return self._who
        context, camera = self.context, self.camera
        if context.observer is None:
            p_o = observer.center_of_ray(camera.sensors, camera.camera_ray)
            return Observer(p_o, observer.centers(camera.sensors), context.cache)
        p_o = observer.sensor_center(context.observer)
        return Observer(p_o, [p_o], context.cache)

    @cached_property
    def aligned(self) -> bool:
        """Whether the observer stands where the camera does, and so sees what it sees."""
        if self._aligned or (self._who is None and self.context.observer is None):
            return True
        return observer.same_center(self.camera.sensors, self.observer.p_o)

    @cached_property
    def distance_and_direction(self) -> tuple[Float, Vector3f]:
        """From the observer to the surface."""
        return observer.distance_and_direction(self.observer.p_o, self.camera.p_d)

    @property
    def r_o(self) -> Vector3f:
        """Unit direction from the observer to the surface."""
        return self.distance_and_direction[1]

    @cached_property
    def sight(self) -> Sight:
        """What the observer sees of the surface: all of it where there is no occlusion to compute."""
        context, camera = self.context, self.camera
        if not context.occlusion or self.aligned:
            return Sight(camera.p_d, self.distance_and_direction[0], arrays.Float(1), arrays.Float(0))
        sight = trace_from_observer(
            camera.place,
            camera.ray,
            camera.p_d,
            self.observer.p_o,
            camera.penetration,
            camera.surface,
            context.falloff,
            context.observer_settings,
            count=camera.counting,
            gaze=self.gaze if self._may_look_gaze_up else None,
            cache=self.observer.cache,
            needs_depth=bool(context.demands & {"factors", "observer_depth"}),
        )
        if sight.density_evals is not None:
            self._evaluations = sight.density_evals
        return sight

    @cached_property
    def gaze(self) -> ObservedGaze:
        """The gaze field for the observer."""
        return self.observer.gaze(self.context, self.camera.place)

    @property
    def _may_look_gaze_up(self) -> bool:
        """Whether a map may stand in for the gaze field: it knows neither factors nor spread, nor features."""
        demands = self.context.demands
        if self.context.gaze is None or "gaze" not in demands or demands & {"factors", "spread"}:
            return False
        return not self.context.gaze.field.config.features

    @cached_property
    def attention(self) -> SurfaceGaze:
        """The gaze of the observer on the surface that they see towards this one."""
        sight, gaze, p_o, r_o, surface = self.sight, self.gaze, self.observer.p_o, self.r_o, self.camera.surface
        networks = arrays.Float(gaze.field.networks)
        # Where the observer cannot see, gaze is 0 whatever the field says.
        attended = surface & (sight.visibility > 0)
        shown = lambda value: dr.select(attended, value * sight.visibility, 0)
        if sight.gaze is not None:
            unknown = attended & (sight.gaze < 0)
            density = dr.if_stmt(
                (unknown, sight.gaze),
                unknown,
                lambda unknown, _: gaze.evaluate(sight.p_od, p_o, r_o, unknown)[0],
                lambda _, density: density,
                label="gaze",
            )
            return SurfaceGaze(shown(density), dr.select(unknown, networks, 0))
        needed = surface if "factors" in self.context.demands else attended
        density, emit, capture, *spread = self._evaluated(needed)
        return SurfaceGaze(
            shown(density),
            dr.select(needed, networks, 0),
            dr.select(surface, emit, 0),
            dr.select(surface, capture, 0),
            shown(spread[0]) if spread else None,
        )

    def _evaluated(self, needed: Bool) -> tuple:
        """``(gaze, emit, capture)``, and the spread if it is demanded, where they are ``needed``."""
        gaze, p_od, p_o, r_o = self.gaze, self.sight.p_od, self.observer.p_o, self.r_o
        with_spread = "spread" in self.context.demands
        evaluate = gaze.evaluate_with_std if with_spread else gaze.evaluate
        if gaze.field.config.features or dr.grad_enabled(p_od, p_o, r_o, *gaze.parameters()):
            return evaluate(p_od, p_o, r_o, needed)
        # What is hidden lies together: where none of a packet is needed its networks are passed over.
        return dr.if_stmt(
            (needed,),
            needed,
            lambda needed: tuple(arrays.Float(v) for v in evaluate(p_od, p_o, r_o, needed)),
            lambda needed: (arrays.Float(0),) * (4 if with_spread else 3),
            label="gaze",
        )

    def view_of_observer(self, name: str) -> Float:
        """The observer's view of this name on the surface, 0 elsewhere."""
        view, who = self.context.views[name], self.observer
        value = evaluate_view(view, who.positions, who.p_o, self.r_o, who.cache)
        return dr.select(self.camera.surface, value * self.sight.visibility if view.is_occluded else value, 0)

    def density_evaluations(self) -> Float:
        """Evaluations of density so far, when ``counts`` is among the demands."""
        # Finding the depth may have added to what the march counted.
        march = self.camera.view.march
        evals = None if march is None else march.density_evals
        return self._evaluations if evals is None else self._evaluations + evals
