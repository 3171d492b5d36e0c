"""The rows of a study: sweeps that are even on log axes, and what a row's name promises."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.evaluation.study import RESOLUTIONS, STEP_COUNTS, settings
from nerg_mi.evaluation.study_subject import open_subject


@pytest.fixture(scope="module")
def rows():
    return settings(
        SimpleNamespace(marched=True, hits=False, extent=2.0, has_gaze=True, normalized=True, resampled=True)
    )


def test_sweeps_are_even_on_a_log_axis(rows):
    steps = lambda group: [2.0 / r.params["step"] for r in rows if r.group == group]
    sweeps = {
        "steps": steps("steps, linear"),
        "resolutions": [r.resolution for r in rows if re.fullmatch(r"grid \d+, cells", r.name)],
        "dt_gamma": [r.params["dt_gamma"] for r in rows if r.group == "dt_gamma"],
        "coarse": [r.params["coarse"] for r in rows if r.group == "coarse"],
        "steps at a grid": [2.0 / r.params["step"] for r in rows if re.fullmatch(r"grid 64, cells, \d+ steps", r.name)],
        "map heights": [r.params["map_height"] for r in rows if "map_height" in r.params and not r.first_frame],
        "tolerances": [r.params["integral_tolerance"] for r in rows if r.group == "integral"][1:],
        "samples": [r.spp for r in rows if r.group == "spp"],
    }
    for name, values in sweeps.items():
        ratios = np.divide(values[1:], values[:-1])
        assert len(values) >= 3 and np.allclose(ratios, ratios[0]) and ratios[0] in (2, 4), (name, values)
    assert tuple(sweeps["steps"]) == STEP_COUNTS and tuple(sweeps["resolutions"]) == RESOLUTIONS


def test_a_sweep_ends_before_what_the_factor_is_without(rows):
    """The default stands for them: steps that do not grow, and nothing coarser than a step."""
    assert min(r.params["coarse"] for r in rows if r.group == "coarse") > 1
    assert min(r.params["dt_gamma"] for r in rows if r.group == "dt_gamma") > 0


def test_rows_do_what_their_names_say(rows):
    for row in rows:
        assert row.first_frame == row.name.endswith("first frame"), row.name
        if found := re.search(r"(\d+) steps", row.name):
            n = row.paper[0] if row.paper else 2.0 / row.params["step"]
            assert n == int(found[1]), row.name
        if found := re.search(r"dt_gamma 1/(\d+)", row.name):
            gamma = row.paper[1] if row.paper else row.params["dt_gamma"]
            assert gamma == 1 / int(found[1]), row.name
        elif row.paper:
            assert row.paper[1] == 0, row.name


@pytest.mark.parametrize("has_gaze", [True, False])
def test_gaze_is_left_out_where_there_is_one(has_gaze):
    subject = SimpleNamespace(marched=True, hits=False, extent=2.0, has_gaze=has_gaze, normalized=False, resampled=True)
    left_out = {r.name: r.params.get("aovs", "") for r in settings(subject) if r.group == "leave out"}
    assert ("no gaze" in left_out) == has_gaze and all("gaze" not in aovs for aovs in left_out.values())
    assert not has_gaze or "visibility" in left_out["no gaze"]


@pytest.mark.parametrize("normalized", [True, False])
def test_integrals_are_varied_where_there_are_any(normalized):
    subject = SimpleNamespace(
        marched=True, hits=False, extent=2.0, has_gaze=True, normalized=normalized, resampled=False
    )
    found = [r.params["integral_tolerance"] for r in settings(subject, quick=True) if r.group == "integral"]
    assert found == ([0.0, 5e-3] if normalized else [])


def test_settings_vary_one_factor_at_a_time():
    subject = open_subject("slab", "auto", 12, 8)
    rows = settings(subject)
    assert rows[0].name == "default" and not rows[0].params
    names = [r.name for r in rows]
    assert len(set(names)) == len(names)
    for rule in ("constant", "linear"):
        assert {r.params["step"] for r in rows if r.group == f"steps, {rule}"} == {
            subject.extent / n for n in STEP_COUNTS
        }
    groups = {r.group for r in rows}
    assert groups >= {
        "dt_gamma",
        "coarse",
        "stop",
        "color_cutoff",
        "depth",
        "visibility",
        "jitter",
        "leave out",
        "spp",
        "resolution",
        "paper",
    }


def test_a_quick_study_is_a_part_of_a_whole_one():
    subject = open_subject("slab", "auto", 12, 8)
    whole = {r.name for r in settings(subject)}
    quick = [r for r in settings(subject, quick=True) if r.group not in ("visibility", "spp", "paper")]
    assert len(quick) > 15 and {r.name for r in quick} <= whole
