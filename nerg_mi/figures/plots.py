"""Figures with scales and labels: depth, gaze, visibility, the gaze sphere and the paper's occlusion figure.

Each function takes arrays as the integrator gives them (rows from the top) and returns a matplotlib ``Figure`` in which
a pixel of the render is a pixel of the figure; `save` writes it, byte for byte the same for the same input. pyplot, and
with it any window, stays out of it.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.files.png import write_figure

from .overlay import Heat, overlay, scale_strip
from .tonemap import LUMINANCE, srgb

DPI = 100
INK, PAPER = "#1c1c1c", "#ffffff"
HIDDEN = np.array([0.16, 0.20, 0.42])
"""Tint (display sRGB) of what the observer cannot see."""
_BAR, _GAP, _LABELS, _HEAD, _FOOT = 14, 10, 66, 26, 10  # pixels


def save(figure, path, text: dict[str, str] | None = None) -> None:
    """Write a figure as PNG. ``text``: what its header says; no time, no program version, so equal figures are equal
    files."""
    write_figure(
        path,
        figure,
        dpi=DPI,
        facecolor=PAPER,
        metadata={"Software": None, **(text or {})},
        pil_kwargs={"optimize": True},
    )


def depth_limits(depth, mask) -> tuple[float, float]:
    """The ends of a scale for ``depth`` (h, w) where ``mask`` (h, w) is true, but for the outermost half percents."""
    depth = np.asarray(depth, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(depth)
    low, high = (float(v) for v in np.percentile(depth[some], (0.5, 99.5))) if some.any() else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def depth_figure(depth, mask, title: str = "Depth", unit: str = "m", limits: tuple[float, float] | None = None):
    """``depth`` (h, w) in scene units, with a colour bar; white where ``mask`` (h, w) says that nothing is met.
    ``limits``: ends of the scale, by default those of `depth_limits`."""
    import matplotlib

    depth = np.asarray(depth, np.float64)
    some = np.asarray(mask, bool) & np.isfinite(depth)
    low, high = limits or depth_limits(depth, mask)
    colors = matplotlib.colormaps["viridis_r"]
    shown = np.where(some[..., None], colors((depth - low) / (high - low))[..., :3], 1.0)
    figure = _Sheet([shown], [title], scale=True)
    figure.bar(colors(np.linspace(0, 1, 256))[:, :3], low, high, f"distance from the camera [{unit}]")
    return figure.figure


def gaze_figure(color, gaze, mask, heat: Heat, title: str = "Gaze", label: str = "gaze density [1/sr]", marker=None):
    """``gaze`` (h, w) in 1/sr over the linear picture ``color`` (h, w, 3), with its scale, which ``label`` explains.
    ``marker``: pixel (x, y) at which the observer stands."""
    sheet = _Sheet([overlay(color, gaze, heat, mask)], [title], scale=True)
    if marker is not None:
        _mark(sheet.panels[0], marker)
    sheet.bar(scale_strip(heat), 0.0, heat.top, label, above=_exceeds(heat, [gaze]))
    return sheet.figure


def visibility_figure(color, visibility, mask, title: str = "Visible to the observer"):
    """``visibility`` (h, w): 1 in the colours of the picture, 0 in a dark blue; white where ``mask`` is false."""
    v = np.clip(np.asarray(visibility, np.float64), 0, 1)[..., None]
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    hidden = HIDDEN * (0.35 + 0.9 * luminance)
    shown = np.where(np.asarray(mask, bool)[..., None], hidden + v * (srgb(color) - hidden), 1.0)
    sheet = _Sheet([shown], [title], scale=True)
    grey = np.linspace(0, 1, 256)[:, None]
    strip = HIDDEN * 0.8 + grey * (0.85 - HIDDEN * 0.8)
    sheet.bar(strip, 0.0, 1.0, "visibility (0 hidden, 1 visible)")
    return sheet.figure


def sphere_figure(color, gaze, mask, heat: Heat, title: str = "All that the observer could turn to"):
    """The observer's sphere as latitude and longitude, in degrees: pictures (h, w, ...) of a `panorama` sensor.

    Azimuth 0 is the sensor's front, positive to the right; elevation 0 the horizon. The first and last row of a
    panorama lie at the poles, so that the picture reaches half a row beyond 90 degrees.
    """
    shown = overlay(color, gaze, heat, mask)
    sheet = _Sheet([shown], [title], scale=True, axes=True)
    axes = sheet.panels[0]
    beyond = 90.0 / max(shown.shape[0] - 1, 1)
    sheet.images[0].set_extent((-180, 180, -90 - beyond, 90 + beyond))
    axes.set_aspect("auto")
    axes.set_xticks(range(-180, 181, 45 if shown.shape[1] >= 200 else 90))
    axes.set_yticks(range(-90, 91, 45))
    axes.tick_params(labelsize=7, colors=INK, length=2, pad=2)
    axes.grid(color="white", alpha=0.25, linewidth=0.5)
    axes.set_xlabel("azimuth [degrees, to the right of the front]", fontsize=7, color=INK, labelpad=1)
    axes.set_ylabel("elevation [degrees]", fontsize=7, color=INK, labelpad=0)
    sheet.bar(scale_strip(heat), 0.0, heat.top, "gaze density [1/sr]", above=_exceeds(heat, [gaze]))
    return sheet.figure


def occlusion_figure(own, moved_without, moved_with, heat: Heat, marker=None):
    """The paper's occlusion figure: three pictures with one scale.

    ``own``, ``moved_without``, ``moved_with``: tuples (color (h, w, 3) linear, gaze (h, w) in 1/sr, mask (h, w)): what
    the observer sees; a camera behind a shelf, gaze without occlusion; the same with it. ``marker``: pixel (x, y) at
    which the observer stands in the two pictures of the moved camera.
    """
    pictures = [overlay(c, g, heat, m) for c, g, m in (own, moved_without, moved_with)]
    titles = ["The observer's own view", "From behind a shelf, without occlusion", "The same with occlusion"]
    sheet = _Sheet(pictures, titles, scale=True)
    if marker is not None:
        for axes in sheet.panels[1:]:
            _mark(axes, marker)
    above = _exceeds(heat, [gaze for _, gaze, _ in (own, moved_without, moved_with)])
    sheet.bar(scale_strip(heat), 0.0, heat.top, "gaze density [1/sr]", above=above)
    return sheet.figure


def _mark(axes, marker) -> None:
    """Show in a picture where the observer stands."""
    axes.plot(
        *marker, marker="o", markersize=6, markerfacecolor="#35c2ff", markeredgecolor="white", markeredgewidth=1.2
    )
    axes.annotate("observer", marker, xytext=(6, 5), textcoords="offset points", fontsize=7, color="white")


def _exceeds(heat: Heat, values) -> bool:
    return any(float(np.max(v)) > heat.top for v in values)


class _Sheet:
    """Pictures of one size side by side, pixel for pixel, each with a title, and room for a scale on the right."""

    def __init__(self, pictures, titles, scale: bool = False, axes: bool = False):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        h, w = pictures[0].shape[:2]
        left, foot = (44, 32) if axes else (_FOOT, _FOOT)
        self.height = h + _HEAD + foot
        self.width = left + len(pictures) * (w + _GAP) + (_BAR + _LABELS if scale else 0)
        self.figure = Figure(figsize=(self.width / DPI, self.height / DPI), dpi=DPI)
        FigureCanvasAgg(self.figure)
        self.panels, self.images = [], []
        for k, (picture, title) in enumerate(zip(pictures, titles)):
            x = left + k * (w + _GAP)
            panel = self.figure.add_axes((x / self.width, foot / self.height, w / self.width, h / self.height))
            self.images.append(panel.imshow(np.clip(picture, 0, 1), interpolation="nearest"))
            for spine in panel.spines.values():
                spine.set_visible(False)
            if not axes:
                panel.set_xticks([])
                panel.set_yticks([])
            panel.set_title(title, fontsize=9, color=INK, pad=5)
            self.panels.append(panel)
        self._bar_at = (left + len(pictures) * (w + _GAP), foot, h)

    def bar(self, strip, low: float, high: float, label: str, above: bool = False) -> None:
        """The scale: ``strip`` (n, 3) display colours from ``low`` to ``high``; ``above``: some values exceed it."""
        x, y, h = self._bar_at
        axes = self.figure.add_axes((x / self.width, y / self.height, _BAR / self.width, h / self.height))
        axes.imshow(
            np.asarray(strip)[:, None],
            origin="lower",
            aspect="auto",
            extent=(0, 1, low, high),
            interpolation="bilinear",
        )
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        axes.tick_params(labelsize=7, colors=INK, length=2, pad=2)
        axes.set_ylabel(label + (", brighter ones clipped" if above else ""), fontsize=7, color=INK, labelpad=3)
        for spine in axes.spines.values():
            spine.set_linewidth(0.5)
