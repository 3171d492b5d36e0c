r"""
.. _integrator-nerg:

Neural radiance and gaze fields (:monosp:`nerg`)
------------------------------------------------

.. pluginparameters::

 * - field
   - :paramtype:`volume`
   - Radiance field (:ref:`nerf <volume-nerf>`) or Gaussian splats (:ref:`splats <volume-splats>`): density and colour.
     Alternative to ``density``. Without either, only the shapes of the scene are rendered, and nothing is marched.

 * - density, color
   - :paramtype:`volume`
   - Any Mitsuba volumes: density in 1/scene unit (first channel), and colour (optional; black by default). There is
     vacuum outside the bounding box of ``density``.

 * - gaze
   - :paramtype:`volume`
   - Gaze field (:ref:`gazefield <volume-gazefield>`). Without it no gaze is computed.

 * - (nested)
   - :paramtype:`integrator`
   - Lights the shapes of the scene; its AOVs follow those of ``nerg``. Without one, ``path`` lights the shapes of a
     scene with emitters, and a headlight those of other scenes.

 * - headlight
   - |float|
   - Shading of shapes in a scene without emitters, 0 to 1: the fraction of their brightness that depends on the angle
     between the normal and the ray. 0 shows the plain albedo. (Default: 0.7)

 * - kde
   - :paramtype:`volume`
   - Tracked rays (:ref:`gazekde <volume-gazekde>`), whose density the AOV ``kde`` shows.

 * - observer
   - :paramtype:`sensor`
   - Observer whose gaze is shown; only the position counts. By default the observer is at the centre of the rendering
     camera, and an observer placed exactly there gives the same image. Cameras without a centre (e.g. orthographic
     ones) require an observer.
   - |exposed|

 * - occlusion
   - |bool|
   - Hide gaze on surfaces that the observer cannot see. Skipped if the observer is at the camera. (Default: true)

 * - falloff
   - |float|
   - :math:`d_f`: distance in scene units over which gaze fades to zero behind an occluder; 0 gives a hard edge.
     (Default: 0.1)
   - |exposed|, |differentiable|

 * - tolerance
   - |float|
   - {depth_tolerance} (Default: 0)

 * - visibility
   - |string|
   - How occlusion is decided. ``depth``: the depth along the observer's ray is compared with the distance to the
     surface (as in the paper). ``transmittance``: the fraction of light that passes between observer and surface;
     ``falloff`` is not used. ``map``: like ``depth``, with a depth and gaze map around the observer that is computed
     once and kept until the observer, the field or a shape changes; best for many pixels or frames of one observer.
     Depths of the map carry no derivatives, and gaze is only looked up if no derivatives are needed. (Default:
     ``depth``)

 * - map_height
   - |int|
   - Rows of the ``map``; it has twice as many columns. Increase it for fine silhouettes. (Default: 512)

 * - directions
   - |int|
   - Maximum number of directions of the integral over each observer's sphere that a *normalised* gaze field is divided
     by. (Default: 131072)

 * - integral_tolerance
   - |float|
   - {integral_tolerance} (Default: 5e-3)

 * - depth
   - |string|
   - Kind of depth: the surface on which gaze is evaluated. {depths} (Default: ``median``)

 * - surface_opacity
   - |float|
   - Minimum opacity of a surface; position, gaze and visibility are 0 below it. (Default: 0.5)

 * - radiance
   - |bool|
   - Compute colour; if false, the image is black and the AOVs are unchanged. (Default: true)

 * - background
   - |float| or |rgb|
   - Linear radiance behind everything; an environment emitter of the scene replaces it. (Default: 0)

 * - ceiling
   - |float|
   - {ceiling}

 * - up
   - |vector|
   - Direction along which ``ceiling`` is measured. (Default: 0, 0, 1)

 * - aovs
   - |string|
   - AOVs to compute, in order, separated by commas; see below. (Default: ``depth,opacity``)

 * - step
   - |float|
   - March step in scene units; 0: the step of the field's training, or 1/1024 of the medium's diagonal. Decrease it for
     exact depths and for thin sheets. (Default: 0)

 * - quadrature
   - |string|
   - Quadrature rule. {quadratures} (Default: ``constant``)

 * - coarse
   - |float|
   - Factor by which steps in front of all matter are longer; a density-only pre-pass finds where matter begins. Matter
     thinner than such a step can be missed: use it for thick matter in a volume without known empty space. 1 disables
     the pre-pass. (Default: 1)

 * - dt_gamma
   - |float|
   - {dt_gamma}

 * - stop
   - |float|
   - {stop} (Default: 1e-7)

 * - color_cutoff
   - |float|
   - Minimum weight of a sample for which colour is evaluated. (Default: 1e-3; for a compiled field, whose colour takes
     most of the time, 0.1)

 * - refined
   - |bool|
   - {refined} (Default: true)

 * - jitter
   - |bool|
   - Shift the steps of each sample by a random fraction of a step, which replaces banding by noise. (Default: false)

docs/explanation/error-and-time.md measures what each default contributes.

This integrator marches through a radiance field, or any pair of volumes, to the surface of each ray, and evaluates a
gaze field for the observer :math:`p_o` in the direction :math:`r_o` to that surface: :math:`G(p_{od}, p_o) =
F_e(p_{od}, -r_o)\,\mathrm{sigmoid}(F_c(p_o, r_o))` (equation 1 of the paper), with the surface :math:`p_{od}` that the
*observer* sees along :math:`r_o`. The default gaze field divides this product by its integral over all directions, and
mixes in a prior. If the observer is not at the camera, a second, density-only march from :math:`p_o` finds
:math:`p_{od}` and the visibility :math:`1 - \mathrm{clip}((d_{o*} - d_o - \mathrm{tolerance}) / d_f, 0, 1)`, by which
gaze is multiplied.

AOVs:

{aovs}

Colours are composited in the colour space of the field's training, then converted to linear: :math:`L =
\alpha\,\mathrm{lin}(C / \alpha) + (1 - \alpha) L_{behind}`. Mono variants use the luminance. The film's alpha is 1
wherever opacity > 0 or an environment emitter is visible (not with ``hide_emitters``), as in other integrators; the AOV
``opacity`` is the fractional opacity.

Use a box filter and ``component_format`` ``float32`` for AOVs: other filters blend depths across edges, and fp16 rounds
them. With a box filter equal seeds give bit-identical images.

Negative and NaN densities count as 0, infinite ones as 1e30. A checkpoint with non-finite weights is rejected when it
is loaded; weights that are set later are not checked.

Derivatives reach field and gaze weights, volumes, ``falloff``, camera and observer positions, in forward and reverse
mode, with memory that does not grow with the number of steps. They ignore visibility edges and the end of the march.
For a ``batch`` of cameras, derivatives with respect to poses exist in reverse mode only. Empty voxels of a
``gridvolume`` are skipped: change its data through the parameters of the scene or of the integrator (``mi.traverse``),
whose ``update()`` refreshes the occupancy.

Shapes of the scene hide the field behind them, from the camera and from the observer, and the field in front of them
attenuates them. Depth on a shape is that of the exact ray cast, and gaze is evaluated there as on any surface. There is
no light transport between both: a shape casts no shadow on the field, whose light is baked in, and the field casts none
on a shape. Derivatives of ``mi.render`` include the radiance of shapes; those with respect to cameras and positions
store each bounce of ``path`` (4 kB a path), and need less memory with ``direct``. Distances to shapes have derivatives,
except across silhouettes.

Inside another integrator (``aov``, ``moment``) the camera is searched among the scene's sensors; pass one of these to
``mi.render``, or give the integrator an explicit ``observer``. Spectral and polarized variants are not supported.

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
from typing import Any

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.interruption import restore_interrupt_handler
from nerg_mi.maths.types import variant_types
from nerg_mi.properties import (
    read_boolean,
    read_choice,
    read_color,
    read_integer,
    read_number,
    read_string,
    read_vector,
)
from nerg_mi.ranges import COORDINATES, MAX_COORDINATE, POSITIVE_VALUES, Range
from nerg_mi.registration import register
from nerg_mi.transport import aovs as nerg_aovs
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.geometry import HEADLIGHT, Ceiling, Shading
from nerg_mi.transport.jit import gc_paused, is_recording
from nerg_mi.transport.march_primal import (
    MarchSettings,
    default_color_cutoff,
    default_dt_gamma,
    default_step,
    default_stop,
)
from nerg_mi.transport.medium import Medium
from nerg_mi.transport.observer import (
    VISIBILITIES,
    ObserverCache,
    ObserverSettings,
    check_center,
    check_centers,
    is_batch,
    sensor_center,
    sensor_centers,
)
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.quadrature import RULES, cells_for_rule
from nerg_mi.transport.recording import FrozenChildren, Recorder
from nerg_mi.transport.volume_medium import FrozenBound, VolumeMedium

from .nerg_pixel import RenderContext

# ---- Parameters ----

PARAMETER_TEXTS = {
    "ceiling": "Height of a clipping plane for cameras above it, so that a roof does not hide the rooms below: rays "
    "that start above the plane begin where they cross it; depths are still measured from the camera. Observer rays "
    "are not clipped. (Default: none)",
    "depth_tolerance": "Depth tolerance of the occlusion test, in scene units; at most 1e18. 0: two march steps "
    "(longer with ``dt_gamma``). Without a field: 1e-4 of the smaller of the scene's diagonal and twice the larger "
    "distance of surface and observer from the origin. The target of the observer's ray lies in front of the camera's "
    "surface by the tolerance plus the penetration depth of light (at most 1/64 of the depth), so that no surface "
    "hides itself.",
    "integral_tolerance": "Relative error of that integral below which fewer directions are used. The error is "
    "estimated from the variation of partial sums; the estimate is usually larger than the true error. 0: always use "
    "the maximum number, which also applies to functions that ``dr.freeze`` records.",
    "dt_gamma": "Minimum step as a fraction of the distance travelled: for wide views, whose distant parts need no "
    "short steps. (Default: 0, i.e. uniform steps; for an unbounded field the value of its training)",
    "stop": "Transmittance below which the march ends. With ``depth`` = ``expected``, the depth error is about 16 x "
    "``stop`` mean free paths.",
    "refined": "Skip the parts of a field's occupied cells in which its training or ``nerg refine`` found no density; "
    "false: skip only its empty cells.",
}


SUMMARY = """Integrator for radiance fields, shapes, and the gaze of an observer.

The parameters that matter most, with their defaults:

    field      Radiance field or Gaussian splats, a volume (none: shapes only).
    gaze       Gaze field, a volume of the type "gazefield" (none: no gaze).
    observer   Sensor at the observer's position (the rendering camera).
    (nested)   Integrator that lights the shapes ("path" with emitters, else a headlight).
    aovs       Images besides colour, separated by commas ("depth,opacity").
    depth      Kind of depth of a field's surface ("median").
    falloff    Distance behind an occluder over which gaze fades (0.1 scene units).
    occlusion  Whether to hide gaze on surfaces that the observer does not see (true).
    step       Step length of the march in scene units (that of the field).
    ceiling    Height above which views from above are clipped (none).

Example, a dictionary for mi.load_dict:

    {"type": "nerg", "field": {"type": "nerf", "filename": "store.safetensors"},
     "gaze": {"type": "gazefield", "filename": "shoppers.safetensors"}, "aovs": "depth,gaze"}

All parameters, and the AOVs, as in the manual:
"""


def fill_manual(manual: str) -> str:
    """``manual`` with all registered kinds of depth and quadrature, and the texts above."""
    texts = {"quadratures": RULES.format_manual(), "depths": DEPTHS.format_manual(), **PARAMETER_TEXTS}
    for name, sentence in texts.items():
        manual = manual.replace(f"{{{name}}}", sentence)
    return manual


def read_children(props) -> dict:
    """The objects among ``props`` by name, or None, and the nested ``integrator``. Raises ``NergError`` for an object
    of the wrong type."""
    children = {name: props.get(name, None) for name in ("field", "density", "color", "gaze", "kde", "observer")}
    if children["gaze"] is not None and not hasattr(children["gaze"], "placed_gaze"):
        raise NergError('"gaze" must be a volume of type "gazefield"')
    if children["kde"] is not None and not hasattr(children["kde"], "kde_view"):
        raise NergError('"kde" must be a volume of type "gazekde"')
    if children["observer"] is not None and not isinstance(children["observer"], mi.Sensor):
        raise NergError('"observer" must be a sensor; its to_world places the observer')
    return children | {"integrator": _nested(props)}


def _nested(props):
    nested = [(name, child) for name, child in props.objects() if isinstance(child, mi.Integrator)]
    for name, _ in nested:
        props.mark_queried(name)
    if len(nested) > 1:
        raise NergError(f'"nerg" takes one nested integrator, got {len(nested)}')
    return nested[0][1] if nested else None


def check_observer(observer) -> None:
    """Raise ``NergError`` for an observer (a sensor, or None) without a finite position within range."""
    if observer is not None:
        check_center(observer, '"observer"')
        if not dr.all(dr.abs(dr.detach(sensor_center(observer))) <= MAX_COORDINATE, axis=None):
            raise NergError(
                f'the position of "observer" is not finite or beyond {MAX_COORDINATE:g}; correct its to_world'
            )


def make_medium(children: dict) -> tuple[Medium | None, FrozenBound | None]:
    """The medium: the ``field``, or ``density`` and ``color``, or none; and its occupancy bound for ``dr.freeze``."""
    field, density, color = (children[name] for name in ("field", "density", "color"))
    if field is not None and density is not None:
        raise NergError('"nerg" takes either "field" (a volume of type "nerf") or "density" (any volume), not both')
    if field is not None:
        if color is not None:
            raise NergError('"color" goes with "density"; a "field" brings its own colour')
        if not hasattr(field, "medium"):
            raise NergError(
                '"field" must be a volume of type "nerf" or "splats"; use other volumes as "density" and "color"'
            )
        return field.medium(), None
    if density is None:
        if color is not None:
            raise NergError('"color" goes with "density", which is missing')
        return None, None
    for name, volume in (("density", density), ("color", color)):
        if volume is not None and not isinstance(volume, mi.Volume):
            raise NergError(f'"{name}" must be a volume')
    medium = VolumeMedium(density, color)
    return medium, FrozenBound(medium)


def make_gaze(children: dict, medium: Medium | None) -> GazeFieldInstance | None:
    """The gaze field. Raises ``NergError`` if the medium lacks the features that it needs."""
    if children["gaze"] is None:
        return None
    gaze = children["gaze"].placed_gaze()
    num_features, feature_medium = gaze.field.config.features, None if children["field"] is None else medium
    if num_features and (feature_medium is None or feature_medium.feature_count != num_features):
        reason = "there is none" if feature_medium is None else f"it has {feature_medium.feature_count}"
        raise NergError(f'the "gaze" field needs {num_features} semantic features of a "field", but {reason}')
    return gaze


def read_march_settings(props, medium: Medium | None) -> MarchSettings:
    """March settings of camera and observer rays."""
    step = read_number(props, "step", 0, Range(0, MAX_COORDINATE))
    settings = MarchSettings(
        step=step or default_step(medium),
        dt_gamma=read_number(props, "dt_gamma", default_dt_gamma(medium), Range(0, 1)),
        stop=read_number(props, "stop", default_stop(medium), Range(0, 1)),
        color_cutoff=read_number(props, "color_cutoff", default_color_cutoff(medium), Range(0, 1)),
        quadrature=read_choice(props, "quadrature", MarchSettings.quadrature, RULES.names()),
        coarse=read_number(props, "coarse", MarchSettings.coarse, Range(1, 1e6)),
        refined=read_boolean(props, "refined", MarchSettings.refined),
        cell_step=step or math.inf,
    )
    if medium is not None:
        cells_for_rule(RULES.find(settings.quadrature), medium)
    return settings


def read_observer_settings(props, march: MarchSettings) -> ObserverSettings:
    """Settings of surfaces and of observer rays."""
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


def read_ceiling(props) -> Ceiling | None:
    """The clipping plane for views from above."""
    up = read_vector(props, "up", (0.0, 0.0, 1.0))
    return Ceiling(read_number(props, "ceiling", 0, COORDINATES), up) if "ceiling" in props else None


def read_background(props):
    """Radiance (Spectrum) behind everything."""
    background = mi.Color3f(read_color(props, "background", 0.0))
    return mi.Spectrum(mi.luminance(background) if mi.is_monochromatic else background)


def describe(nerg) -> str:
    """The integrator ``nerg`` with all its parameters as text."""
    body: dict[str, Any] = {
        k: str(v).replace("\n", "\n  ") for k, v in nerg.children.items() if k not in ("observer", "integrator")
    }
    if nerg.observer is not None:
        body["observer"] = sensor_center(nerg.observer)
    march, observer_settings = nerg.settings, nerg.observer_settings
    body |= {
        "occlusion": nerg.occlusion,
        "visibility": observer_settings.visibility,
        "falloff": nerg.falloff,
        "tolerance": observer_settings.tolerance or "2 steps",
        "map_height": observer_settings.map_height,
        "directions": observer_settings.directions,
        "integral_tolerance": observer_settings.integral_tolerance,
        "depth": observer_settings.depth,
        "surface_opacity": observer_settings.surface_opacity,
        "headlight": nerg.shading.headlight,
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
    """Exposes the pose of a sensor as differentiable and discontinuous; Mitsuba declares it as not differentiable,
    because of silhouettes."""

    def __init__(self, cb, prefix):
        super().__init__()
        self.cb, self.prefix = cb, prefix

    def put(self, name, value, flags, *kind):
        if name == "to_world":
            self.cb.put(self.prefix + name, value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous, *kind)


# ---- The integrator ----

__doc__ = fill_manual(__doc__ or "").replace("{aovs}", nerg_aovs.format_manual())


class NergIntegrator(mi.SamplingIntegrator):
    __doc__ = SUMMARY + (__doc__ or "")

    # What images do not depend on, or what a recording takes from elsewhere.
    UNRECORDED = ("_children", "_frozen_bound", "_sensors", "cache", "observer", "recorder", "variant")

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise NergError(
                f'"nerg" renders rgb and mono variants, not "{mi.variant()}": radiance fields are trained on rgb '
                'photos; call mi.set_variant("llvm_ad_rgb")'
            )
        self.variant = mi.variant()
        # Not tested on graphics cards.
        self.recorder = Recorder(is_enabled=str(self.variant).startswith("llvm"))
        children = read_children(props)
        self._children = FrozenChildren(children, self.recorder)
        self.medium, self._frozen_bound = make_medium(children)
        self.gaze = make_gaze(children, self.medium)
        self.observer = children["observer"]
        self.shading = Shading(children["integrator"], read_number(props, "headlight", HEADLIGHT, Range(0, 1)))
        check_observer(self.observer)

        self.occlusion = read_boolean(props, "occlusion", True)
        self.falloff: Any = mi.Float(read_number(props, "falloff", 0.1, Range(0, POSITIVE_VALUES.high)))
        self.radiance = read_boolean(props, "radiance", True)
        self.background = read_background(props)
        self.ceiling = read_ceiling(props)
        self.jitter = read_boolean(props, "jitter", False)
        self.settings = read_march_settings(props, self.medium)
        self.observer_settings = read_observer_settings(props, self.settings)

        self.aovs = nerg_aovs.parse_aovs(read_string(props, "aovs", "depth,opacity"), self)
        self.required_data = nerg_aovs.collect_required_data(self.aovs)
        self.views = nerg_aovs.collect_observer_views(self.aovs, self)
        self.cache = ObserverCache(recorder=self.recorder)
        self._sensors = None  # sensor of the current rendering; None if another integrator calls this one

    def aov_names(self):
        return nerg_aovs.channel_names(self.aovs, self.medium) + self.shading.aov_names()

    def render(self, scene, sensor=0, seed: Any = 0, spp=0, develop=True, evaluate=True):
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        if self.observer is None and self.context().observer_aovs:
            check_centers(sensor)
        restore_interrupt_handler()
        with self.rendering_from(sensor, scene), gc_paused():
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
        if self.should_stop():
            raise KeyboardInterrupt  # Mitsuba stops on Ctrl-C without raising
        return image

    @contextmanager
    def rendering_from(self, sensor, scene):
        """Return a context manager. Inside it, rays passed to the integrator are camera rays of ``sensor``."""
        self.context().check_scene(scene)
        if 0 in sensor.film().crop_size():
            raise NergError("the film's crop window is empty; give it a crop_width and a crop_height of at least 1")
        self._sensors = [sensor]
        try:
            yield
        finally:
            self._sensors = None

    def render_forward(self, scene, params, sensor, seed: Any = 0, spp=0):
        # Mitsuba 3.9.1 aborts the process in this case, also for its own integrators: a batch calls its cameras through
        # a table of all sensors, including the observer.
        centers = sensor_centers([sensor]) + ([] if self.observer is None else [sensor_center(self.observer)])
        if is_batch(sensor) and any(dr.grad_enabled(c) for c in centers):
            raise NergError(
                'a "batch" of cameras has no forward derivatives with respect to the pose of an observer or a camera; '
                "render its cameras one by one, or use reverse mode (dr.backward)"
            )
        return super().render_forward(scene, params, sensor, seed, spp)

    def sample(self, scene, sampler, ray: Any, medium=None, active: Any = True):
        active = variant_types().Bool(active)
        # Another integrator that calls this one may have chosen any sensor.
        sensors, is_chosen = self._sensors or scene.sensors(), self._sensors is not None
        camera = self.context().trace(scene, sensors, sampler, ray, active, is_chosen)
        aovs = camera.make_pixel().compute_channels(self.aovs)
        L, shown, nested = camera.compute_radiance(scene, sampler, medium)
        return dr.select(active, L, 0), shown, aovs + nested

    def context(self) -> RenderContext:
        """The context of a rendering with the integrator's own AOVs."""
        return RenderContext(self, self.aovs, self.required_data, self.views, self.radiance)

    def make_context(self, aovs: Sequence[str], radiance: bool) -> RenderContext:
        """The context of a rendering with other AOVs, with or without colour. Raises ``NergError`` for AOVs that cannot
        be computed."""
        names = nerg_aovs.parse_aovs(",".join(aovs), self)
        views = nerg_aovs.collect_observer_views(names, self)
        return RenderContext(self, names, nerg_aovs.collect_required_data(names), views, radiance)

    @property
    def children(self):
        """The volumes, the observer and the nested integrator, by parameter name."""
        children = self._children.objects | {"integrator": self.shading.nested}
        return {name: child for name, child in children.items() if child is not None}

    def traverse(self, cb):
        for name, child in self.children.items():
            if name == "observer":
                child.traverse(PoseFlags(cb, "observer."))
            else:
                cb.put(name, child, mi.ParamFlags.Differentiable)
        cb.put("falloff", self.falloff, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        if not keys or {"field", "density", "color"} & set(keys):
            # For a volume without arrays, this is the only sign of a change.
            self.cache.clear()
        if self.medium is not None:
            self.medium.refresh(force=not keys or "density" in keys)
        # Keys of the scene's parameters, and of the integrator's own.
        if self.observer is not None and (not keys or {"to_world", "observer.to_world"} & set(keys)):
            self.observer.parameters_changed(["to_world"])
        if is_recording():
            # Values of a recording cannot be checked.
            return
        check_observer(self.observer)
        if not dr.all(self.falloff >= 0):
            raise NergError(f'"falloff" must not be negative, got {self.falloff}')

    def to_string(self):
        return describe(self)


register("integrator", "nerg", NergIntegrator)
