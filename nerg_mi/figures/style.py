"""How figures look, and how they are written: colours, hatching, scales, tone mapping, sheets, provenance."""

from __future__ import annotations

import functools
import io
import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from nerg_mi import __version__
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_writable, file_sha256, write_bytes

# ---- Colors ----
#
# Colour maps by name: the one place where they are checked.
#
# All have a lightness that rises evenly, or rises evenly to both sides of a middle, so that equal steps of a value look
# equal, also to people who do not tell red from green, and on grey paper. Rainbows (``jet``) are left out: they show
# edges where the values have none.

SEQUENTIAL = ("inferno", "magma", "plasma", "viridis", "cividis")
"""For values from a least to a greatest one."""

DIVERGING = ("RdBu_r", "PuOr_r", "BrBG_r", "PRGn_r")
"""For differences, whose middle is 0."""

CATEGORICAL = ("tab20", "tab10")
"""For whole numbers that name classes."""

_COLORS = {
    "sequential": (SEQUENTIAL, "perceptually uniform"),
    "diverging": (DIVERGING, "diverging"),
    "categorical": (CATEGORICAL, "categorical"),
}


def find_colormap(name: str, kind: str = "sequential") -> Any:
    """The colour map ``name`` of matplotlib: a function from 0..1 to RGBA. A name may end in ``_r``, for the other
    direction. Raises `NergError` for one that is not of the ``kind``: "sequential", "diverging" or "categorical"."""
    import matplotlib

    names, words = _COLORS[kind]
    if name.removesuffix("_r") not in {of.removesuffix("_r") for of in names}:
        raise NergError(f'"{name}" is no {words} colour map: choose one of {", ".join(names)}')
    return matplotlib.colormaps[name]


def apply_colormap(name: str, shares: Any, kind: str = "sequential") -> np.ndarray:
    """Display colours (..., 3) of places ``shares`` (...) on a scale, 0..1."""
    return np.asarray(find_colormap(name, kind)(np.asarray(shares, np.float64)))[..., :3]


# ---- Hatching ----
#
# Where a picture knows nothing: diagonal lines over paled colours, which no value of any scale looks like.

PERIOD, WIDTH = 8, 2
"""Pixels from line to line along a row, and of a line."""

PALE, LINE = 0.82, 0.42
"""Grey that the picture is mixed with, and grey of the lines, display values."""

_MIXED = 0.65


def hatch_lines(height: int, width: int, unit: int = 1) -> np.ndarray:
    """Whether a pixel (``height``, ``width``) lies on a line of the hatching; ``unit``: by what lines are coarser."""
    y, x = np.ogrid[:height, :width]
    return (x + y) % (PERIOD * unit) < WIDTH * unit


def hatch(display: Any, unknown: Any, unit: int = 1) -> np.ndarray:
    """``display`` values (h, w, 3), hatched where ``unknown`` (h, w) is true, and unchanged elsewhere."""
    shown = np.asarray(display, np.float64)
    where = np.asarray(unknown, bool)[..., None]
    pale = shown + _MIXED * (PALE - shown)
    height, width = shown.shape[:2]
    drawn = np.where(hatch_lines(height, width, unit)[..., None], LINE, pale)
    return np.where(where, drawn, shown)


def hatch_swatch(height: int, width: int, unit: int = 1) -> np.ndarray:
    """What stands in a legend (``height``, ``width``, 3): the hatching over a middle grey."""
    return hatch(np.full((height, width, 3), 0.5), np.full((height, width), True), unit)


# ---- Provenance ----
#
# Where a picture comes from, as every picture and video says it of itself: inputs, seed, settings and versions.
#
# Nothing of the machine is in it: of files their names and the SHA-256 of their bytes, no folders, no users, no times,
# so that equal inputs give equal files.

_PROGRAMS = ("mitsuba", "drjit")
_OF_THE_RUN = ("seed", "store", "scheduler")
"""Options that are said elsewhere, or on which nothing that is made depends."""


@dataclass(frozen=True)
class Provenance:
    """``what`` made a picture (a command, or a function); ``inputs``: SHA-256 (hex) of files by their names; ``seed``
    of the random numbers, or None where there are none; ``settings`` that were given; ``versions`` of programs."""

    what: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def json(self) -> str:
        """All of it as one line of ASCII."""
        return json.dumps({f.name: getattr(self, f.name) for f in fields(self)}, sort_keys=True, default=str)

    def text(self) -> dict[str, str]:
        """What the header of a picture says, by the names that PNG has for it: ``Software`` and ``Comment``."""
        programs = ", ".join(f"{name} {number}" for name, number in self.versions.items())
        return {"Software": programs, "Comment": self.json()}


def make_provenance(
    what: str,
    inputs: Iterable[str | Path] = (),
    seed: int | None = None,
    settings: Any = None,
    checksums: dict[Path, str] | None = None,
) -> Provenance:
    """That of what is made of the files, or datasets of rays, ``inputs`` by ``settings``.

    ``settings``: a mapping, or a dataclass of options, of which those are said that differ from their defaults.
    ``known``: checksums by path that need not be computed again; those that are computed are added. Raises `NergError`
    for a file that cannot be read.
    """
    checksums = {} if checksums is None else checksums
    sums: dict[str, str] = {}
    for path in dict.fromkeys(map(Path, inputs)):
        name, number = path.name, 2
        while name in sums:
            name, number = f"{path.name} ({number})", number + 1
        if path not in checksums:
            checksums[path] = _digest(path)
        sums[name] = checksums[path]
    given = {name: value for name, value in _given(settings).items() if name not in _OF_THE_RUN}
    return Provenance(what, sums, seed, {k: _plain(v) for k, v in given.items()}, versions())


def _digest(path: Path) -> str:
    if not path.is_dir():
        return file_sha256(path)
    from nerg_mi.rays.dataset import hash_rays

    return hash_rays(path)


def existing_files(*values: Any) -> list[Path]:
    """Those of ``values`` that name files or folders which are there; others, such as rays in memory, have no name."""
    return [Path(v) for v in values if isinstance(v, (str, os.PathLike)) and Path(v).exists()]


def versions() -> dict[str, str]:
    """Version of each program that has a part in a picture, by name."""
    return {"nerg_mi": __version__, **{name: _version(name) for name in _PROGRAMS}}


def _version(name: str) -> str:
    loaded = sys.modules.get(name)
    if loaded is not None:  # where a picture was rendered; it says the same as what is installed, at once
        return loaded.__version__
    from importlib.metadata import version

    return version(name)


def _given(settings: Any) -> dict[str, Any]:
    if settings is None:
        return {}
    if isinstance(settings, Mapping):
        return dict(settings)
    every = {f.name: (getattr(settings, f.name), f.default) for f in fields(settings)}
    return {name: value for name, (value, default) in every.items() if value != default and value is not None}


def _plain(value: Any) -> Any:
    """A setting as JSON has it, with the names of files in place of their paths."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, str):
        return re.split(r"[/\\]", value)[-1] if re.search(r"[/\\]", value) else value
    return value if isinstance(value, (bool, int, float)) or value is None else type(value).__name__


# ---- Saving ----
#
# Figures as files: PNG and SVG, byte for byte the same for the same input, and as pixels for a video.

FORMATS = (".png", ".svg")
"""Suffixes of figures that are written."""

_OF_SVG = {"Software": "Creator", "Comment": "Description", "Title": "Title"}
_SALT = "nerg_mi"


def save(figure: Any, path: str | os.PathLike, metadata: Provenance | Mapping[str, str] | None = None) -> None:
    """Write a matplotlib figure as .png, or as .svg with its pictures embedded and all else as lines and text.

    ``about``: what its header says, names of PNG's texts (such as ``Comment``) in a mapping; no time is in it, so that
    equal figures are equal files. Raises `NergError` for other suffixes and for what cannot be written.
    """
    check_writable(path, *FORMATS)
    text = dict(metadata.text() if isinstance(metadata, Provenance) else metadata or {})
    write_bytes(path, encode(figure, Path(path).suffix.lower(), text))


def encode(figure: Any, suffix: str, text: Mapping[str, str] | None = None) -> bytes:
    """The bytes of ``figure`` in one of `FORMATS`, with ``text`` in its header."""
    import matplotlib

    out, text = io.BytesIO(), dict(text or {})
    if suffix == ".svg":
        known = {_OF_SVG[k]: v for k, v in text.items() if k in _OF_SVG}
        metadata: dict[str, Any] = {"Date": None, "Creator": None, **known}
        # Ids are made of the salt, and at random without one.
        with matplotlib.rc_context({"svg.hashsalt": _SALT, "svg.fonttype": "none", "svg.image_inline": True}):
            figure.savefig(out, format="svg", dpi=figure.dpi, metadata=metadata)
        return out.getvalue()
    figure.savefig(
        out, format="png", dpi=figure.dpi, metadata={"Software": None, **text}, pil_kwargs={"optimize": True}
    )
    return out.getvalue()


def rasterize(figure: Any) -> np.ndarray:
    """``figure`` as display values (h, w, 3) of uint8, as its PNG has them."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


# ---- Scale ----
#
# Ticks of a scale: round values, written so that they are short however small or large they are.

_SUPER = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def ticks_of(low: float, high: float, most: int, log: bool = False) -> tuple[list[float], list[str], str]:
    """``(places, names, factor)``: where ticks stand on a scale from 0 (``low``) to 1 (``high``), what is written
    there, and what belongs before the unit, such as "10⁻⁶" of values that are so small. About ``most`` of them;
    ``log``: at powers of ten of a logarithmic scale."""
    from matplotlib.ticker import MaxNLocator

    if log:
        first, last = math.log10(low), math.log10(high)
        step = max(1, math.ceil((last - first) / most))
        powers = [p for p in range(math.ceil(first - 1e-9), math.floor(last + 1e-9) + 1) if p % step == 0]
        if len(powers) >= 2:
            return [(p - first) / (last - first) for p in powers], [_power(p) for p in powers], ""
        ends = [low, math.sqrt(low * high), high]
        return [0.0, 0.5, 1.0], [f"{v:.2g}" for v in ends], ""
    most_of_all = max(abs(low), abs(high))
    power = math.floor(math.log10(most_of_all)) if most_of_all > 0 else 0
    power = 0 if -3 <= power < 4 else power
    unit = 10.0**power
    found = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low / unit, high / unit)
    edge = 1e-9 * (high - low) / unit
    values = [v for v in found if low / unit - edge <= v <= high / unit + edge]
    span = (high - low) / unit
    gap = min((b - a for a, b in zip(values, values[1:])), default=span)
    # As many digits as tell neighbours apart.
    digits = max(0, -math.floor(math.log10(gap) + 1e-9)) if gap > 0 else 0
    if gap > 0 and abs(round(gap, digits) - gap) > 1e-6 * gap:
        digits += 1
    names = [f"{0.0 if abs(v) < 1e-12 * span else v:.{digits}f}".replace("-", "−") for v in values]
    return [(v - low / unit) / span for v in values], names, "" if power == 0 else _power(power)


def _power(p: int) -> str:
    return {0: "1", 1: "10"}.get(p, "10" + str(p).translate(_SUPER))


# ---- Sheet ----
#
# The page that pictures are shown on: panels of one size, pixel for pixel, with titles, a scale and a legend.
#
# A pixel of a picture is a pixel of the page; one that is too small to carry a title is shown with each pixel as a
# square of several. Text, bars and gaps grow with the pictures, so that they can be read when a large one is shown
# small.

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


def label_axes(axes: Any, x: str, y: str, size: float = SMALL, ticks: float = 7, **how: Any) -> None:
    """Say along ``axes`` what they are of, in letters of a ``size``, beside ``ticks`` of another."""
    axes.set_xlabel(x, fontsize=size, color=INK, **how)
    axes.set_ylabel(y, fontsize=size, color=INK, **how)
    axes.tick_params(labelsize=ticks, colors=INK, length=2)


def label_bar(bar: Any, text: str, size: float = SMALL) -> None:
    bar.set_label(text, fontsize=size, color=INK)
    bar.ax.tick_params(labelsize=7, colors=INK, length=2)


@functools.cache
def _page_type() -> Any:
    # Matplotlib is loaded when something is drawn, and not with every command.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class FigurePage(Figure):
        def __init__(self, **how: Any):
            super().__init__(**how)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            return encode(self, ".png")

    return FigurePage


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
        self.width = round_up_to_even(left + columns * slot_w + (columns - 1) * (left if axes else gap) + self._side + foot)
        note = wrap(note, self.width - 2 * left, SMALL * unit) if note else ""
        foot += SMALL * unit * _PER_POINT * 1.25 * (note.count("\n") + 1) if note else 0.0
        self.height = round_up_to_even(rows * (head + slot_h + below) + foot)
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
        axes.imshow(np.clip(hatch_swatch(side, side, max(round(self.unit), 1)), 0, 1), interpolation="nearest")
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


def round_up_to_even(pixels: float) -> int:
    """Rounded up to an even number, as the sides of a video's frames have to be."""
    return 2 * math.ceil(round(pixels) / 2)


def wrap(text: str, width: float, size: float) -> str:
    """``text`` in lines that fit into ``width`` pixels at ``size`` points."""
    letters = max(int(width / (size * _PER_POINT * _WIDE)), 8)
    return "\n".join(textwrap.wrap(text, letters)) or text


# ---- Contact sheets of several pictures ----


def contact_sheet(
    pictures: Sequence[np.ndarray],
    titles: Sequence[str],
    columns: int | None = None,
    add_scale: Callable[[Sheet], None] | None = None,
    note: str = "",
) -> Any:
    """``pictures`` (h, w, 3), display values, each under its title, in rows of ``columns`` (default: about as many as
    rows); smaller ones lie in the middle of their place.

    ``add_scale``: draws the one scale of all on the sheet; ``note``: what they rest on.
    """
    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    height, width = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
    sheet = Sheet(
        [_padded(p, height, width) for p in pictures], titles, scale=add_scale is not None, columns=columns, note=note
    )
    if add_scale is not None:
        add_scale(sheet)
    return sheet.page


def shrink(picture: Any, width: int) -> np.ndarray:
    """``picture`` (h, w, 3) at most ``width`` pixels wide: means of squares of whole pixels, so that nothing is
    invented; what lacks to a square at the right and lower edge is left out."""
    picture = np.asarray(picture, np.float64)
    by = max(math.ceil(picture.shape[1] / width), 1)
    h, w = (max(n // by, 1) for n in picture.shape[:2])
    if by == 1:
        return picture
    some = picture[: h * by, : w * by]
    return some.reshape(h, some.shape[0] // h, w, some.shape[1] // w, 3).mean(axis=(1, 3))


def _padded(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    out = np.ones((height, width, 3))
    h, w = picture.shape[:2]
    top, left = (height - h) // 2, (width - w) // 2
    out[top : top + h, left : left + w] = picture
    return out
