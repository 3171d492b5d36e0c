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
from nerg_mi.transport.splat_lists import Window
from nerg_mi.transport.splat_medium import SplatMedium

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

_STEPS = 1024
"""Values of a scale whose display is tabulated."""


def render_frame(
    scene: Scene,
    view: PinholeView,
    observer: np.ndarray,
    layer: Layer,
    scale: Scale,
    width: int,
    pace: FramePace,
    *,
    ceiling: Ceiling | None = None,
    is_draft: bool = True,
    is_observer_at_rest: bool = False,
) -> tuple[StagePicture, np.ndarray]:
    """Render a picture of ``width`` pixels with one sample per pixel at once.

    Parameters
    ----------
    scene, view, observer, ceiling
        As for `refine`.
    layer, scale
        What is displayed.
    width : int
        Width in pixels.
    pace : FramePace
        Records the time of a draft.
    is_draft : bool
        Whether the view or the observer moves: the colour of a compiled field is evaluated at one or two positions per
        ray, and splats behind nearly opaque ones are left out.
    is_observer_at_rest : bool
        Whether a coarse map around the observer has the gaze of a draft. It is kept, and takes as long as a frame.

    Returns
    -------
    picture : StagePicture
        Without values.
    colors : ndarray of shape (height, width, 3), uint8
        Its colours.
    """
    start, integrator = time.perf_counter(), scene.integrator
    settings, observed, medium = integrator.settings, integrator.observer_settings, integrator.medium
    if is_draft and isinstance(medium, SplatMedium):
        settings = replace(settings, stop=max(settings.stop, _SPLAT_STOP))
    elif is_draft and medium is not None and medium.is_density_separate:
        settings = replace(settings, color_cutoff=max(settings.color_cutoff, _COLOR_CUTOFF))
    if is_draft and is_observer_at_rest and observed.visibility != "transmittance":
        observed = replace(observed, visibility="map", map_height=min(observed.map_height, _MAP_HEIGHT))
    with (
        override_attribute(scene, "observer_settings", observed),
        rough_integrals(scene),
        override_attribute(scene, "ceiling", ceiling),
        override_attribute(scene, "settings", settings),
    ):
        colors = _trace_colors(scene, view, observer, layer, scale, width)
    seconds = time.perf_counter() - start
    if is_draft:
        pace.record(seconds, colors.shape[0] * width)
    return StagePicture({}, 1, seconds, 1, False), colors


def _trace_colors(
    scene: Scene, view: PinholeView, observer: np.ndarray, layer: Layer, scale: Scale, width: int
) -> np.ndarray:
    """Displayed colours (height, width, 3) uint8 of the pixels of ``view``."""
    import drjit as dr

    mi: Any = variant_types()
    height, scene_mi, overlay = view.picture_height(width), scene.mitsuba, layer.overlay
    quantity = [layer.quantity] if layer.quantity else []
    context: Any = make_aov_context(scene, [COLOR, *dict.fromkeys(["opacity", *quantity])])
    eye = context.make_observer(observer, True) if context.observer_aovs else None
    half_width = math.tan(view.fov / 2) * view.aspect
    half_height, right = half_width * height / width, np.cross(view.forward, view.up)
    origin = mi.Point3f(*map(float, view.origin))
    axes = [mi.Vector3f(*map(float, v)) for v in (view.forward, half_width * right, -half_height * view.up)]
    columns, pixel = mi.UInt32(width), mi.Vector2f(2 / width, 2 / height)
    key, first = mi.UInt32(0), mi.UInt64(0)
    table = mi.Float(copy_aligned(_tabulate_display(layer, scale)).ravel()) if overlay is not None else mi.Float(0)
    # Literals would compile kernels for each view.
    dr.make_opaque(origin, axes, columns, pixel, key, first, table)
    low, rate, count = _divide_scale(layer, scale)
    steps = [mi.Float(low), mi.Float(rate)]
    dr.make_opaque(steps)

    def list_inputs() -> list[Any]:
        if eye is not None:
            eye.prepare(context, scene_mi, [], width * height)
        cells = _SPLAT_CELLS, max(round(_SPLAT_CELLS * height / width), 1)
        plane = Window(
            np.stack([right, -view.up, view.forward]), (-half_width, -half_height), (half_width, half_height), cells
        )
        seen = scene.geometry.seen_from(origin, width * height, (plane,))
        return [*context.list_inputs(scene_mi, [], width * height, seen), eye]

    def render() -> list[Any]:
        with dr.suspend_grad():
            index = dr.arange(mi.UInt32, width * height)
            y = index // columns
            x = index - y * columns
            ahead, across, down = axes
            d = ahead + across * dr.fma(x + 0.5, pixel.x, -1) + down * dr.fma(y + 0.5, pixel.y, -1)
            ray = mi.RayDifferential3f(origin + dr.zeros(mi.Point3f, width * height), dr.normalize(d))
            sampler = make_sampler(1, key, first, width * height)
            camera = context.trace(scene_mi, [], sampler, ray, mi.Bool(True))
            values = camera.make_pixel(eye).compute_channels(context.aovs)
            channels = dict(zip(context.channel_names(context.aovs), values))
            color = list(camera.compute_radiance(scene_mi, sampler, None)[0])
            shown = [linear_to_srgb(_clip(c)) for c in (color * 3)[:3]]
            if overlay is not None:
                # A single channel has a suffix, which the name of its overlay lacks.
                value = next(v for n, v in channels.items() if overlay.name in (n, n.rpartition(".")[0]))
                luminance = linear_to_srgb(sum(w * _clip(c) for w, c in zip(LUMINANCE.tolist(), (color * 3)[:3])))
                # NaN becomes 0.
                place = (dr.select(dr.isnan(value), 0, value) - steps[0]) * steps[1]
                if layer.kind == "categorical":
                    place -= count * dr.floor(place / count)
                row = mi.UInt32(dr.clip(place, 0, count - 1) + 0.5)
                a, b, c = (dr.gather(mi.Vector3f, table, 3 * row + k) for k in range(3))
                shown = [a[k] * shown[k] + b[k] * luminance + c[k] for k in range(3)]
                is_line = (x + y) % PERIOD < WIDTH
                hatched = [dr.select(is_line, LINE, v + PALE_FRACTION * (PALE - v)) for v in shown]
                has_surface = channels["opacity.Y"] > 0.5
                shown = [dr.select(has_surface, v, h) for v, h in zip(shown, hatched)]
            red, green, blue = (mi.UInt32(dr.fma(dr.clip(v, 0, 1), 255, 0.5)) for v in shown)
            return [red | (green << 8) | (blue << 16)]

    kind = "frame", width, height, layer.title, layer.kind
    numbers = [origin, axes, columns, pixel, key, first, table, steps]
    (packed,) = context.nerg.recorder.run(render, kind, list_inputs, numbers)
    return np.ascontiguousarray(packed.numpy().view(np.uint8).reshape(height, width, 4)[..., :3])


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
