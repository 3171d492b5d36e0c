"""Layers that the viewer shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np

from nerg_mi.api.scene import COLOR, Scene
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Overlay, OverlayLayers, Style, map_colors, find_overlay, list_overlays, srgb, to_bytes
from nerg_mi.figures.style import CATEGORICAL, DIVERGING, SEQUENTIAL, find_colormap, hatch
from nerg_mi.transport.aovs import AOVS

COLORMAPS = {"sequential": SEQUENTIAL, "diverging": DIVERGING, "categorical": CATEGORICAL}
"""Colour maps to choose from, by the kind of what is shown."""


@dataclass(frozen=True)
class Layer:
    """Colour, and the ``overlay`` on it, or none."""

    overlay: Overlay | None = None

    @property
    def title(self) -> str:
        """Its name for people."""
        heading = "colour" if self.overlay is None else self.overlay.quantity.heading
        return heading[0].lower() + heading[1:]

    @property
    def quantity(self) -> str:
        """The AOV that it shows, or ""."""
        return "" if self.overlay is None else self.overlay.quantity.name

    @property
    def kind(self) -> str:
        """How it is shown: "color", or as the AOV's display says."""
        return "color" if self.overlay is None else self.overlay.display.kind

    @property
    def depends_on_observer(self) -> bool:
        """Whether it depends on the observer."""
        return self.overlay is not None and AOVS[self.quantity].is_per_observer

    def select_values(self, by_quantity: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """Its values (...) among those of each quantity, (...) or, of several channels, (..., channels)."""
        values = by_quantity.get(self.quantity)
        if values is None or self.overlay is None or self.overlay.name == self.quantity:
            return values
        channel = self.overlay.name.partition(".")[2]
        channels = AOVS[self.quantity].channels
        return values[..., int(channel) if channels is None else channels.index(channel)]


@dataclass(frozen=True)
class DisplaySettings:
    """How a layer is coloured: ``layer``, ``colors`` (None: its usual ones), and a range (low, high) (None: that of
    what is seen)."""

    layer: Layer
    colors: str | None = None
    limits: tuple[float, float] | None = None


def get_layer(name: str) -> Layer:
    """The layer of the AOV, or the channel of one, ``name``; of colour alone for "color"."""
    return Layer(None if name == COLOR else find_overlay(name))


def list_layers(scene: Scene) -> list[Layer]:
    """The layers that ``scene`` can show: colour, and every AOV that varies in it."""
    layers = [Layer()]
    for aov in AOVS.values():
        try:
            scene.integrator.make_context([aov.name], False)
        except NergError:
            # That is how the integrator says what it lacks.
            continue
        if not aov.is_constant(scene.integrator):
            layers += [Layer(overlay) for overlay in list_overlays(aov, aov.channel_suffixes(scene.integrator.medium))]
    return layers


def required_quantities(layer: Layer) -> list[str]:
    """What has to be computed to show ``layer``."""
    return list(dict.fromkeys([COLOR, "depth", "opacity", *([layer.quantity] if layer.quantity else [])]))


def colormap_kind(layer: Layer) -> str:
    """The kind of the colour maps that ``layer`` may have."""
    return "sequential" if layer.overlay is None else layer.overlay.colormap_kind


def choose_scale(layer: Layer, limits: tuple[float, float] | None, colors: str | None) -> Scale:
    """The scale of ``layer``, where nobody chose ``limits`` or ``colors`` its usual one."""
    overlay = layer.overlay
    if overlay is None:
        return Scale()
    low, high = limits or overlay.display.limits or (0.0, 1.0)
    # What was chosen for a layer before may be a map of another kind.
    colormap = colors if colors is not None and colors in COLORMAPS[overlay.colormap_kind] else overlay.default_colormap
    return Scale(low, high, colormap, overlay.colormap_kind)


@dataclass(frozen=True)
class Scale:
    """Colours ``colors``, of that ``kind`` (`find_colors`), between ``low`` and ``high``."""

    low: float = 0.0
    high: float = 1.0
    colors: str = "inferno"
    kind: str = "sequential"

    def __post_init__(self) -> None:
        find_colormap(self.colors, self.kind)
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise NergError(f"a range goes from a number to a larger one, got {self.low:g} to {self.high:g}")


def choose_range(layer: Layer, values: np.ndarray, mask: np.ndarray) -> tuple[float, float] | None:
    """A range for ``values`` where ``mask`` has a surface; None where there is nothing to take one from."""
    if layer.overlay is None or not np.any(mask):
        return None
    return layer.overlay.limits_of(np.asarray(values), np.asarray(mask, bool))


def colorize(
    layer: Layer, color: np.ndarray, values: np.ndarray | None, mask: np.ndarray, scale: Scale, hatched: bool = True
) -> np.ndarray:
    """uint8 (..., 3) of what ``layer`` shows: linear ``color`` (..., 3), ``values`` (...) and ``mask`` (...), where
    there is a surface. Pixels (h, w) without one are hatched."""
    shape = np.shape(mask)
    # Points are a picture of one row.
    rows = shape if len(shape) == 2 else (1, shape[0])
    color, mask = np.asarray(color).reshape(*rows, 3), np.asarray(mask, bool).reshape(rows)
    if layer.overlay is None or values is None:
        pixels = srgb(color)
    else:
        inputs = OverlayLayers(color, np.asarray(values).reshape(rows), mask)
        pixels = layer.overlay.paint(inputs, (scale.low, scale.high), Style(scale.colors))
    if hatched and len(shape) == 2 and layer.overlay is not None:
        pixels = hatch(pixels, ~mask)
    return to_bytes(pixels).reshape(*shape, 3)


def grey_out(colors: np.ndarray) -> np.ndarray:
    """uint8 ``colors`` (..., 3) as what is out of date is shown: in grey, and with little contrast."""
    grey = 80 + 0.45 * (colors @ np.array([0.2126, 0.7152, 0.0722]))
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)


STALE_STYLE = "opacity:0.35;filter:grayscale(1)"
"""The style of what is out of date, in HTML."""


def format_note(text: str) -> str:
    """``text`` in small letters, as HTML."""
    return f"<div style='font-size:0.85em;padding:0 1em'>{escape(text)}</div>"


def format_legend(layer: Layer, scale: Scale, stale: str = "") -> str:
    """The scale as HTML; empty where there is none. ``stale``: why it is not that of what is shown; "": it is."""
    if stale:
        return f"<div style='{STALE_STYLE}'>{format_legend(layer, scale)}</div>{format_note(stale)}"
    from matplotlib.colors import to_hex

    overlay = layer.overlay
    if overlay is None:
        return format_note("")
    if overlay.display.kind in ("shade", "categorical"):
        return format_note(overlay.quantity.label)
    samples = np.linspace(scale.low, scale.high, 9)
    stops = ",".join(to_hex(c) for c in map_colors(samples, (scale.low, scale.high), scale.colors, scale.kind))
    unit = overlay.quantity.unit or overlay.quantity.label
    ends = f"<span>{scale.low:.3g}</span><span>{escape(unit)}</span><span>{scale.high:.3g}</span>"
    return (
        f"<div style='padding:0 1em;font-size:0.85em'><div style='height:10px;border-radius:3px;"
        f"background:linear-gradient(90deg,{stops})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ends}</div></div>"
    )
