"""A study as tables and plots."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from nerg_mi.figures.style import Provenance, new_page, save
from nerg_mi.files.atomic import write_text
from nerg_mi.files.tables import format_markdown_table, write_csv, write_json

from .study import COLUMNS, PAPER

# ---- Tables ----
#
# What follows from a study's rows: the Pareto front, the comparison with the paper's marching, and the files.

PARETO_ERRORS = ("color_rmse", "depth_mae", "visibility_mae", "gaze_mae")
"""The errors that are set against time; a row's ``pareto`` names those for which it is on the front."""

TIMING_COLUMNS = ("default_seconds", "default_cpu_seconds", "timed_by")
"""Columns of rows that were timed in parts: the default's times by the process that timed the row, and which it was."""


def find_pareto_front(points: list[tuple[float, float]]) -> list[bool]:
    """Which of the points (time, error) no other one beats: no other is at most as large in both and smaller in one."""
    order = sorted(range(len(points)), key=lambda i: points[i])
    on, best = [False] * len(points), math.inf
    for i in order:
        time, error = points[i]
        # Of equal points all are on the front.
        if error < best or (error == best and any(on[j] and points[j] == points[i] for j in order)):
            on[i], best = True, error
    return on


def is_comparable(row: dict) -> bool:
    """Whether a row renders all that the default does, for one ray a pixel of the scene itself."""
    return row["spp"] == 1 and not row["resolution"] and row["group"] not in ("leave out", "spp")


def mark_pareto_fronts(rows: list[dict]) -> None:
    """Set ``pareto`` of each row: the errors of `FRONTS` for which it is on the front, space-separated."""
    for row in rows:
        row["pareto"] = ""
    for error in PARETO_ERRORS:
        able = [r for r in rows if is_comparable(r) and error in r]
        for row, on in zip(able, find_pareto_front([(r["seconds"], r[error]) for r in able])):
            if on:
                row["pareto"] = f"{row['pareto']} {error.rsplit('_', 1)[0]}".strip()


def compare_with_paper(rows: list[dict], clock: str = "seconds") -> list[dict]:
    """For each row of the paper's marching: the default beside it, the least depth error of ours that takes no longer,
    and the shortest time of ours whose depth error is no larger, with the ratios; None where ours has no such row.

    ``clock``: ``seconds``, or ``cpu_seconds`` where other work shares the machine.
    """
    # A map is made once for many frames: its rows' times are not those of one picture.
    ours = [r for r in rows if r["group"] != PAPER and is_comparable(r) and r["visibility"] != "map"]
    default = next(r for r in rows if r["group"] == "default")
    out = []
    for paper in (r for r in rows if r["group"] == PAPER):
        no_longer = min((r for r in ours if r[clock] <= paper[clock]), key=lambda r: r["depth_mae"], default=None)
        no_worse = min((r for r in ours if r["depth_mae"] <= paper["depth_mae"]), key=lambda r: r[clock], default=None)
        out.append(
            {
                "paper": _brief(paper),
                "default": _brief(default),
                "equal_time": no_longer
                and _brief(no_longer) | {"error_ratio": paper["depth_mae"] / max(no_longer["depth_mae"], 1e-12)},
                "equal_error": no_worse and _brief(no_worse) | {"time_ratio": paper[clock] / no_worse[clock]},
            }
        )
    return out


def _brief(row: dict) -> dict:
    names = (
        "setting seconds cpu_seconds density_evals color_evals depth_mae depth_p99 surface_mae visibility_wrong".split()
    )
    return {n: row[n] for n in names if n in row}


def write_tables(out: Path, report: dict) -> list[Path]:
    """Write ``study.csv`` (the rows), ``study.md`` (the same by factor, to read), ``scaling.csv`` and ``study.json``
    (all of ``report``); returns their paths."""
    paths = [out / "study.csv", out / "study.md", out / "scaling.csv", out / "study.json"]
    of_rows = [*COLUMNS, *(TIMING_COLUMNS if report.get("timed_by") else ())]
    for path, rows, columns in ((paths[0], report["rows"], of_rows), (paths[2], report["scaling"], None)):
        write_csv(
            path,
            ({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows),
            columns or list(rows[0]),
        )
    write_text(paths[1], format_report(report))
    write_json(paths[3], report)
    return paths


def summarise(report: dict) -> list[str]:
    """The default beside the paper's marching, in words: a line each."""
    lines = []
    for pair in report["against_paper"]:
        paper, default = pair["paper"], pair["default"]
        if not lines:
            lines.append(_line(default))
        lines.append(_line(paper))
        if pair["equal_time"]:
            lines.append(
                f"  no slower: {pair['equal_time']['setting']}, "
                f"depth error {pair['equal_time']['error_ratio']:.1f} times less"
            )
        if pair["equal_error"]:
            lines.append(
                f"  no worse: {pair['equal_error']['setting']}, {pair['equal_error']['time_ratio']:.1f} times faster"
            )
    return lines


def _line(row: dict) -> str:
    return (
        f"{row['setting']}: {1000 * row['seconds']:.0f} ms, {row['density_evals']:.0f} density evaluations a pixel, "
        f"depth error {row['depth_mae']:.2g} (99 %: {row['depth_p99']:.2g})"
    )


# Column of study.csv, its heading to read, and what it is multiplied with.
_SHOWN = (
    ("seconds", "ms", 1e3),
    ("cpu_seconds", "CPU ms", 1e3),
    ("density_evals", "density", 1),
    ("color_evals", "colour", 1),
    ("color_rmse", "colour RMSE", 1),
    ("depth_mae", "depth MAE", 1),
    ("depth_p99", "depth 99 %", 1),
    ("surface_mae", "surface MAE", 1),
    ("visibility_mae", "visibility MAE", 1),
    ("visibility_wrong", "wrong %", 100),
    ("gaze_mae", "gaze MAE", 1),
    ("gaze_kld", "gaze KLD", 1),
    ("peak_mb", "MiB", 1),
)


def format_report(report: dict) -> str:
    """A table for each factor, the default first in all of them, and the comparison with the paper's marching."""
    rows = report["rows"]
    shown = [c for c in _SHOWN if any(c[0] in r for r in rows)]
    default = rows[0]
    head = ["setting", *(title for _, title, _ in shown)]
    text = [
        f"{report['scene']}, {report['size'][0]} x {report['size'][1]}, {report['variant']}, "
        f"reference: {report['reference']}"
    ]
    if report["reference_change_when_step_halved"]:
        change = ", ".join(f"{k} {v:.2g}" for k, v in report["reference_change_when_step_halved"].items())
        text.append(f"The next coarser reference differs by: {change}")
    if report.get("timed_by"):
        text.append(_timed_by(report["timed_by"]))
    for group in dict.fromkeys(r["group"] for r in rows[1:]):
        mine = [default, *(r for r in rows if r["group"] == group)]
        cells = [[r["setting"], *(f"{r[k] * by:.3g}" if k in r else "" for k, _, by in shown)] for r in mine]
        text.append(f"### {group}\n\n{format_markdown_table(head, cells)}")
    for clock, unit in (("seconds", "ms"), ("cpu_seconds", "CPU ms")):
        head = ["paper", unit, "depth MAE", "no slower", "times less error", "no worse", "times faster"]
        cells = []
        for pair in compare_with_paper(rows, clock):
            paper, time, error = pair["paper"], pair["equal_time"], pair["equal_error"]
            cells.append([paper["setting"], f"{1e3 * paper[clock]:.3g}", f"{paper['depth_mae']:.3g}"])
            cells[-1] += [time["setting"], f"{time['error_ratio']:.3g}"] if time else ["none", ""]
            cells[-1] += [error["setting"], f"{error['time_ratio']:.3g}"] if error else ["none", ""]
        if not cells:
            continue
        title = f"against the paper's marching, by {clock.replace('_', ' ')}"
        text.append(f"### {title}\n\n{format_markdown_table(head, cells)}")
    return "\n\n".join(text) + "\n"


def _timed_by(who: list[dict]) -> str:
    """Who took the times, in a sentence."""
    get_or_compute_each = (
        f"process {found['process']} ({found['processor']}, {found['threads']} threads), {found['rows']} settings, "
        "the default in {:.3g} to {:.3g} ms".format(*(1e3 * s for s in found["seconds"]))
        for found in who
    )
    return f"Times are those of whoever measured a setting: {'; '.join(get_or_compute_each)}."


# ---- Pictures of a study: error against time with the Pareto front, and cost against size on log axes ----

PANELS = (
    ("color_rmse", "colour RMSE [linear radiance]"),
    ("depth_mae", "depth MAE [scene units]"),
    ("visibility_mae", "visibility MAE"),
    ("gaze_mae", "gaze MAE [1/sr]"),
)
MIN_PLOTTED_ERROR = 1e-9  # Errors below it are shown on the axis' lower end: single precision has nothing to say there


def plot_errors(path: Path, rows: list[dict], title: str, provenance: Provenance | None = None) -> None:
    """Four panels of error against seconds, a colour a factor, the front as a line, the paper's marching as crosses."""
    import matplotlib
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator

    figure = new_page(960, 720)
    able = [r for r in rows if is_comparable(r)]
    groups = list(dict.fromkeys(r["group"] for r in able))
    colors = matplotlib.colormaps["tab20"](np.linspace(0, 1, 20))[: len(groups)]
    handles = {}
    for axes, (error, label) in zip(figure.subplots(2, 2).ravel(), PANELS):
        for group, color in zip(groups, colors):
            mine = [r for r in able if r["group"] == group and error in r]
            if not mine:
                continue
            xy = np.array([(r["seconds"], max(r[error], MIN_PLOTTED_ERROR)) for r in mine])
            marker, size = {"default": ("*", 150), PAPER: ("x", 34)}.get(group, ("o", 16))
            tint = {"default": "black", PAPER: "crimson"}.get(group, color)
            handles[group] = axes.scatter(
                *xy.T, s=size, marker=marker, color=tint, zorder=4 if group in ("default", PAPER) else 3
            )
        front = sorted(
            (r["seconds"], max(r[error], MIN_PLOTTED_ERROR)) for r in able if error.rsplit("_", 1)[0] in r["pareto"].split()
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
    save(figure, path, provenance)


def plot_scaling(path: Path, rows: list[dict], title: str, provenance: Provenance | None = None) -> None:
    """Seconds against pixels, samples a pixel and extent, log-log, with the exponent of the upper half of each."""
    figure = new_page(960, 320)
    names = {"pixels": "pixels", "samples": "samples a pixel", "extent": "extent of the scene at equal step"}
    varied = [axis for axis in names if any(r["axis"] == axis for r in rows)]
    for axes, axis in zip(figure.subplots(1, len(varied)), varied):
        x, y = np.array([(r["value"], r["seconds"]) for r in rows if r["axis"] == axis]).T
        axes.loglog(x, y, "o-", color="C0", markersize=4, linewidth=1)
        half = len(x) // 2
        axes.set_title(f"exponent {fit_exponent(x[half - 1 :], y[half - 1 :]):.2f} in the upper half", fontsize=8)
        axes.set_xlabel(names[axis], fontsize=8)
        axes.set_ylabel("seconds a picture", fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        axes.grid(True, which="major", color="0.9", linewidth=0.6)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    save(figure, path, provenance)


def fit_exponent(x, y) -> float:
    """Slope of log y against log x, by least squares."""
    return float(np.polyfit(np.log(np.asarray(x, float)), np.log(np.asarray(y, float)), 1)[0])
