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

What each of the defaults gains and costs is measured in docs/error-and-time.md ("Defaults").

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

from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.interruption import give_back_ctrl_c
from nerg_mi.maths.types import variant_types
from nerg_mi.properties import boolean, number, text
from nerg_mi.ranges import VALUES, Range
from nerg_mi.registration import register
from nerg_mi.transport import aovs as nerg_aovs
from nerg_mi.transport import observer
from nerg_mi.transport.geometry import Shading
from nerg_mi.transport.jit import no_collection, recording
from nerg_mi.transport.observer import ObserverCache

from . import nerg_properties
from .nerg_pixel import RenderContext

__doc__ = nerg_properties.complete(__doc__ or "").replace("{aovs}", nerg_aovs.manual())


class NergIntegrator(mi.SamplingIntegrator):
    __doc__ = __doc__

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise NergError(
                f'"nerg" renders rgb and mono variants, not "{mi.variant()}": radiance fields are trained on rgb '
                'photos; call mi.set_variant("llvm_ad_rgb")'
            )
        self._given = nerg_properties.read_children(props)
        self.medium, self._known_empty = nerg_properties.medium_of(self._given)
        self.gaze = nerg_properties.gaze_of(self._given, self.medium)
        self.observer, self.shading = self._given["observer"], Shading(self._given["integrator"])
        nerg_properties.check_observer(self.observer)

        self.occlusion = boolean(props, "occlusion", True)
        self.falloff: Any = mi.Float(number(props, "falloff", 0.1, Range(0, VALUES.high)))
        self.radiance = boolean(props, "radiance", True)
        self.background = nerg_properties.background_of(props)
        self.ceiling = nerg_properties.ceiling_of(props)
        self.jitter = boolean(props, "jitter", False)
        self.settings = nerg_properties.march_settings(props, self.medium)
        self.observer_settings = nerg_properties.observer_settings(props, self.settings)

        self.aovs = nerg_aovs.read_aovs(text(props, "aovs", "depth,opacity"), self)
        self.demands = nerg_aovs.demands_of(self.aovs)
        self.views = nerg_aovs.views_of(self.aovs, self)
        self.cache = ObserverCache()
        self._sensors = None  # of the render in progress; None when another integrator drives ours

    def aov_names(self):
        return nerg_aovs.channel_names(self.aovs, self.medium) + self.shading.aov_names()

    def render(self, scene, sensor=0, seed: Any = 0, spp=0, develop=True, evaluate=True):
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        give_back_ctrl_c()
        with self.seen_by(sensor, scene), no_collection():
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
        if self.should_stop():
            raise KeyboardInterrupt  # Mitsuba has heard Ctrl-C, and told nobody.
        return image

    @contextmanager
    def seen_by(self, sensor, scene):
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
        eyes = observer.centers([sensor]) + ([] if self.observer is None else [observer.center(self.observer)])
        if observer.is_batch(sensor) and any(dr.grad_enabled(c) for c in eyes):
            raise NergError(
                'a "batch" of cameras has no forward derivatives with respect to the pose of an observer or a camera; '
                "render its cameras one by one, or use reverse mode (dr.backward)"
            )
        return super().render_forward(scene, params, sensor, seed, spp)

    def sample(self, scene, sampler, ray: Any, medium=None, active: Any = True):
        active = variant_types().Bool(active)
        camera = self.context().trace(scene, self._sensors or scene.sensors(), sampler, ray, active)
        aovs = camera.for_observer().channels(self.aovs)
        L, shown, nested = camera.radiance(scene, sampler, medium)
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

    def for_aovs(self, aovs: Sequence[str], radiance: bool) -> RenderContext:
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
                child.traverse(nerg_properties.Pose(cb, "observer."))
            else:
                cb.put(name, child, mi.ParamFlags.Differentiable)
        cb.put("falloff", self.falloff, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        if not keys or {"field", "density", "color"} & set(keys):
            # Of a volume that shows no arrays only this tells that it is another one.
            self.cache.forget()
        if self.medium is not None:
            self.medium.refresh(anyway=not keys or "density" in keys)
        # Of the scene's parameters, and of this integrator's alone.
        if self.observer is not None and (not keys or {"to_world", "observer.to_world"} & set(keys)):
            self.observer.parameters_changed(["to_world"])
        if recording():
            # What is recorded is not looked at.
            return
        nerg_properties.check_observer(self.observer)
        if not dr.all(self.falloff >= 0):
            raise NergError(f'"falloff" must not be negative, got {self.falloff}')

    def to_string(self):
        return nerg_properties.describe(self)


register("integrator", "nerg", NergIntegrator)
