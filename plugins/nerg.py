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
   - {apart} (Default: 0)

 * - visibility
   - |string|
   - How occlusion is decided. ``depth``: what the observer meets is compared with the distance to the surface (the
     paper). ``transmittance``: the share of light that passes between observer and surface; ``falloff`` has no part in
     it. ``map``: as ``depth``, with depths and gaze around the observer computed once for all directions and kept until
     the observer, the field or a shape changes; right for many pixels or frames of one observer. Its depths carry no
     derivatives; gaze is then looked up only while none of it are wanted either. (Default: ``depth``)

 * - map_height
   - |int|
   - Rows of the ``map``; it has twice as many columns. More of them for fine silhouettes. (Default: 512)

 * - directions
   - |int|
   - Of the integral that a *normalised* gaze field is divided by, for each observer, at most. (Default: 131072)

 * - integral_tolerance
   - |float|
   - {integral_tolerance} (Default: 5e-3)

 * - depth
   - |string|
   - {depths} The surface that gaze is evaluated on lies there. (Default: ``median``)

 * - surface_opacity
   - |float|
   - Opacity from which on a ray is said to meet a surface; position, gaze and visibility are 0 below it. (Default: 0.5)

 * - radiance
   - |bool|
   - false computes no colour: the image is black, the AOVs are unchanged. (Default: true)

 * - background
   - |float| or |rgb|
   - Linear radiance behind everything; an environment emitter of the scene takes its place. (Default: 0)

 * - ceiling
   - |float|
   - {ceiling}

 * - up
   - |vector|
   - Along which ``ceiling`` is measured. (Default: 0, 0, 1)

 * - aovs
   - |string|
   - What to compute, in the order wanted, with commas between; see below. (Default: ``depth,opacity``)

 * - step
   - |float|
   - March step in scene units; 0 stands for the one that the field was trained with, or for a 1024th of the medium's
     diagonal. Less for exact depths, and for sheets that are thinner. (Default: 0)

 * - quadrature
   - |string|
   - {quadratures} (Default: ``constant``)

 * - coarse
   - |float|
   - Steps in front of all matter are this many times longer; a first, density-only march finds where matter begins.
     What is thinner than such a step may be missed: for thick matter in a volume whose empty space is not known. 1 does
     without. (Default: 1)

 * - dt_gamma
   - |float|
   - {dt_gamma}

 * - stop
   - |float|
   - {stop} (Default: 1e-7)

 * - color_cutoff
   - |float|
   - Samples that contribute less than this weight get no colour. (Default: 1e-3)

 * - refined
   - |bool|
   - {refined} (Default: true)

 * - jitter
   - |bool|
   - Shift the steps of each sample by a random share of a step, for noise in place of bands. (Default: false)

What each of the defaults gains and costs is measured in docs/explanation/error-and-time.md ("Defaults").

This integrator marches a radiance field, or any pair of volumes, and evaluates a gaze field on the surface that each
ray meets: :math:`G(p_{od}, p_o) = F_e(p_{od}, -r_o)\,\mathrm{sigmoid}(F_c(p_o, r_o))` (equation 1 of the paper), with
:math:`p_o` the observer, :math:`r_o` the direction to the surface and :math:`p_{od}` the surface that the *observer*
meets along it. For an observer who is not the camera, a second, density-only march from :math:`p_o` finds
:math:`p_{od}` and the visibility :math:`1 - \mathrm{clip}((d_{o*} - d_o - \mathrm{tolerance}) / d_f, 0, 1)` that gaze
is multiplied with.

AOVs (0 where nothing is met):

{aovs}

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
are skipped: change its data through the scene's or the integrator's parameters (``mi.traverse``), whose ``update()``
refreshes what is known to be empty.

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
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.interruption import restore_interrupt_handler
from nerg_mi.maths.types import variant_types
from nerg_mi.properties import read_boolean, read_choice, read_color, read_integer, read_number, read_string, read_vector
from nerg_mi.ranges import COORDINATES, MAX_COORDINATE, POSITIVE_VALUES, Range
from nerg_mi.registration import register
from nerg_mi.transport import aovs as nerg_aovs
from nerg_mi.transport import observer
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.geometry import Ceiling, Shading
from nerg_mi.transport.jit import no_collection, recording
from nerg_mi.transport.march_primal import MarchSettings, default_growth, default_step, default_stop
from nerg_mi.transport.medium import Medium
from nerg_mi.transport.observer import VISIBILITIES, ObserverCache, ObserverSettings, sensor_center, check_center
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.quadrature import RULES, boundaries
from nerg_mi.transport.volume_medium import KnownEmpty, VolumeMedium

from .nerg_pixel import RenderContext

# ---- Parameters ----

TEXTS = {
    "ceiling": "Height above which a place is left out of what cameras see from above it, so that a roof hides no "
    "room: rays that start higher begin where they come below it; depths still count from the camera. What observers "
    "see is not cut. (Default: none)",
    "apart": "How far apart the camera's and the observer's idea of a surface may be, in scene units; 0 stands "
    "for two march steps, or, without a field, for 1e-4 of the scene's diagonal (or of twice the larger distance of "
    "surface and observer from the origin, if that is less: a far-away sky dome does not blunt shadows). The "
    "point that the observer looks for lies this far, and as far as light goes into the surface (at most a 64th "
    "of the depth), in front of the camera's surface, so that no surface hides itself. More than 1e18 counts as "
    "that.",
    "integral_tolerance": "Error of that integral, as a share of it, below which fewer directions will do: told by the "
    "scatter of parts of the sum, which tells more than there is as a rule. 0: always as many; so it is, too, in what "
    "``dr.freeze`` records.",
    "dt_gamma": "Steps are at least this share of the distance travelled: for wide views, whose far parts need no "
    "short steps. (Default: 0, i.e. uniform steps; for a field without an end that which it was trained with)",
    "stop": "Transmittance below which what lies behind is left out: what then lacks of an expected depth is 16 times "
    "that, in mean free paths.",
    "refined": "Skip the parts of a field's occupied cells in which nothing was found when it was trained or refined "
    "(``nerg refine``); false: only its empty cells.",
}


def complete(manual: str) -> str:
    """The ``manual`` with the kinds of depth and of quadrature that are registered, and what else is said here."""
    texts = {"quadratures": RULES.format_manual(), "depths": DEPTHS.format_manual(), **TEXTS}
    for name, sentence in texts.items():
        manual = manual.replace(f"{{{name}}}", sentence)
    return manual


def read_children(props) -> dict:
    """The objects that ``props`` names, or None, and the nested ``integrator``. Raises ``NergError`` for one that is
    not what its name asks for."""
    found = {name: props.get(name, None) for name in ("field", "density", "color", "gaze", "kde", "observer")}
    if found["gaze"] is not None and not hasattr(found["gaze"], "placed_gaze"):
        raise NergError('"gaze" must be a volume of type "gazefield"')
    if found["kde"] is not None and not hasattr(found["kde"], "kde_view"):
        raise NergError('"kde" must be a volume of type "gazekde"')
    if found["observer"] is not None and not isinstance(found["observer"], mi.Sensor):
        raise NergError('"observer" must be a sensor; its to_world places the observer')
    return found | {"integrator": _nested(props)}


def _nested(props):
    found = [(name, child) for name, child in props.objects() if isinstance(child, mi.Integrator)]
    for name, _ in found:
        props.mark_queried(name)
    if len(found) > 1:
        raise NergError(f'"nerg" takes one nested integrator, got {len(found)}')
    return found[0][1] if found else None


def check_observer(observer) -> None:
    """Raise ``NergError`` for an observer (a sensor, or None) who stands nowhere, or too far away."""
    if observer is not None:
        check_center(observer, '"observer"')
        if not dr.all(dr.abs(dr.detach(sensor_center(observer))) <= MAX_COORDINATE, axis=None):
            raise NergError(
                f'"observer" stands at a position that is not finite, or beyond {MAX_COORDINATE:g}; correct its to_world'
            )


def medium_of(children: dict) -> tuple[Medium | None, KnownEmpty | None]:
    """What is marched: the ``field``, or ``density`` and ``color``, or nothing; and what of the latter is skipped."""
    field, density, paint = (children[name] for name in ("field", "density", "color"))
    if field is not None and density is not None:
        raise NergError('"nerg" takes either "field" (a volume of type "nerf") or "density" (any volume), and not both')
    if field is not None:
        if paint is not None:
            raise NergError('"color" goes with "density"; a "field" brings its own colour')
        if not hasattr(field, "medium"):
            raise NergError(
                '"field" must be a volume of type "nerf" or "splats"; give other volumes as "density" and "color"'
            )
        return field.medium(), None
    if density is None:
        if paint is not None:
            raise NergError('"color" goes with "density", which is missing')
        return None, None
    for name, volume in (("density", density), ("color", paint)):
        if volume is not None and not isinstance(volume, mi.Volume):
            raise NergError(f'"{name}" must be a volume')
    medium = VolumeMedium(density, paint)
    return medium, KnownEmpty(medium)


def gaze_of(children: dict, medium: Medium | None) -> GazeFieldInstance | None:
    """The gaze field, whose features the medium must have."""
    if children["gaze"] is None:
        return None
    gaze = children["gaze"].placed_gaze()
    wanted, given = gaze.field.config.features, None if children["field"] is None else medium
    if wanted and (given is None or given.feature_count != wanted):
        has = "there is none" if given is None else f"that has {given.feature_count}"
        raise NergError(f'the "gaze" field asks for {wanted} semantic features of a "field", but {has}')
    return gaze


def march_settings(props, medium: Medium | None) -> MarchSettings:
    """Of the camera's and the observer's rays."""
    step = read_number(props, "step", 0, Range(0, MAX_COORDINATE))
    settings = MarchSettings(
        step=step or default_step(medium),
        dt_gamma=read_number(props, "dt_gamma", default_growth(medium), Range(0, 1)),
        stop=read_number(props, "stop", default_stop(medium), Range(0, 1)),
        color_cutoff=read_number(props, "color_cutoff", MarchSettings.color_cutoff, Range(0, 1)),
        quadrature=read_choice(props, "quadrature", MarchSettings.quadrature, RULES.names()),
        coarse=read_number(props, "coarse", MarchSettings.coarse, Range(1, 1e6)),
        refined=read_boolean(props, "refined", MarchSettings.refined),
        cell_step=step or math.inf,
    )
    if medium is not None:
        boundaries(RULES.find(settings.quadrature), medium)
    return settings


def observer_settings(props, march: MarchSettings) -> ObserverSettings:
    """Of the surfaces, and of what the observer sees of them."""
    defaults = ObserverSettings(march=march)
    return ObserverSettings(
        march=march,
        depth=read_choice(props, "depth", defaults.depth, DEPTHS.names()),
        surface_opacity=read_number(props, "surface_opacity", defaults.surface_opacity, Range(0, 1)),
        visibility=read_choice(props, "visibility", defaults.visibility, VISIBILITIES),
        tolerance=read_number(props, "tolerance", defaults.tolerance, Range(0, POSITIVE_VALUES.high)),
        map_height=read_integer(props, "map_height", defaults.map_height, Range(2, 16384)),
        directions=read_integer(props, "directions", defaults.directions, Range(64, 1 << 24)),
        integral_tolerance=read_number(props, "integral_tolerance", defaults.integral_tolerance, Range(0, 1)),
    )


def ceiling_of(props) -> Ceiling | None:
    """What is left out of views from above."""
    up = read_vector(props, "up", (0.0, 0.0, 1.0))
    return Ceiling(read_number(props, "ceiling", 0, COORDINATES), up) if "ceiling" in props else None


def background_of(props):
    """Radiance (Spectrum) behind everything."""
    background = mi.Color3f(read_color(props, "background", 0.0))
    return mi.Spectrum(mi.luminance(background) if mi.is_monochromatic else background)


def describe(nerg) -> str:
    """The integrator ``nerg`` with all its parameters, for people."""
    body: dict[str, Any] = {
        k: str(v).replace("\n", "\n  ") for k, v in nerg.children.items() if k not in ("observer", "integrator")
    }
    if nerg.observer is not None:
        body["observer"] = sensor_center(nerg.observer)
    march, seen = nerg.settings, nerg.observer_settings
    body |= {
        "occlusion": nerg.occlusion,
        "visibility": seen.visibility,
        "falloff": nerg.falloff,
        "tolerance": seen.tolerance or "2 steps",
        "map_height": seen.map_height,
        "directions": seen.directions,
        "integral_tolerance": seen.integral_tolerance,
        "depth": seen.depth,
        "surface_opacity": seen.surface_opacity,
        "radiance": nerg.radiance,
        "ceiling": "none" if nerg.ceiling is None else nerg.ceiling,
        "aovs": ",".join(nerg.aovs),
        "quadrature": march.quadrature,
        "step": march.step,
        "coarse": march.coarse,
        "dt_gamma": march.dt_gamma,
        "stop": march.stop,
        "color_cutoff": march.color_cutoff,
        "refined": march.refined,
        "jitter": nerg.jitter,
    }
    return "NergIntegrator[\n" + "".join(f"  {k} = {v},\n" for k, v in body.items()) + "]"


class PoseFlags(mi.TraversalCallback):
    """Shows the pose of a sensor as what it is to us. Mitsuba calls it not differentiable, as silhouettes are not."""

    def __init__(self, cb, prefix):
        super().__init__()
        self.cb, self.prefix = cb, prefix

    def put(self, name, value, flags, *kind):
        if name == "to_world":
            self.cb.put(self.prefix + name, value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous, *kind)


# ---- The integrator ----

__doc__ = complete(__doc__ or "").replace("{aovs}", nerg_aovs.manual())


class NergIntegrator(mi.SamplingIntegrator):
    __doc__ = __doc__

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise NergError(
                f'"nerg" renders rgb and mono variants, not "{mi.variant()}": radiance fields are trained on rgb '
                'photos; call mi.set_variant("llvm_ad_rgb")'
            )
        self._given = read_children(props)
        self.medium, self._known_empty = medium_of(self._given)
        self.gaze = gaze_of(self._given, self.medium)
        self.observer, self.shading = self._given["observer"], Shading(self._given["integrator"])
        check_observer(self.observer)

        self.occlusion = read_boolean(props, "occlusion", True)
        self.falloff: Any = mi.Float(read_number(props, "falloff", 0.1, Range(0, POSITIVE_VALUES.high)))
        self.radiance = read_boolean(props, "radiance", True)
        self.background = background_of(props)
        self.ceiling = ceiling_of(props)
        self.jitter = read_boolean(props, "jitter", False)
        self.settings = march_settings(props, self.medium)
        self.observer_settings = observer_settings(props, self.settings)

        self.aovs = nerg_aovs.read_aovs(read_string(props, "aovs", "depth,opacity"), self)
        self.demands = nerg_aovs.demands_of(self.aovs)
        self.views = nerg_aovs.views_of(self.aovs, self)
        self.cache = ObserverCache()
        self._sensors = None  # of the render in progress; None when another integrator drives ours

    def aov_names(self):
        return nerg_aovs.channel_names(self.aovs, self.medium) + self.shading.aov_names()

    def render(self, scene, sensor=0, seed: Any = 0, spp=0, develop=True, evaluate=True):
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        restore_interrupt_handler()
        with self.rendering_from(sensor, scene), no_collection():
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
        if self.should_stop():
            raise KeyboardInterrupt  # Mitsuba has heard Ctrl-C, and told nobody.
        return image

    @contextmanager
    def rendering_from(self, sensor, scene):
        """While this is open the rays that ``sample`` is given come from ``sensor``."""
        self.context().check_place(scene)
        if 0 in sensor.film().crop_size():
            raise NergError("the film's crop window is empty; give it a crop_width and a crop_height of at least 1")
        self._sensors = [sensor]
        try:
            yield
        finally:
            self._sensors = None

    def render_forward(self, scene, params, sensor, seed: Any = 0, spp=0):
        # Mitsuba 3.9.1 ends the process instead, also with its own integrators: a batch calls its cameras through a
        # table of all sensors, the observer among them.
        eyes = observer.centers([sensor]) + ([] if self.observer is None else [observer.sensor_center(self.observer)])
        if observer.is_batch(sensor) and any(dr.grad_enabled(c) for c in eyes):
            raise NergError(
                'a "batch" of cameras has no forward derivatives with respect to the pose of an observer or a camera; '
                "render its cameras one by one, or use reverse mode (dr.backward)"
            )
        return super().render_forward(scene, params, sensor, seed, spp)

    def sample(self, scene, sampler, ray: Any, medium=None, active: Any = True):
        active = variant_types().Bool(active)
        camera = self.context().trace(scene, self._sensors or scene.sensors(), sampler, ray, active)
        aovs = camera.make_pixel().compute_channels(self.aovs)
        L, shown, nested = camera.compute_radiance(scene, sampler, medium)
        return dr.select(active, L, 0), shown, aovs + nested

    def context(self) -> RenderContext:
        """What its pictures are computed with."""
        return RenderContext(
            aovs=self.aovs,
            demands=self.demands,
            views=self.views,
            radiance=self.radiance,
            medium=self.medium,
            gaze=self.gaze,
            shading=self.shading,
            observer=self.observer,
            cache=self.cache,
            occlusion=self.occlusion,
            falloff=self.falloff,
            settings=self.settings,
            observer_settings=self.observer_settings,
            ceiling=self.ceiling,
            background=self.background,
            hide_emitters=self.hide_emitters,
            jitter=self.jitter,
        )

    def make_context(self, aovs: Sequence[str], radiance: bool) -> RenderContext:
        """The same for other AOVs, with colour or without. Raises ``NergError`` for those that it cannot compute."""
        names = nerg_aovs.read_aovs(",".join(aovs), self)
        views = nerg_aovs.views_of(names, self)
        demands = nerg_aovs.demands_of(names)
        return replace(self.context(), aovs=names, demands=demands, views=views, radiance=radiance)

    @property
    def children(self):
        """The volumes, the observer and the nested integrator, by their names as parameters."""
        given = self._given | {"integrator": self.shading.nested}
        return {name: child for name, child in given.items() if child is not None}

    def traverse(self, cb):
        for name, child in self.children.items():
            if name == "observer":
                child.traverse(PoseFlags(cb, "observer."))
            else:
                cb.put(name, child, mi.ParamFlags.Differentiable)
        cb.put("falloff", self.falloff, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        if not keys or {"field", "density", "color"} & set(keys):
            # Of a volume that shows no arrays only this tells that it is another one.
            self.cache.clear()
        if self.medium is not None:
            self.medium.refresh(anyway=not keys or "density" in keys)
        # Of the scene's parameters, and of this integrator's alone.
        if self.observer is not None and (not keys or {"to_world", "observer.to_world"} & set(keys)):
            self.observer.parameters_changed(["to_world"])
        if recording():
            # What is recorded is not looked at.
            return
        check_observer(self.observer)
        if not dr.all(self.falloff >= 0):
            raise NergError(f'"falloff" must not be negative, got {self.falloff}')

    def to_string(self):
        return describe(self)


register("integrator", "nerg", NergIntegrator)
