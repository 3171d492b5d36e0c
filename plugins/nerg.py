r"""
.. _integrator-nerg:

Neural radiance and gaze fields (:monosp:`nerg`)
------------------------------------------------

.. pluginparameters::

 * - field
   - :paramtype:`volume`
   - A trained radiance field (:ref:`nerf <volume-nerf>`): density and colour. Either this, or ``density``, or neither:
     the shapes of the scene are then all there is, and nothing is marched.

 * - density, color
   - :paramtype:`volume`
   - Any Mitsuba volumes: density in 1 / scene unit (first channel), and colour (optional; black without it). Outside of
     the bounding box of ``density`` there is vacuum.

 * - gaze
   - :paramtype:`volume`
   - A trained gaze field (:ref:`gazefield <volume-gazefield>`). Without it no gaze is computed.

 * - (nested)
   - :paramtype:`integrator`
   - Lights the shapes of the scene; its AOVs follow ours. Without one it is ``path`` where the scene has emitters, and
     shapes show their plain albedo where it has none.

 * - kde
   - :paramtype:`volume`
   - Tracked rays (:ref:`gazekde <volume-gazekde>`), whose density the AOV ``kde`` shows.

 * - observer
   - :paramtype:`sensor`
   - Whose gaze it is; only its position counts. Without it the observer is the centre of the rendering camera, and an
     observer placed exactly there gives the same picture. Cameras without a centre (orthographic, say) need one.
   - |exposed|

 * - occlusion
   - |bool|
   - Hide gaze on surfaces that the observer cannot see. Not needed, and not computed, while the observer is the camera.
     (Default: true)

 * - falloff
   - |float|
   - :math:`d_f`, in scene units: how far behind what the observer sees gaze fades to zero; 0 is a hard edge.
     (Default: 0.1)
   - |exposed|, |differentiable|

 * - tolerance
   - |float|
   - How far apart the camera's and the observer's idea of a surface may be, in scene units; 0 stands for two march
     steps, or, without a field, for 1e-4 of the scene's diagonal (or of twice the larger distance of surface and
     observer from the origin, if that is less: a far-away sky dome does not blunt shadows). The point that the observer
     looks for lies this far, and as far as light goes into the surface (at most a 64th of the depth), in front of the
     camera's surface, so that no surface hides itself. More than 1e18 counts as that. (Default: 0)

 * - visibility
   - |string|
   - How occlusion is decided. ``depth``: what the observer meets is compared with the distance to the surface (the
     paper). ``transmittance``: the share of light that passes between observer and surface; ``falloff`` has no part in
     it. ``map``: as ``depth``, with depths and gaze around the observer computed once for all directions and kept until
     the observer, the field or a shape changes; right for many pixels or frames of one observer. Its depths carry no
     derivatives; gaze is then looked up only while none of it are wanted either. (Default: ``depth``; in the store
     2.67 % of the pixels are wrong by it, 2.66 % by ``transmittance``, 3.0 % by ``map``: docs/error-and-time.md)

 * - map_height
   - |int|
   - Rows of the ``map``; it has twice as many columns. (Default: 512; store: 3.0 % of the pixels are wrong, 3.5 % at
     256, 2.83 % at 1,024 for 4 times the rays)

 * - depth
   - |string|
   - {depths} The surface that gaze is evaluated on
     lies at this depth. (Default: ``median``; store: 2.67 % of the pixels have a wrong visibility, 2.89 % with
     ``expected``; ``refined`` takes 41 % more evaluations for 59 % less depth error)

 * - surface_opacity
   - |float|
   - Opacity from which on a ray is said to meet a surface; position, gaze and visibility are 0 below it. (Default: 0.5)

 * - radiance
   - |bool|
   - false computes no colour: the image is black, the AOVs are unchanged. (Default: true)

 * - background
   - |float| or |rgb|
   - Linear radiance behind everything; an environment emitter of the scene takes its place. (Default: 0)

 * - aovs
   - |string|
   - Comma-separated list, in the order wanted; see below. What is not asked for is not computed.
     (Default: ``depth,opacity``)

 * - step
   - |float|
   - March step in scene units; 0 stands for the one that the field was trained with, or for a 1024th of the medium's
     diagonal. (Default: 0; store: depth is then 2.3 mm off its limit, which is 19 mm off the walls; sheets of 4e-3 in a
     unit cube: 5e-4 off, a third of them lost at 256 steps)

 * - quadrature
   - |string|
   - {quadratures} (Default: ``constant``; store,
     1,024 steps: depth 1.25 mm off, ``linear`` 2.33 mm)

 * - coarse
   - |float|
   - Steps in front of all matter are this many times longer; a first, density-only march finds where matter begins.
     What is thinner than such a step may be missed. 1 does without. (Default: 1; 4 saves 10 % of the store's
     evaluations and loses 32 % of thin sheets)

 * - dt_gamma
   - |float|
   - Steps are at least this share of the distance travelled. (Default: 0, i.e. uniform steps; store: 1/128 saves 19 %
     of the evaluations and errs 2.5 times more in depth)

 * - stop
   - |float|
   - Transmittance below which what lies behind is left out: what then lacks of an expected depth is 16 times that, in
     mean free paths. (Default: 1e-7; store: 33.8 evaluations a pixel for 32.8 at 1e-4; fog: 1e-3 has 33 times its depth
     error)

 * - color_cutoff
   - |float|
   - Samples that contribute less than this weight get no colour. (Default: 1e-3; store: 3.6 colour evaluations a
     pixel for 16.3 at 0, colour error unchanged)

 * - jitter
   - |bool|
   - Shift the steps of each sample by a random share of a step. (Default: false; store: depth 2.31 mm off with
     it, 2.30 mm without)

This integrator marches a radiance field, or any pair of volumes, and evaluates a gaze field on the surface that each
ray meets: :math:`G(p_{od}, p_o) = F_e(p_{od}, -r_o)\,\mathrm{sigmoid}(F_c(p_o, r_o))` (equation 1 of the paper), with
:math:`p_o` the observer, :math:`r_o` the direction to the surface and :math:`p_{od}` the surface that the *observer*
meets along it. For an observer who is not the camera, a second, density-only march from :math:`p_o` finds
:math:`p_{od}` and the visibility :math:`1 - \mathrm{clip}((d_{o*} - d_o - \mathrm{tolerance}) / d_f, 0, 1)` that gaze
is multiplied with.

AOVs (0 where nothing is met):

- ``depth`` (``depth.T``): distance along the ray from the ray's origin, wherever opacity > 0
- ``opacity`` (``.Y``): 1 - transmittance
- ``position`` (``.X .Y .Z``): the surface :math:`p_d`
- ``gaze`` (``.Y``): density in 1/sr of the observer attending this surface, after occlusion
- ``emit``, ``capture`` (``.Y``): the two factors after their activations; 1 for one that the variant lacks
- ``gaze_std`` (``.Y``): standard deviation of ``gaze`` over the members of an ensemble, in 1/sr, after occlusion
- ``support`` (``.Y``): how many training rays started around the observer, one at distance d counting 1 - d²/R²
  (R of the training); one number an observer, shown where there is a surface
- ``kde`` (``.Y``): density in 1/sr of the tracked rays nearest to the observer, towards this surface, after occlusion
- ``visibility`` (``.Y``): 1 visible to the observer .. 0 hidden
- ``observer_depth`` (``.T``): :math:`d_o`; the distance to the surface where no occlusion is computed
- ``features`` (``.0``, ``.1``, ...): the field's geometry features, accumulated like colour (not divided by opacity)
- ``features_at`` (``.0``, ``.1``, ...): the same features at the surface :math:`p_d`; 0 on shapes
- ``density_evals``, ``color_evals``, ``gaze_evals`` (``.Y``): evaluations made for the pixel

Colours are composited in the colour space that the field was trained in, then converted to linear:
:math:`L = \alpha\,\mathrm{lin}(C / \alpha) + (1 - \alpha) L_{behind}`. Mono variants receive the luminance. The film's
alpha is 1 wherever opacity > 0 or an environment emitter shows (not with ``hide_emitters``), as in other integrators;
use the ``opacity`` AOV for the fractional one.

Use a box filter and ``component_format`` ``float32`` for AOVs: other filters blend depths across edges, and fp16 rounds
them. With a box filter equal seeds give equal pictures to the bit.

Densities that are negative or NaN count as 0, infinite ones as 1e30 (a checkpoint with weights that are not finite is
refused when it is loaded; weights set later are not looked at).

Derivatives reach field and gaze weights, volumes, ``falloff``, camera and observer positions, in forward and in reverse
mode, with memory that does not grow with the number of steps. They do not see the edges of visibility, nor where
marching stops. In a ``batch`` of cameras, those of poses exist in reverse mode only. Empty voxels of a ``gridvolume``
are skipped: change its data through the scene's or the integrator's
parameters (``mi.traverse``), whose ``update()`` refreshes what is known to be empty.

Shapes of the scene hide the field behind them, from the camera and from the observer, and the field in front of them
attenuates them. Depth on a shape is that of the exact ray cast, and gaze is evaluated there as on any surface. Light
does not pass between the two: a shape casts no shadow on the field, whose light is baked in, nor the field on a shape.
The radiance of the default ``path`` carries no derivatives (nest ``direct``); distances to shapes do, except over
silhouettes.

Inside of another integrator (``aov``, ``moment``) the camera is looked for among the scene's sensors; give
``mi.render`` one of these, or the integrator an explicit ``observer``. Spectral and polarized variants are not
supported.

.. tabs::
    .. code-tab:: xml
        :name: nerg-integrator

        <integrator type="nerg" id="integrator">
            <volume name="field" type="nerf">
                <string name="filename" value="store.safetensors"/>
            </volume>
            <volume name="gaze" type="gazefield">
                <string name="filename" value="shoppers.safetensors"/>
            </volume>
            <sensor name="observer" type="perspective">
                <transform name="to_world">
                    <lookat origin="2, 1, 1.6" target="4, 3, 1.4" up="0, 0, 1"/>
                </transform>
            </sensor>
            <float name="falloff" value="0.3"/>
            <string name="aovs" value="depth,opacity,gaze,visibility"/>
        </integrator>

    .. code-tab:: python

        'type': 'nerg',
        'density': {'type': 'constvolume', 'value': 3.0},
        'depth': 'median',
        'aovs': 'depth,opacity'
"""

from __future__ import annotations

import math
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.interruption import give_back_ctrl_c
from nerg_mi.maths.color import composite_to_linear
from nerg_mi.properties import boolean, choice, color, integer, number, text
from nerg_mi.registration import register
from nerg_mi.transport.features import FeaturePainter, observed_features, snapshot
from nerg_mi.transport.freezing import no_collection, recording
from nerg_mi.transport.march.depth import DEPTHS
from nerg_mi.transport.march.rules import RULES, boundaries
from nerg_mi.transport.march.settings import MarchSettings, default_step
from nerg_mi.transport.media.painting import ColorPainter
from nerg_mi.transport.media.volume import KnownEmpty, VolumeMedium
from nerg_mi.transport.observer import viewpoint
from nerg_mi.transport.observer.ensemble import SupportView
from nerg_mi.transport.observer.sight import KINDS as VISIBILITIES
from nerg_mi.transport.observer.sight import ObserverPass, Sight, towards
from nerg_mi.transport.place import Place
from nerg_mi.transport.shading import Shading

__doc__ = __doc__.replace("{quadratures}", RULES.manual()).replace("{depths}", DEPTHS.manual())

CHANNELS = {
    "depth": "T",
    "opacity": "Y",
    "position": "XYZ",
    "gaze": "Y",
    "emit": "Y",
    "capture": "Y",
    "gaze_std": "Y",
    "support": "Y",
    "kde": "Y",
    "visibility": "Y",
    "observer_depth": "T",
    "density_evals": "Y",
    "color_evals": "Y",
    "gaze_evals": "Y",
}
_FEATURES = ("features", "features_at")
_GAZE_AOVS = {"gaze", "emit", "capture", "gaze_evals", "gaze_std"}
# What else there is to know of an observer, from a view with ``face``, ``value`` and ``occluded``.
_VIEWS = {"support", "kde"}
_OBSERVER_AOVS = {"visibility", "observer_depth"} | _VIEWS
# What needs to know what the observer sees.
_HIDDEN_AOVS = (_GAZE_AOVS | _OBSERVER_AOVS) - {"support"}


class NergIntegrator(mi.SamplingIntegrator):
    __doc__ = __doc__

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise NergError(
                f'"nerg" renders rgb and mono variants, not "{mi.variant()}": radiance fields are trained on rgb photos; '
                'call mi.set_variant("llvm_ad_rgb")'
            )
        field, density, paint = (props.get(k, None) for k in ("field", "density", "color"))
        gaze, kde, observer = (props.get(k, None) for k in ("gaze", "kde", "observer"))
        self.medium = _medium(field, density, paint)
        self._known_empty = None if density is None else KnownEmpty(self.medium)
        if gaze is not None and not hasattr(gaze, "gaze_medium"):
            raise NergError('"gaze" must be a volume of type "gazefield"')
        if kde is not None and not hasattr(kde, "kde_view"):
            raise NergError('"kde" must be a volume of type "gazekde"')
        if observer is not None and not isinstance(observer, mi.Sensor):
            raise NergError('"observer" must be a sensor; its to_world places the observer')
        self._given = {
            "field": field,
            "density": density,
            "color": paint,
            "gaze": gaze,
            "kde": kde,
            "observer": observer,
        }
        self.gaze = None if gaze is None else gaze.gaze_medium()
        _check_semantics(self.gaze, field, self.medium)
        self.observer = observer
        self.shading = Shading(_nested(props))
        self._check_observer()

        self.occlusion = boolean(props, "occlusion", True)
        self.falloff = mi.Float(number(props, "falloff", 0.1, low=0))
        self.depth_kind = choice(props, "depth", "median", DEPTHS.names())
        self.surface_opacity = number(props, "surface_opacity", 0.5, low=0, high=1)
        self.radiance = boolean(props, "radiance", True)
        background = mi.Color3f(color(props, "background", 0.0))
        self.background = mi.Spectrum(mi.luminance(background) if mi.is_monochromatic else background)
        self.aovs = _aovs(text(props, "aovs", "depth,opacity"), self.gaze, field, kde)
        self._views = {"kde": kde.kde_view()} if "kde" in self.aovs else {}
        if "support" in self.aovs:
            self._views["support"] = SupportView(self.gaze.field.support, self.gaze.to_world)
        self.jitter = boolean(props, "jitter", False)
        step = number(props, "step", 0, low=0)
        self.settings = MarchSettings(
            step=step or default_step(self.medium),
            dt_gamma=number(props, "dt_gamma", MarchSettings.dt_gamma, low=0, high=1),
            stop=number(props, "stop", MarchSettings.stop, low=0, high=1),
            color_cutoff=number(props, "color_cutoff", MarchSettings.color_cutoff, low=0, high=1),
            quadrature=choice(props, "quadrature", MarchSettings.quadrature, RULES.names()),
            coarse=number(props, "coarse", MarchSettings.coarse, low=1),
            cell_step=step or math.inf,
        )
        if self.medium is not None:
            boundaries(RULES.find(self.settings.quadrature), self.medium)
        self.observer_pass = ObserverPass(
            self.settings,
            choice(props, "visibility", "depth", VISIBILITIES),
            self.depth_kind,
            self.surface_opacity,
            number(props, "tolerance", 0, low=0),
            integer(props, "map_height", 512, low=2, high=16384),
        )
        # The sensors of the render in progress; None when another integrator drives ours.
        self._sensors = None

    # ------------------------------------------------------------------------
    # Mitsuba's interface
    # ------------------------------------------------------------------------

    def aov_names(self):
        return [f"{name}.{c}" for name in self.aovs for c in self._parts(name)] + self.shading.aov_names()

    def _parts(self, name):
        return map(str, range(self.medium.feature_count)) if name in _FEATURES else CHANNELS[name]

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        give_back_ctrl_c()
        with self.seen_by(sensor, scene), no_collection():
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
        if self.should_stop():
            # Mitsuba has heard Ctrl-C, and told nobody.
            raise KeyboardInterrupt
        return image

    @contextmanager
    def seen_by(self, sensor, scene):
        """While this is open the rays that ``sample`` is given come from ``sensor``."""
        self._check_place(scene)
        if 0 in sensor.film().crop_size():
            raise NergError("the film's crop window is empty; give it a crop_width and a crop_height of at least 1")
        self._sensors = [sensor]
        try:
            yield
        finally:
            self._sensors = None

    def render_forward(self, scene, params, sensor, seed=0, spp=0):
        # Mitsuba 3.9.1 ends the process instead, also with its own integrators: a batch calls its cameras through a
        # table of all sensors, the observer among them.
        if viewpoint.is_batch(sensor) and any(dr.grad_enabled(c) for c in self._eyes(sensor)):
            raise NergError(
                'a "batch" of cameras has no forward derivatives with respect to the pose of an observer or a camera; '
                "render its cameras one by one, or use reverse mode (dr.backward)"
            )
        return super().render_forward(scene, params, sensor, seed, spp)

    def _eyes(self, sensor):
        return viewpoint.centers([sensor]) + ([] if self.observer is None else [viewpoint.center(self.observer)])

    def sample(self, scene, sampler, ray, medium=None, active=True):
        if self._sensors is None:
            self._check_place(scene)
        active = mi.Bool(active)
        offset = sampler.next_1d(active) if self.jitter else None
        asked = set(self.aovs)
        count = bool(asked & {"density_evals", "color_evals"})

        # ---------------------- The camera's ray ----------------------------
        place = Place(self.medium, scene)
        lit = self.radiance and self.medium is not None and self.medium.has_color
        paint = ColorPainter(_color_type(self.medium)) if lit else None
        if "features" in asked:
            paint = FeaturePainter(self.medium, lit)
        view = place.trace(ray, active, self.settings, offset=offset, count=count, color=paint)
        if "features" in asked:
            painted = list(view.march.color)
            view.march.color = mi.Color3f(painted[:3]) if lit else None
            out_features = [dr.select(active, f, 0) for f in painted[3 * lit :]]
        alpha = view.opacity
        some = active & (alpha > 0)
        out = {"opacity": dr.select(active, alpha, 0)}
        if "features" in asked:
            out["features"] = out_features
        if asked - {"opacity", "density_evals", "color_evals", "features"}:
            out["depth"] = view.depth(self.depth_kind, some)

        # ---------------------- The surface and its gaze ---------------------
        density_evals = mi.Float(0)
        if asked & (_GAZE_AOVS | _OBSERVER_AOVS | {"position", "features_at"}):
            surface = active & view.meets(self.surface_opacity)
            p_d = ray.o + ray.d * out["depth"]
            out["position"] = dr.select(surface, p_d, 0)
            if "features_at" in asked:
                out["features_at"] = snapshot(self.medium, p_d, surface & (out["depth"] < view.distance))
            if asked & (_GAZE_AOVS | _OBSERVER_AOVS):
                fuzz = view.penetration(self.depth_kind, out["depth"])
                more = self._gaze(scene, place, ray, p_d, fuzz, surface, asked, count, out)
                density_evals = density_evals + more if more is not None else density_evals
        if count:
            # Finding the depth may have added to what the march counted.
            if view.march is not None:
                density_evals = density_evals + view.march.density_evals
            out["density_evals"] = density_evals
            out["color_evals"] = view.march.color_evals if lit else mi.Float(0)

        # ---------------------- Colour ---------------------------------------
        L, nested = mi.Spectrum(0), [mi.Float(0)] * len(self.shading.aov_names())
        if self.radiance:
            behind, nested, shown = self.shading.radiance(
                scene, sampler, ray, medium, view, self.background, self.hide_emitters, active
            )
            some |= shown
            front, color = view.front, view.march.color if lit else None
            learnt = self.medium.background(ray.o, ray.d) if lit and scene.environment() is None else None
            if learnt is not None:
                # Trained together, composited together: in the field's colour space.
                color = dr.select(view.hit, color, dr.fma(1 - front, mi.Color3f(learnt), color))
                front = dr.select(view.hit, front, 1)
            L = (1 - front) * behind
            if lit:
                L += composite_to_linear(color, front, self.medium.color_space)
        several = ("position", *_FEATURES)
        aovs = [c for name in self.aovs for c in (out[name] if name in several else [out[name]])]
        return dr.select(active, L, 0), some, aovs + nested

    @property
    def children(self):
        """The volumes, the observer and the nested integrator, by their names as parameters."""
        given = self._given | {"integrator": self.shading.nested}
        return {name: child for name, child in given.items() if child is not None}

    def traverse(self, cb):
        for name, child in self.children.items():
            if name == "observer":
                child.traverse(_Pose(cb, "observer."))
            else:
                cb.put(name, child, mi.ParamFlags.Differentiable)
        cb.put("falloff", self.falloff, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        # A map knows by itself of which observer it is, and the fall-off has no part in it.
        if not keys or set(keys) - {"falloff", "to_world"}:
            self.observer_pass.forget()
        if self.medium is not None:
            self.medium.refresh(anyway=not keys or "density" in keys)
        if self.observer is not None and (not keys or "to_world" in keys):
            self.observer.parameters_changed(["to_world"])
        if recording():
            # What is recorded is not looked at.
            return
        self._check_observer()
        if not dr.all(self.falloff >= 0):
            raise NergError(f'"falloff" must not be negative, got {self.falloff}')

    def _check_place(self, scene):
        if self.medium is None and len(scene.shapes()) == 0:
            raise NergError('there is nothing to render: give "nerg" a "field" or a "density", or the scene shapes')

    def _check_observer(self):
        if self.observer is not None:
            viewpoint.require_center(self.observer, '"observer"')
            if not dr.all(dr.isfinite(dr.detach(viewpoint.center(self.observer))), axis=None):
                raise NergError('"observer" stands at a position that is not finite; correct its to_world')

    def to_string(self):
        s = self.settings
        body = {
            k: str(v).replace("\n", "\n  ") for k, v in self.children.items() if k not in ("observer", "integrator")
        }
        if self.observer is not None:
            body["observer"] = viewpoint.center(self.observer)
        body |= {
            "occlusion": self.occlusion,
            "visibility": self.observer_pass.kind,
            "falloff": self.falloff,
            "tolerance": self.observer_pass.tolerance or "2 steps",
            "depth": self.depth_kind,
            "surface_opacity": self.surface_opacity,
            "radiance": self.radiance,
            "aovs": ",".join(self.aovs),
            "quadrature": s.quadrature,
            "step": s.step,
            "coarse": s.coarse,
            "dt_gamma": s.dt_gamma,
            "stop": s.stop,
            "color_cutoff": s.color_cutoff,
            "jitter": self.jitter,
        }
        return "NergIntegrator[\n" + "".join(f"  {k} = {v},\n" for k, v in body.items()) + "]"

    # ------------------------------------------------------------------------
    # The observer
    # ------------------------------------------------------------------------

    def _gaze(self, scene, place, ray, p_d, fuzz, surface, asked, count, out):
        """Add the AOVs that depend on the observer to ``out``; returns the density evaluations made (None: not
        counted)."""
        sensors = self._sensors or scene.sensors()
        if self.observer is None:
            p_o = viewpoint.center_of_ray(sensors, ray)
            aligned = True
        else:
            p_o = viewpoint.center(self.observer)
            aligned = viewpoint.same_center(sensors, p_o)

        observers = viewpoint.centers(sensors) if self.observer is None else [p_o]
        for view in self._views.values():
            view.face(observers)
        if asked & _GAZE_AOVS:
            self.gaze.face(observers, place, self.settings, self.depth_kind, self.surface_opacity)

        distance, r_o = towards(p_o, p_d)
        sight = Sight(p_d, distance, mi.Float(1), mi.Float(0))
        if self.occlusion and not aligned and asked & _HIDDEN_AOVS:
            of_gaze = asked & _GAZE_AOVS
            keeps = of_gaze and not self.gaze.field.config.semantic and of_gaze <= {"gaze", "gaze_evals"}
            looked_up = self.gaze if keeps else None
            sight = self.observer_pass.look(place, ray, p_d, p_o, fuzz, surface, self.falloff, count, looked_up)
        out["visibility"] = dr.select(surface, sight.visibility, 0)
        out["observer_depth"] = dr.select(surface, sight.depth, 0)
        for name, view in self._views.items():
            out[name] = dr.select(surface, view.value(p_o, r_o) * (sight.visibility if view.occluded else 1), 0)

        if asked & _GAZE_AOVS:
            # Where the observer cannot see, gaze is 0 whatever the field says.
            attended = surface & (sight.visibility > 0)
            networks = mi.Float(self.gaze.networks)
            if sight.gaze is not None:
                unknown = attended & (sight.gaze < 0)
                gaze = dr.if_stmt(
                    (unknown, sight.gaze),
                    unknown,
                    lambda unknown, gaze: self.gaze.evaluate(sight.p_od, p_o, r_o, unknown)[0],
                    lambda unknown, gaze: gaze,
                    label="gaze",
                )
                out["gaze"] = dr.select(attended, gaze * sight.visibility, 0)
                out["gaze_evals"] = dr.select(unknown, networks, 0)
                return sight.density_evals
            needed = surface if asked & {"emit", "capture"} else attended
            semantic = observed_features(
                self.gaze.field.config.semantic, place, sight.p_od, p_o, r_o, needed, self.settings
            )
            evaluate = self.gaze.spread if "gaze_std" in asked else self.gaze.evaluate
            gaze, emit, capture, *spread = evaluate(sight.p_od, p_o, r_o, needed, semantic)
            out["gaze"] = dr.select(attended, gaze * sight.visibility, 0)
            out["gaze_std"] = dr.select(attended, spread[0] * sight.visibility, 0) if spread else None
            out["emit"], out["capture"] = dr.select(surface, emit, 0), dr.select(surface, capture, 0)
            out["gaze_evals"] = dr.select(surface, networks, 0)
        return sight.density_evals


class _Pose(mi.TraversalCallback):
    """Shows the pose of a sensor as what it is to us. Mitsuba calls it not differentiable, as silhouettes are not."""

    def __init__(self, cb, prefix):
        super().__init__()
        self.cb, self.prefix = cb, prefix

    def put(self, name, value, flags, *kind):
        if name == "to_world":
            self.cb.put(self.prefix + name, value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous, *kind)


# ----------------------------------------------------------------------------
# Reading the properties
# ----------------------------------------------------------------------------


def _medium(field, density, color):
    if field is not None and density is not None:
        raise NergError('"nerg" takes either "field" (a volume of type "nerf") or "density" (any volume), and not both')
    if field is not None:
        if color is not None:
            raise NergError('"color" goes with "density"; a "field" brings its own colour')
        if not hasattr(field, "medium"):
            raise NergError('"field" must be a volume of type "nerf"; give other volumes as "density" and "color"')
        return field.medium()
    if density is None:
        if color is not None:
            raise NergError('"color" goes with "density", which is missing')
        return None
    for name, volume in (("density", density), ("color", color)):
        if volume is not None and not isinstance(volume, mi.Volume):
            raise NergError(f'"{name}" must be a volume')
    return VolumeMedium(density, color)


def _check_semantics(gaze, field, medium):
    if gaze is None or not gaze.field.config.semantic:
        return
    wanted = gaze.field.config.geometry
    if field is None or medium.feature_count != wanted:
        has = "there is none" if field is None else f"that has {medium.feature_count}"
        raise NergError(f'the "gaze" field asks for {wanted} semantic features of a "field", but {has}')


def _nested(props):
    found = [child for _, child in props.objects() if isinstance(child, mi.Integrator)]
    for name, child in props.objects():
        if isinstance(child, mi.Integrator):
            props.mark_queried(name)
    if len(found) > 1:
        raise NergError(f'"nerg" takes one nested integrator, got {len(found)}')
    return found[0] if found else None


def _aovs(value, gaze, field, kde):
    names = [n.strip() for n in value.split(",") if n.strip()]
    for name in names:
        if name not in CHANNELS and name not in _FEATURES:
            raise NergError(f'"aovs" does not know "{name}"; it knows {", ".join([*CHANNELS, *_FEATURES])}')
        if name in _FEATURES and field is None:
            raise NergError(f'"aovs" asks for "{name}", which needs a "field"')
        if name in _GAZE_AOVS | {"support"} and gaze is None:
            raise NergError(f'"aovs" asks for "{name}", which needs a "gaze" volume')
        if name == "kde" and kde is None:
            raise NergError('"aovs" asks for "kde", which needs a "kde" volume of type "gazekde"')
        if name == "gaze_std" and not hasattr(gaze, "spread"):
            raise NergError(
                '"aovs" asks for "gaze_std", which needs a "gaze" of several members; train it with --ensemble 5'
            )
        if name == "support" and getattr(gaze.field, "support", None) is None:
            raise NergError('"aovs" asks for "support", which the checkpoint of "gaze" does not hold; train it again')
    if len(set(names)) < len(names):
        raise NergError(f'"aovs" names something twice: "{value}"')
    return names


def _color_type(medium):
    return mi.Spectrum if medium.color_space == "spectrum" else mi.Color3f


register("integrator", "nerg", NergIntegrator)
