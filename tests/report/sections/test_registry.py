"""Every section: shown from what there is, and told in one sentence where it is left out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nerg_mi.report.sections import SECTIONS, SETTINGS
from tests.report.made import HOSTILE, bare, whole
from tests.report.test_html import Parsed

ABSENT = {"verdict", "data", "people", "gaze", "stage", "objects", "scores"}
"""Sections that need more than a gaze field."""


def text_of(section, run) -> str:
    return Parsed(section.body(run)).text


@pytest.mark.parametrize("section", SECTIONS, ids=lambda s: s.name)
def test_shown_or_left_out_with_a_reason(section):
    assert section.absent(whole()) is None and len(text_of(section, whole())) > 40
    reason = section.absent(bare())
    assert (reason is not None) == (section.name in ABSENT)
    if reason is None:
        assert section.body(bare())
    else:
        assert reason.endswith(".") and len(reason) > 40 and reason.count(".") <= 2


def test_names_are_apart():
    assert len({s.name for s in SECTIONS}) == len({s.title for s in SECTIONS}) == len(SECTIONS)


def test_what_is_said():
    said = {s.name: text_of(s, whole()) for s in SECTIONS}
    assert said["verdict"].startswith("Better than nearest rays, the strongest baseline, for new people at new places.")
    assert "4.00 × 4.00 × 4.00" in said["place"] and "9 that it was trained on" in said["place"]
    assert "400 of 400 rows" in said["data"] and "median number of people within 0.25 m is 3" in said["people"]
    assert "The observer stands somewhere. Densities are in 1/sr" in said["gaze"]
    assert "the mean of all 2" in said["stage"] and "people's paths" in said["stage"]
    assert "25.00 [20.00, 30.00]" in said["objects"] and "3 of 4" in said["objects"]
    assert "lead in KLD, nats" in said["scores"] and "A field is" not in said["scores"]
    assert "mean of 2 fields" in said["uncertainty"] and "CC 0.700, KLD 0.400" in said["uncertainty"]
    assert "3 positions, 1 people, and every ray within 0.5 m" in said["settings"]
    assert "A head is not a gaze" in said["limits"] and "Places are static" in said["limits"]
    assert "ab" * 32 in said["provenance"]


def test_who_was_held_out_is_counted_and_not_named():
    assert "Ada" not in text_of(SETTINGS, replace(whole(), gaze={"provenance": {"test": {"people": ["Ada"]}}}))


def test_shares_that_few_people_could_see_are_hidden():
    objects = next(s for s in SECTIONS if s.name == "objects")
    said = text_of(objects, replace(whole(), least=3))
    assert "otherhidden" in said and "fewer than 3" in said and said.count("25.00") == 2
    assert "hidden" not in text_of(objects, whole())


def test_without_people_there_are_no_intervals_of_shares():
    objects = next(s for s in SECTIONS if s.name == "objects")
    (first, *_) = whole().objects
    alone = replace(first, recorded=None, saw=None, looked=None, people=None)
    said = text_of(objects, replace(whole(), objects=(alone,), eyes=1))
    assert "at 1 place" in said and "rays recorded" not in said


def test_one_split_each():
    both = whole().results[0]
    run = replace(whole(), results=(both, replace(both, split="pos", people=3)))
    verdict, scores = (next(s for s in SECTIONS if s.name == n) for n in ("verdict", "scores"))
    assert "No verdict for known people at new places: 3 people" in text_of(verdict, run)
    assert "Known people at new places (3 people, 60 places)" in text_of(scores, run)
    assert HOSTILE not in scores.body(replace(run, results=(replace(both, split=HOSTILE),)))
