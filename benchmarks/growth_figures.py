"""Figures of `bench.py`: cost against size, and the roof over the evaluation of density."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from nerg_mi.figures.sheet import INK, new_page

import numpy as np

_OURS, _SLOPE, _HAND = "#1f5fa8", "#b9b9b9", "#c0392b"
_PANEL = (330, 250)


def _short(size: float) -> str:
    """A size as the mark of an axis: 230k, 2.1M."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if size >= unit:
            return f"{size / unit:.{1 if size < 10 * unit else 0}f}{letter}"
    return f"{size:g}"


def growth_figure(curves: Sequence[Mapping]):
    """A panel for each of ``curves``: ``title``, ``axis``, ``sizes`` (n,), ``low``, ``middle`` and ``high`` (n,)
    milliseconds, and the fitted ``exponent``; both axes logarithmic, with the slope of proportion in grey."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    columns = 3
    rows = -(-len(curves) // columns)
    figure = new_page(columns * _PANEL[0], rows * _PANEL[1])
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, curve in zip(panels, curves):
        sizes, middle = (np.asarray(curve[k], float) for k in ("sizes", "middle"))
        axes.plot(sizes, middle[-1] * sizes / sizes[-1], color=_SLOPE, linewidth=1, linestyle="--")
        ends = [np.asarray(curve[k], float) for k in ("low", "high")]
        axes.errorbar(sizes, middle, [middle - ends[0], ends[1] - middle], color=_OURS, marker="o", ms=3, lw=1.2)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(sizes, [_short(n) for n in sizes])
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,g}"))
        axes.minorticks_off()
        axes.set_title(curve["title"], fontsize=8, color=INK)
        axes.set_xlabel(curve["axis"], fontsize=7, color=INK)
        axes.set_ylabel(curve.get("unit", "CPU ms"), fontsize=7, color=INK)
        axes.tick_params(labelsize=6, colors=INK, length=2)
        axes.text(0.04, 0.9, f"size^{curve['exponent']:.2f}", transform=axes.transAxes, fontsize=8, color=_OURS)
    for axes in panels[len(curves) :]:
        axes.set_visible(False)
    figure.tight_layout()
    return figure


def roofline_figure(peak: float, bandwidths: Mapping[str, float], intensity: float, found: Mapping[str, float]):
    """The roofs of a machine of ``peak`` GFLOP/s and ``bandwidths`` (GB/s by name), and the GFLOP/s ``found`` by name
    at ``intensity`` (operations a byte)."""
    figure = new_page(700, 340)
    axes = figure.subplots()
    x = np.geomspace(0.1, 100, 200)
    for k, (name, rate) in enumerate(bandwidths.items()):
        axes.plot(x, np.minimum(peak, rate * x), color=INK, linewidth=1, linestyle=("-", "--", ":")[k % 3], label=name)
    for k, (name, rate) in enumerate(found.items()):
        ours = name.startswith("Dr.Jit")
        color = _OURS if ours else _HAND
        axes.plot(intensity, rate, marker="os^vDP"[k % 6], color=color, linestyle="none", ms=5, label=name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("operations a byte", fontsize=8, color=INK)
    axes.set_ylabel("GFLOP/s", fontsize=8, color=INK)
    axes.set_title("An evaluation of density under the roof of the machine", fontsize=9, color=INK)
    axes.tick_params(labelsize=7, colors=INK, length=2)
    # Beside the axes: where the markers are depends on the machine.
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.01, 0.5))
    figure.tight_layout()
    return figure
