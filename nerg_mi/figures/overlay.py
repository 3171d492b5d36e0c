"""Gaze over a picture, plots, and the overlays that commands draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files import images
from nerg_mi.maths.color import encode_srgb
from nerg_mi.ranges import LOG_DECADES
from nerg_mi.transport.aovs import AOVS, Aov, Display, Quantity

from .style import SMALL, Sheet, apply_colormap, find_colormap, hatch

# ---- From linear radiance to the bytes of a picture ----
#
# The sRGB transfer function of IEC 61966-2-1; nothing is scaled or compressed, so that equal radiance has equal bytes
# in every picture. What is brighter than white is clipped.

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear sRGB for the luminance (Rec. 709)."""


def srgb(linear) -> np.ndarray:
    """sRGB values in 0..1 (float64) of linear ones of any shape; clipped to 0..1, NaN becomes 0."""
    x = np.clip(np.nan_to_num(np.asarray(linear, np.float64), nan=0.0), 0.0, 1.0)
    return encode_srgb(x)


def to_bytes(display) -> np.ndarray:
    """Display values in 0..1 as uint8, rounded to the nearest."""
    return (np.clip(display, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_png(path, display, text: dict[str, str] | None = None) -> None:
    """Write display values (h, w, 3) in 0..1 as an 8-bit PNG. ``text``: what its header says (tEXt chunks)."""
    import mitsuba as mi

    images.write_png(path, mi.Bitmap(to_bytes(display)), text)


# ---- Overlay ----
#
# Attention over colour: a heat map that stays readable on a picture, with a scale that can be read off.
#
# Values are densities in 1/sr. Colours come from one of matplotlib's perceptually uniform maps; the heat grows more
# opaque with the value, over a picture that is dimmed and greyed, so that goods stay recognisable and their colours are
# not mistaken for heat. Where there is no surface nothing is coloured, and what is not known can be hatched.

MOST_DECADES = float(LOG_DECADES.high)


@dataclass(frozen=True)
class Heat:
    """How values become colour.

    ``top``: the value, in 1/sr, at the upper end of the scale, which starts at 0; ``colors``: one of
    `style.SEQUENTIAL`; ``opacity``: of the hottest pixel; ``ramp``: share of the scale over which opacity rises from
    0; ``dim``: brightness of the picture below; ``grey``: how much of its colour is taken away. ``decades``: 0 for a
    linear scale, else a logarithmic one that starts so many powers of ten below ``top``. Raises NergError for what
    cannot be shown.
    """

    vmax: float
    colormap: str = "inferno"
    opacity: float = 0.9
    ramp: float = 0.35
    background_brightness: float = 0.8
    grey: float = 0.6
    decades: float = 0.0

    def __post_init__(self):
        if not (np.isfinite(self.vmax) and self.vmax > 0):
            raise NergError(f"the top of a heat map's scale must be positive, got {self.vmax}: give it a range")
        if not 0 <= self.decades <= MOST_DECADES:
            raise NergError(f"a scale has 0 (linear) to {MOST_DECADES:.0f} decades, and {self.decades} were asked for")
        find_colormap(self.colormap)

    @property
    def vmin(self) -> float:
        """The value at the lower end of the scale."""
        return self.vmax * 10.0**-self.decades if self.decades else 0.0

    def normalize(self, values) -> np.ndarray:
        """Place on the scale, 0..1."""
        x = np.nan_to_num(np.asarray(values, np.float64)) / self.vmax
        if self.decades:
            x = 1.0 + np.log10(np.maximum(x, 10.0 ** -(MOST_DECADES + 1))) / self.decades
        return np.clip(x, 0.0, 1.0)

    def alpha(self, values) -> np.ndarray:
        """Opacity of the heat, 0..``opacity``: a smooth rise over ``ramp``."""
        x = np.clip(self.normalize(values) / self.ramp, 0.0, 1.0)
        return self.opacity * x * x * (3.0 - 2.0 * x)


def robust_max(values, mask, percentile: float = 99.5) -> float:
    """The value that ``percentile`` percent of the pixels in ``mask`` (bool, like ``values``) stay below.

    A robust end for a scale: a few grazing pixels do not darken all others. Raises NergError where nothing is positive.
    """
    inside = np.asarray(values)[np.asarray(mask, bool)]
    top = float(np.percentile(inside, percentile)) if inside.size else 0.0
    if top <= 0 and inside.size:
        top = float(inside.max())  # all attention may lie on fewer pixels than the percentile leaves out
    if not top > 0:
        raise NergError("there is no gaze in this picture to take a scale from: move the camera, or give a range")
    return top


def underlay(color, heat: Heat) -> np.ndarray:
    """Display values (h, w, 3) of the linear picture ``color`` (h, w, 3), dimmed and greyed as ``heat`` says."""
    shown = srgb(color)
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    return heat.background_brightness * (shown + heat.grey * (luminance - shown))


def overlay(color, values, heat: Heat, mask=None, unknown=None) -> np.ndarray:
    """Display values (h, w, 3) in 0..1: ``values`` (h, w) in 1/sr as heat over the linear picture ``color`` (h, w, 3).

    ``mask`` (h, w) bool: where there is a surface; the heat stays away from the rest. ``unknown`` (h, w) bool: where
    nothing is known, which is hatched in place of heat.
    """
    alpha = heat.alpha(values)
    if mask is not None:
        alpha = np.where(mask, alpha, 0.0)
    if unknown is not None:
        alpha = np.where(unknown, 0.0, alpha)
    hot = apply_colormap(heat.colormap, heat.normalize(values))
    base = underlay(color, heat)
    shown = base + alpha[..., None] * (hot - base)
    return shown if unknown is None else hatch(shown, unknown)


def scale_strip(heat: Heat, steps: int = 256) -> np.ndarray:
    """The colours of the scale (``steps``, 3) from its lower end to ``heat.top``, as they look over a surface of middle
    grey; steps are even on the scale, be it linear or logarithmic."""
    share = np.linspace(0.0, 1.0, steps)
    values = heat.vmax * (10.0 ** (heat.decades * (share - 1.0)) if heat.decades else share)
    return overlay(np.full((1, steps, 3), 0.2), values[None], heat)[0]


# ---- Plots ----
#
# Figures with scales and labels: depth, gaze, visibility, differences and the paper's occlusion figure.
#
# Each function takes arrays as the integrator gives them (rows from the top) and returns a matplotlib ``Figure``, see
# `sheet`; `style.save` writes it.

HIDDEN_TINT = np.array([0.16, 0.20, 0.42])
"""Tint (display sRGB) of what the observer cannot see."""

GAZE_LABEL = AOVS["gaze"].scale_label
_STEPS = 256


def percentile_limits(values, mask) -> tuple[float, float]:
    """The ends of a scale for ``values`` (h, w) where ``mask`` (h, w) is true, but for the outermost half percents."""
    values = np.asarray(values, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(values)
    low, high = (float(v) for v in np.percentile(values[some], (0.5, 99.5))) if some.any() else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def symmetric_limit(values) -> float:
    """The end of a scale to both sides of 0: that which 99.5 percent of ``values`` stay within."""
    size = np.abs(values)
    return float((np.percentile(size, 99.5) if size.size else 0.0) or (size.max() if size.size else 0.0) or 1)


def depth_figure(
    depth,
    mask,
    title: str = "Depth",
    unit: str = "m",
    limits: tuple[float, float] | None = None,
    colormap: str = "viridis_r",
):
    """``depth`` (h, w) in scene units, with a colour bar; hatched where ``mask`` (h, w) says that nothing is met.
    ``limits``: ends of the scale, by default those of `percentile_limits`."""
    return map_figure(depth, mask, title, f"{AOVS['depth'].label} [{unit}]", limits, colormap)


def map_figure(
    values,
    mask,
    title: str,
    label: str,
    limits: tuple[float, float] | None = None,
    colors: str = "viridis",
    kind: str = "sequential",
    note: str = "",
) -> Any:
    """``values`` (h, w) in ``colors`` of that ``kind`` alone, with a bar; hatched where ``mask`` (h, w) is false.
    ``limits``: ends of the scale, by default those of `percentile_limits`; ``note``: what they rest on."""
    values = np.asarray(values, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(values)
    ends = limits or percentile_limits(values, mask)
    shown = map_colors(np.where(some, values, ends[0]), ends, colors, kind)
    sheet = Sheet([_hatched(shown, ~some)], [title], scale=True, note=note)
    add_map_scale(sheet, ends, colors, kind, label, values[some], unknown=not some.all())
    return sheet.page


def map_colors(values, limits: tuple[float, float], colormap: str, kind: str) -> np.ndarray:
    """Display colours (..., 3) of ``values`` (...) between ``limits``; classes have each their own, as far as there
    are so many."""
    values = np.asarray(values, np.float64)
    if kind == "categorical":
        count = find_colormap(colormap, kind).N
        return apply_colormap(colormap, (np.round(values) % count + 0.5) / count, kind)
    return apply_colormap(colormap, (values - limits[0]) / (limits[1] - limits[0]), kind)


def add_map_scale(
    sheet: Sheet, limits: tuple[float, float], colors: str, kind: str, label: str, values, unknown: bool = False
) -> None:
    """The scale of `color_of` on a ``sheet``; ``values``: those that it explains."""
    low, high = limits
    if kind == "categorical":
        classes = np.repeat(np.arange(round(low), round(high) + 1), _STEPS // 8)
        sheet.bar(map_colors(classes, limits, colors, kind), low - 0.5, high + 0.5, label, unknown=unknown)
        return
    strip = apply_colormap(colors, np.linspace(0, 1, _STEPS), kind)
    over = dict(above=bool(np.any(values > high)), below=bool(np.any(values < low)))
    sheet.bar(strip, low, high, label, unknown=unknown, **over)


def gaze_figure(
    color, gaze, mask, heat: Heat, title: str = "Gaze", label: str = GAZE_LABEL, marker=None, unknown=None, note: str = ""
) -> Any:
    """``gaze`` (h, w) in 1/sr over the linear picture ``color`` (h, w, 3), with its scale, which ``label`` explains.
    ``marker``: pixel (x, y) at which the observer stands; ``unknown`` (h, w) bool: where it is hatched, since nothing
    is known there; ``note``: what it rests on."""
    sheet = Sheet([overlay(color, gaze, heat, mask, unknown)], [title], scale=True, note=note)
    if marker is not None:
        mark_observer(sheet, 0, marker)
    add_scale(sheet, heat, label, [(gaze, mask)], unknown is not None and bool(np.any(unknown)))
    return sheet.page


def visibility_figure(color, visibility, mask, title: str = "Visible to the observer"):
    """``visibility`` (h, w): 1 in the colours of the picture, 0 in a dark blue; hatched where ``mask`` is false."""
    of = OverlayLayers(np.asarray(color), np.asarray(visibility), np.asarray(mask, bool))
    return find_overlay("visibility").draw(of, None, Style(title=title))


def shaded(color, values) -> np.ndarray:
    """Display values (h, w, 3) of the linear picture ``color`` (h, w, 3) where ``values`` (h, w) are 1, and of a dark
    blue one where they are 0."""
    v = np.clip(np.asarray(values, np.float64), 0, 1)[..., None]
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    hidden = HIDDEN_TINT * (0.35 + 0.9 * luminance)
    return hidden + v * (srgb(color) - hidden)


def difference_figure(
    first,
    second,
    mask=None,
    title: str = "Difference",
    label: str = "difference",
    limit=None,
    colormap: str = "RdBu_r",
    note: str = "",
):
    """``first`` less ``second``, (h, w) each, in the colours of a diverging map whose middle is 0; hatched where
    ``mask`` (h, w) is false, or one of both is no number. ``limit``: both ends of the scale, by default that which 99.5
    percent of the pixels stay within; ``note``: what they rest on."""
    less = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    some = np.isfinite(less) if mask is None else np.isfinite(less) & np.asarray(mask, bool)
    limit = float(limit or symmetric_limit(less[some]))
    return map_figure(less, some, title, label, (-limit, limit), colormap, "diverging", note)


def occlusion_figure(observer_view, moved_without, moved_with, heat: Heat, marker=None, hatched: bool = False, note: str = ""):
    """The paper's occlusion figure: three pictures with one scale.

    ``own``, ``moved_without``, ``moved_with``: tuples (color (h, w, 3) linear, gaze (h, w) in 1/sr, mask (h, w)): what
    the observer sees; another camera, gaze without occlusion; the same with it. ``marker``: pixel (x, y) at which the
    observer stands in the two pictures of the other camera. ``hatched``: hatch where there is no surface;
    ``note``: what it rests on.
    """
    parts = (observer_view, moved_without, moved_with)
    void = [~np.asarray(m, bool) if hatched else None for _, _, m in parts]
    pictures = [overlay(c, g, heat, m, u) for (c, g, m), u in zip(parts, void)]
    titles = ["The observer's own view", "Another camera, without occlusion", "The same with occlusion"]
    sheet = Sheet(pictures, titles, scale=True, note=note)
    if marker is not None:
        for panel in (1, 2):
            mark_observer(sheet, panel, marker)
    add_scale(sheet, heat, GAZE_LABEL, [(g, m) for _, g, m in parts], any(u is not None and u.any() for u in void))
    return sheet.page


def add_scale(sheet: Sheet, heat: Heat, label: str, values, unknown: bool = False) -> None:
    """The scale of ``heat`` on a ``sheet``; ``values``: pairs (values, mask) of all pictures that it explains."""
    above = any(float(np.max(v, where=np.asarray(m, bool), initial=0.0)) > heat.vmax for v, m in values)
    sheet.bar(scale_strip(heat), heat.vmin, heat.vmax, label, above=above, log=heat.decades > 0, unknown=unknown)


def mark_observer(sheet: Sheet, panel: int, at: tuple[float, float]) -> None:
    """Show in a picture of ``sheet`` that the observer stands at the pixel ``at`` (x, y)."""
    axes, unit = sheet.panels[panel], sheet.unit
    dot = dict(markerfacecolor="#35c2ff", markeredgecolor="white", markeredgewidth=1.2 * unit)
    axes.plot(*at, marker="o", markersize=6 * unit, **dot)
    height, width = sheet.images[panel].get_array().shape[:2]
    # Towards the middle, so that it stays within the picture.
    left, low = at[0] > 0.6 * width, at[1] < 0.15 * height
    axes.annotate(
        "observer",
        at,
        ((-6 if left else 6) * unit, (-6 if low else 5) * unit),
        textcoords="offset points",
        ha="right" if left else "left",
        va="top" if low else "bottom",
        fontsize=SMALL * unit,
        color="white",
        bbox=dict(boxstyle="round,pad=0.15", facecolor="black", alpha=0.45, linewidth=0),
    )


def _hatched(shown, unknown) -> np.ndarray:
    """``shown`` (h, w, 3), hatched over a middle grey where ``unknown`` (h, w)."""
    return hatch(np.where(np.asarray(unknown)[..., None], 0.5, shown), unknown) if np.any(unknown) else shown


# ---- Overlays ----
#
# What can be laid over a picture: the AOVs of the integrator `nerg`, drawn as their table says
# (`nerg_mi.transport.aovs`), and which scale several pictures share. Values are (h, w) each.

Limits = tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class OverlayLayers:
    """A picture and what lies over it: linear ``color`` (h, w, 3), ``values`` (h, w), ``mask`` (h, w) bool where there
    is a surface; ``marker``: pixel (x, y) of the observer, or None; ``supported``: whether anything was recorded around
    the observer, so that their gaze is known; ``basis``: rays and people that it rests on, in words, "" where that is
    not known."""

    color: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    marker: tuple[float, float] | None = None
    has_support: bool = True
    support_note: str = ""


@dataclass(frozen=True)
class Style:
    """How an overlay is drawn: the ``colors`` of its scale (None: those usual for it), over how many ``decades`` that
    is logarithmic (0: linear), whether what is not known is hatched (``hatched``), and the ``title`` (None: the usual
    one)."""

    colormap: str | None = None
    decades: float = 0.0
    hatch_unknown: bool = True
    title: str | None = None


USUAL = Style()


_USUAL_COLORS = {
    "sequential": "viridis",
    "heat": "inferno",
    "diverging": "RdBu_r",
    "categorical": "tab20",
    "shade": "viridis",
}


@dataclass(frozen=True)
class Overlay:
    """How a ``quantity`` is laid over a picture; ``name``: that of the AOV, with its channel's where it has several."""

    quantity: Quantity
    name: str

    @property
    def display(self) -> Display:
        """How its values are shown."""
        return self.quantity.display

    @property
    def default_colormap(self) -> str:
        """The colour map where nobody chose another."""
        return self.display.cmap or _USUAL_COLORS[self.display.kind]

    @property
    def colormap_kind(self) -> str:
        """The kind of its colour maps, see `style.find_colors`."""
        return self.display.kind if self.display.kind in ("diverging", "categorical") else "sequential"

    @property
    def needs_limits(self) -> bool:
        """Whether the ends of its scale depend on what is seen."""
        return self.display.limits is None and self.display.kind != "categorical"

    @property
    def is_scaled_by_top(self) -> bool:
        """Whether its scale follows from the upper end alone."""
        return self.display.kind in ("heat", "diverging")

    def limits(self, layers: OverlayLayers) -> Limits:
        """The ends of the scale of one picture; None where it shows nothing of the quantity, or needs no scale."""
        return self.limits_of(layers.values, layers.mask)

    def limits_of(self, values, mask) -> Limits:
        """The same of ``values`` (h, w) where ``mask`` (h, w) is true."""
        if not self.needs_limits:
            return None
        values, mask = np.nan_to_num(values), np.asarray(mask, bool)
        if self.display.kind == "heat":
            return (0.0, robust_max(values, mask)) if np.any(values[mask] > 0) else None
        if self.display.kind == "diverging":
            limit = symmetric_limit(values[mask])
            return -limit, limit
        return percentile_limits(values, mask)

    def paint(self, layers: OverlayLayers, limits: Limits, style: Style = USUAL, unknown=None) -> np.ndarray:
        """Display values (h, w, 3) of ``of``, hatched where ``unknown`` (h, w) bool is true."""
        kind, colors = self.display.kind, style.colormap or self.default_colormap
        if kind == "heat":
            return overlay(layers.color, layers.values, self.heat(limits, style), layers.mask, unknown)
        if kind == "shade":
            shown = shaded(layers.color, np.nan_to_num(layers.values))
        else:
            shown = map_colors(np.nan_to_num(layers.values), self._ends(layers.values, layers.mask, limits), colors, self.colormap_kind)
        return shown if unknown is None else _hatched(shown, unknown)

    def draw(self, layers: OverlayLayers, limits: Limits, style: Style = USUAL) -> Any:
        """A figure of ``of`` on a scale with these ``limits``."""
        needs_support, label = self.quantity.needs_support, self.quantity.scale_label
        title = style.title or self.quantity.heading
        if self.display.kind == "heat":
            if style.title is None and needs_support and not layers.has_support:
                title = f"{title}: nobody recorded around here"
            unknown = unknown_mask(layers, needs_support) if style.hatch_unknown else None
            heat = self.heat(limits, style)
            return gaze_figure(layers.color, layers.values, layers.mask, heat, title, label, layers.marker, unknown, layers.support_note)
        unknown = ~(np.asarray(layers.mask, bool) & np.isfinite(layers.values))
        sheet = Sheet([self.paint(layers, limits, style, unknown)], [title], scale=True, note=layers.support_note)
        self.add_scale(sheet, [layers], limits, style, bool(unknown.any()))
        return sheet.page

    def add_scale(
        self, sheet: Sheet, each: Sequence[OverlayLayers], limits: Limits, style: Style = USUAL, unknown: bool = False
    ) -> None:
        """The scale of the pictures ``each`` on a ``sheet``; ``unknown``: whether some are hatched."""
        label = self.quantity.scale_label
        if self.display.kind == "heat":
            add_scale(sheet, self.heat(limits, style), label, [(of.values, of.mask) for of in each], unknown)
        elif self.display.kind == "shade":
            grey = np.linspace(0, 1, _STEPS)[:, None]
            sheet.bar(HIDDEN_TINT * 0.8 + grey * (0.85 - HIDDEN_TINT * 0.8), 0.0, 1.0, label, unknown=unknown)
        else:
            seen = np.concatenate([of.values[of.mask & np.isfinite(of.values)] for of in each])
            ends = self._ends(seen, np.ones(seen.shape, bool), limits)
            add_map_scale(sheet, ends, style.colormap or self.default_colormap, self.colormap_kind, label, seen, unknown)

    def check_limits(self, limits: Limits) -> None:
        """Raise `NergError` where there is nothing to take a scale from."""
        if limits is None and self.needs_limits:
            raise NergError(
                f'"{self.name}" is 0 wherever a surface is seen; move the camera or the observer, or give --top'
            )

    def heat(self, limits: Limits, style: Style = USUAL) -> Heat:
        """How its values become heat on a scale with these ``limits``."""
        return Heat(1.0 if limits is None else limits[1], style.colormap or self.default_colormap, decades=style.decades)

    def _ends(self, values, mask, limits: Limits) -> tuple[float, float]:
        """The ends of a scale of colours alone."""
        if self.display.kind == "categorical":
            seen = np.round(values[mask & np.isfinite(values)])
            return (float(seen.min()), float(seen.max())) if seen.size else (0.0, 0.0)
        if self.display.kind == "diverging" and limits is not None:
            return -abs(limits[1]), abs(limits[1])
        return limits or self.display.limits or percentile_limits(values, mask)


def unknown_mask(layers: OverlayLayers, of_gaze: bool) -> np.ndarray:
    """Where nothing is known (h, w), bool: where there is no surface, and everywhere for gaze without support."""
    void = ~np.asarray(layers.mask, bool)
    return void if layers.has_support or not of_gaze else np.ones_like(void)


def list_overlays(aov: Aov, channels: Sequence[str] | None = None) -> list[Overlay]:
    """What can be laid over a picture of an AOV: itself, or each of its ``channels``; None: those that every medium
    has."""
    if not aov.has_multiple_channels:
        return [Overlay(aov, aov.name)]
    return [_overlay_of_channel(aov, channel) for channel in channels or aov.channels or "0"]


def _overlay_of_channel(aov: Aov, channel: str) -> Overlay:
    words = aov.label or aov.name.replace("_", " ")
    return Overlay(replace(aov, title=f"{aov.heading} {channel}", label=f"{words} {channel}"), f"{aov.name}.{channel}")


def find_overlay(name: str) -> Overlay:
    """The overlay ``name``: an AOV, or a channel of one, such as "position.Z". Raises `NergError` for one that there is
    not."""
    first, _, channel = name.partition(".")
    if first in AOVS:
        aov = AOVS[first]
        names = [of.name for of in list_overlays(aov)]
        if not aov.has_multiple_channels and channel in ("", aov.channels):
            return Overlay(aov, first)
        if name in names or (aov.channels is None and channel.isdecimal()):
            return _overlay_of_channel(aov, channel)
        raise NergError(f'"{name}" is no single channel: lay {" or ".join(names)} over the picture')
    known = [of.name for aov in AOVS.values() for of in list_overlays(aov)]
    raise NergError(f'there is no overlay "{name}"; there are {", ".join(known)}')


def find_channel_overlay(name: str) -> Overlay:
    """The overlay of the channel ``name`` of a file: one of a nested integrator's, which no table knows, lies over the
    picture as a heat."""
    first = name.partition(".")[0]
    if first in AOVS:
        return find_overlay(name)
    return Overlay(Quantity(name=first, label=name, display=Display(kind="heat")), name)


def shared_limits(all_limits: Sequence[Limits], vmax: float | None) -> Limits:
    """Ends of one scale for all pictures, of the ends of ``each``, with the upper end ``top`` where one is given."""
    known = [limits for limits in all_limits if limits is not None]
    if vmax is not None:
        low = min((limits[0] for limits in known), default=0.0)
        return min(low, 0.0) if low >= vmax else low, vmax
    return (min(limits[0] for limits in known), max(limits[1] for limits in known)) if known else None
