"""What follows from a study's rows: Pareto fronts, and the comparison with the paper's marching."""

import math

import numpy as np

from nerg_mi.evaluation import study_tables


def test_pareto():
    assert study_tables.pareto([(1, 5), (2, 3), (3, 4), (4, 1), (5, 1)]) == [True, True, False, True, False]
    assert study_tables.pareto([(1, 1), (1, 1), (1, 2)]) == [True, True, False]
    assert study_tables.pareto([]) == []
    rng = np.random.default_rng(0)
    points = [tuple(p) for p in rng.random((200, 2))]
    beaten = [any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points) for p in points]
    assert study_tables.pareto(points) == [not b for b in beaten]


def test_a_page_shows_times_in_ms_shares_in_percent_and_errors_as_they_are():
    units = {"seconds": 1e3, "cpu_seconds": 1e3, "visibility_wrong": 100}
    names = [*units, "density_evals", "color_evals", "peak_mb", "color_rmse", "depth_mae", "depth_p99", "surface_mae"]
    names += ["visibility_mae", "gaze_mae", "gaze_kld"]
    row = {"setting": "a", "group": "leave out", "spp": 1, "resolution": "", "visibility": "depth"}
    row |= {name: (k + 1) / 128 for k, name in enumerate(names)}
    about = {"scene": "s", "size": (1, 1), "variant": "v", "reference": "r", "reference_change_when_step_halved": {}}
    page = study_tables.markdown({"rows": [{**row, "group": "default"}, row], **about})
    assert "against the paper" not in page
    shown = [float(cell) for cell in page.split("| a |")[2].split("\n")[0].strip(" |").split("|")]
    assert sorted(shown) == sorted(float(f"{row[name] * units.get(name, 1):.3g}") for name in names)


def test_against_paper_takes_the_best_of_either_kind():
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
        first, second = study_tables.against_paper(rows, clock)
        assert first["equal_time"]["setting"] == "default" and math.isclose(first["equal_time"]["error_ratio"], 5)
        assert first["equal_error"]["setting"] == "short" and math.isclose(first["equal_error"]["time_ratio"], 4)
        assert second["equal_time"] is None and second["equal_error"] is None
