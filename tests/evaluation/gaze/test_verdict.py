"""The verdict on constructed scores: better, worse, undecided, too few, and what speaks for two things at once."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.evaluation.gaze_report import BETTER, UNDECIDED, WORSE, Comparison, Lead, judge, lead_of, widening


def row(method, bits, cc, kld, reach=0.05, gap=None):
    """Scores with intervals of ``reach`` either way; ``gap``: that of the field's lead, where it is known."""
    values = {"bits": bits, "CC": cc, "KLD": kld}
    out = {"method": method, **values}
    for name, value in values.items():
        out |= {f"{name}.low": value - reach, f"{name}.high": value + reach}
        if gap is not None:
            out |= {f"{name}.gap.low": -gap, f"{name}.gap.high": gap}
    return out


def scored(field, nearest=(0.4, 0.65, 0.55), **more):
    return [
        row("gaze field", *field, **more),
        row("uniform", -0.5, 0.0, 1.0, **more),
        row("position-blind", 0.0, 0.4, 0.75, **more),
        row("position-blind, kappa 50", -0.1, 0.38, 0.8, **more),
        row("4,096 nearest rays", *nearest, **more),
        {"method": "split half", "bits": 0.1, "CC": 0.7, "KLD": 0.9},
    ]


@pytest.mark.parametrize(
    "field, grade, words",
    [
        ((0.9, 0.85, 0.3), "use", "Better than nearest rays, the strongest baseline, for new people at new places."),
        ((0.42, 0.66, 0.54), "limited", "whether it is better than nearest rays is undecided with 30 people"),
        ((0.2, 0.5, 0.65), "limited", "worse than nearest rays for new people at new places: use the rays"),
        ((0.01, 0.41, 0.74), "unclear", "Not shown to be better than position-blind for new people"),
        ((-0.3, 0.2, 0.95), "reject", "Worse than position-blind for new people at new places: do not use."),
        ((-0.9, -0.3, 1.6), "reject", "Worse than knowing nothing for new people at new places: do not use."),
    ],
)
def test_each_grade(field, grade, words):
    verdict = judge(scored(field, reach=0.02), "both", 30, 60)
    assert verdict.grade == grade and words in verdict.sentence
    assert verdict.sentence.count(".") == 1 and verdict.sentence.endswith(".")


@pytest.mark.parametrize("people, positions", [(4, 60), (30, 9), (0, 0), (1, 1)])
def test_never_a_verdict_from_too_few(people, positions):
    verdict = judge(scored((0.9, 0.85, 0.3), reach=0.0), "pos", people, positions)
    assert verdict.grade == "none" and verdict.comparisons == () and "too few" in verdict.sentence
    assert judge(scored((0.9, 0.85, 0.3)), "pos", 5, 10).grade != "none"


def test_wide_intervals_decide_nothing():
    assert judge(scored((0.9, 0.85, 0.3), reach=2.0), "both", 30, 60).grade == "unclear"
    assert judge(scored((-0.9, -0.3, 1.6), reach=9.0), "both", 30, 60).grade == "unclear"


def test_scores_that_contradict_each_other_decide_nothing():
    leads = lambda *ends: tuple(Lead("x", (a + b) / 2, a, b) for a, b in ends)
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
        ("position-blind", "Better than position-blind, the strongest baseline, and than nearest rays for"),
        ("position-blind, kappa 50", "Better than position-blind, the strongest baseline, and than nearest rays for"),
        ("uniform", "Better than uniform, the strongest baseline, and than nearest rays for"),
        ("16 nearest probes", "Better than 16 nearest probes, the strongest baseline, and than nearest rays for"),
        ("4,096 nearest rays", "Better than nearest rays, the strongest baseline, for"),
    ],
)
def test_the_strongest_baseline_is_named(strongest, words):
    rows = [*scored((0.9, 0.85, 0.3), reach=0.02), row("16 nearest probes", 0.1, 0.5, 0.6, 0.02)]
    next(r for r in rows if r["method"] == strongest).update(row(strongest, 0.5, 0.6, 0.6, 0.02))
    verdict = judge(rows, "both", 30, 60)
    assert verdict.grade == "use" and verdict.sentence.startswith(words)
    # The other half of the people is no baseline, however well it does.
    rows[5]["bits"] = 2.0
    assert judge(rows, "both", 30, 60).sentence == verdict.sentence


def test_a_baseline_stronger_than_nearest_rays_decides_too():
    rows = lambda bits, reach: [*scored((0.9, 0.85, 0.3), reach=0.02), row("16 nearest probes", bits, *reach)]
    better = judge(rows(1.2, (0.9, 0.2, 0.02)), "both", 30, 60)
    assert better.grade == "limited" and "worse than 16 nearest probes for" in better.sentence
    level = judge(rows(0.91, (0.84, 0.31, 0.2)), "both", 30, 60)
    assert level.grade == "limited" and "better than 16 nearest probes is undecided" in level.sentence
    assert {c.reference for c in level.comparisons} >= {"uniform", "position-blind", "16 nearest probes"}


def test_the_stronger_of_the_blind_densities_is_the_reference():
    rows = scored((0.2, 0.5, 0.65), reach=0.02)
    rows[3] |= row("position-blind, kappa 50", 0.35, 0.6, 0.6, 0.02)
    assert judge(rows, "both", 30, 60).grade == "reject"


def test_missing_numbers_and_methods():
    rows = scored((0.9, 0.85, 0.3), reach=0.02)
    assert judge([r | {"bits": None} for r in rows], "both", 30, 60).grade == "use"
    assert judge(
        [{k: None if k in ("bits", "CC") else v for k, v in r.items()} for r in rows], "both", 30, 60
    ).grade == ("unclear")
    assert "not compared with nearest rays" in judge(rows[:4], "both", 30, 60).sentence
    assert judge(rows[:2], "both", 30, 60).grade == "none"
    bare = [{k: v for k, v in r.items() if "." not in k} for r in rows]
    assert judge(bare, "both", 30, 60).grade == "unclear"


def test_the_lead_by_its_own_interval_is_sharper_than_by_two():
    field, other = row("f", 0.6, 0.7, 0.5, 0.2), row("o", 0.4, 0.6, 0.6, 0.2)
    wide = lead_of(field, other, "bits", 30)
    assert wide.value == pytest.approx(0.2) and wide.high - wide.value == pytest.approx(0.4 * widening(30))
    paired = lead_of(field, row("o", 0.4, 0.6, 0.6, 0.2, gap=0.1), "bits", 30)
    assert paired.outcome == BETTER and wide.outcome == UNDECIDED
    # Less KLD is better.
    assert lead_of(field, other, "KLD", 30).value == pytest.approx(0.1)


def test_intervals_for_few_people_cover_as_they_should():
    """Leads of n people drawn from a normal law around zero: 95 of 100 intervals hold zero, and those without the
    widening far fewer."""
    rng, n, trials = np.random.default_rng(0), 6, 4000
    x = rng.normal(size=(trials, n))
    reach = 1.96 * x.std(axis=1) / np.sqrt(n)  # what a bootstrap of the mean has in the limit of many resamples
    mean = np.abs(x.mean(axis=1))
    assert np.mean(mean <= reach * widening(n)) == pytest.approx(0.95, abs=0.012)
    assert np.mean(mean <= reach) < 0.88
    assert widening(10**6) == pytest.approx(1, abs=1e-3)


def test_the_way_to_the_other_half_of_the_people():
    verdict = judge(scored((0.3, 0.55, 0.6)), "both", 30, 60)
    assert verdict.half == pytest.approx((0.55 - 0.4) / (0.7 - 0.4))
    assert judge(scored((0.3, 0.55, 0.6))[:5], "both", 30, 60).half is None
