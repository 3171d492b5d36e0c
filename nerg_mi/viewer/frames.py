"""Frames of a moving view: one program computes rays, values and displayed colours, and is replayed for each frame.

A frame has a fifteenth of a second; NumPy would need longer for its rays and colours than the scene does.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from nerg_mi.environment.bands import make_sampler
from nerg_mi.environment.scene import COLOR, Scene, make_aov_context
from nerg_mi.figures.overlay import LUMINANCE, OverlayLayers, Style, srgb
from nerg_mi.figures.style import LINE, PALE, PALE_FRACTION, PERIOD, WIDTH, find_colormap
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.color import linear_to_srgb
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.transport.ray_cells import RayCells
from nerg_mi.transport.splat_medium import SplatMedium

from .lattice import Lattice
from .layers import Layer, Scale
from .points import FramePace, PinholeView, StagePicture, override_attribute, rough_integrals

_COLOR_CUTOFF = 0.5
"""`MarchSettings.color_cutoff` of drafts of a compiled field: colour takes most of their time."""

_SPLAT_STOP = 0.05
"""`MarchSettings.stop` of drafts of splats."""

_SPLAT_CELLS = 96
"""Cells of the lists of splats across a frame of any width: with another number, kernels are compiled again."""

_MAP_HEIGHT = 192
"""Rows of the map around the observer of drafts: one for each degree, and two columns for each."""

_MOVING_DIRECTIONS = 1 << 10
"""Maximum number of directions of the integral that normalises the gaze of a moving observer in drafts."""

_STEPS = 1024
"""Values of a scale whose display is tabulated."""


def render_frame(
    scene: Scene,
    view: PinholeView,
    observer: np.ndarray,
    layer: Layer,
    scale: Scale,
    lattice: Lattice,
    pace: FramePace,
    *,
    ceiling: Ceiling | None = None,
    is_draft: bool = True,
    is_observer_at_rest: bool = False,
    is_view_at_rest: bool = False,
) -> tuple[StagePicture, np.ndarray]:
    """Render a picture with at most one sample per pixel at once.

    Parameters
    ----------
    scene, view, observer, ceiling
        As for `refine`.
    layer, scale
        What is displayed.
    lattice : Lattice
        The pixels, and which of them are traced.
    pace : FramePace
        Records the time of a draft.
    is_draft : bool
        Whether the view or the observer moves: the colour of a compiled field is evaluated at one or two positions per
        ray, and splats behind nearly opaque ones are left out.
    is_observer_at_rest : bool
        Whether a coarse map around the observer has the gaze of a draft. It is kept, and takes as long as a frame.
    is_view_at_rest : bool
        Whether a draft for a moving observer has the colours and surfaces of all pixels in the settings of the scene,
        if the layer can keep them: only what the observer sees is computed again.

    Returns
    -------
    picture : StagePicture
        Without values.
    colors : ndarray of shape (height, width, 3), uint8
        Its colours.
    """
    start, integrator = time.perf_counter(), scene.integrator
    settings, observed, medium = integrator.settings, integrator.observer_settings, integrator.medium
    is_view_kept = is_draft and is_view_at_rest and not is_observer_at_rest and layer.can_keep_view
    if is_draft and not is_view_kept and isinstance(medium, SplatMedium):
        settings = replace(settings, stop=max(settings.stop, _SPLAT_STOP))
    elif is_draft and not is_view_kept and medium is not None and medium.is_density_separate:
        settings = replace(settings, color_cutoff=max(settings.color_cutoff, _COLOR_CUTOFF))
    if is_draft and is_observer_at_rest and observed.visibility != "transmittance":
        observed = replace(observed, visibility="map", map_height=min(observed.map_height, _MAP_HEIGHT))
    elif is_draft:
        observed = replace(observed, directions=min(observed.directions, _MOVING_DIRECTIONS))
    with (
        override_attribute(scene, "observer_settings", observed),
        rough_integrals(scene),
        override_attribute(scene, "ceiling", ceiling),
        override_attribute(scene, "settings", settings),
    ):
        frame = _Frame(scene, view, layer, scale, lattice)
        colors = frame.render(observer, is_view_kept)
    seconds = time.perf_counter() - start
    if is_draft:
        pace.record(seconds, lattice.num_rays, is_view_kept)
    return StagePicture({}, 1, seconds, 1, False), colors


class _Frame:
    """A frame of ``view``: its rays, and what kernels read of them. Arguments: as of `render_frame`."""

    def __init__(self, scene: Scene, view: PinholeView, layer: Layer, scale: Scale, lattice: Lattice):
        import drjit as dr

        mi: Any = variant_types()
        self.scene, self.view, self.layer, self.lattice = scene, view, layer, lattice
        quantity = [layer.quantity] if layer.quantity else []
        self.context: Any = make_aov_context(scene, [COLOR, *dict.fromkeys(["opacity", *quantity])])
        half_width, right = math.tan(view.fov / 2) * view.aspect, np.cross(view.forward, view.up)
        half_height = half_width * lattice.height / lattice.width
        cells = _SPLAT_CELLS, max(round(_SPLAT_CELLS * lattice.height / lattice.width), 1)
        corner = half_width, half_height
        self._plane = RayCells(np.stack([right, -view.up, view.forward]), (-half_width, -half_height), corner, cells)
        self._origin = mi.Point3f(*map(float, view.origin))
        axes = (view.forward, half_width * right, -half_height * view.up)
        self._axes = [mi.Vector3f(*map(float, v)) for v in axes]
        self._pixel = mi.Vector2f(2 / lattice.width, 2 / lattice.height)
        self._key, self._first = mi.UInt32(0), mi.UInt64(0)
        is_plain = layer.overlay is None
        self._table = mi.Float(0 if is_plain else copy_aligned(_tabulate_display(layer, scale)).ravel())
        low, rate, self._count = _divide_scale(layer, scale)
        self._steps = [mi.Float(low), mi.Float(rate)]
        # Literals would compile kernels for each view.
        self._numbers = [self._origin, self._axes, self._pixel, self._key, self._first, self._table, self._steps]
        dr.make_opaque(self._numbers)
        self._numbers.append(lattice.numbers)

    def render(self, observer: np.ndarray, is_view_kept: bool) -> np.ndarray:
        """Displayed colours (height, width, 3) uint8."""
        context, layer, lattice = self.context, self.layer, self.lattice
        eye = context.make_observer(observer, True) if context.observer_aovs else None
        cached = self._keep_view() if is_view_kept else None

        def list_inputs() -> list[Any]:
            if eye is not None:
                eye.prepare(context, self.scene.mitsuba, [], lattice.num_rays)
            return [*self._list_inputs(is_traced=cached is None), eye]

        kind = "frame", lattice, layer.title, layer.kind, self._count, is_view_kept
        run = context.nerg.recorder.run
        (packed,) = run(lambda: [self._paint(eye, cached)], kind, list_inputs, [*self._numbers, *(cached or [])])
        pixels = packed.numpy().view(np.uint8).reshape(lattice.height, lattice.width, 4)
        return np.ascontiguousarray(pixels[..., :3])

    def _list_inputs(self, is_traced: bool) -> list[Any]:
        num_rays, seen = self.lattice.num_rays, None
        if is_traced:
            seen = self.scene.geometry.seen_from(self._origin, num_rays, self._plane)
        return self.context.list_inputs(self.scene.mitsuba, [], num_rays, seen)

    def _keep_view(self) -> list[Any]:
        """Colour, opacity and surfaces of all pixels; those of the last frame if it has the same view."""
        import drjit as dr

        nerg = self.context.nerg
        whole = _Frame(self.scene, self.view, Layer(), Scale(), replace(self.lattice, pixels_per_ray=1))

        def trace() -> list[Any]:
            with dr.suspend_grad():
                camera, color = whole._trace()
                values = [*color, *camera.compute_channels(["opacity"]), *camera.surface]
                dr.eval(values)
                return values

        kind = "view", whole.lattice
        compute = lambda: nerg.recorder.run(trace, kind, lambda: whole._list_inputs(True), whole._numbers)
        ceiling = nerg.ceiling and nerg.ceiling.height
        return nerg.cache.get_or_compute_value("view", (self.view, ceiling, whole.lattice), compute)

    def _trace(self, surface: list[Any] | None = None) -> tuple[Any, list[Any]]:
        """The rays of the lattice, and their linear colour; ``surface``: that of all pixels, which replaces both."""
        import drjit as dr

        mi: Any = variant_types()
        num_rays, scene = self.lattice.num_rays, self.scene.mitsuba
        x, y = self.lattice.locate(dr.arange(mi.UInt32, num_rays))
        ahead, across, down = self._axes
        d = ahead + across * dr.fma(x + 0.5, self._pixel.x, -1) + down * dr.fma(y + 0.5, self._pixel.y, -1)
        ray = mi.RayDifferential3f(self._origin + dr.zeros(mi.Point3f, num_rays), dr.normalize(d))
        if surface is not None:
            width, height = self.lattice.numbers[:2]
            pixel = dr.minimum(y, height - 1) * width + dr.minimum(x, width - 1)
            surface = [dr.gather(type(v), v, pixel) for v in surface]
            return self.context.view_surface(scene, ray, surface), []
        sampler = make_sampler(1, self._key, self._first, num_rays)
        camera = self.context.trace(scene, [], sampler, ray, mi.Bool(True))
        return camera, (list(camera.compute_radiance(scene, sampler, None)[0]) * 3)[:3]

    def _paint(self, eye: Any, cached: list[Any] | None) -> Any:
        """Displayed colours of all pixels, as whole numbers. Arguments: observer, and result of `_keep_view`."""
        import drjit as dr

        mi: Any = variant_types()
        with dr.suspend_grad():
            camera, color = self._trace(None if cached is None else cached[4:])
            aovs = [name for name in self.context.aovs if cached is None or name != "opacity"]
            channels = dict(zip(self.context.channel_names(aovs), camera.make_pixel(eye).compute_channels(aovs)))
            # A single channel has a suffix, which the name of its overlay lacks.
            overlay = self.layer.overlay
            value = [v for n, v in channels.items() if overlay and overlay.name in (n, n.rpartition(".")[0])][:1]
            opacity = [channels["opacity.Y"]] if cached is None else cached[3:4]
            index = dr.arange(mi.UInt32, self.lattice.width * self.lattice.height)
            y = index // self.lattice.numbers[0]
            x = index - y * self.lattice.numbers[0]
            if self.lattice.pixels_per_ray > 1:
                dr.eval(color, opacity, value)
                value = self.lattice.interpolate(value, x, y, self.layer.kind != "categorical")
            if cached is None:
                color, opacity = (self.lattice.interpolate(v, x, y) for v in (color, opacity))
            else:
                color = cached[:3]
            shown = self._display(color, opacity[0], value, x + y)
            red, green, blue = (mi.UInt32(dr.fma(dr.clip(v, 0, 1), 255, 0.5)) for v in shown)
            return red | (green << 8) | (blue << 16)

    def _display(self, color: list[Any], opacity: Any, value: list[Any], diagonal: Any) -> list[Any]:
        """Displayed sRGB of linear colours, with the ``value`` of the layer, if it has one; ``diagonal``: column plus
        row of the pixels."""
        import drjit as dr

        mi: Any = variant_types()
        shown = [linear_to_srgb(_clip(c)) for c in color]
        if not value:
            return shown
        luminance = linear_to_srgb(sum(w * _clip(c) for w, c in zip(LUMINANCE.tolist(), color)))
        # NaN becomes 0.
        place = (dr.select(dr.isnan(value[0]), 0, value[0]) - self._steps[0]) * self._steps[1]
        if self.layer.kind == "categorical":
            place = dr.round(place)
            place -= self._count * dr.floor(place / self._count)
        row = mi.UInt32(dr.clip(place, 0, self._count - 1) + 0.5)
        a, b, c = (dr.gather(mi.Vector3f, self._table, 3 * row + k) for k in range(3))
        shown = [a[k] * shown[k] + b[k] * luminance + c[k] for k in range(3)]
        is_line = diagonal % PERIOD < WIDTH
        hatched = [dr.select(is_line, LINE, v + PALE_FRACTION * (PALE - v)) for v in shown]
        return [dr.select(opacity > 0.5, v, h) for v, h in zip(shown, hatched)]


def _clip(linear: Any) -> Any:
    """Values clipped to 0..1; NaN becomes 0."""
    import drjit as dr

    return dr.select(linear > 0, dr.minimum(linear, 1), 0)


def _divide_scale(layer: Layer, scale: Scale) -> tuple[float, float, int]:
    """Value of the first row of the table of a scale, rows per unit, and number of rows."""
    kind = layer.kind
    if kind == "categorical":
        return 0.0, 1.0, find_colormap(scale.colors, kind).N
    low, high = {"heat": (0.0, scale.high), "shade": (0.0, 1.0), "diverging": (-abs(scale.high), abs(scale.high))}.get(
        kind, (scale.low, scale.high)
    )
    return low, (_STEPS - 1) / max(high - low, 1e-30), _STEPS


@lru_cache(maxsize=16)
def _tabulate_display(layer: Layer, scale: Scale) -> np.ndarray:
    """Factors a, b and c (rows, 9) of the display ``a srgb(colour) + b srgb(luminance) + c`` for values of the scale.

    All displays of overlays have this form; the factors are read off their pictures of black, white, red and green.
    """
    assert layer.overlay is not None
    low, rate, count = _divide_scale(layer, scale)
    values = np.tile(low + np.arange(count) / rate, (4, 1))
    color = np.repeat(np.array([[0.0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 0]])[:, None], count, axis=1)
    inputs = OverlayLayers(color, values, np.ones((4, count), bool))
    black, white, red, green = layer.overlay.paint(inputs, (scale.low, scale.high), Style(cmap=scale.colors))
    of_red, of_green = srgb(LUMINANCE[:2])
    b = np.stack([(green - black)[:, 0] / of_green, *((red - black)[:, k] / of_red for k in (1, 2))], axis=1)
    return np.concatenate([white - black - b, b, black], axis=1).astype(np.float32)
