"""Depth error against run time of four marches of one field, and what each measure contributes alone.

    python benchmarks/error_time.py SCENE.xml [--repeats 7] [--voxels 1024] [--width 192] [--height 128] [--result NAME]
    python benchmarks/error_time.py --draw FIGURE.png

The curves are the march of the paper's code; the same with two corrections of its depth, which is divided by the
opacity and taken in the middle of a step; `nerg` with its defaults; and `nerg` with a compiled copy of the field. Each
point has another number of steps along the diagonal of the scene. ``depth error`` is compared with a march of the same
field with steps 32 times shorter, ``error against geometry`` with the exact surfaces (the store only). Both are means
of absolute differences.

NAME-measures, of a scene with exact surfaces, has the settings of `nerg` at the default step. The first row has none of
its measures, the next ones have one each, and the last ones all of them. --draw draws the results of
the store and the fox.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.evaluation.study import PAPER, PaperMarch, StudyRow, measure_rows
from nerg_mi.evaluation.study_run import find_reference_scene
from nerg_mi.evaluation.study_subject import load_subject
from nerg_mi.figures.style import new_page, save
from nerg_mi.transport.march_primal import SEPARATE_COLOR_CUTOFF
from timing import results, save_result

STEPS = 128, 256, 512, 1024, 2048, 4096
CORRECTED = {"depth_at": 0.5, "divides_by_opacity": True}
CURVES = ("paper", "paper, corrected", "default", "compiled")
COLUMNS = {
    "cpu_seconds": ("CPU time, ms", 1e3, ".1f"),
    "density_evals": ("density evaluations", 1, ".1f"),
    "color_evals": ("colour evaluations", 1, ".1f"),
    "depth_mae": ("depth error", 1, ".2e"),
    "surface_mae": ("error against geometry", 1, ".4f"),
    "visibility_wrong": ("wrong visibility, %", 100, ".2f"),
    "color_rmse": ("colour RMSE", 1, ".1e"),
}
"""Columns of a study -> title, factor and format."""
FIGURE = (
    ("error-time-store", "error against geometry", "demo store, against its exact surfaces [m]"),
    ("error-time-fox", "depth error", "photos of a fox, against a long march"),
)


def list_curves(subject, voxels: int) -> list[StudyRow]:
    rows = []
    for steps in STEPS:
        paper, ours = {"depth": "expected", "visibility": "depth"}, {"step": subject.extent / steps}
        compiled = ours | {"color_cutoff": SEPARATE_COLOR_CUTOFF}
        rows += [
            StudyRow(f"paper, {steps} steps", PAPER, paper, paper=PaperMarch(steps)),
            StudyRow(f"paper, corrected, {steps} steps", PAPER, paper, paper=PaperMarch(steps, **CORRECTED)),
            StudyRow(f"default, {steps} steps", "default", ours),
            StudyRow(f"compiled, {steps} steps", "compiled", compiled, voxels=voxels),
        ]
    return rows


def list_measures(subject, voxels: int) -> list[StudyRow]:
    """The two corrections of the paper's march, and the measures of `nerg`."""
    rows = []
    for name, corrections in (
        ("paper, 1024 steps", {}),
        ("... depth divided by opacity", {"divides_by_opacity": True}),
        ("... depth in the middle of a step", {"depth_at": 0.5}),
        ("... both", CORRECTED),
    ):
        rows.append(StudyRow(name, PAPER, {"depth": "expected"}, paper=PaperMarch(**corrections)))
    # Observer rays that compute their depth do not end early.
    whole = {"aovs": f"{subject.aov_names()},observer_depth"}
    none = {**whole, "refined": False, "color_cutoff": 0.0, "depth": "expected"}
    compiled = {"color_cutoff": SEPARATE_COLOR_CUTOFF}
    for name, params, resolution in (
        ("nerg, none of its measures", none, 0),
        ("... median depth", none | {"depth": "median"}, 0),
        ("... colour cut-off of 0.001", none | {"color_cutoff": 1e-3}, 0),
        ("... parts of cells", none | {"refined": True}, 0),
        ("... map of the observer", none | {"visibility": "map", "aovs": subject.aov_names()}, 0),
        ("... compiled field", none | compiled, voxels),
        ("default: median, cut-off, parts, rays that end early", {}, 0),
        ("... and map", {"visibility": "map"}, 0),
        ("compiled", compiled, voxels),
        ("... and map", compiled | {"visibility": "map"}, voxels),
    ):
        rows.append(StudyRow(name, "measures", params, voxels=resolution))
    return rows


def format_rows(table: list[dict], columns: list[str]) -> list[list[str]]:
    shown = [(key, *COLUMNS[key][1:]) for key in columns]
    return [[row["setting"], *(f"{row[key] * by:{format_}}" for key, by, format_ in shown)] for row in table]


def draw(path: Path) -> None:
    """Two panels, on log axes, with a curve for each of `CURVES`."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    figure = new_page(960, 380)
    for axes, (name, error, label) in zip(figure.subplots(1, 2), FIGURE):
        result = results.read(name)
        x, y = (result["columns"].index(title) for title in ("CPU time, ms", error))
        for curve in CURVES:
            points = [(float(r[x]), float(r[y])) for r in result["rows"] if r[0].rpartition(", ")[0] == curve]
            axes.loglog(*zip(*points), "o-", markersize=4, linewidth=1.2, label=curve)
        axes.set_title(label, fontsize=9)
        axes.set_xlabel("CPU time per image [ms]", fontsize=8)
        axes.set_ylabel("mean depth error", fontsize=8)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.minorticks_off()
        axes.tick_params(labelsize=7)
        axes.grid(True, color="0.92", linewidth=0.5)
        axes.legend(fontsize=7, frameon=False)
    figure.tight_layout()
    save(figure, path, {"Software": "benchmarks/error_time.py"})


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", help="Scene file of a field, with the integrator nerg.")
    parser.add_argument("--draw", type=Path, help="Only draw the published results into this file (.png).")
    parser.add_argument("--repeats", type=int, default=7, help="Number of timed images. Default: %(default)s.")
    parser.add_argument(
        "--voxels", type=int, default=1024, choices=(256, 512, 1024), help="Of the compiled field. Default: 1024."
    )
    parser.add_argument("--width", type=int, default=192, help="Width of the image in pixels. Default: %(default)s.")
    parser.add_argument("--height", type=int, default=128, help="Height of the image in pixels. Default: %(default)s.")
    parser.add_argument("--result", default="error-time-store", help="Name of the result. Default: %(default)s.")
    args = parser.parse_args(argv)
    if args.draw:
        draw(args.draw)
        return
    if args.scene is None:
        parser.error("give a scene file, or --draw")
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    subject = load_subject(args.scene, args.width, args.height, surfaces=find_reference_scene)
    curves = list_curves(subject, args.voxels)
    measures = list_measures(subject, args.voxels) if subject.surfaces else []
    table = measure_rows(subject, curves + measures, args.repeats, on_step=lambda name: print(name, flush=True))
    columns = [key for key in COLUMNS if key in table[0]]
    head = ["setting", *(COLUMNS[key][0] for key in columns)]
    save_result(args.result, head, format_rows(table[: len(curves)], columns), "1")
    if measures:
        save_result(f"{args.result}-measures", head, format_rows(table[len(curves) :], columns), "1")
    print(f"load at the end: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
