"""Appearance and files of figures: colour maps, hatching, scales, page layout, provenance."""

from __future__ import annotations

import functools
import inspect
import io
import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from nerg_mi import __version__
from nerg_mi.errors import NergError, clean_text
from nerg_mi.files.atomic import check_writable, file_sha256, write_bytes
from nerg_mi.files.values import to_path
from nerg_mi.progress import Reporter, is_notebook

# ---- Colour maps ----
#
# All maps are perceptually uniform, or symmetric around a centre, so that equal steps of a value look equal, also with
# colour vision deficiencies and in greyscale. Rainbow maps (``jet``) are excluded, since they show edges that are not
# in the data.

SEQUENTIAL = ("inferno", "magma", "plasma", "viridis", "cividis")
"""Sequential colour maps."""

DIVERGING = ("RdBu_r", "PuOr_r", "BrBG_r", "PRGn_r")
"""Diverging colour maps, for differences."""

CATEGORICAL = ("tab20", "tab10")
"""Categorical colour maps, for class indices."""

_COLORS = {
    "sequential": (SEQUENTIAL, "perceptually uniform"),
    "diverging": (DIVERGING, "diverging"),
    "categorical": (CATEGORICAL, "categorical"),
}


def find_colormap(name: str, kind: str = "sequential") -> Any:
    """Return matplotlib's colour map ``name``, which may end in ``_r`` for the reverse direction.

    Raises `NergError` for a name that is not of the ``kind`` "sequential", "diverging" or "categorical".
    """
    import matplotlib

    names, description = _COLORS[kind]
    if name.removesuffix("_r") not in {n.removesuffix("_r") for n in names}:
        raise NergError(f'"{name}" is not a {description} colour map; choose one of {", ".join(names)}')
    return matplotlib.colormaps[name]


def apply_colormap(name: str, values: Any, kind: str = "sequential") -> np.ndarray:
    """Map positions in 0..1 to display colours (..., 3)."""
    return np.asarray(find_colormap(name, kind)(np.asarray(values, np.float64)))[..., :3]


# ---- Hatching ----
#
# Diagonal lines over pale colours mark pixels without data.

PERIOD, WIDTH = 8, 2
"""Spacing and width of the lines in pixels."""

PALE, LINE = 0.82, 0.42
"""Display values of the grey that the image is blended with, and of the lines."""

PALE_FRACTION = 0.65
"""Weight of that grey."""


def hatch_lines(height: int, width: int, unit: int = 1) -> np.ndarray:
    """Return whether pixels (``height``, ``width``) are on a hatching line, magnified by ``unit``."""
    y, x = np.ogrid[:height, :width]
    return (x + y) % (PERIOD * unit) < WIDTH * unit


def hatch(display: Any, unknown: Any, unit: int = 1) -> np.ndarray:
    """Hatch ``display`` values (h, w, 3) where ``unknown`` (h, w) is true."""
    shown = np.asarray(display, np.float64)
    where = np.asarray(unknown, bool)[..., None]
    pale = shown + PALE_FRACTION * (PALE - shown)
    height, width = shown.shape[:2]
    hatched = np.where(hatch_lines(height, width, unit)[..., None], LINE, pale)
    return np.where(where, hatched, shown)


def hatch_swatch(height: int, width: int, unit: int = 1) -> np.ndarray:
    """Return a legend entry (``height``, ``width``, 3) of the hatching over a middle grey."""
    return hatch(np.full((height, width, 3), 0.5), np.full((height, width), True), unit)


# ---- Provenance ----
#
# Inputs, seed, settings and versions, which every image and video contains.
#
# Files are identified by name and SHA-256; paths, users and times are excluded, so that equal inputs give equal files.

_PACKAGES = ("mitsuba", "drjit")
_EXCLUDED_OPTIONS = ("seed", "store", "scheduler", "worker_wait")
"""Options that are recorded elsewhere, or do not change results."""


@dataclass(frozen=True)
class Provenance:
    """Origin of an image.

    ``what``: command or function; ``inputs``: SHA-256 (hex) of the input files by name; ``seed`` of random numbers, or
    None; ``settings``: non-default options; ``versions`` of packages.
    """

    what: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def json(self) -> str:
        """Return all fields as one line of ASCII."""
        return json.dumps({f.name: getattr(self, f.name) for f in fields(self)}, sort_keys=True, default=str)

    def text(self) -> dict[str, str]:
        """Return the tEXt chunks of a PNG: ``Software`` and ``Comment``."""
        programs = ", ".join(f"{name} {number}" for name, number in self.versions.items())
        return {"Software": programs, "Comment": self.json()}


def make_provenance(
    what: str,
    inputs: Iterable[str | Path] = (),
    seed: int | None = None,
    settings: Any = None,
    checksums: dict[Path, str] | None = None,
) -> Provenance:
    """Record the origin of an output.

    Parameters
    ----------
    what
        Command or function.
    inputs
        Files or datasets. Raises `NergError` for a file that cannot be read.
    seed
        Seed of the random numbers.
    settings
        A mapping (`changed_arguments`), or a dataclass of options, of which those with non-default values are recorded.
    checksums
        Cache of checksums by path, which is extended.
    """
    checksums = {} if checksums is None else checksums
    sums: dict[str, str] = {}
    for path in dict.fromkeys(map(Path, inputs)):
        name, number = path.name, 2
        while name in sums:
            name, number = f"{path.name} ({number})", number + 1
        if path not in checksums:
            checksums[path] = _input_digest(path)
        sums[name] = checksums[path]
    options = {name: value for name, value in _changed_options(settings).items() if name not in _EXCLUDED_OPTIONS}
    return Provenance(what, sums, seed, {k: _to_json(v) for k, v in options.items()}, versions())


def _input_digest(path: Path) -> str:
    if not path.is_dir():
        return file_sha256(path)
    from nerg_mi.tracking.dataset import hash_rays

    return hash_rays(path)


def existing_files(*values: Any) -> list[Path]:
    """Return the paths of existing files and folders among ``values``."""
    return [Path(v) for v in values if isinstance(v, (str, os.PathLike)) and Path(v).exists()]


def versions() -> dict[str, str]:
    """Return the versions of the packages that affect an image, by name."""
    return {"nerg_mi": __version__, **{name: _version(name) for name in _PACKAGES}}


def _version(name: str) -> str:
    loaded = sys.modules.get(name)
    if loaded is not None:  # faster than reading the package metadata
        return loaded.__version__
    from importlib.metadata import version

    return version(name)


def _changed_options(settings: Any) -> dict[str, Any]:
    if settings is None:
        return {}
    if isinstance(settings, Mapping):
        return dict(settings)
    all_options = {f.name: (getattr(settings, f.name), f.default) for f in fields(settings)}
    return {name: value for name, (value, default) in all_options.items() if value != default and value is not None}


def changed_arguments(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``values`` of settings (keywords) of ``function`` that are neither None nor the default, by name.

    Settings in dataclasses are listed individually."""
    keywords = [p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    settings = {p.name: p.default for p in keywords if p.name not in ("output", "parallel", "progress")}
    is_changed = lambda value, default: value is not None and (default is None or value != default)
    changed = {name: values[name] for name, default in settings.items() if is_changed(values[name], default)}
    nested = [changed.pop(name) for name, default in settings.items() if is_dataclass(default) and name in changed]
    return changed | {name: value for part in nested for name, value in _changed_options(part).items()}


def _to_json(value: Any) -> Any:
    """Convert a setting to JSON; paths become file names."""
    if isinstance(value, Mapping):
        return {str(k): _to_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_json(v) for v in value]
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, str):
        return re.split(r"[/\\]", value)[-1] if re.search(r"[/\\]", value) else value
    return value if isinstance(value, (bool, int, float)) or value is None else type(value).__name__


# ---- Saving ----
#
# PNG, SVG and PDF files that are bitwise reproducible, and pixel arrays for videos. What is drawn is a figure of
# matplotlib, its axes, or an array of them.

FORMATS = (".png", ".svg", ".pdf")
"""Supported file suffixes."""

_METADATA_KEYS = {
    ".svg": {"Software": "Creator", "Comment": "Description", "Title": "Title"},
    ".pdf": {"Software": "Creator", "Comment": "Subject", "Title": "Title"},
}
_VECTOR_STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.image_inline": True, "pdf.fonttype": 42}
"""Text stays text in vector files, so that it can be searched and edited."""

_SALT = "nerg_mi"


def as_axes(axes: Any, count: int) -> np.ndarray:
    """Return one or several axes as an array (``count``,). Raises `NergError` for another number."""
    several = np.ravel(np.asarray(axes, object))
    if len(several) != count:
        raise NergError(f"the figure has {count} panels and needs as many axes, got {len(several)}")
    return several


def figure_of(drawn: Any) -> Any:
    """Return the matplotlib figure of ``drawn``: a figure, axes, or an array of axes."""
    first = np.ravel(np.asarray(drawn, object))[0]
    return first if hasattr(first, "savefig") else first.get_figure(root=True)


def show_figure(figure: Any) -> Any:
    """Return a new ``figure``, made the current one of pyplot, if that is imported, for its ``savefig`` and ``show``.

    A notebook shows what a cell returns, and would show the figure twice.
    """
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None and not is_notebook():
        pyplot.figure(FigureClass=lambda **_: figure)
    return figure


def save(drawn: Any, path: str | os.PathLike, metadata: Provenance | Mapping[str, str] | None = None) -> None:
    """Write a matplotlib figure as .png, or as .svg or .pdf with embedded images and text as text.

    Parameters
    ----------
    drawn
        Figure or axes.
    path
        Output file. Raises `NergError` for other suffixes and for files that cannot be written.
    metadata
        Provenance, or tEXt chunks by name, such as ``Comment``. Timestamps are omitted.
    """
    check_writable(path, *FORMATS)
    text = dict(metadata.text() if isinstance(metadata, Provenance) else metadata or {})
    write_bytes(path, encode(drawn, Path(path).suffix.lower(), text))


def check_figure(output: str | os.PathLike | None) -> None:
    """Raise `NergError` if a figure evidently cannot be written to ``output``, unless that is None."""
    if output is not None:
        check_writable(to_path(output), *FORMATS)


def finish_figure(
    drawn: Any,
    output: str | os.PathLike | None,
    what: str,
    inputs: Iterable[str | Path],
    seed: int | None,
    settings: Mapping[str, Any],
    reporter: Reporter,
) -> Any:
    """Write a new figure with its provenance (`make_provenance`) unless ``output`` is None, and return it to show."""
    figure = figure_of(drawn)
    if output is not None:
        save(figure, output, make_provenance(what, inputs, seed, settings))
        reporter.message(f"Wrote {output} ({' x '.join(f'{v:.0f}' for v in figure.bbox.size)}).")
    return show_figure(figure)


def encode(drawn: Any, suffix: str, text: Mapping[str, str] | None = None) -> bytes:
    """Encode a figure or axes in one of `FORMATS`, with metadata ``text``."""
    import matplotlib

    figure, out, text = _clean_texts(figure_of(drawn)), io.BytesIO(), dict(text or {})
    if suffix in _METADATA_KEYS:
        keys = _METADATA_KEYS[suffix]
        times: dict[str, Any] = {"Date": None} if suffix == ".svg" else {"CreationDate": None}
        metadata = {**times, "Creator": None, **{keys[k]: v for k, v in text.items() if k in keys}}
        # A fixed salt makes ids deterministic.
        with matplotlib.rc_context({"svg.hashsalt": _SALT, **_VECTOR_STYLE}):
            figure.savefig(out, format=suffix[1:], dpi=figure.dpi, metadata=metadata)
        return out.getvalue()
    figure.savefig(
        out, format="png", dpi=figure.dpi, metadata={"Software": None, **text}, pil_kwargs={"optimize": True}
    )
    return out.getvalue()


def _clean_texts(figure: Any) -> Any:
    """Remove characters that no font shows and that SVG does not allow from all texts of ``figure``; return it."""
    from matplotlib.text import Text

    for artist in figure.findobj(Text):
        content = artist.get_text()
        if (cleaned := clean_text(content)) != content:
            artist.set_text(cleaned)
    return figure


def rasterize(drawn: Any) -> np.ndarray:
    """Render a figure or axes to display values (h, w, 3), uint8, identical to its PNG."""
    figure = _clean_texts(figure_of(drawn))
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


# ---- Ticks ----

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def scale_ticks(low: float, high: float, max_ticks: int, log: bool = False) -> tuple[list[float], list[str], str]:
    """Choose about ``max_ticks`` ticks of a scale.

    Returns their positions (0 at ``low``, 1 at ``high``), their labels, and a factor for the unit, such as "10⁻⁶".
    ``log``: powers of ten of a logarithmic scale.
    """
    from matplotlib.ticker import MaxNLocator

    if log:
        first, last = math.log10(low), math.log10(high)
        step = max(1, math.ceil((last - first) / max_ticks))
        powers = [p for p in range(math.ceil(first - 1e-9), math.floor(last + 1e-9) + 1) if p % step == 0]
        if len(powers) >= 2:
            return [(p - first) / (last - first) for p in powers], [_format_power(p) for p in powers], ""
        ends = [low, math.sqrt(low * high), high]
        return [0.0, 0.5, 1.0], [f"{v:.2g}" for v in ends], ""
    max_magnitude = max(abs(low), abs(high))
    power = math.floor(math.log10(max_magnitude)) if max_magnitude > 0 else 0
    power = 0 if -3 <= power < 4 else power
    unit = 10.0**power
    candidates = MaxNLocator(max_ticks, steps=[1, 2, 2.5, 5, 10]).tick_values(low / unit, high / unit)
    edge = 1e-9 * (high - low) / unit
    values = [v for v in candidates if low / unit - edge <= v <= high / unit + edge]
    span = (high - low) / unit
    gap = min((b - a for a, b in zip(values, values[1:])), default=span)
    # Use enough digits to distinguish neighbouring ticks.
    digits = max(0, -math.floor(math.log10(gap) + 1e-9)) if gap > 0 else 0
    if gap > 0 and abs(round(gap, digits) - gap) > 1e-6 * gap:
        digits += 1
    names = [f"{0.0 if abs(v) < 1e-12 * span else v:.{digits}f}".replace("-", "−") for v in values]
    return [(v - low / unit) / span for v in values], names, "" if power == 0 else _format_power(power)


def _format_power(p: int) -> str:
    return {0: "1", 1: "10"}.get(p, "10" + str(p).translate(_SUPERSCRIPTS))


# ---- Page layout ----
#
# A page of equally sized panels with titles, a scale and a legend.
#
# A pixel of an image is a pixel of the page; images that are too small for a title are magnified by an integer factor.
# Text, bars and gaps grow with the images, so that they remain legible if a large page is displayed at a small size.

DPI = 100
INK, PAPER = "#1c1c1c", "#ffffff"
SMALL, TITLE = 8, 10
"""Sizes of text in points, on a page of pictures of `REFERENCE_SIZE` pixels, for `font_size`."""

REFERENCE_SIZE = 700.0
_MIN_SIZE = 150  # minimum size in pixels of an image with a title and a scale
_PIXELS_PER_POINT = DPI / 72
_EPSILON = 1e-6
_LETTER_WIDTH = 0.62  # mean width of a letter relative to the font size
_BAR, _GAP, _EDGE, _TIP, _SIDE = 14, 12, 10, 9, 104


def new_page(width: float, height: float) -> Any:
    """Create an empty matplotlib figure of the given size in pixels. It displays itself in notebooks and does not
    use pyplot."""
    # Avoid rounding down to one pixel less.
    size = (width + _EPSILON) / DPI, (height + _EPSILON) / DPI
    return _page_type()(figsize=size, dpi=DPI, facecolor=PAPER)


def text_scale() -> float:
    """Return the size of text relative to the default: a tenth of matplotlib's ``rcParams["font.size"]``."""
    import matplotlib

    return float(matplotlib.rcParams["font.size"]) / 10


def font_size(points: float) -> float:
    """Return a font size that is ``points`` with the default ``rcParams["font.size"]`` of 10 points."""
    return points * text_scale()


def label_axes(axes: Any, x: str, y: str, size: float = SMALL, ticks: float = 7, **how: Any) -> None:
    """Label ``axes`` with sizes ``size`` for the labels and ``ticks`` for the ticks, see `font_size`."""
    axes.set_xlabel(x, fontsize=font_size(size), color=INK, **how)
    axes.set_ylabel(y, fontsize=font_size(size), color=INK, **how)
    axes.tick_params(labelsize=font_size(ticks), colors=INK, length=2)


def label_bar(bar: Any, text: str, size: float = SMALL) -> None:
    """Label a colour bar."""
    bar.set_label(text, fontsize=font_size(size), color=INK)
    bar.ax.tick_params(labelsize=font_size(7), colors=INK, length=2)


@functools.cache
def _page_type() -> Any:
    # Import matplotlib only when a figure is drawn.
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
    """Images (h, w, 3) of equal size with titles, arranged in rows on a page of their own, or drawn in existing axes.

    Attributes: ``page``: figure; ``panels``, ``images``: axes and image of each panel; ``unit``: text size relative to
    the default.

    Parameters
    ----------
    pictures, titles
        Images and their titles.
    scale
        Whether to reserve space for a colour bar.
    axes
        Whether to reserve space for ticks and labels of each panel.
    columns
        Number of columns. Default: one row.
    note
        Note below the panels.
    panels
        Axes to draw in, one for each image. None: a page whose pixels are those of the images.
    """

    def __init__(
        self,
        pictures: Sequence[np.ndarray],
        titles: Sequence[str],
        scale: bool = False,
        axes: bool = False,
        columns: int | None = None,
        note: str = "",
        panels: Any = None,
    ):
        self.panels: list[Any] = []
        self.images: list[Any] = []
        self._has_page = panels is None
        if panels is not None:
            self._fill(as_axes(panels, len(pictures)), pictures, titles, axes, note)
            return
        h, w = pictures[0].shape[:2]
        magnification = max(1, math.ceil(_MIN_SIZE / max(h, w)))
        h, w = h * magnification, w * magnification
        self.unit = unit = float(np.clip(math.sqrt(h * w) / REFERENCE_SIZE, 1.0, 6.0)) * text_scale()
        columns = min(columns or len(pictures), len(pictures))
        rows = -(-len(pictures) // columns)
        slot_w, slot_h = max(w, _MIN_SIZE), max(h, _MIN_SIZE if scale and rows == 1 else 1)
        wrapped = [wrap(title, slot_w, TITLE * unit) for title in titles]
        line = TITLE * unit * _PIXELS_PER_POINT * 1.25
        head = 9 * unit + line * max(text.count("\n") + 1 for text in wrapped)
        left, below = (54 * unit, 42 * unit) if axes else (_EDGE * unit, 0.0)
        foot, gap = _EDGE * unit, _GAP * unit
        self._side = _SIDE * unit if scale else 0.0
        self.width = round_up_to_even(
            left + columns * slot_w + (columns - 1) * (left if axes else gap) + self._side + foot
        )
        note = wrap(note, self.width - 2 * left, SMALL * unit) if note else ""
        foot += SMALL * unit * _PIXELS_PER_POINT * 1.25 * (note.count("\n") + 1) if note else 0.0
        self.height = round_up_to_even(rows * (head + slot_h + below) + foot)
        self.page = new_page(self.width, self.height)
        step = slot_w + (left if axes else gap)
        for k, (picture, title) in enumerate(zip(pictures, wrapped)):
            row, column = divmod(k, columns)
            x = round(left + column * step + (slot_w - w) / 2)
            top = round(row * (head + slot_h + below) + head + (slot_h - h) / 2)
            panel = self._add_axes(x, top, w, h)
            panel.set_anchor("C")
            self._show(panel, picture, title, axes)
        if note:
            position = left / self.width, 0.6 * _EDGE * unit / self.height
            self.page.text(*position, note, fontsize=SMALL * unit, color=INK, va="bottom")
        content_height = rows * (head + slot_h + below) - head - below
        self._bar_position = (
            round(left + columns * step - (left if axes else gap) + gap),
            round(head),
            round(content_height),
        )

    def _show(self, panel: Any, picture: np.ndarray, title: str, axes: bool) -> None:
        """Draw an image with its title in the axes ``panel``."""
        self.images.append(panel.imshow(np.clip(picture, 0, 1), interpolation="nearest"))
        for spine in panel.spines.values():
            spine.set_visible(False)
        if not axes:
            panel.set_xticks([])
            panel.set_yticks([])
        panel.set_title(title, fontsize=TITLE * self.unit, color=INK, pad=4 * self.unit)
        self.panels.append(panel)

    def _fill(
        self, panels: np.ndarray, pictures: Sequence[np.ndarray], titles: Sequence[str], axes: bool, note: str
    ) -> None:
        """Draw the images in existing axes, with the scale to the right of the last one."""
        self.page, self.unit = figure_of(panels[0]), text_scale()
        for panel, picture, title in zip(panels, pictures, titles):
            self._show(panel, picture, title, axes)
        last = panels[-1]
        last.apply_aspect()
        to_layout = DPI / last.get_figure(root=True).dpi
        self.width, self.height = last.bbox.width * to_layout, last.bbox.height * to_layout
        self._bar_position = self.width + _GAP * self.unit, 0.0, self.height
        if note:
            below = (42 if axes else 4) * self.unit * 72 / DPI
            text = wrap(note, self.width, SMALL * self.unit)
            where = dict(xycoords="axes fraction", textcoords="offset points", va="top", annotation_clip=False)
            panels[0].annotate(text, (0, 0), (0, -below), fontsize=SMALL * self.unit, color=INK, **where)

    def _add_axes(self, x: float, top: float, width: float, height: float) -> Any:
        """Add axes at a position in pixels from the upper left corner of the page, or of the last panel."""
        position = (x / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        return self.page.add_axes(position) if self._has_page else self.panels[-1].inset_axes(position)

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
        """Draw the scale.

        Parameters
        ----------
        strip
            Display colours (n, 3) from ``low`` to ``high``, uniform in the value or, if ``log``, in its logarithm.
        low, high
            Ends of the scale.
        label
            Label with the unit.
        above, below
            Whether values exceed the scale, which a tip at its end shows.
        log
            Whether the scale is logarithmic.
        unknown
            Whether to explain the hatching below the scale.
        """
        unit, (x, top, height) = self.unit, self._bar_position
        strip = np.asarray(strip)
        if unknown:
            height -= round(24 * unit)
            self._draw_no_data(x, top + height + round(8 * unit))
        tip = round(_TIP * unit)
        start, long = top + (tip if above else 0), height - tip * (above + below)
        axes = self._add_axes(x, start, round(_BAR * unit), long)
        axes.imshow(strip[:, None], origin="lower", aspect="auto", extent=(0, 1, 0, 1), interpolation="bilinear")
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        positions, names, factor = scale_ticks(low, high, int(np.clip(long / (26 * unit), 3, 9)), log)
        axes.set_yticks(positions, names)
        axes.tick_params(labelsize=SMALL * unit, colors=INK, length=2 * unit, width=0.6 * unit, pad=2 * unit)
        axes.set_ylabel(
            wrap(_insert_factor(label, factor), long, SMALL * unit), fontsize=SMALL * unit, color=INK, labelpad=4 * unit
        )
        for spine in axes.spines.values():
            spine.set_linewidth(0.6 * unit)
        for is_shown, end, base, color in (
            (above, 1 + tip / long, 1.0, strip[-1]),
            (below, -tip / long, 0.0, strip[0]),
        ):
            if is_shown:
                axes.fill(
                    [0, 0.5, 1], [base, end, base], color=color, edgecolor=INK, clip_on=False, linewidth=0.6 * unit
                )
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)

    def legend(self, text: str = "no data") -> None:
        """Draw the legend of the hatching, for pages without a scale."""
        x, top, height = self._bar_position
        self._draw_no_data(x, top + height - round(16 * self.unit), text)

    def _draw_no_data(self, x: float, top: float, text: str = "no data") -> None:
        side = round(16 * self.unit)
        axes = self._add_axes(x, top, side, side)
        axes.imshow(np.clip(hatch_swatch(side, side, max(round(self.unit), 1)), 0, 1), interpolation="nearest")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_linewidth(0.6 * self.unit)
        where = dict(xycoords="axes fraction", textcoords="offset points", va="center", annotation_clip=False)
        axes.annotate(text, (1, 0.5), (5 * self.unit, 0), fontsize=SMALL * self.unit, color=INK, **where)


def _insert_factor(label: str, factor: str) -> str:
    """Insert ``factor`` before the unit in ``label``."""
    if not factor:
        return label
    return label.replace("[", f"[{factor} ", 1) if "[" in label else f"{label} [{factor}]"


def round_up_to_even(pixels: float) -> int:
    """Round up to an even number, as video frames require."""
    return 2 * math.ceil(round(pixels) / 2)


def wrap(text: str, width: float, size: float) -> str:
    """Wrap ``text`` to ``width`` pixels at ``size`` points."""
    letters = max(int(width / (size * _PIXELS_PER_POINT * _LETTER_WIDTH)), 8)
    return "\n".join(textwrap.wrap(text, letters)) or text


# ---- Contact sheets ----


def contact_sheet(
    pictures: Sequence[np.ndarray],
    titles: Sequence[str],
    columns: int | None = None,
    add_scale: Callable[[Sheet], None] | None = None,
    note: str = "",
    axes: Any = None,
) -> np.ndarray:
    """Arrange images, display values, with titles in a grid; smaller images are centred. Return the axes (N,).

    Parameters
    ----------
    pictures, titles
        Images and their titles.
    columns
        Number of columns. Default: about the number of rows.
    add_scale
        Draws the common scale.
    note
        Note below the images.
    axes
        Axes to draw in, one for each image. None: a new figure.
    """
    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    height, width = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
    sheet = Sheet(
        [_pad_picture(p, height, width) for p in pictures],
        titles,
        scale=add_scale is not None,
        columns=columns,
        note=note,
        panels=axes,
    )
    if add_scale is not None:
        add_scale(sheet)
    return np.array(sheet.panels)


def shrink(picture: Any, width: int) -> np.ndarray:
    """Reduce ``picture`` (h, w, 3) to at most ``width`` pixels by averaging blocks; incomplete blocks are dropped."""
    picture = np.asarray(picture, np.float64)
    factor = max(math.ceil(picture.shape[1] / width), 1)
    h, w = (max(n // factor, 1) for n in picture.shape[:2])
    if factor == 1:
        return picture
    cropped = picture[: h * factor, : w * factor]
    return cropped.reshape(h, cropped.shape[0] // h, w, cropped.shape[1] // w, 3).mean(axis=(1, 3))


def _pad_picture(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    out = np.ones((height, width, 3))
    h, w = picture.shape[:2]
    top, left = (height - h) // 2, (width - w) // 2
    out[top : top + h, left : left + w] = picture
    return out
