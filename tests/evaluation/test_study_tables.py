"""Tests of `nerg_mi.evaluation.study_tables`."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from nerg_mi.evaluation import study_tables
from nerg_mi.evaluation import study_tables as study_plots
from tests.notes import find_wrong_notes

# ---- The figures of a study: content of matplotlib's figures ----


@pytest.fixture
def drawn(monkeypatch):
    figures = []
    monkeypatch.setattr(study_plots, "save", lambda figure, path, provenance: figures.append(figure))
    return figures


def row(group, seconds, error, pareto=""):
    return {
        "group": group,
        "seconds": seconds,
        "pareto": pareto,
        "spp": 1,
        "resolution": "",
        "voxels": "",
        "visibility": "depth",
    } | {name: error for name, _ in study_plots.PANELS}


ALL = "color depth visibility gaze"

ROWS = [
    row("default", 0.02, 1e-3, ALL),
    row("steps", 0.01, 2e-3, ALL),
    row("steps", 0.16, 0.0, ALL),
    row("paper", 0.08, 5e-3),
]

SCALING = [
    {"axis": axis, "value": v, "seconds": 0.1 * v**p}
    for axis, p in (("pixels", 1.0), ("samples", 0.5), ("extent", 2.0))
    for v in (1, 2, 4, 8)
]


def test_panels_show_all_rows_and_the_front_below_them(drawn):
    study_plots.plot_errors("a.png", ROWS, "title")
    panels = drawn[0].axes
    assert [a.get_ylabel() for a in panels] == [label for _, label in study_plots.PANELS]
    assert {a.get_xlabel() for a in panels} == {"seconds per picture"}
    for axes in panels:
        (front,) = axes.lines
        # Sorted by time; an error of zero is at the lower end of the axis.
        assert np.allclose(front.get_xydata(), [(0.01, 2e-3), (0.02, 1e-3), (0.16, study_plots.MIN_PLOTTED_ERROR)])
        assert front.get_drawstyle() == "steps-post"
        points = {len(c.get_offsets()): c for c in axes.collections}
        assert sum(len(c.get_offsets()) for c in axes.collections) == 4
        assert np.allclose(points[2].get_offsets(), [(0.01, 2e-3), (0.16, study_plots.MIN_PLOTTED_ERROR)])
        assert all(c.get_zorder() > front.get_zorder() for c in axes.collections)
        assert axes.get_xscale() == axes.get_yscale() == "log"
    crosses = [c for c in panels[0].collections if np.allclose(c.get_offsets(), [(0.08, 5e-3)])]
    assert len(crosses) == 1 and tuple(crosses[0].get_facecolor()[0]) == to_rgba("crimson")
    named = sorted(t.get_text() for t in drawn[0].legends[0].get_texts())
    assert named == ["Pareto front", "default", "paper", "steps"]


def test_cost_is_drawn_over_named_axes_with_the_exponent(drawn):
    study_plots.plot_scaling("a.png", SCALING, "title")
    panels = drawn[0].axes
    assert [a.get_xlabel() for a in panels] == ["pixels", "samples per pixel", "extent of the scene at equal step"]
    assert [a.get_title().split()[1] for a in panels] == ["1.00", "0.50", "2.00"]
    assert {a.get_ylabel() for a in panels} == {"seconds per picture"}
    assert np.allclose(panels[2].lines[0].get_xydata(), [(v, 0.1 * v**2) for v in (1, 2, 4, 8)])
    # The exponent of the upper half excludes the fixed cost of a render.
    study_plots.plot_scaling("a.png", [r | {"seconds": 9.0} if r["value"] == 1 else r for r in SCALING], "title")
    assert [a.get_title() for a in drawn[1].axes] == [a.get_title() for a in panels]


# ---- Results from the rows of a study: Pareto fronts, and the comparison with the paper's marching ----


def test_missing_values_have_a_reason(monkeypatch, tmp_path):
    monkeypatch.setattr(study_tables, "format_report", lambda report: "")
    table = [dict.fromkeys(study_tables.COLUMNS, 1.0), {"setting": "gaze only", "gaze_mae": 0.1}]
    report = {"rows": table, "scaling": SCALING}
    study_tables.add_row_notes(report)
    paths = study_tables.write_tables(tmp_path, report)
    with open(paths[0], encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert not find_wrong_notes(rows) and [bool(row["note"]) for row in rows] == [False, True]
    assert not find_wrong_notes(table)


def test_pareto():
    assert study_tables.find_pareto_front([(1, 5), (2, 3), (3, 4), (4, 1), (5, 1)]) == [True, True, False, True, False]
    assert study_tables.find_pareto_front([(1, 1), (1, 1), (1, 2)]) == [True, True, False]
    assert study_tables.find_pareto_front([]) == []
    rng = np.random.default_rng(0)
    points = [tuple(p) for p in rng.random((200, 2))]
    beaten = [any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points) for p in points]
    assert study_tables.find_pareto_front(points) == [not b for b in beaten]


def test_units_of_the_report():
    units = {"seconds": 1e3, "cpu_seconds": 1e3, "visibility_wrong": 100}
    names = [*units, "density_evals", "color_evals", "peak_mb", "color_rmse", "depth_mae", "depth_p99", "surface_mae"]
    names += ["visibility_mae", "gaze_mae", "gaze_kld"]
    row = {"setting": "a", "group": "leave out", "spp": 1, "resolution": "", "voxels": "", "visibility": "depth"}
    row |= {name: (k + 1) / 128 for k, name in enumerate(names)}
    provenance = {
        "scene": "s",
        "size": (1, 1),
        "variant": "v",
        "reference": "r",
        "reference_change_when_step_halved": {},
    }
    page = study_tables.format_report({"rows": [{**row, "group": "default"}, row], **provenance})
    assert "against the paper" not in page
    shown = [float(cell) for cell in page.split("| a |")[2].split("\n")[0].strip(" |").split("|")]
    assert sorted(shown) == sorted(float(f"{row[name] * units.get(name, 1):.3g}") for name in names)


def test_comparison_with_the_paper_selects_the_best_rows():
    def row(setting, group, seconds, depth_mae):
        return {
            "setting": setting,
            "group": group,
            "seconds": seconds,
            "cpu_seconds": 2 * seconds,
            "depth_mae": depth_mae,
            "density_evals": 1.0,
            "spp": 1,
            "resolution": "",
            "voxels": "",
            "visibility": "depth",
        }

    rows = [
        row("default", "default", 3, 0.1),
        row("short", "steps", 1, 0.4),
        row("map", "visibility", 0.1, 0.1) | {"visibility": "map"},
        row("slow", "steps", 9, 0.01),
        row("p", "paper", 4, 0.5),
        row("fast", "paper", 0.5, 0.001),
    ]
    for clock in ("seconds", "cpu_seconds"):
        first, second = study_tables.compare_with_paper(rows, clock)
        assert first["equal_time"]["setting"] == "default" and math.isclose(first["equal_time"]["error_ratio"], 5)
        assert first["equal_error"]["setting"] == "short" and math.isclose(first["equal_error"]["time_ratio"], 4)
        assert second["equal_time"] is None and second["equal_error"] is None
        # The map is no candidate.
        assert first["settings"] == second["settings"] == 3
