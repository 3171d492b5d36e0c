"""What :ref:`nerg <integrator-nerg>` finds along one camera ray: the parts that its colour and its AOVs are made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi

from nerg_mi.maths.color import composite_to_linear
from nerg_mi.transport import observer
from nerg_mi.transport.field_medium import FeaturePainter, color_painter
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.observer import view_along
from nerg_mi.transport.observer_gaze import ObservedGaze
from nerg_mi.transport.occlusion import Sight, trace_sight

if TYPE_CHECKING:
    from typing_extensions import Self

    from nerg_mi.transport.march_primal import MarchResult
    from nerg_mi.transport.medium import Painter


@dataclass(frozen=True)
class Attention:
    """What a gaze field says of a surface: ``gaze`` and its ``spread`` (None unless demanded) after occlusion, the
    factors ``emit`` and ``capture`` (None where a map knew the gaze), and the networks evaluated."""

    gaze: Any
    evaluations: Any
    emit: Any = None
    capture: Any = None
    spread: Any = None


class Pixel:
    """One lane a camera ray. The ray is traced at once; all else is found when it is first asked for, so that nothing
    is traced that nothing asks for.

    ``nerg``: the integrator; ``sensors``: those that rays may come from; ``offset``: by which share of a step the march
    is shifted, or None. What has to be known before the first part is found is said by ``nerg.demands``:

    - ``counts``: evaluations of density and colour are counted;
    - ``features``: geometry features are accumulated along the ray;
    - ``observer_depth``: the depth that the observer meets is found also where visibility does not need it;
    - ``gaze``: the gaze field is evaluated; ``factors``: on every surface, also where the observer does not see it;
      ``spread``: with the standard deviation over its members.
    """

    # What does not depend on the observer: all that a pixel for another observer takes over.
    _SHARED = (
        *("nerg", "sensors", "camera_ray", "active", "ray", "ahead", "place", "lit", "painter", "counting", "view"),
        *("some", "depth", "surface", "p_d", "penetration"),
    )

    def __init__(self, nerg, scene, sensors: list, ray, active, offset):
        self.nerg, self.sensors, self.camera_ray, self.active = nerg, sensors, ray, active
        # What is traced, and how far the camera's ray went before it.
        self.ray, self.ahead = (ray, None) if nerg.ceiling is None else nerg.ceiling.cut(ray)
        medium = nerg.medium
        self.place = Place(medium, scene)
        self.lit = nerg.radiance and medium is not None and medium.has_color
        painter, features = None, "features" in nerg.demands
        if medium is not None and self.lit:
            painter = color_painter(medium, _color_type(medium), features)
        elif medium is not None and features:
            painter = FeaturePainter(medium)
        self.painter = painter
        self.counting = "counts" in nerg.demands
        self.view = self.place.trace(self.ray, active, nerg.settings, offset=offset, count=self.counting, color=painter)
        self.some = active & (self.view.opacity > 0)
        self._evaluations: list = []
        self.cache = nerg.cache

    def for_observer(self, p_o, observers: list, aligned: bool, cache) -> Self:
        """The same ray for another observer at ``p_o`` (Point3f), one of ``observers``, of whom ``cache`` knows; what
        does not depend on the observer is found once. ``aligned``: they stand where the camera does."""
        other = type(self).__new__(type(self))
        # Nothing else is taken over, so that no cached property keeps a value of this pixel's observer.
        for name in self._SHARED:
            setattr(other, name, getattr(self, name))
        other.p_o, other.observers, other.aligned, other.cache = p_o, observers, aligned, cache
        other._evaluations = []
        return other

    @cached_property
    def color(self):
        """The medium's colour along the ray, times its opacity; None where there is none."""
        if not self.lit:
            return None
        medium, view, painter = self.nerg.medium, self.view, cast("Painter", self.painter)
        ray = medium.local(self.ray.o, self.ray.d)
        return painter.color(medium, cast("MarchResult", view.march).color, view.front, ray, self.active)

    @property
    def accumulated_features(self) -> list:
        """Geometry features, accumulated along the ray."""
        painter, march = cast("FeaturePainter", self.painter), cast("MarchResult", self.view.march)
        return [dr.select(self.active, f, 0) for f in painter.features(march.color)]

    @cached_property
    def depth(self):
        """Distance along the traced ray to its surface, 0 where nothing absorbs."""
        return self.view.depth(self.nerg.observer_settings.depth, self.some)

    @property
    def camera_depth(self):
        """The same from where the camera's ray starts."""
        return self.depth if self.ahead is None else dr.select(self.some, self.depth + self.ahead, 0)

    @cached_property
    def surface(self):
        """Whether the ray meets a surface."""
        return self.active & self.view.meets(self.nerg.observer_settings.surface_opacity)

    @cached_property
    def p_d(self):
        """The surface, wherever there is one."""
        return self.ray.o + self.ray.d * self.depth

    @cached_property
    def penetration(self):
        """How far light goes into the matter before the surface."""
        return self.view.penetration(self.nerg.observer_settings.depth, self.depth)

    @cached_property
    def observers(self) -> list:
        """Where the observer stands, or each of those who take the picture (Point3f of one lane)."""
        if self.nerg.observer is None:
            return observer.centers(self.sensors)
        return [self.p_o]

    @cached_property
    def p_o(self):
        """The observer of this ray."""
        if self.nerg.observer is None:
            return observer.center_of_ray(self.sensors, self.camera_ray)
        return observer.center(self.nerg.observer)

    @cached_property
    def aligned(self) -> bool:
        """Whether the observer stands where the camera does, and so sees what it sees."""
        return self.nerg.observer is None or observer.same_center(self.sensors, self.p_o)

    @cached_property
    def distance_and_direction(self) -> tuple:
        """From the observer to the surface."""
        return observer.distance_and_direction(self.p_o, self.p_d)

    @property
    def r_o(self):
        """Unit direction from the observer to the surface."""
        return self.distance_and_direction[1]

    @cached_property
    def sight(self) -> Sight:
        """What the observer sees of the surface: all of it where there is no occlusion to compute."""
        nerg = self.nerg
        if not nerg.occlusion or self.aligned:
            return Sight(self.p_d, self.distance_and_direction[0], mi.Float(1), mi.Float(0))
        sight = trace_sight(
            self.place,
            self.ray,
            self.p_d,
            self.p_o,
            self.penetration,
            self.surface,
            nerg.falloff,
            nerg.observer_settings,
            count=self.counting,
            gaze=self.gaze if self._may_look_gaze_up else None,
            cache=self.cache,
            whole=bool(nerg.demands & {"factors", "observer_depth"}),
        )
        if sight.density_evals is not None:
            self._evaluations.append(sight.density_evals)
        return sight

    @cached_property
    def gaze(self) -> ObservedGaze:
        """The gaze field for the observers."""
        return self.nerg.gaze.at(self.observers, self.place, self.nerg.observer_settings, self.cache)

    @property
    def _may_look_gaze_up(self) -> bool:
        """Whether a map may stand in for the gaze field: it knows neither factors nor spread, nor features."""
        demands = self.nerg.demands
        if "gaze" not in demands or demands & {"factors", "spread"}:
            return False
        return not self.nerg.gaze.field.config.features

    @cached_property
    def attention(self) -> Attention:
        """The gaze of the observer on the surface that they see towards this one."""
        nerg, sight, gaze, p_o, r_o = self.nerg, self.sight, self.gaze, self.p_o, self.r_o
        networks = mi.Float(nerg.gaze.field.networks)
        # Where the observer cannot see, gaze is 0 whatever the field says.
        attended = self.surface & (sight.visibility > 0)
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
            return Attention(shown(density), dr.select(unknown, networks, 0))
        needed = self.surface if "factors" in nerg.demands else attended
        density, emit, capture, *spread = self._evaluated(needed)
        return Attention(
            shown(density),
            dr.select(needed, networks, 0),
            dr.select(self.surface, emit, 0),
            dr.select(self.surface, capture, 0),
            shown(spread[0]) if spread else None,
        )

    def _evaluated(self, needed) -> tuple:
        """``(gaze, emit, capture)``, and the spread if it is demanded, where they are ``needed``."""
        gaze, p_od, p_o, r_o = self.gaze, self.sight.p_od, self.p_o, self.r_o
        with_spread = "spread" in self.nerg.demands
        evaluate = gaze.spread if with_spread else gaze.evaluate
        if self.nerg.gaze.field.config.features or dr.grad_enabled(p_od, p_o, r_o, *gaze.parameters()):
            return evaluate(p_od, p_o, r_o, needed)
        # What is hidden lies together: where none of a packet is needed its networks are passed over.
        return dr.if_stmt(
            (needed,),
            needed,
            lambda needed: tuple(mi.Float(v) for v in evaluate(p_od, p_o, r_o, needed)),
            lambda needed: (mi.Float(0),) * (4 if with_spread else 3),
            label="gaze",
        )

    def view_of_observer(self, name: str):
        """The observer's view of this name on the surface, 0 elsewhere."""
        view = self.nerg.views[name]
        value = view_along(view, self.observers, self.p_o, self.r_o, self.cache)
        return dr.select(self.surface, value * self.sight.visibility if view.occluded else value, 0)

    def radiance(self, scene, sampler, medium) -> tuple:
        """``(radiance, shown, AOVs of the nested integrator)``: of the field, and of what shows through it; whether
        there is anything but the background. ``medium``: Mitsuba's, that the camera stands in (or None)."""
        nerg, view, front, color = self.nerg, self.view, self.view.front, self.color
        if not nerg.radiance:
            # A nested integrator has its AOVs also where it lights nothing.
            return mi.Spectrum(0), self.some, [mi.Float(0)] * len(nerg.shading.aov_names())
        behind, nested, shown = nerg.shading.radiance(
            scene, sampler, self.ray, medium, view, nerg.background, nerg.hide_emitters, self.active
        )
        learnt = nerg.medium.background(self.ray.o, self.ray.d) if self.lit and scene.environment() is None else None
        if learnt is not None:
            # Trained together, composited together: in the field's colour space.
            color = dr.select(view.hit, color, dr.fma(1 - front, mi.Color3f(learnt), color))
            front = dr.select(view.hit, front, 1)
        L = (1 - front) * behind
        if self.lit:
            L += composite_to_linear(color, front, nerg.medium.color_space)
        return L, self.some | shown, nested

    def density_evaluations(self):
        """Evaluations of density so far, when ``counts`` is among the demands."""
        total = mi.Float(0)
        for counted in self._evaluations:
            total = total + counted
        # Finding the depth may have added to what the march counted.
        march = self.view.march
        return total if march is None or march.density_evals is None else total + march.density_evals


def _color_type(medium):
    return mi.Spectrum if medium.color_space == "spectrum" else mi.Color3f
