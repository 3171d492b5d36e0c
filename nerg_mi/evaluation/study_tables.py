"""Tables and plots of a study."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.figures.style import Provenance, new_page, save
from nerg_mi.files.atomic import write_text
from nerg_mi.files.tables import add_notes, format_markdown_table, write_csv, write_json

from .study import COLUMNS, PAPER
from .study_truth import ERROR_NAMES

# ---- Tables ----
#
# Results derived from the rows of a study: the Pareto front, the comparison with the march of the paper, and the files.

PARETO_ERRORS = ("color_rmse", "depth_mae", "visibility_mae", "gaze_mae")
"""Errors that are compared with time; ``pareto`` of a row lists those for which it is on the Pareto front."""

TIMING_COLUMNS = ("default_seconds", "default_cpu_seconds", "timed_by")
"""Columns of rows that were timed by several processes: the times of the default in the process that timed the row, and
the index of that process.
"""


def find_pareto_front(points: list[tuple[float, float]]) -> list[bool]:
    """Return which points (time, error) are on the Pareto front: no other point is at most as large in both and
    smaller in one.
    """
    order = sorted(range(len(points)), key=lambda i: points[i])
    is_front, best = [False] * len(points), math.inf
    for i in order:
        time, error = points[i]
        # Equal points are all on the front.
        if error < best or (error == best and any(is_front[j] and points[j] == points[i] for j in order)):
            is_front[i], best = True, error
    return is_front


def is_comparable(row: dict) -> bool:
    """Return whether a row renders everything that the default does, with one ray per pixel of the scene itself."""
    return row["spp"] == 1 and not row["resolution"] and row["group"] not in ("leave out", "spp")


def mark_pareto_fronts(rows: list[dict]) -> None:
    """Set ``pareto`` of each row: the errors of `PARETO_ERRORS` for which it is on the front, space-separated."""
    for row in rows:
        row["pareto"] = ""
    for error in PARETO_ERRORS:
        candidates = [r for r in rows if is_comparable(r) and error in r]
        for row, on in zip(candidates, find_pareto_front([(r["seconds"], r[error]) for r in candidates])):
            if on:
                row["pareto"] = f"{row['pareto']} {error.rsplit('_', 1)[0]}".strip()


def compare_with_paper(rows: list[dict], clock: str = "seconds") -> list[dict]:
    """Compare each row of the paper's march with the default, and with the best rows of this package at equal time and
    at equal error.

    ``equal_time`` has the smallest depth error among rows that take no longer, ``equal_error`` the shortest time
    among rows with at most the same depth error, each with its ratio; None if there is no such row. They are chosen
    among ``settings`` rows by the errors and times that are reported; the default is not chosen. ``clock`` is
    ``seconds``, or ``cpu_seconds`` if the machine is shared.
    """
    # A map is computed once for many frames, so the times of its rows are not those of one picture. A compiled field
    # does not evaluate the networks that the march of the paper does.
    once = lambda row: row["visibility"] == "map" or bool(row["voxels"])
    candidates = [r for r in rows if r["group"] != PAPER and is_comparable(r) and not once(r)]
    default = next(r for r in rows if r["group"] == "default")
    out = []
    for paper in (r for r in rows if r["group"] == PAPER):
        equal_time = min(
            (r for r in candidates if r[clock] <= paper[clock]), key=lambda r: r["depth_mae"], default=None
        )
        equal_error = min(
            (r for r in candidates if r["depth_mae"] <= paper["depth_mae"]), key=lambda r: r[clock], default=None
        )
        out.append(
            {
                "paper": _select_columns(paper),
                "default": _select_columns(default),
                "settings": len(candidates),
                "equal_time": equal_time
                and _select_columns(equal_time)
                | {"error_ratio": paper["depth_mae"] / max(equal_time["depth_mae"], 1e-12)},
                "equal_error": equal_error
                and _select_columns(equal_error) | {"time_ratio": paper[clock] / equal_error[clock]},
            }
        )
    return out


def _select_columns(row: dict) -> dict:
    names = (
        "setting seconds cpu_seconds density_evals color_evals depth_mae depth_p99 surface_mae visibility_wrong".split()
    )
    return {n: row[n] for n in names if n in row}


def write_tables(out: Path, report: dict) -> list[Path]:
    """Write ``study.csv`` (rows), ``study.md`` (rows by factor), ``scaling.csv`` and ``study.json`` (all of
    ``report``).

    Returns their paths.
    """
    paths = [out / "study.csv", out / "study.md", out / "scaling.csv", out / "study.json"]
    row_columns = [*_list_columns(report), "note"]
    for path, rows, columns in ((paths[0], report["rows"], row_columns), (paths[2], report["scaling"], None)):
        write_csv(
            path,
            ({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows),
            columns or list(rows[0]),
        )
    write_text(paths[1], format_report(report))
    write_json(paths[3], report)
    return paths


def add_row_notes(report: dict) -> None:
    """Add a ``note`` on missing values to each row."""
    add_notes(report["rows"], _explain_missing, _list_columns(report))


def _list_columns(report: dict) -> list[str]:
    return [*COLUMNS, *(TIMING_COLUMNS if report.get("timed_by") else ())]


def _explain_missing(row: Mapping[str, Any], column: str) -> tuple[str, str]:
    if column in ERROR_NAMES:
        return column, "the setting does not render it, or the scene has no reference of it"
    return column, "not a value of this scene or setting"


def summarise(report: dict) -> list[str]:
    """Summarise the comparison of the default with the march of the paper, one line each."""
    lines = []
    for pair in report["against_paper"]:
        paper, default = pair["paper"], pair["default"]
        if not lines:
            lines.append(_format_line(default))
        lines.append(_format_line(paper))
        if pair["equal_time"]:
            lines.append(
                f"  at equal time, the best of {pair['settings']} settings: {pair['equal_time']['setting']}, "
                f"depth error {pair['equal_time']['error_ratio']:.1f} times smaller"
            )
        if pair["equal_error"]:
            lines.append(
                f"  at equal error, the best of {pair['settings']} settings: {pair['equal_error']['setting']}, "
                f"{pair['equal_error']['time_ratio']:.1f} times faster"
            )
    return lines


def _format_line(row: dict) -> str:
    return (
        f"{row['setting']}: {1000 * row['seconds']:.0f} ms, {row['density_evals']:.0f} density evaluations per pixel, "
        f"depth error {row['depth_mae']:.2g} (99th percentile: {row['depth_p99']:.2g})"
    )


# Column of study.csv, its heading, and the factor of its values.
_TABLE_COLUMNS = (
    ("seconds", "ms", 1e3),
    ("cpu_seconds", "CPU ms", 1e3),
    ("density_evals", "density", 1),
    ("color_evals", "colour", 1),
    ("color_rmse", "colour RMSE", 1),
    ("depth_mae", "depth MAE", 1),
    ("depth_median", "depth median", 1),
    ("depth_p99", "depth p99", 1),
    ("surface_mae", "surface MAE", 1),
    ("visibility_mae", "visibility MAE", 1),
    ("visibility_wrong", "wrong %", 100),
    ("gaze_mae", "gaze MAE", 1),
    ("gaze_kld", "gaze KLD", 1),
    ("peak_mb", "MiB", 1),
    ("voxels_mb", "voxels, MB", 1),
)


def format_report(report: dict) -> str:
    """Format the report as Markdown: a table per factor, with the default first, and the comparison with the paper's
    march.
    """
    rows = report["rows"]
    columns = [c for c in _TABLE_COLUMNS if any(c[0] in r for r in rows)]
    default = rows[0]
    head = ["setting", *(title for _, title, _ in columns)]
    text = [
        f"{report['scene']}, {report['size'][0]} x {report['size'][1]}, {report['variant']}, "
        f"reference: {report['reference']}"
    ]
    if report["reference_change_when_step_halved"]:
        change = ", ".join(f"{k} {v:.2g}" for k, v in report["reference_change_when_step_halved"].items())
        text.append(f"The next coarser reference differs by: {change}")
    if report.get("timed_by"):
        text.append(_format_timing(report["timed_by"]))
    for group in dict.fromkeys(r["group"] for r in rows[1:]):
        group_rows = [default, *(r for r in rows if r["group"] == group)]
        cells = [[r["setting"], *(f"{r[k] * by:.3g}" if k in r else "" for k, _, by in columns)] for r in group_rows]
        text.append(f"### {group}\n\n{format_markdown_table(head, cells)}")
    for clock, unit in (("seconds", "ms"), ("cpu_seconds", "CPU ms")):
        head = ["paper", unit, "depth MAE", "at equal time", "error ratio", "at equal error", "speed-up"]
        cells = []
        pairs = compare_with_paper(rows, clock)
        if not pairs:
            continue
        for pair in pairs:
            paper, time, error = pair["paper"], pair["equal_time"], pair["equal_error"]
            cells.append([paper["setting"], f"{1e3 * paper[clock]:.3g}", f"{paper['depth_mae']:.3g}"])
            cells[-1] += [time["setting"], f"{time['error_ratio']:.3g}"] if time else ["none", ""]
            cells[-1] += [error["setting"], f"{error['time_ratio']:.3g}"] if error else ["none", ""]
        title = f"the best of {pairs[0]['settings']} settings and the march of the paper, by {clock.replace('_', ' ')}"
        text.append(f"### {title}\n\n{format_markdown_table(head, cells)}")
    return "\n\n".join(text) + "\n"


def _format_timing(processes: list[dict]) -> str:
    """Describe the processes that took the times."""
    sentences = (
        f"process {process['process']} ({process['processor']}, {process['threads']} threads), "
        f"{process['rows']} settings, "
        "the default in {:.3g} to {:.3g} ms".format(*(1e3 * s for s in process["seconds"]))
        for process in processes
    )
    return f"Each setting was timed by one of several processes: {'; '.join(sentences)}."


# ---- Plots of a study: error against time with the Pareto front, and cost against size on log axes ----

PANELS = (
    ("color_rmse", "colour RMSE [linear radiance]"),
    ("depth_mae", "depth MAE [scene units]"),
    ("visibility_mae", "visibility MAE"),
    ("gaze_mae", "gaze MAE [1/sr]"),
)
# Errors below this value, the limit of single precision, are drawn at the lower end of the axis
MIN_PLOTTED_ERROR = 1e-9


def plot_errors(path: Path, rows: list[dict], title: str, provenance: Provenance | None = None) -> None:
    """Plot error against time in four panels, with a colour per factor, the Pareto front as a line, and the paper's
    march as crosses.
    """
    import matplotlib
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator

    figure = new_page(960, 720)
    candidates = [r for r in rows if is_comparable(r)]
    groups = list(dict.fromkeys(r["group"] for r in candidates))
    colors = matplotlib.colormaps["tab20"](np.linspace(0, 1, 20))[: len(groups)]
    handles = {}
    for axes, (error, label) in zip(figure.subplots(2, 2).ravel(), PANELS):
        for group, color in zip(groups, colors):
            group_rows = [r for r in candidates if r["group"] == group and error in r]
            if not group_rows:
                continue
            xy = np.array([(r["seconds"], max(r[error], MIN_PLOTTED_ERROR)) for r in group_rows])
            marker, size = {"default": ("*", 150), PAPER: ("x", 34)}.get(group, ("o", 16))
            marker_color = {"default": "black", PAPER: "crimson"}.get(group, color)
            handles[group] = axes.scatter(
                *xy.T, s=size, marker=marker, color=marker_color, zorder=4 if group in ("default", PAPER) else 3
            )
        front = sorted(
            (r["seconds"], max(r[error], MIN_PLOTTED_ERROR))
            for r in candidates
            if error.rsplit("_", 1)[0] in r["pareto"].split()
        )
        if front:
            (handles["Pareto front"],) = axes.plot(
                *np.array(front).T, color="0.4", linewidth=1, drawstyle="steps-post", zorder=2
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("seconds per picture", fontsize=8)
        axes.set_ylabel(label, fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        for axis in (axes.xaxis, axes.yaxis):
            # With less than a decade, matplotlib would label every minor tick, and the labels would overlap.
            axis.set_minor_locator(LogLocator(subs=(2, 5)))
            axis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(1.5, 1.5)))
        axes.grid(True, which="major", color="0.9", linewidth=0.6)
    figure.suptitle(title, fontsize=10)
    figure.legend(handles.values(), handles, loc="lower center", ncol=6, fontsize=7, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    save(figure, path, provenance)


def plot_scaling(path: Path, rows: list[dict], title: str, provenance: Provenance | None = None) -> None:
    """Plot time against pixels, samples per pixel and extent on log axes, with the exponent of the upper half of
    each."""
    figure = new_page(960, 320)
    names = {"pixels": "pixels", "samples": "samples per pixel", "extent": "extent of the scene at equal step"}
    varied = [axis for axis in names if any(r["axis"] == axis for r in rows)]
    for axes, axis in zip(figure.subplots(1, len(varied)), varied):
        x, y = np.array([(r["value"], r["seconds"]) for r in rows if r["axis"] == axis]).T
        axes.loglog(x, y, "o-", color="C0", markersize=4, linewidth=1)
        half = len(x) // 2
        axes.set_title(f"exponent {fit_exponent(x[half - 1 :], y[half - 1 :]):.2f} in the upper half", fontsize=8)
        axes.set_xlabel(names[axis], fontsize=8)
        axes.set_ylabel("seconds per picture", fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        axes.grid(True, which="major", color="0.9", linewidth=0.6)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    save(figure, path, provenance)


def fit_exponent(x, y) -> float:
    """Fit the slope of log y against log x by least squares."""
    return float(np.polyfit(np.log(np.asarray(x, float)), np.log(np.asarray(y, float)), 1)[0])
