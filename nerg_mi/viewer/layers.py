"""Layers that the viewer shows."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from nerg_mi.api.scene import COLOR, Scene
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay, srgb, to_bytes, top_of
from nerg_mi.figures.style import SEQUENTIAL as MAPS
from nerg_mi.figures.style import hatch


@dataclass(frozen=True)
class Layer:
    """``title`` for people, the ``quantity`` of the integrator beside colour, or none, its ``unit``; ``kind``: "color",
    "heat" over the colour, "shade" (visible or hidden) or "map" (colours alone); ``of_observer``: whether it depends on
    the observer."""

    title: str
    quantity: str = ""
    unit: str = ""
    kind: str = "heat"
    of_observer: bool = True


@dataclass(frozen=True)
class Shade:
    """How a layer is coloured: ``layer``, ``colors`` (None: its usual ones), and a range (low, high) (None: that of
    what is seen)."""

    layer: Layer
    colors: str | None = None
    fixed: tuple[float, float] | None = None


LAYERS = {
    layer.title: layer
    for layer in (
        Layer("gaze", "gaze", "1/sr"),
        Layer("colour", kind="color", of_observer=False),
        Layer("depth", "depth", "units", "map", of_observer=False),
        Layer("visibility", "visibility", kind="shade"),
        Layer("spread of gaze", "gaze_std", "1/sr"),
        Layer("support", "support", "rays", "map"),
        Layer("tracked gaze (kde)", "kde", "1/sr"),
        Layer("what surfaces attract", "emit"),
        Layer("what the observer gives", "capture"),
    )
}
"""What there is to choose from; what a scene does not have is left out (`available`)."""


def available(scene: Scene) -> list[Layer]:
    """The layers that ``scene`` can show, without a factor that its gaze field lacks."""
    found, lacking = [], _lacking(scene)
    for layer in LAYERS.values():
        if layer.quantity and layer.quantity == lacking:
            continue
        try:
            if layer.quantity:
                scene.integrator.for_aovs([layer.quantity], False)
        except NergError:
            # That is how the integrator says what it lacks.
            continue
        found.append(layer)
    return found


def _lacking(scene: Scene) -> str:
    """The factor that the gaze field of ``scene`` has not, which the integrator takes as 1; "" where it has both."""
    gaze = scene.integrator.gaze
    variant = "" if gaze is None else gaze.field.config.variant
    return {"emit": "capture", "capture": "emit"}.get(variant, "")


def quantities(layer: Layer) -> list[str]:
    """What has to be computed to show ``layer``."""
    return list(dict.fromkeys([COLOR, "depth", "opacity", *([layer.quantity] if layer.quantity else [])]))


def usual_colors(layer: Layer) -> str:
    """The colour map of ``layer`` where nobody chose another."""
    return "viridis" if layer.kind == "map" else "inferno"


@dataclass(frozen=True)
class Scale:
    """Colours ``colors`` (one of `MAPS`) between ``low`` and ``high``."""

    low: float = 0.0
    high: float = 1.0
    colors: str = "inferno"

    def __post_init__(self) -> None:
        if self.colors not in MAPS:
            raise NergError(f'"{self.colors}" is no perceptually uniform colour map; choose one of {", ".join(MAPS)}')
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise NergError(f"a range goes from a number to a larger one, got {self.low:g} to {self.high:g}")


def automatic(layer: Layer, values: np.ndarray, mask: np.ndarray) -> tuple[float, float] | None:
    """A range for ``values`` where ``mask`` has a surface; None where there is nothing to take one from."""
    inside = np.asarray(values)[np.asarray(mask, bool)]
    if layer.kind == "map":
        if not inside.size:
            return None
        low, high = (float(v) for v in np.percentile(inside, [1, 99]))
        low = 0.0 if layer.quantity == "support" else low
        return (low, high) if high > low else (low, low + max(abs(low), 1.0) * 1e-3)
    return (0.0, top_of(values, mask)) if (inside > 0).any() else None


def colored(
    layer: Layer, color: np.ndarray, values: np.ndarray | None, mask: np.ndarray, scale: Scale, hatched: bool = True
) -> np.ndarray:
    """uint8 (..., 3) of what ``layer`` shows: linear ``color`` (..., 3), ``values`` (...) and ``mask`` (...), where
    there is a surface. Pixels (h, w) without one are hatched."""
    import matplotlib

    shape = np.shape(mask)
    # Points are a picture of one row.
    rows = shape if len(shape) == 2 else (1, shape[0])
    color, mask = np.asarray(color).reshape(*rows, 3), np.asarray(mask, bool).reshape(rows)
    values = None if values is None else np.asarray(values).reshape(rows)
    if layer.kind == "color" or values is None:
        shown = srgb(color)
    elif layer.kind == "heat":
        shown = overlay(color, values, Heat(scale.high, scale.colors), mask)
    elif layer.kind == "shade":
        seen = np.clip(np.nan_to_num(values), 0, 1)[..., None]
        shown = srgb(color) * (0.25 + 0.75 * seen) + (1 - seen) * np.array([0.02, 0.04, 0.22])
    else:
        share = np.clip((np.nan_to_num(values) - scale.low) / (scale.high - scale.low), 0, 1)
        shown = matplotlib.colormaps[scale.colors](share)[..., :3]
    if hatched and len(shape) == 2 and layer.kind != "color":
        shown = hatch(shown, ~mask)
    return to_bytes(shown).reshape(*shape, 3)


def greyed(colors: np.ndarray) -> np.ndarray:
    """uint8 ``colors`` (..., 3) as what is out of date is shown: in grey, and with little contrast."""
    grey = 80 + 0.45 * (colors @ np.array([0.2126, 0.7152, 0.0722]))
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)


STALE = "opacity:0.35;filter:grayscale(1)"
"""The style of what is out of date, in HTML."""


def note(text: str) -> str:
    """``text`` in small letters, as HTML."""
    return f"<div style='font-size:0.85em;padding:0 1em'>{escape(text)}</div>"


def legend(layer: Layer, scale: Scale, stale: str = "") -> str:
    """The scale as HTML; empty where there is none. ``stale``: why it is not that of what is shown; "": it is."""
    if stale:
        return f"<div style='{STALE}'>{legend(layer, scale)}</div>{note(stale)}"
    import matplotlib
    from matplotlib.colors import to_hex

    if layer.kind in ("color", "shade"):
        words = {"color": "", "shade": "dark blue: hidden from the observer"}[layer.kind]
        return note(words)
    name = scale.colors
    stops = ",".join(to_hex(matplotlib.colormaps[name](k / 8)) for k in range(9))
    ends = f"<span>{scale.low:.3g}</span><span>{layer.unit}</span><span>{scale.high:.3g}</span>"
    return (
        f"<div style='padding:0 1em;font-size:0.85em'><div style='height:10px;border-radius:3px;"
        f"background:linear-gradient(90deg,{stops})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ends}</div></div>"
    )
