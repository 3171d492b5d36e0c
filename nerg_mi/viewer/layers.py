"""The layers that the viewer displays: colour and AOVs, with their ranges and colour maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np

from nerg_mi.environment.scene import COLOR, Scene
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import (
    Overlay,
    OverlayLayers,
    Style,
    find_overlay,
    list_overlays,
    map_colors,
    srgb,
    to_bytes,
)
from nerg_mi.figures.style import CATEGORICAL, DIVERGING, SEQUENTIAL, find_colormap, hatch
from nerg_mi.transport.aovs import AOVS

COLORMAPS = {"sequential": SEQUENTIAL, "diverging": DIVERGING, "categorical": CATEGORICAL}
"""Color maps to choose from, by the kind of data that they suit."""


@dataclass(frozen=True)
class Layer:
    """A layer: the colour of the scene, with an overlay of an AOV or without.

    Parameters
    ----------
    overlay : Overlay or None
        The AOV channel to draw over the colour. None: colour alone.
    """

    overlay: Overlay | None = None

    @property
    def title(self) -> str:
        """The name shown in the panel."""
        heading = "colour" if self.overlay is None else self.overlay.quantity.heading
        return heading[0].lower() + heading[1:]

    @property
    def quantity(self) -> str:
        """The name of the AOV that the layer displays; "" for colour alone."""
        return "" if self.overlay is None else self.overlay.quantity.name

    @property
    def kind(self) -> str:
        """How the layer is drawn: "color", or the kind of the AOV's display."""
        return "color" if self.overlay is None else self.overlay.display.kind

    @property
    def depends_on_observer(self) -> bool:
        """Whether the values depend on the observer."""
        return self.overlay is not None and AOVS[self.quantity].is_per_observer

    @property
    def can_keep_view(self) -> bool:
        """Whether another observer changes nothing but the values on the surfaces of the view. Numbers of evaluations
        are those of the view, too."""
        return self.depends_on_observer and "counts" not in AOVS[self.quantity].required_data

    def select_values(self, by_quantity: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """Select the values of this layer.

        Parameters
        ----------
        by_quantity : mapping of str to ndarray
            Values of each AOV, of shape (...), or (..., channels) for an AOV of several channels.

        Returns
        -------
        ndarray or None
            Values of shape (...); None if ``by_quantity`` does not contain the AOV.
        """
        values = by_quantity.get(self.quantity)
        if values is None or self.overlay is None or self.overlay.name == self.quantity:
            return values
        channel = self.overlay.name.partition(".")[2]
        channels = AOVS[self.quantity].channels
        return values[..., int(channel) if channels is None else channels.index(channel)]


@dataclass(frozen=True)
class DisplaySettings:
    """How a layer is displayed.

    Parameters
    ----------
    layer : Layer
        The layer.
    colors : str or None
        Name of the colour map. None: the default of the layer.
    limits : tuple of float or None
        Ends (low, high) of the colour scale, in the unit of the layer. None: set automatically from the displayed
        values.
    """

    layer: Layer
    colors: str | None = None
    limits: tuple[float, float] | None = None


def get_layer(name: str) -> Layer:
    """Return the layer of an AOV or of one of its channels (``name``), or of colour alone ("color")."""
    return Layer(None if name == COLOR else find_overlay(name))


def list_layers(scene: Scene) -> list[Layer]:
    """List the layers that ``scene`` can display: colour, and each AOV that varies in it."""
    layers = [Layer()]
    for aov in AOVS.values():
        try:
            scene.integrator.make_context([aov.name], False)
        except NergError:
            # The integrator cannot compute this AOV.
            continue
        if not aov.is_constant(scene.integrator):
            layers += [Layer(overlay) for overlay in list_overlays(aov, aov.channel_suffixes(scene.integrator.medium))]
    return layers


def required_quantities(layer: Layer) -> list[str]:
    """List the quantities that a picture needs to display ``layer``."""
    return list(dict.fromkeys([COLOR, "depth", "opacity", *([layer.quantity] if layer.quantity else [])]))


def colormap_kind(layer: Layer) -> str:
    """Return the kind of the colour maps that suit ``layer``, one of the keys of `COLORMAPS`."""
    return "sequential" if layer.overlay is None else layer.overlay.colormap_kind


def choose_scale(layer: Layer, limits: tuple[float, float] | None, colors: str | None) -> Scale:
    """Return the colour scale of ``layer``.

    ``limits`` and ``colors`` are the selected ends and colour map; None means the default of the layer.
    """
    overlay = layer.overlay
    if overlay is None:
        return Scale()
    low, high = limits or overlay.display.limits or (0.0, 1.0)
    # The selected colour map may belong to a previous layer of another kind.
    colormap = colors if colors is not None and colors in COLORMAPS[overlay.colormap_kind] else overlay.default_colormap
    return Scale(low, high, colormap, overlay.colormap_kind)


@dataclass(frozen=True)
class Scale:
    """A colour scale.

    Parameters
    ----------
    low, high : float
        Values at the ends of the scale, in the unit of the layer.
    colors : str
        Name of a colour map.
    kind : str
        The kind of the colour map, one of the keys of `COLORMAPS`.

    Raises
    ------
    NergError
        The colour map does not exist or is of another kind, or ``low`` is not a finite number below ``high``.
    """

    low: float = 0.0
    high: float = 1.0
    colors: str = "inferno"
    kind: str = "sequential"

    def __post_init__(self) -> None:
        find_colormap(self.colors, self.kind)
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise NergError(f"the lower end of a range must be below the upper end, got {self.low:g} to {self.high:g}")


def choose_range(layer: Layer, values: np.ndarray, mask: np.ndarray) -> tuple[float, float] | None:
    """Choose the ends (low, high) of the colour scale from ``values`` (...) where ``mask`` (...) is true.

    Returns None if there are no values.
    """
    if layer.overlay is None or not np.any(mask):
        return None
    return layer.overlay.limits_of(np.asarray(values), np.asarray(mask, bool))


def colorize(
    layer: Layer, color: np.ndarray, values: np.ndarray | None, mask: np.ndarray, scale: Scale, hatched: bool = True
) -> np.ndarray:
    """Compute the displayed colours of a layer.

    Parameters
    ----------
    layer : Layer
        The layer.
    color : ndarray of shape (..., 3)
        Linear RGB of the scene.
    values : ndarray of shape (...) or None
        Values of the layer; None displays the colour alone.
    mask : ndarray of shape (...), bool
        Where there is a surface.
    scale : Scale
        The colour scale.
    hatched : bool
        Whether to hatch the pixels of an image (h, w) without a surface.

    Returns
    -------
    ndarray of shape (..., 3), uint8
        Colours in sRGB.
    """
    shape = np.shape(mask)
    # Points are treated as an image of one row.
    rows = shape if len(shape) == 2 else (1, shape[0])
    color, mask = np.asarray(color).reshape(*rows, 3), np.asarray(mask, bool).reshape(rows)
    if layer.overlay is None or values is None:
        pixels = srgb(color)
    else:
        inputs = OverlayLayers(color, np.asarray(values).reshape(rows), mask)
        pixels = layer.overlay.paint(inputs, (scale.low, scale.high), Style(cmap=scale.colors))
    if hatched and len(shape) == 2 and layer.overlay is not None:
        pixels = hatch(pixels, ~mask)
    return to_bytes(pixels).reshape(*shape, 3)


def grey_out(colors: np.ndarray) -> np.ndarray:
    """Return ``colors`` (..., 3) uint8 as grey levels of low contrast, which mark outdated contents."""
    grey = 80 + 0.45 * (colors @ np.array([0.2126, 0.7152, 0.0722]))
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)


STALE_STYLE = "opacity:0.35;filter:grayscale(1)"
"""CSS that marks outdated contents."""


def format_note(text: str) -> str:
    """Format ``text`` as HTML in a small font."""
    return f"<div style='font-size:0.85em;padding:0 1em'>{escape(text)}</div>"


def format_legend(layer: Layer, scale: Scale, stale: str = "") -> str:
    """Format the colour scale as HTML; ``stale`` is the reason why it is outdated, "" if it is not."""
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
