"""The page that pictures are shown on: panels of one size, pixel for pixel, with titles, a scale and a legend.

A pixel of a picture is a pixel of the page; one that is too small to carry a title is shown with each pixel as a square
of several. Text, bars and gaps grow with the pictures, so that they can be read when a large one is shown small.
"""

from __future__ import annotations

import functools
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from .hatching import swatch
from .saving import encode
from .scale import ticks_of

DPI = 100
INK, PAPER = "#1c1c1c", "#ffffff"
SMALL, TITLE = 8, 10
"""Sizes of text, in points, on a page of pictures of `USUAL` pixels."""

USUAL = 700.0
_LEAST = 150  # pixels: the room that a title and a scale need
_PER_POINT = DPI / 72
_HAIR = 1e-6
_WIDE = 0.62  # mean width of a letter, in sizes of the text
_BAR, _GAP, _EDGE, _TIP, _SIDE = 14, 12, 10, 9, 104


def new_page(width: float, height: float) -> Any:
    """An empty figure of matplotlib of so many pixels, which notebooks show by themselves; pyplot, and with it any
    window, stays out of it."""
    # Inches times dots an inch must not fall short of a whole pixel.
    size = (width + _HAIR) / DPI, (height + _HAIR) / DPI
    return _page_type()(figsize=size, dpi=DPI, facecolor=PAPER)


@functools.cache
def _page_type() -> Any:
    # Matplotlib is loaded when something is drawn, and not with every command.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Page(Figure):
        def __init__(self, **how: Any):
            super().__init__(**how)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            return encode(self, ".png")

    return Page


class Sheet:
    """Pictures (h, w, 3) of one size in rows of ``columns``, each with one of ``titles``.

    ``scale``: room for a bar on the right; ``axes``: room for ticks and labels of each panel; ``note``: a line below
    all of it. ``page``: the figure; ``panels``, ``images``: axes of each picture and what they show; ``unit``: by what
    text is larger than usual.
    """

    def __init__(
        self,
        pictures: Sequence[np.ndarray],
        titles: Sequence[str],
        scale: bool = False,
        axes: bool = False,
        columns: int | None = None,
        note: str = "",
    ):
        h, w = pictures[0].shape[:2]
        times = max(1, math.ceil(_LEAST / max(h, w)))
        h, w = h * times, w * times
        self.unit = unit = float(np.clip(math.sqrt(h * w) / USUAL, 1.0, 6.0))
        columns = min(columns or len(pictures), len(pictures))
        rows = -(-len(pictures) // columns)
        slot_w, slot_h = max(w, _LEAST), max(h, _LEAST if scale and rows == 1 else 1)
        wrapped = [wrap(title, slot_w, TITLE * unit) for title in titles]
        line = TITLE * unit * _PER_POINT * 1.25
        head = 9 * unit + line * max(text.count("\n") + 1 for text in wrapped)
        left, below = (54 * unit, 42 * unit) if axes else (_EDGE * unit, 0.0)
        foot, gap = _EDGE * unit, _GAP * unit
        self._side = _SIDE * unit if scale else 0.0
        self.width = even(left + columns * slot_w + (columns - 1) * (left if axes else gap) + self._side + foot)
        note = wrap(note, self.width - 2 * left, SMALL * unit) if note else ""
        foot += SMALL * unit * _PER_POINT * 1.25 * (note.count("\n") + 1) if note else 0.0
        self.height = even(rows * (head + slot_h + below) + foot)
        self.page = new_page(self.width, self.height)
        self.panels: list[Any] = []
        self.images: list[Any] = []
        step = slot_w + (left if axes else gap)
        for k, (picture, title) in enumerate(zip(pictures, wrapped)):
            row, column = divmod(k, columns)
            x = round(left + column * step + (slot_w - w) / 2)
            top = round(row * (head + slot_h + below) + head + (slot_h - h) / 2)
            panel = self._add(x, top, w, h)
            self.images.append(panel.imshow(np.clip(picture, 0, 1), interpolation="nearest"))
            panel.set_anchor("C")
            for spine in panel.spines.values():
                spine.set_visible(False)
            if not axes:
                panel.set_xticks([])
                panel.set_yticks([])
            panel.set_title(title, fontsize=TITLE * unit, color=INK, pad=4 * unit)
            self.panels.append(panel)
        if note:
            at = left / self.width, 0.6 * _EDGE * unit / self.height
            self.page.text(*at, note, fontsize=SMALL * unit, color=INK, va="bottom")
        whole = rows * (head + slot_h + below) - head - below
        self._bar_at = (round(left + columns * step - (left if axes else gap) + gap), round(head), round(whole))

    def _add(self, x: float, top: float, width: float, height: float) -> Any:
        """Axes at a place in pixels, from the page's upper left corner."""
        return self.page.add_axes(
            (x / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        )

    def bar(
        self,
        strip: Any,
        low: float,
        high: float,
        label: str,
        above: bool = False,
        below: bool = False,
        log: bool = False,
        unknown: bool = False,
    ) -> None:
        """The scale: ``strip`` (n, 3) display colours from ``low`` to ``high``, evenly in the value, or in its
        logarithm where ``log``; ``above``, ``below``: some values exceed it, which a tip at its end says; ``unknown``:
        a swatch below it explains the hatching."""
        unit, (x, top, height) = self.unit, self._bar_at
        strip = np.asarray(strip)
        if unknown:
            height -= round(24 * unit)
            self._no_data(x, top + height + round(8 * unit))
        tip = round(_TIP * unit)
        start, long = top + (tip if above else 0), height - tip * (above + below)
        axes = self._add(x, start, round(_BAR * unit), long)
        axes.imshow(strip[:, None], origin="lower", aspect="auto", extent=(0, 1, 0, 1), interpolation="bilinear")
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        places, names, factor = ticks_of(low, high, int(np.clip(long / (26 * unit), 3, 9)), log)
        axes.set_yticks(places, names)
        axes.tick_params(labelsize=SMALL * unit, colors=INK, length=2 * unit, width=0.6 * unit, pad=2 * unit)
        axes.set_ylabel(
            wrap(_scaled(label, factor), long, SMALL * unit), fontsize=SMALL * unit, color=INK, labelpad=4 * unit
        )
        for spine in axes.spines.values():
            spine.set_linewidth(0.6 * unit)
        for shown, end, base, color in ((above, 1 + tip / long, 1.0, strip[-1]), (below, -tip / long, 0.0, strip[0])):
            if shown:
                axes.fill(
                    [0, 0.5, 1], [base, end, base], color=color, edgecolor=INK, clip_on=False, linewidth=0.6 * unit
                )
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)

    def legend(self, text: str = "no data") -> None:
        """The swatch that explains the hatching, without a scale above it."""
        x, top, height = self._bar_at
        self._no_data(x, top + height - round(16 * self.unit), text)

    def _no_data(self, x: float, top: float, text: str = "no data") -> None:
        side = round(16 * self.unit)
        axes = self._add(x, top, side, side)
        axes.imshow(np.clip(swatch(side, side, max(round(self.unit), 1)), 0, 1), interpolation="nearest")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_linewidth(0.6 * self.unit)
        where = dict(xycoords="axes fraction", textcoords="offset points", va="center", annotation_clip=False)
        axes.annotate(text, (1, 0.5), (5 * self.unit, 0), fontsize=SMALL * self.unit, color=INK, **where)


def _scaled(label: str, factor: str) -> str:
    """``label`` with ``factor`` before its unit."""
    if not factor:
        return label
    return label.replace("[", f"[{factor} ", 1) if "[" in label else f"{label} [{factor}]"


def even(pixels: float) -> int:
    """Rounded up to an even number, as the sides of a video's frames have to be."""
    return 2 * math.ceil(round(pixels) / 2)


def wrap(text: str, width: float, size: float) -> str:
    """``text`` in lines that fit into ``width`` pixels at ``size`` points."""
    letters = max(int(width / (size * _PER_POINT * _WIDE)), 8)
    return "\n".join(textwrap.wrap(text, letters)) or text
