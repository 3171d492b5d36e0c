"""Pictures of a study: error against time with the Pareto front, and cost against size on log axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.figures.style import Provenance, new_page, save

from .settings import PAPER
from .tables import comparable

PANELS = (
    ("color_rmse", "colour RMSE [linear radiance]"),
    ("depth_mae", "depth MAE [scene units]"),
    ("visibility_mae", "visibility MAE"),
    ("gaze_mae", "gaze MAE [1/sr]"),
)
# Errors below it are shown on the axis' lower end: single precision has nothing to say there.
FLOOR = 1e-9


def plot_errors(path: Path, rows: list[dict], title: str, about: Provenance | None = None) -> None:
    """Four panels of error against seconds, a colour a factor, the front as a line, the paper's marching as crosses."""
    import matplotlib
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator

    figure = new_page(960, 720)
    able = [r for r in rows if comparable(r)]
    groups = list(dict.fromkeys(r["group"] for r in able))
    colors = matplotlib.colormaps["tab20"](np.linspace(0, 1, 20))[: len(groups)]
    handles = {}
    for axes, (error, label) in zip(figure.subplots(2, 2).ravel(), PANELS):
        for group, color in zip(groups, colors):
            mine = [r for r in able if r["group"] == group and error in r]
            if not mine:
                continue
            xy = np.array([(r["seconds"], max(r[error], FLOOR)) for r in mine])
            marker, size = {"default": ("*", 150), PAPER: ("x", 34)}.get(group, ("o", 16))
            tint = {"default": "black", PAPER: "crimson"}.get(group, color)
            handles[group] = axes.scatter(
                *xy.T, s=size, marker=marker, color=tint, zorder=4 if group in ("default", PAPER) else 3
            )
        front = sorted(
            (r["seconds"], max(r[error], FLOOR)) for r in able if error.rsplit("_", 1)[0] in r["pareto"].split()
        )
        if front:
            (handles["Pareto front"],) = axes.plot(
                *np.array(front).T, color="0.4", linewidth=1, drawstyle="steps-post", zorder=2
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("seconds a picture", fontsize=8)
        axes.set_ylabel(label, fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        for axis in (axes.xaxis, axes.yaxis):
            # Where hardly a decade is shown, matplotlib would label every minor tick, one upon the other.
            axis.set_minor_locator(LogLocator(subs=(2, 5)))
            axis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(1.5, 1.5)))
        axes.grid(True, which="major", color="0.9", linewidth=0.6)
    figure.suptitle(title, fontsize=10)
    figure.legend(handles.values(), handles, loc="lower center", ncol=6, fontsize=7, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    save(figure, path, about)


def plot_scaling(path: Path, rows: list[dict], title: str, about: Provenance | None = None) -> None:
    """Seconds against pixels, samples a pixel and extent, log-log, with the exponent of the upper half of each."""
    figure = new_page(960, 320)
    names = {"pixels": "pixels", "samples": "samples a pixel", "extent": "extent of the scene at equal step"}
    varied = [axis for axis in names if any(r["axis"] == axis for r in rows)]
    for axes, axis in zip(figure.subplots(1, len(varied)), varied):
        x, y = np.array([(r["value"], r["seconds"]) for r in rows if r["axis"] == axis]).T
        axes.loglog(x, y, "o-", color="C0", markersize=4, linewidth=1)
        half = len(x) // 2
        axes.set_title(f"exponent {exponent(x[half - 1 :], y[half - 1 :]):.2f} in the upper half", fontsize=8)
        axes.set_xlabel(names[axis], fontsize=8)
        axes.set_ylabel("seconds a picture", fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        axes.grid(True, which="major", color="0.9", linewidth=0.6)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    save(figure, path, about)


def exponent(x, y) -> float:
    """Slope of log y against log x, by least squares."""
    return float(np.polyfit(np.log(np.asarray(x, float)), np.log(np.asarray(y, float)), 1)[0])
