"""Tests of `nerg_mi.evaluation.gaze_report`."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.stats import spearmanr

from nerg_mi.errors import NergError
from nerg_mi.evaluation import gaze, gaze_report, metrics, uncertainty
from nerg_mi.evaluation.baselines import CONDITIONAL_KDE, NEAREST_RAYS, PRIOR, UNIFORM
from nerg_mi.evaluation.gaze_report import (
    BETTER,
    UNDECIDED,
    WORSE,
    Comparison,
    ScoreDifference,
    Verdict,
    compare_scores,
    compute_verdict,
    draw_comparison,
    explain_verdict,
    format_table,
    read_results,
    small_sample_factor,
    write_report,
)
from nerg_mi.evaluation.uncertainty import summarise_folds
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.probes import REGION_LEVELS, calibrate_levels, compute_region_levels, format_level
from tests.evaluation.test_gaze import crowd

# ---- Output of an evaluation of gaze: cells computed by hand, valid files, and requested pictures ----

ROWS = [
    {
        "method": "field",
        "KLD": 0.51234,
        "KLD.low": 0.4,
        "KLD.high": 0.65,
        "CC": 0.9,
        "MAE": 0.012345,
        "KLD.less": -0.25,
        "NSS": math.nan,
    },
    {"method": "uniform", "KLD": 1.5, "CC": 0.0, "MAE": 0.05, "integral": 1.0},
    {"method": "split half", "KLD": 0.25},
]


def test_a_table_by_hand():
    assert format_table(ROWS, ("method", "KLD", "CC", "MAE", "NSS", "integral", "AUC")).splitlines() == [
        "| method | KLD | CC | MAE | NSS | integral |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        "| field | 0.512 [0.400, 0.650] | 0.900 | 0.0123 |  |  |",
        "| uniform | 1.500 | 0.000 | 0.0500 |  | 1.000 |",
        "| split half | 0.250 |  |  |  |  |",
    ]
    people = format_table([{"method": "a", "person": "ann", "rays": 12}], ("method", "person", "rays"))
    assert people.splitlines()[1:] == ["| --- | --- | ---: |", "| a | ann | 12 |"]


def test_files(tmp_path):
    persons = [{"method": "field", "person": "ann", "rays": 3, "KLD": 0.5, "NSS": math.nan}]
    files = write_report(tmp_path, ROWS, persons, {"seed": 4}, "notes")
    page = files[0].read_text()
    # The field is compared with the last of the baselines, and the split half is not a baseline.
    assert page.startswith("notes\n") and "| field less uniform | -0.250 |" in page
    assert "| field | ann | 3 | 0.500 |  |" in page
    with open(files[1], newline="") as f:
        rows = list(csv.DictReader(f))
    assert [r["method"] for r in rows] == ["field", "uniform", "split half"] and float(rows[0]["MAE"]) == 0.012345  # noqa: RUF069 (stored)
    provenance = json.loads(files[3].read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert (
        provenance["seed"] == 4 and provenance["methods"][0]["NSS"] is None and provenance["persons"][0]["NSS"] is None
    )
    assert provenance["methods"][0]["KLD"] == 0.51234 and provenance["persons"][0]["rays"] == 3  # noqa: RUF069 (stored)


def test_pictures_are_on_the_scale_of_the_reference(tmp_path, monkeypatch):
    d = fibonacci_directions(500)
    centres = np.arange(15.0).reshape(5, 3)
    truth = np.exp(3 * d @ np.array([1.0, 0, 0])) * np.arange(1, 6)[:, None]
    counts = np.array([[3, 0, 4], [1, 1, 1], [1, 1, 1], [1, 1, 1], [900, 600, 0]])
    test, drawn = SimpleNamespace(centres=centres, directions=d, truth=truth, counts=counts), []
    monkeypatch.setattr(gaze_report, "save", lambda figure, path, provenance: drawn.append(figure))
    calls = []

    def twice(positions, directions):
        calls.append(positions)
        return 2 * np.exp(3 * directions[:, 0]) * np.ones((len(positions), 1))

    draw_comparison(test, {"twice": twice}, tmp_path / "a.png", count=2, height=8)
    images = [a for a in drawn[0].axes if a.images]
    # Each row has its own scale with a colour bar.
    scales = [a for a in drawn[0].axes if a not in images]
    assert len(scales) == 2 and all("1/sr" in a.get_ylabel() for a in scales)
    assert [tuple(a.get_ylim()) for a in scales] == [images[k].images[0].get_clim() for k in (0, 2)]
    assert np.array_equal(calls[0], centres[[0, 4]]) and [a.get_title() for a in images] == [
        "reference",
        "twice",
        "",
        "",
    ]
    assert "0.0, 1.0, 2.0 m\n7 samples of 2 participants" in images[0].get_ylabel()
    assert "12.0, 13.0, 14.0 m\n1,500 samples of 2 participants" in images[2].get_ylabel()
    assert all("elevation" in a.get_ylabel() and "degrees" in a.get_ylabel() for a in images[::2])
    assert ["azimuth" in a.get_xlabel() and "degrees" in a.get_xlabel() for a in images] == [False, False, True, True]
    # The brightest direction of the reference, +x, is at its azimuth and elevation.
    row, column = np.unravel_index(np.argmax(images[0].images[0].get_array()), (8, 16))
    left, right, bottom, top = images[0].images[0].get_extent()
    assert abs(left + (column + 0.5) / 16 * (right - left) - 90) < 25
    assert abs(top - (row + 0.5) / 8 * (top - bottom)) < 25
    for a, b in (images[:2], images[2:]):
        # One scale per row.
        assert a.images[0].get_clim() == b.images[0].get_clim() and a.images[0].get_clim()[0] == 0
        shown = [np.asarray(x.images[0].get_array()) for x in (a, b)]
        row = 1 if a is images[0] else 5
        # The nearest directions of the truth differ by up to a tenth of a radian.
        assert shown[0].shape == (8, 16) and np.allclose(2 * shown[0], row * shown[1], rtol=0.6)


# ---- Results are read as written, and other files are refused with one sentence ----

RESULTS_ROWS = [
    {"method": "gaze field", "bits": 0.5, "KLD": float("nan")},
    {"method": "uniform", "bits": 0.0, "KLD": 1.0},
]

PERSONS = [{"method": "gaze field", "person": "Ada", "rays": 4, "bits": 0.1}]
METADATA = {"gaze": "g.safetensors", "split": "both", "kappa": 20.0, "positions": 12}


def test_results_are_read_back(tmp_path):
    write_report(tmp_path, RESULTS_ROWS, PERSONS, {**METADATA, "people": 7, "gaze_sha256": "ab"}, "# notes")
    result = read_results(tmp_path / "gaze.json")
    assert (result.gaze, result.split, result.num_positions, result.num_participants, result.sha256) == (
        "g.safetensors",
        "both",
        12,
        7,
        "ab",
    )
    assert (
        result.rows[0]["KLD"] is None
        and result.rows[1]["KLD"] == pytest.approx(1.0)
        and result.participant_rows[0]["person"] == "Ada"
    )


def test_old_names_of_methods_are_read(tmp_path):
    rows = [RESULTS_ROWS[0], {"method": "position-blind"}, {"method": "position-blind, kappa 50"}]
    write_report(tmp_path, rows, [], METADATA, "")
    methods = [row["method"] for row in read_results(tmp_path / "gaze.json").rows]
    assert methods == ["gaze field", "position-independent prior", "position-independent prior, kappa 50"]


@pytest.mark.parametrize(
    "change",
    [
        [],
        {"gaze": 1},
        {"methods": []},
        {"methods": [{"bits": 1}]},
        {"methods": [{"method": "a", "bits": "1"}]},
        {"methods": {"a": 1}},
        {"positions": -1},
        {"positions": True},
        {"people": "three"},
        {"split": "x" * 999},
        {"kappa": None},
        {"persons": [{"method": "m", "person": ["a"]}]},
    ],
)
def test_invalid_results_are_refused(tmp_path, change):
    path = tmp_path / "gaze.json"
    full = {**METADATA, "methods": RESULTS_ROWS[1:], "persons": PERSONS}
    path.write_text(json.dumps(change if isinstance(change, list) else {**full, **change}))
    with pytest.raises(NergError, match='"nerg eval gaze"'):
        read_results(path)
    path.write_text(json.dumps(full))
    assert read_results(path).num_participants == 1


# ---- Verdict ----
#
# The verdict on synthetic scores: better, worse, undecided, too few, and ambiguous cases.


def row(method, bits, cc, kld, reach=0.05, gap=None):
    """Scores with intervals of ± ``reach``; ``gap`` is that of the difference to the field, if known."""
    values = {"bits": bits, "CC": cc, "KLD": kld}
    out = {"method": method, **values}
    for name, value in values.items():
        out |= {f"{name}.low": value - reach, f"{name}.high": value + reach}
        if gap is not None:
            out |= {f"{name}.gap.low": -gap, f"{name}.gap.high": gap}
    return out


def scored(field, nearest=(0.4, 0.65, 0.55), **options):
    return [
        row("gaze field", *field, **options),
        row("uniform", -0.5, 0.0, 1.0, **options),
        row("position-independent prior", 0.0, 0.4, 0.75, **options),
        row("position-independent prior, kappa 50", -0.1, 0.38, 0.8, **options),
        row("nearest rays", *nearest, **options),
        {"method": "split half", "bits": 0.1, "CC": 0.7, "KLD": 0.9},
    ]


@pytest.mark.parametrize(
    "field, grade, words",
    [
        (
            (0.9, 0.85, 0.3),
            "use",
            "Better than the nearest rays, the strongest baseline, for held-out participants at held-out positions.",
        ),
        ((0.42, 0.66, 0.54), "limited", "the comparison with the nearest rays is undecided with 30 participants"),
        (
            (0.2, 0.5, 0.65),
            "limited",
            "worse than the nearest rays for held-out participants at held-out positions: use the rays directly",
        ),
        (
            (0.01, 0.41, 0.74),
            "unclear",
            "Not shown to be better than the position-independent prior for held-out participants",
        ),
        (
            (-0.3, 0.2, 0.95),
            "reject",
            "Worse than the position-independent prior for held-out participants at held-out positions: do not use.",
        ),
        (
            (-0.9, -0.3, 1.6),
            "reject",
            "Worse than the uniform density for held-out participants at held-out positions: do not use.",
        ),
    ],
)
def test_each_grade(field, grade, words):
    verdict = compute_verdict(scored(field, reach=0.02), "both", 30, 60)
    assert verdict.grade == grade and words in verdict.sentence
    assert verdict.sentence.count(".") == 1 and verdict.sentence.endswith(".")


@pytest.mark.parametrize("people, positions", [(4, 60), (30, 9), (0, 0), (1, 1)])
def test_no_verdict_from_too_few_participants(people, positions):
    verdict = compute_verdict(scored((0.9, 0.85, 0.3), reach=0.0), "pos", people, positions)
    assert verdict.grade == "none" and verdict.comparisons == () and "too few" in verdict.sentence
    assert compute_verdict(scored((0.9, 0.85, 0.3)), "pos", 5, 10).grade != "none"


def test_contradicting_scores_are_undecided():
    leads = lambda *ends: tuple(ScoreDifference("x", (a + b) / 2, a, b) for a, b in ends)
    good, bad, open_ = (0.1, 0.3), (-0.3, -0.1), (-0.1, 0.2)
    cases = [
        ((good, good, good), BETTER),
        ((good, good, open_), BETTER),
        ((good, open_, open_), UNDECIDED),
        ((good, good, bad), UNDECIDED),
        ((bad, bad, good), UNDECIDED),
        ((bad, open_, bad), WORSE),
        ((bad, open_, open_), UNDECIDED),
        (((np.nan, np.nan), good, open_), UNDECIDED),
        (((0.0, 0.1), (0.0, 0.1), (0.0, 0.1)), UNDECIDED),
    ]
    for ends, outcome in cases:
        assert Comparison("r", leads(*ends)).outcome == outcome, ends


@pytest.mark.parametrize(
    "strongest, words",
    [
        (
            "position-independent prior",
            "Better than the position-independent prior, the strongest baseline, and than the nearest rays for",
        ),
        (
            "position-independent prior, kappa 50",
            "Better than the position-independent prior, the strongest baseline, and than the nearest rays for",
        ),
        ("uniform", "Better than the uniform density, the strongest baseline, and than the nearest rays for"),
        (
            "conditional kernel density",
            "Better than the conditional kernel density, the strongest baseline, and than the nearest rays for",
        ),
        ("nearest rays", "Better than the nearest rays, the strongest baseline, for"),
    ],
)
def test_the_strongest_baseline_is_named(strongest, words):
    rows = [*scored((0.9, 0.85, 0.3), reach=0.02), row("conditional kernel density", 0.1, 0.5, 0.6, 0.02)]
    next(r for r in rows if r["method"] == strongest).update(row(strongest, 0.5, 0.6, 0.6, 0.02))
    verdict = compute_verdict(rows, "both", 30, 60)
    assert verdict.grade == "use" and verdict.sentence.startswith(words)
    # The split half is not a baseline, however good it is.
    rows[5]["bits"] = 2.0
    assert compute_verdict(rows, "both", 30, 60).sentence == verdict.sentence


def test_a_stronger_baseline_is_also_compared():
    rows = lambda bits, half_width: [
        *scored((0.9, 0.85, 0.3), reach=0.02),
        row("conditional kernel density", bits, *half_width),
    ]
    better = compute_verdict(rows(1.2, (0.9, 0.2, 0.02)), "both", 30, 60)
    assert better.grade == "limited" and "worse than the conditional kernel density for" in better.sentence
    level = compute_verdict(rows(0.91, (0.84, 0.31, 0.2)), "both", 30, 60)
    assert level.grade == "limited" and "with the conditional kernel density is undecided" in level.sentence
    assert {c.reference for c in level.comparisons} >= {UNIFORM, PRIOR, CONDITIONAL_KDE}


def test_the_stronger_of_the_priors_is_the_reference():
    rows = scored((0.2, 0.5, 0.65), reach=0.02)
    rows[3] |= row("position-independent prior, kappa 50", 0.35, 0.6, 0.6, 0.02)
    assert compute_verdict(rows, "both", 30, 60).grade == "reject"


def test_missing_numbers_and_methods():
    rows = scored((0.9, 0.85, 0.3), reach=0.02)
    assert compute_verdict([r | {"bits": None} for r in rows], "both", 30, 60).grade == "use"
    assert compute_verdict(
        [{k: None if k in ("bits", "CC") else v for k, v in r.items()} for r in rows], "both", 30, 60
    ).grade == ("unclear")
    assert "not compared with the nearest rays" in compute_verdict(rows[:4], "both", 30, 60).sentence
    assert compute_verdict(rows[:2], "both", 30, 60).grade == "none"
    bare = [{k: v for k, v in r.items() if "." not in k} for r in rows]
    without = compute_verdict(bare, "both", 30, 60)
    assert without.grade == "none" and "intervals" in without.sentence


def test_paired_interval_is_narrower_than_two_intervals():
    field, other = row("f", 0.6, 0.7, 0.5, 0.2), row("o", 0.4, 0.6, 0.6, 0.2)
    wide = compare_scores(field, other, "bits", 30)
    assert wide.value == pytest.approx(0.2) and wide.high - wide.value == pytest.approx(0.4 * small_sample_factor(30))
    paired = compare_scores(field, row("o", 0.4, 0.6, 0.6, 0.2, gap=0.1), "bits", 30)
    assert paired.outcome == BETTER and wide.outcome == UNDECIDED
    # Lower KLD is better.
    assert compare_scores(field, other, "KLD", 30).value == pytest.approx(0.1)


def test_small_sample_intervals_have_nominal_coverage():
    """Differences of n participants drawn from a normal distribution around zero: 95 of 100 intervals contain zero, and
    far fewer without the widening.
    """
    rng, n, trials = np.random.default_rng(0), 6, 4000
    x = rng.normal(size=(trials, n))
    half_width = (
        1.96 * x.std(axis=1) / np.sqrt(n)
    )  # half-width of a bootstrap of the mean in the limit of many resamples
    mean = np.abs(x.mean(axis=1))
    assert np.mean(mean <= half_width * small_sample_factor(n)) == pytest.approx(0.95, abs=0.012)
    assert np.mean(mean <= half_width) < 0.88
    assert small_sample_factor(10**6) == pytest.approx(1, abs=1e-3)


def test_verdicts_are_explained_with_their_terms():
    """The grades of `compute_verdict`, and the terms in parentheses."""
    texts = {}
    for grade in ("use", "limited", "unclear", "reject", "none"):
        for outcome in (1.0, 0.0):
            difference = ScoreDifference("bits", outcome, outcome - 0.5, outcome + 0.5)
            verdict = Verdict(grade, "", (Comparison(NEAREST_RAYS, (difference, difference)),))
            texts[grade, outcome] = explain_verdict(verdict, "pos")
            assert '(split "pos")' in texts[grade, outcome]
    assert texts["use", 1.0] != texts["limited", 1.0] != texts["limited", 0.0]
    assert len(set(texts.values())) == 6
    assert all(f"({PRIOR})" in texts[grade, 1.0] for grade in ("use", "limited", "unclear"))


def test_noisy_split_half_of_old_files_is_left_out(tmp_path):
    rows = [{"method": "gaze field", "bits": 0.5}, {"method": "split half", "bits": -11.0}]
    data = {"gaze": "g", "split": "both", "positions": 20, "people": 30, "methods": rows}
    for people, bits, is_kept in ((30, -11.0, False), (9, 0.3, False), (10, 0.3, True)):
        rows[1]["bits"], data["people"] = bits, people
        (tmp_path / "gaze.json").write_text(json.dumps(data))
        results = read_results(tmp_path / "gaze.json")
        assert (len(results.rows) == 2) == is_kept == (not results.split_half_note)


def test_split_half_fraction():
    verdict = compute_verdict(scored((0.3, 0.55, 0.6)), "both", 30, 60)
    assert verdict.split_half_fraction == pytest.approx((0.55 - 0.4) / (0.7 - 0.4))
    assert compute_verdict(scored((0.3, 0.55, 0.6))[:5], "both", 30, 60).split_half_fraction is None


# ---- Means over folds ----


def fold(ours, bar, half=None):
    rows = [{"method": "gaze field", "KLD": ours, "integral": 1.0}, {"method": "nearest", "KLD": bar}]
    return rows + ([] if half is None else [{"method": "split half", "KLD": half}])


def test_means_intervals_and_differences_of_pairs():
    ours, bars = np.array([0.4, 0.6, 0.5]), np.array([0.7, 0.8, 0.75])
    rows = {row["method"]: row for row in summarise_folds([fold(a, b) for a, b in zip(ours, bars)])}
    assert list(rows) == ["gaze field", "nearest", "gaze field less nearest"]
    # SciPy's interval of a mean.
    low, high = stats.ttest_1samp(ours, 0).confidence_interval(0.95)
    field = rows["gaze field"]
    assert (field["KLD"], field["KLD.low"], field["KLD.high"]) == pytest.approx((0.5, low, high))
    assert field["folds"] == 3 and field["integral.low"] == field["integral.high"] == pytest.approx(1.0)
    low, high = stats.ttest_rel(ours, bars).confidence_interval(0.95)
    less = rows["gaze field less nearest"]
    assert (less["KLD"], less["KLD.low"], less["KLD.high"]) == pytest.approx((-0.25, low, high))


def test_missing_scores_of_folds_are_skipped():
    rows = {row["method"]: row for row in summarise_folds([fold(0.4, 0.7, 0.2), fold(0.6, math.nan)])}
    assert rows["split half"] == {"method": "split half", "folds": 1, "KLD": 0.2}
    assert rows["nearest"]["KLD"] == pytest.approx(0.7) and "KLD.low" not in rows["nearest"]
    # The comparison is with the last method, not with the split half.
    assert "gaze field less nearest" in rows and summarise_folds([fold(1, 2)[:1]])[0]["KLD"] == 1


# ---- Ranks, risks and regions ----


def row_uncertainty(support, error, group, **options):
    return {"support": support, "KLD": error, "group": group, **options}


@pytest.fixture(scope="module")
def evaluation():
    """Test data of four participants, and two methods: a map and the uniform density."""
    centres = np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6], [-0.5, -3, 1.6]])
    test = gaze.make_test(crowd(), centres, 0.6, 20.0, 256, min_rays=20)
    return test, test.truth[::-1], np.full_like(test.truth, 1 / (4 * np.pi))


def test_low_support_correlates_with_errors():
    rng = np.random.default_rng(0)
    support = rng.integers(0, 40, 60)
    error = 1 / (1 + support) + rng.normal(0, 0.1, 60)
    rows = [row_uncertainty(s, e, str(i // 6)) for i, (s, e) in enumerate(zip(support, error))]
    (result,) = uncertainty.correlate_uncertainty(rows)
    assert result["signal"] == "support" and result["error"] == "KLD" and result["positions"] == 60
    assert result["rho"] == pytest.approx(spearmanr(-support, error)[0])
    assert result["rho.low"] < result["rho"] < result["rho.high"]
    assert result["100%"] == pytest.approx(error.mean()) and result["25%"] < result["50%"] < result["100%"]


def test_spread_correlates_with_errors_and_few_groups_have_no_interval():
    rows = [row_uncertainty(5.0, float(k), str(k % 4), spread=float(k), excess=-float(k)) for k in range(12)]
    result = {(r["signal"], r["error"]): r for r in uncertainty.correlate_uncertainty(rows)}
    assert result["spread", "KLD"]["rho"] == pytest.approx(1) and result["spread", "excess"]["rho"] == pytest.approx(-1)
    assert result["spread", "KLD"]["25%"] == 1 and "rho.low" not in result["spread", "KLD"]
    # A constant signal has no rank, and all positions count.
    same = result["support", "KLD"]
    assert math.isnan(same["rho"]) and same["25%"] == same["100%"] == pytest.approx(5.5)


def test_position_rows_have_their_errors(evaluation):
    test, maps, uniform = evaluation
    rows = uncertainty.score_positions(test, maps, uniform, support=np.array([1, 2, 3]), groups=["a", "a", "b"])
    assert [r["group"] for r in rows] == ["a", "a", "b"] and [r["support"] for r in rows] == [1, 2, 3]
    expected = metrics.kld(test.truth, test.smooth(maps), eps=1e-6)
    assert [r["KLD"] for r in rows] == pytest.approx(expected.tolist()) and "spread" not in rows[0]
    # The four participants look at different heights, so one half predicts the other worse than itself.
    assert all(0 < r["half"] < r["prior"] and r["excess"] == r["KLD"] - r["half"] for r in rows)
    halves = [[r["half"] for r in uncertainty.score_positions(test, maps, uniform, seed=seed)] for seed in (1, 2)]
    assert halves[0] != halves[1]
    np.testing.assert_allclose(halves[1], uncertainty.compute_split_half_errors(test, test.smooth(uniform), 2))
    alone = gaze.make_test(crowd(people=1), test.centres, 0.6, 20.0, 256, min_rays=20)
    assert "half" not in uncertainty.score_positions(alone, maps, uniform)[0]


def test_equal_halves_agree():
    test = gaze.make_test(crowd(20_000), np.array([[-0.5, 0, 1.6]]), 0.6, 20.0, 256, max_rays=4096)
    distances = uncertainty.compute_split_half_errors(test, np.zeros_like(test.truth))
    alike = type(test)(**{**vars(test), "participant_densities": np.repeat(test.truth[:, None], 4, axis=1)})
    assert uncertainty.compute_split_half_errors(alike, np.zeros_like(test.truth)) == pytest.approx(
        -np.log(1), abs=1e-6
    )
    assert distances[0] > 0.05


def test_split_half_error_of_two_participants():
    """Each half is one participant, so all random halves have the same error, in both directions."""
    rng, num = np.random.default_rng(0), 64
    test = gaze.make_test(crowd(people=2), np.array([[-0.5, 0, 1.6]]), 0.6, 20.0, num, min_rays=20)
    a, b, prior = rng.uniform(0.1, 2, (3, num))
    test = replace(test, participant_densities=np.stack([a, b])[None], counts=np.full((1, 2), 50.0))
    normalise = lambda v: v / v.mean()
    divergence = lambda p, q: np.mean(normalise(p) * np.log(normalise(p) / normalise(q)))
    expected = (divergence(a, 0.8 * b + 0.2 * prior) + divergence(b, 0.8 * a + 0.2 * prior)) / 2
    np.testing.assert_allclose(uncertainty.compute_split_half_errors(test, prior[None]), expected, rtol=1e-4)


def test_interval_of_correlations_draws_groups():
    """Quantiles of Spearman's correlation over draws of whole groups, each of positions that agree."""
    rng, groups, size, count = np.random.default_rng(2), 6, 5, 400
    group = np.repeat(np.arange(groups), size)
    support, kld = rng.normal(size=(2, groups))[:, group] + 1e-3 * rng.normal(size=(2, groups * size))
    rows = [{"support": s, "KLD": e, "group": str(g)} for s, e, g in zip(support, kld, group)]
    (row,) = uncertainty.correlate_uncertainty(rows, count, seed=7)
    assert row["rho"] == pytest.approx(spearmanr(-support, kld).statistic)
    draws = np.random.default_rng(7)
    values = []
    for _ in range(count):
        taken = np.concatenate([np.flatnonzero(group == g) for g in draws.integers(0, groups, groups)])
        values.append(spearmanr(-support[taken], kld[taken]).statistic)
    np.testing.assert_allclose([row["rho.low"], row["rho.high"]], np.quantile(values, [0.025, 0.975]), atol=1e-6)


def test_interval_of_coverage_draws_participants(evaluation):
    """1.96 standard deviations of the coverage over draws of whole participants."""
    test, maps, _ = evaluation
    at = np.random.default_rng(3).uniform(0, maps.max(), test.sample_participants.shape)
    # The rays of the first participant are at the lowest densities.
    at[test.sample_participants == 0] = 0
    (row,) = uncertainty.measure_calibration(test, {"field": (maps, at)}, 50, seed=5)
    num = len(test.participants)
    draws = np.random.default_rng(5).multinomial(num, np.full(num, 1 / num), 50)
    is_inside = compute_region_levels(maps, at) <= 0.8
    inside, total = (
        np.array([np.sum(w[test.sample_participants == p]) for p in range(num)])
        for w in (is_inside, np.ones_like(is_inside, float))
    )
    half_width = 1.96 * np.std(draws @ inside / (draws @ total))
    assert row["80%"] == pytest.approx(is_inside.mean()) and half_width > 0.01
    assert row["80%.high"] - row["80%"] == pytest.approx(half_width) == pytest.approx(row["80%"] - row["80%.low"])


def test_intervals_of_differences_are_widened_for_few_participants():
    """The bootstrap's interval, in the units of Student's t with n - 1 degrees of freedom and of n / (n - 1)."""
    field, other = {"bits": 1.0}, {"bits": 0.4, "bits.gap.low": 0.5, "bits.gap.high": 0.7}
    for count in (3, 5, 50):
        difference = compare_scores(field, other, "bits", count)
        half_width = 0.1 / 1.96 * stats.t.ppf(0.975, count - 1) * math.sqrt(count / (count - 1))
        np.testing.assert_allclose((difference.low, difference.high), (0.6 - half_width, 0.6 + half_width))


def test_interval_of_folds_is_that_of_students_t():
    folds = [[{"method": "field", "bits": v}, {"method": "other", "bits": w}] for v, w in ((1, 0.5), (2, 1), (4, 3.5))]
    field, _, difference = summarise_folds(folds)
    for row, values in ((field, [1, 2, 4]), (difference, [0.5, 1, 0.5])):
        interval = stats.t.interval(0.95, 2, np.mean(values), stats.sem(values))
        assert row["bits"] == pytest.approx(np.mean(values))
        np.testing.assert_allclose((row["bits.low"], row["bits.high"]), interval)


def test_calibrated_regions_have_nominal_coverage(evaluation):
    """Regions of a density that is too narrow have too little coverage; calibrated levels restore it."""
    test, _, _ = evaluation
    rng = np.random.default_rng(1)
    selected = np.stack([rng.choice(256, 4000, p=row / row.sum()) for row in test.truth])
    drawn = type(test)(**{**vars(test), "sample_participants": rng.integers(0, 4, selected.shape)})
    sharp = test.truth**3, np.take_along_axis(test.truth**3, selected, axis=1)
    half = compute_region_levels(sharp[0], sharp[1][:, :2000]).ravel()
    result = calibrate_levels(half, np.ones(len(half)))
    rows = uncertainty.measure_calibration(drawn, {"sharp": sharp, "other": sharp}, 0, 0, {"sharp": result})
    assert [r["method"] for r in rows] == ["sharp", "sharp, calibrated", "other"]
    for share in REGION_LEVELS:
        name = format_level(share)
        assert rows[0][name] == rows[2][name] < share - 0.05 and rows[1][name] == pytest.approx(share, abs=0.03)
