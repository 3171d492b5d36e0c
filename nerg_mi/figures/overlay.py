"""Colour conversion, heat maps over images, and figures of AOVs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files import images
from nerg_mi.maths.color import encode_srgb
from nerg_mi.ranges import LOG_DECADES
from nerg_mi.transport.aovs import AOVS, Aov, Display, Quantity

from .settings import Style
from .style import SMALL, Sheet, apply_colormap, find_colormap, hatch

# ---- Colour conversion ----
#
# sRGB transfer function of IEC 61966-2-1 without tone mapping, so that equal radiance has equal bytes in every image.
# Values above white are clipped.

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance weights of linear sRGB (Rec. 709)."""


def srgb(linear) -> np.ndarray:
    """Convert linear values of any shape to sRGB values in 0..1 (float64); values are clipped, NaN becomes 0."""
    x = np.clip(np.nan_to_num(np.asarray(linear, np.float64), nan=0.0), 0.0, 1.0)
    return encode_srgb(x)


def to_bytes(display) -> np.ndarray:
    """Convert display values in 0..1 to uint8, rounded."""
    return (np.clip(display, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_png(path, display, text: dict[str, str] | None = None) -> None:
    """Write display values (h, w, 3) in 0..1 as an 8-bit PNG with tEXt chunks ``text``."""
    import mitsuba as mi

    images.write_png(path, mi.Bitmap(to_bytes(display)), text)


# ---- Heat maps ----
#
# Gaze density over a colour image, with a scale.
#
# Values are densities in 1/sr. Colours come from one of matplotlib's perceptually uniform maps. The opacity of the heat
# map increases with the value; the image below is dimmed and desaturated, so that objects remain recognisable and their
# colours are not mistaken for heat. Pixels without a surface are not coloured, and pixels without data can be hatched.

MAX_DECADES = float(LOG_DECADES.high)


@dataclass(frozen=True)
class Heat:
    """Appearance of a heat map. Raises NergError for invalid values.

    Parameters
    ----------
    vmax
        Value at the upper end of the scale, in 1/sr. The scale starts at 0.
    colormap
        One of `style.SEQUENTIAL`.
    opacity
        Opacity at the upper end.
    ramp
        Fraction of the scale over which the opacity rises from 0.
    background_brightness
        Brightness of the image below.
    background_desaturation
        Fraction of its colour that is removed.
    decades
        0 for a linear scale, otherwise the number of decades of a logarithmic one.
    """

    vmax: float
    colormap: str = "inferno"
    opacity: float = 0.9
    ramp: float = 0.35
    background_brightness: float = 0.8
    background_desaturation: float = 0.6
    decades: float = 0.0

    def __post_init__(self):
        if not (np.isfinite(self.vmax) and self.vmax > 0):
            raise NergError(
                f"the upper end of a heat map's scale must be positive, got {self.vmax}; set {parameter('vmax')} "
                "to a positive number, or use data that are not 0 everywhere"
            )
        if not 0 <= self.decades <= MAX_DECADES:
            raise NergError(f"a scale has 0 (linear) to {MAX_DECADES:.0f} decades, got {self.decades}")
        find_colormap(self.colormap)

    @property
    def vmin(self) -> float:
        """Value at the lower end of the scale."""
        return self.vmax * 10.0**-self.decades if self.decades else 0.0

    def normalize(self, values) -> np.ndarray:
        """Map values to positions on the scale, 0..1."""
        x = np.nan_to_num(np.asarray(values, np.float64)) / self.vmax
        if self.decades:
            x = 1.0 + np.log10(np.maximum(x, 10.0 ** -(MAX_DECADES + 1))) / self.decades
        return np.clip(x, 0.0, 1.0)

    def alpha(self, values) -> np.ndarray:
        """Return the opacity of the heat map, a smooth ramp from 0 to ``opacity``."""
        x = np.clip(self.normalize(values) / self.ramp, 0.0, 1.0)
        return self.opacity * x * x * (3.0 - 2.0 * x)


def robust_max(values, mask, percentile: float = 99.5) -> float:
    """Return a percentile of the pixels in ``mask``, as a robust end of a scale.

    Raises NergError if no pixel is positive.
    """
    masked = np.asarray(values)[np.asarray(mask, bool)]
    top = float(np.percentile(masked, percentile)) if masked.size else 0.0
    if top <= 0 and masked.size:
        top = float(masked.max())  # the percentile may exclude all pixels with attention
    if not top > 0:
        raise NergError(
            f"this image contains no gaze to derive a scale from; move the camera or set {parameter('vmax')}"
        )
    return top


def dim_background(color, heat: Heat) -> np.ndarray:
    """Return display values (h, w, 3) of the linear image ``color``, dimmed and desaturated."""
    shown = srgb(color)
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    return heat.background_brightness * (shown + heat.background_desaturation * (luminance - shown))


def overlay(color, values, heat: Heat, mask=None, unknown=None) -> np.ndarray:
    """Draw ``values`` (h, w) in 1/sr as a heat map over the linear image ``color`` (h, w, 3). Return display values in
    0..1.

    Parameters
    ----------
    color
        Linear image.
    values
        Gaze density.
    heat
        Appearance of the heat map.
    mask
        Pixels with a surface; others are not coloured.
    unknown
        Pixels without data, which are hatched.
    """
    alpha = heat.alpha(values)
    if mask is not None:
        alpha = np.where(mask, alpha, 0.0)
    if unknown is not None:
        alpha = np.where(unknown, 0.0, alpha)
    hot = apply_colormap(heat.colormap, heat.normalize(values))
    base = dim_background(color, heat)
    shown = base + alpha[..., None] * (hot - base)
    return shown if unknown is None else hatch(shown, unknown)


def color_strip(heat: Heat, steps: int = 256) -> np.ndarray:
    """Return the colours of the scale (``steps``, 3) from its lower to its upper end, over a middle grey."""
    share = np.linspace(0.0, 1.0, steps)
    values = heat.vmax * (10.0 ** (heat.decades * (share - 1.0)) if heat.decades else share)
    return overlay(np.full((1, steps, 3), 0.2), values[None], heat)[0]


# ---- Figures ----
#
# Figures of depth, gaze, visibility and differences, and the occlusion figure of the paper. Functions take images with
# rows from the top, draw in given matplotlib ``Axes`` or in a new figure, and return the axes; `style.save` writes
# their figure.

HIDDEN_TINT = np.array([0.16, 0.20, 0.42])
"""Tint (display sRGB) of surfaces that are hidden from the observer."""

GAZE_LABEL = AOVS["gaze"].scale_label
_STEPS = 256
_OBSERVER_LABEL = "observer"


def percentile_limits(values, mask) -> tuple[float, float]:
    """Return the 0.5 and 99.5 percentiles of ``values`` (h, w) in ``mask`` (h, w)."""
    values = np.asarray(values, np.float64)
    is_valid = np.asarray(mask, bool) & np.isfinite(values)
    low, high = (float(v) for v in np.percentile(values[is_valid], (0.5, 99.5))) if is_valid.any() else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def symmetric_limit(values) -> float:
    """Return the 99.5 percentile of the absolute ``values``, as the limit of a symmetric scale."""
    size = np.abs(values)
    return float((np.percentile(size, 99.5) if size.size else 0.0) or (size.max() if size.size else 0.0) or 1)


def depth_figure(
    depth,
    mask,
    title: str = "Depth",
    unit: str = "m",
    limits: tuple[float, float] | None = None,
    colormap: str = "viridis_r",
    axes: Any = None,
) -> Any:
    """Draw ``depth`` (h, w) in scene units with a colour bar; pixels outside ``mask`` are hatched. Return the axes.

    ``limits``: ends of the scale. Default: `percentile_limits`. ``axes``: axes to draw in. Default: a new figure.
    """
    return map_figure(depth, mask, title, f"{AOVS['depth'].label} [{unit}]", limits, colormap, axes=axes)


def map_figure(
    values,
    mask,
    title: str,
    label: str,
    limits: tuple[float, float] | None = None,
    colormap: str = "viridis",
    colormap_kind: str = "sequential",
    note: str = "",
    axes: Any = None,
) -> Any:
    """Draw ``values`` (h, w) with a colour map and a colour bar; pixels outside ``mask`` are hatched. Return the axes.

    ``limits``: ends of the scale. Default: `percentile_limits`. ``note``: note below the figure. ``axes``: axes to draw
    in. Default: a new figure.
    """
    values = np.asarray(values, np.float64)
    is_valid = np.asarray(mask, bool) & np.isfinite(values)
    color_limits = limits or percentile_limits(values, mask)
    shown = map_colors(np.where(is_valid, values, color_limits[0]), color_limits, colormap, colormap_kind)
    sheet = Sheet([_hatch_grey(shown, ~is_valid)], [title], scale=True, note=note, panels=axes)
    add_map_scale(sheet, color_limits, colormap, colormap_kind, label, values[is_valid], unknown=not is_valid.all())
    return sheet.panels[0]


def map_colors(values, limits: tuple[float, float], colormap: str, colormap_kind: str) -> np.ndarray:
    """Map ``values`` (...) between ``limits`` to display colours (..., 3); classes use the discrete colours of the
    map cyclically."""
    values = np.asarray(values, np.float64)
    if colormap_kind == "categorical":
        count = find_colormap(colormap, colormap_kind).N
        return apply_colormap(colormap, (np.round(values) % count + 0.5) / count, colormap_kind)
    return apply_colormap(colormap, (values - limits[0]) / (limits[1] - limits[0]), colormap_kind)


def add_map_scale(
    sheet: Sheet,
    limits: tuple[float, float],
    colormap: str,
    colormap_kind: str,
    label: str,
    values,
    unknown: bool = False,
) -> None:
    """Add the scale of `map_colors` to ``sheet``; ``values`` are the values it explains."""
    low, high = limits
    if colormap_kind == "categorical":
        classes = np.repeat(np.arange(round(low), round(high) + 1), _STEPS // 8)
        sheet.bar(map_colors(classes, limits, colormap, colormap_kind), low - 0.5, high + 0.5, label, unknown=unknown)
        return
    strip = apply_colormap(colormap, np.linspace(0, 1, _STEPS), colormap_kind)
    over = dict(above=bool(np.any(values > high)), below=bool(np.any(values < low)))
    sheet.bar(strip, low, high, label, unknown=unknown, **over)


def gaze_figure(
    color,
    gaze,
    mask,
    heat: Heat,
    title: str = "Gaze",
    label: str = GAZE_LABEL,
    marker=None,
    unknown=None,
    note: str = "",
    axes: Any = None,
) -> Any:
    """Draw ``gaze`` (h, w) in 1/sr over the linear image ``color`` (h, w, 3), with a labelled scale. Return the axes.

    ``marker``: pixel (x, y) of the observer; ``unknown`` (h, w) bool: pixels without data, which are hatched; ``note``:
    note below the figure; ``axes``: axes to draw in. Default: a new figure.
    """
    sheet = Sheet([overlay(color, gaze, heat, mask, unknown)], [title], scale=True, note=note, panels=axes)
    if marker is not None:
        mark_observer(sheet, 0, marker, heat.alpha(gaze) * np.asarray(mask, bool))
    add_scale(sheet, heat, label, [(gaze, mask)], unknown is not None and bool(np.any(unknown)))
    return sheet.panels[0]


def visibility_figure(color, visibility, mask, title: str = "Visible to the observer", axes: Any = None) -> Any:
    """Draw ``visibility`` (h, w): visible surfaces in colour, hidden ones in dark blue; pixels outside ``mask`` are
    hatched. Return the axes.

    ``axes``: axes to draw in. Default: a new figure.
    """
    layers = OverlayLayers(np.asarray(color), np.asarray(visibility), np.asarray(mask, bool))
    return find_overlay("visibility").draw(layers, None, Style(title=title), axes)


def shade_hidden(color, values) -> np.ndarray:
    """Blend the linear image ``color`` (h, w, 3) where ``values`` (h, w) are 1 with a dark blue one where they are
    0."""
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
    axes: Any = None,
) -> Any:
    """Draw ``first`` minus ``second``, (h, w) each, with a diverging colour map; invalid and masked pixels are hatched.
    Return the axes.

    ``limit``: end of the symmetric scale. Default: `symmetric_limit`. ``note``: note below the figure. ``axes``: axes
    to draw in. Default: a new figure.
    """
    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    is_valid = np.isfinite(difference) if mask is None else np.isfinite(difference) & np.asarray(mask, bool)
    limit = float(limit or symmetric_limit(difference[is_valid]))
    return map_figure(difference, is_valid, title, label, (-limit, limit), colormap, "diverging", note, axes)


def occlusion_figure(
    observer_view,
    without_occlusion,
    with_occlusion,
    heat: Heat,
    marker=None,
    hatch_empty: bool = False,
    note: str = "",
    axes: Any = None,
) -> np.ndarray:
    """Draw the occlusion figure of the paper: three images with one scale. Return their axes (3,).

    Parameters
    ----------
    observer_view, without_occlusion, with_occlusion
        Tuples of linear colour (h, w, 3), gaze in 1/sr (h, w) and mask (h, w): the observer's view, another camera
        without occlusion, and the same camera with occlusion.
    heat
        Appearance of the heat map.
    marker
        Pixel (x, y) of the observer in the images of the other camera.
    hatch_empty
        Whether pixels without a surface are hatched.
    note
        Note below the figure.
    axes
        Three axes to draw in. Default: a new figure.
    """
    parts = (observer_view, without_occlusion, with_occlusion)
    void = [~np.asarray(m, bool) if hatch_empty else None for _, _, m in parts]
    pictures = [overlay(c, g, heat, m, u) for (c, g, m), u in zip(parts, void)]
    titles = ["Observer's view", "Another camera, without occlusion", "Another camera, with occlusion"]
    sheet = Sheet(pictures, titles, scale=True, note=note, panels=axes)
    if marker is not None:
        for panel in (1, 2):
            _, gaze, mask = parts[panel]
            mark_observer(sheet, panel, marker, heat.alpha(gaze) * np.asarray(mask, bool))
    add_scale(sheet, heat, GAZE_LABEL, [(g, m) for _, g, m in parts], any(u is not None and u.any() for u in void))
    return np.array(sheet.panels)


def add_scale(sheet: Sheet, heat: Heat, label: str, values, unknown: bool = False) -> None:
    """Add the scale of ``heat`` to ``sheet``; ``values`` are pairs (values, mask) of all images it explains."""
    above = any(float(np.max(v, where=np.asarray(m, bool), initial=0.0)) > heat.vmax for v, m in values)
    sheet.bar(color_strip(heat), heat.vmin, heat.vmax, label, above=above, log=heat.decades > 0, unknown=unknown)


def mark_observer(sheet: Sheet, panel: int, at: tuple[float, float], heat: Any = None) -> None:
    """Mark the observer at the pixel ``at`` (x, y) of a panel.

    The label is placed on the side where it hides least of the ``heat`` (h, w), opacities; default: at the upper right.
    """
    axes, unit = sheet.panels[panel], sheet.unit
    dot = dict(markerfacecolor="#35c2ff", markeredgecolor="white", markeredgewidth=1.2 * unit)
    axes.plot(*at, marker="o", markersize=6 * unit, **dot)
    height, width = sheet.images[panel].get_array().shape[:2]
    # Extent of the label in pixels of the image.
    pixels = width / max(axes.bbox.width, 1e-9) * axes.get_figure(root=True).dpi / 72 * SMALL * unit
    size = np.array([0.7 * len(_OBSERVER_LABEL), 2.0]) * pixels
    sides = [(right, up) for up in (True, False) for right in (True, False)]

    def cost(side: tuple[bool, bool]) -> float:
        right, up = side
        x, y = (at[0] if right else at[0] - size[0]), (at[1] - size[1] if up else at[1])
        columns, rows = (np.clip([v, v + s], 0, n).astype(int) for v, s, n in zip((x, y), size, (width, height)))
        outside = 1 - np.ptp(columns) * np.ptp(rows) / max(size.prod(), 1.0)
        covered = np.zeros(1) if heat is None else np.asarray(heat)[slice(*rows), slice(*columns)]
        return 2 * max(outside, 0.0) + float(covered.mean() if covered.size else 0.0)

    right, up = min(sides, key=cost)
    axes.annotate(
        _OBSERVER_LABEL,
        at,
        ((6 if right else -6) * unit, (5 if up else -6) * unit),
        textcoords="offset points",
        ha="left" if right else "right",
        va="bottom" if up else "top",
        fontsize=SMALL * unit,
        color="white",
        bbox=dict(boxstyle="round,pad=0.15", facecolor="black", alpha=0.45, linewidth=0),
    )


def _hatch_grey(shown, unknown) -> np.ndarray:
    """Hatch ``shown`` (h, w, 3) over a middle grey where ``unknown`` (h, w) is true."""
    return hatch(np.where(np.asarray(unknown)[..., None], 0.5, shown), unknown) if np.any(unknown) else shown


# ---- Overlays of AOVs ----
#
# AOVs of the integrator `nerg`, drawn according to their table (`nerg_mi.transport.aovs`), and scales shared by several
# images. Values are (h, w) arrays.

Limits = tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class OverlayLayers:
    """An image and the values over it.

    ``color`` (h, w, 3), linear; ``values`` (h, w); ``mask`` (h, w) bool of pixels with a surface; ``marker``: pixel (x,
    y) of the observer, or None; whether there are training samples near the observer; and the number of samples and
    participants that support the gaze, as text.
    """

    color: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    marker: tuple[float, float] | None = None
    has_support: bool = True
    support_note: str = ""


DEFAULT_STYLE = Style()


_DEFAULT_COLORMAPS = {
    "sequential": "viridis",
    "heat": "inferno",
    "diverging": "RdBu_r",
    "categorical": "tab20",
    "shade": "viridis",
}


@dataclass(frozen=True)
class Overlay:
    """A ``quantity`` that is drawn over an image; ``name``: AOV, with its channel if it has several."""

    quantity: Quantity
    name: str

    @property
    def display(self) -> Display:
        """How the values are displayed."""
        return self.quantity.display

    @property
    def default_colormap(self) -> str:
        """Default colour map."""
        return self.display.cmap or _DEFAULT_COLORMAPS[self.display.kind]

    @property
    def colormap_kind(self) -> str:
        """Kind of colour map, see `style.find_colormap`."""
        return self.display.kind if self.display.kind in ("diverging", "categorical") else "sequential"

    @property
    def needs_limits(self) -> bool:
        """Whether the ends of the scale depend on the values."""
        return self.display.limits is None and self.display.kind != "categorical"

    @property
    def is_scaled_by_top(self) -> bool:
        """Whether the scale is defined by its upper end alone."""
        return self.display.kind in ("heat", "diverging")

    def check_style(self, style: Style) -> None:
        """Raise `NergError` for a colour map that does not exist, or does not suit the values."""
        if style.cmap is not None:
            find_colormap(style.cmap, self.colormap_kind)

    def limits(self, layers: OverlayLayers) -> Limits:
        """Return the lower and upper end of the colour scale of the image ``layers``, from its values on surfaces.

        None if the scale does not depend on the values (fixed ends, or categories), or if a heat map has no value above
        0.
        """
        return self.limits_of(layers.values, layers.mask)

    def limits_of(self, values, mask) -> Limits:
        """Return the ends of the colour scale for ``values`` (h, w) at the pixels in ``mask`` (h, w); None as for
        `limits`."""
        if not self.needs_limits:
            return None
        values, mask = np.nan_to_num(values), np.asarray(mask, bool)
        if self.display.kind == "heat":
            return (0.0, robust_max(values, mask)) if np.any(values[mask] > 0) else None
        if self.display.kind == "diverging":
            limit = symmetric_limit(values[mask])
            return -limit, limit
        return percentile_limits(values, mask)

    def paint(self, layers: OverlayLayers, limits: Limits, style: Style = DEFAULT_STYLE, unknown=None) -> np.ndarray:
        """Return display values (h, w, 3); pixels in ``unknown`` (h, w) are hatched."""
        kind, colors = self.display.kind, style.cmap or self.default_colormap
        if kind == "heat":
            return overlay(layers.color, layers.values, self.heat(limits, style), layers.mask, unknown)
        if kind == "shade":
            shown = shade_hidden(layers.color, np.nan_to_num(layers.values))
        else:
            shown = map_colors(
                np.nan_to_num(layers.values),
                self._color_limits(layers.values, layers.mask, limits),
                colors,
                self.colormap_kind,
            )
        return shown if unknown is None else _hatch_grey(shown, unknown)

    def draw(self, layers: OverlayLayers, limits: Limits, style: Style = DEFAULT_STYLE, axes: Any = None) -> Any:
        """Draw a figure on a scale with the given limits, in ``axes`` or in a new figure. Return the axes."""
        needs_support, label = self.quantity.needs_support, self.quantity.scale_label
        title = style.title or self.quantity.heading
        if self.display.kind == "heat":
            if style.title is None and needs_support and not layers.has_support:
                title = f"{title}: no samples near this observer"
            unknown = unknown_mask(layers, needs_support) if style.hatching else None
            heat = self.heat(limits, style)
            return gaze_figure(
                layers.color,
                layers.values,
                layers.mask,
                heat,
                title,
                label,
                layers.marker,
                unknown,
                layers.support_note,
                axes,
            )
        unknown = ~(np.asarray(layers.mask, bool) & np.isfinite(layers.values))
        picture = self.paint(layers, limits, style, unknown)
        sheet = Sheet([picture], [title], scale=True, note=layers.support_note, panels=axes)
        self.add_scale(sheet, [layers], limits, style, bool(unknown.any()))
        return sheet.panels[0]

    def add_scale(
        self,
        sheet: Sheet,
        all_layers: Sequence[OverlayLayers],
        limits: Limits,
        style: Style = DEFAULT_STYLE,
        unknown: bool = False,
    ) -> None:
        """Add the scale of several images to ``sheet``; ``unknown``: whether some pixels are hatched."""
        label = self.quantity.scale_label
        if self.display.kind == "heat":
            add_scale(
                sheet, self.heat(limits, style), label, [(layers.values, layers.mask) for layers in all_layers], unknown
            )
        elif self.display.kind == "shade":
            grey = np.linspace(0, 1, _STEPS)[:, None]
            sheet.bar(HIDDEN_TINT * 0.8 + grey * (0.85 - HIDDEN_TINT * 0.8), 0.0, 1.0, label, unknown=unknown)
        else:
            values = np.concatenate([layers.values[layers.mask & np.isfinite(layers.values)] for layers in all_layers])
            color_limits = self._color_limits(values, np.ones(values.shape, bool), limits)
            add_map_scale(
                sheet, color_limits, style.cmap or self.default_colormap, self.colormap_kind, label, values, unknown
            )

    def check_limits(self, limits: Limits) -> None:
        """Raise `NergError` if there are no values to derive a scale from."""
        if limits is None and self.needs_limits:
            raise NergError(
                f'"{self.name}" is 0 on all visible surfaces; move the camera or the observer, or give '
                f"{parameter('vmax')}"
            )

    def heat(self, limits: Limits, style: Style = DEFAULT_STYLE) -> Heat:
        """Return the appearance of a heat map with the given limits."""
        return Heat(
            1.0 if limits is None else limits[1], style.cmap or self.default_colormap, decades=style.log_decades
        )

    def _color_limits(self, values, mask, limits: Limits) -> tuple[float, float]:
        """Return the ends of a colour scale."""
        if self.display.kind == "categorical":
            classes = np.round(values[mask & np.isfinite(values)])
            return (float(classes.min()), float(classes.max())) if classes.size else (0.0, 0.0)
        if self.display.kind == "diverging" and limits is not None:
            return -abs(limits[1]), abs(limits[1])
        return limits or self.display.limits or percentile_limits(values, mask)


def unknown_mask(layers: OverlayLayers, needs_support: bool) -> np.ndarray:
    """Return the pixels without data (h, w): those without a surface, and all pixels of gaze without support."""
    void = ~np.asarray(layers.mask, bool)
    return void if layers.has_support or not needs_support else np.ones_like(void)


def list_overlays(aov: Aov, channels: Sequence[str] | None = None) -> list[Overlay]:
    """Return the overlays of an AOV: itself, or one for each of its ``channels``. None: the channels that every
    medium has."""
    if not aov.has_multiple_channels:
        return [Overlay(aov, aov.name)]
    return [_channel_overlay(aov, channel) for channel in channels or aov.channels or "0"]


def _channel_overlay(aov: Aov, channel: str) -> Overlay:
    label = aov.label or aov.name.replace("_", " ")
    return Overlay(replace(aov, title=f"{aov.heading} {channel}", label=f"{label} {channel}"), f"{aov.name}.{channel}")


def find_overlay(name: str) -> Overlay:
    """Return the overlay ``name``: an AOV or one of its channels, such as "position.Z". Raises `NergError` for an
    unknown name."""
    first, _, channel = name.partition(".")
    if first in AOVS:
        aov = AOVS[first]
        names = [overlay.name for overlay in list_overlays(aov)]
        if not aov.has_multiple_channels and channel in ("", aov.channels):
            return Overlay(aov, first)
        if name in names or (aov.channels is None and channel.isdecimal()):
            return _channel_overlay(aov, channel)
        raise NergError(f'"{name}" has several channels; choose {" or ".join(names)}')
    names_of_all = [overlay.name for aov in AOVS.values() for overlay in list_overlays(aov)]
    raise NergError(f'unknown overlay "{name}"; choose one of {", ".join(names_of_all)}')


def find_channel_overlay(name: str) -> Overlay:
    """Return the overlay of a channel ``name`` of a file. Channels that are not in the table, such as those of a
    nested integrator, are drawn as heat maps."""
    first = name.partition(".")[0]
    if first in AOVS:
        return find_overlay(name)
    return Overlay(Quantity(name=first, label=name, display=Display(kind="heat")), name)


def shared_limits(all_limits: Sequence[Limits], vmax: float | None) -> Limits:
    """Return one scale for several images from the limits of each; the upper end may be given."""
    explicit_limits = [limits for limits in all_limits if limits is not None]
    if vmax is not None:
        low = min((limits[0] for limits in explicit_limits), default=0.0)
        return min(low, 0.0) if low >= vmax else low, vmax
    return (
        (min(limits[0] for limits in explicit_limits), max(limits[1] for limits in explicit_limits))
        if explicit_limits
        else None
    )
