"""The report's HTML: what may stand in it, its sections, and the whole page."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from nerg_mi.report import html
from nerg_mi.report.html import Point, interval_chart, nice_ticks
from nerg_mi.report.sections import SECTIONS, SETTINGS, render_page
from tests.report.made import HOSTILE, PNG, bare, packed_scene, whole

# ---- Charts: values where their scale says, and scales of round numbers ----

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("low, high", [(0, 1), (-2.3, 0.01), (1e-7, 3e-7), (5, 5), (-1e6, 1e9), (0.97, 1.02)])
def test_ticks_are_round_and_span(low, high):
    ticks = nice_ticks(low, high)
    steps = np.diff(ticks)
    assert 2 <= len(ticks) <= 6 and np.allclose(steps, steps[0]) and ticks[0] <= low and ticks[-1] >= high
    digits = f"{steps[0]:.6e}".split("e")[0]
    assert float(digits) in (1, 2, 5)


def test_values_lie_where_their_scale_says():
    points = [Point("a", 0.0, -1.0, 1.0, True), Point("b", 2.0), Point("c", math.nan, math.nan, math.nan)]
    root = ET.fromstring(interval_chart([("score", points), ("other", points)]))
    circles = root.findall(f"{SVG}circle")
    assert len(circles) == 4  # of c nothing is known
    ticks = {t.text: float(t.get("x")) for t in root.findall(f"{SVG}text") if t.get("class") == "faint"}
    assert float(circles[0].get("cx")) < float(circles[1].get("cx"))
    for circle, value in zip(circles[2:], ("0", "2")):
        assert float(circle.get("cx")) == pytest.approx(ticks[value], abs=0.02)
    assert "a 0, b 2, c nan" in root.get("aria-label")


def test_labels_are_text():
    root = ET.fromstring(interval_chart([(HOSTILE, [Point(HOSTILE, 1.0)])]))
    assert {e.tag for e in root.iter()} == {f"{SVG}{t}" for t in ("svg", "text", "line", "circle")}


# ---- Markup by hand: whatever text is given, it stays text ----


class Parsed(HTMLParser):
    """Tags, attributes and text of a piece of markup, as a browser's parser takes them apart."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("text", [HOSTILE, "a < b & c > d", "\"'", "]]>", "<!--", "</p>", "&lt;", "\u2067x\u2069"])
def test_text_stays_text(text):
    shown = "".join(c if c.isprintable() else "?" for c in text)
    found = Parsed(html.element("p", text, title=text, data_name=text))
    assert found.tags == [("p", {"title": shown, "data-name": shown})] and found.text == shown


def test_what_cannot_be_seen_is_shown_as_such():
    assert html.markup("a\u202eb\u200fc\x00d\x1b[0m") == "a?b?c?d?[0m"
    assert html.markup("two\nlines") == "two lines"


def test_markup_is_kept_and_lists_are_joined():
    bold = html.element("b", "x")
    assert html.markup([bold, " & ", 3, None, ["<", bold]]) == "<b>x</b> &amp; 3&lt;<b>x</b>"
    assert html.element("input", type="checkbox", checked=True, disabled=False, name=None) == (
        '<input type="checkbox" checked>'
    )


def test_tables():
    found = html.table(["name", "value"], [["a<b", "1"], ["c", 2.5]], [1])
    parsed = Parsed(found)
    assert [t for t, _ in parsed.tags].count("tr") == 3 and parsed.text == "namevaluea<b1c2.5"
    assert [a for t, a in parsed.tags if t == "td"] == [{}, {"class": "number"}] * 2
    assert Parsed(html.key_value_table([("x", "<y>")])).text == "x<y>"


def test_pictures_are_within_the_page():
    ((_, attributes),) = Parsed(html.image(PNG, "a <picture>")).tags
    assert attributes["src"].startswith("data:image/png;base64,iVBOR") and attributes["alt"] == "a <picture>"
    assert Parsed(html.figure(html.image(PNG, ""), "<words>")).text == "<words>"


# ---- The page: whole, bare, with hostile names, and loading nothing ----

SIZE = 6_000_000


def test_every_section_is_there():
    for run in (whole(), bare()):
        tags = Parsed(render_page(run)).tags
        assert [a["id"] for t, a in tags if t == "section"] == [s.name for s in SECTIONS]
        assert [a["href"] for t, a in tags if t == "a"] == [f"#{s.name}" for s in SECTIONS]


def test_equal_runs_give_equal_bytes():
    assert render_page(whole()) == render_page(whole()) and len(render_page(whole()).encode()) < SIZE


def test_names_never_become_markup():
    tame, hostile = (Parsed(render_page(whole(name))) for name in ("shelf", HOSTILE))
    assert [t for t, _ in hostile.tags] == [t for t, _ in tame.tags]
    keys = lambda found: [sorted(a) for _, a in found.tags]
    assert keys(hostile) == keys(tame)
    assert not any(key.startswith("on") for _, a in hostile.tags for key in a)
    assert "alert(1)" in hostile.text and "\u202e" not in render_page(whole(HOSTILE))


@pytest.mark.parametrize("run", [whole(), bare(), whole(HOSTILE)], ids=["whole", "bare", "hostile"])
def test_nothing_is_loaded(run):
    text = render_page(run)
    for tag, attributes in Parsed(text).tags:
        assert tag not in ("link", "iframe", "object", "embed", "form", "base", "video", "audio", "source"), tag
        assert attributes.get("src", "data:image/png;base64,").startswith("data:image/png;base64,"), tag
        assert attributes.get("href", "#").startswith("#") and "style" not in attributes, tag
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    assert "url(" not in style and "@import" not in style


def test_the_policy_allows_what_is_in_the_page_and_no_more():
    text = render_page(whole())
    (policy,) = [a["content"] for t, a in Parsed(text).tags if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    hashed = lambda kind: [
        f"'sha256-{base64.b64encode(hashlib.sha256(part.encode()).digest()).decode()}'"
        for part in re.findall(rf"<{kind}>(.*?)</{kind}>", text, re.S)
    ]
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:" and "connect-src" not in rules
    assert rules["script-src"].split() == hashed("script") and rules["style-src"].split() == hashed("style")
    assert len(hashed("script")) == 1
    # Before anything that it governs.
    assert text.index("Content-Security-Policy") < min(text.index("<style>"), text.index("<title>"))


def test_a_report_without_a_scene_has_no_script():
    text = render_page(bare())
    assert "<script" not in text and "script-src 'none'" in text.replace("&#x27;", "'")


def test_the_scene_is_data():
    assert packed_scene(render_page(whole(HOSTILE)))["count"] == whole().stage_points


# ---- Every section: shown from what there is, and told in one sentence where it is left out ----

ABSENT = {"verdict", "data", "people", "gaze", "stage", "objects", "scores"}
"""Sections that need more than a gaze field."""


def text_of(section, run) -> str:
    return Parsed(section.render(run)).text


@pytest.mark.parametrize("section", SECTIONS, ids=lambda s: s.name)
def test_shown_or_left_out_with_a_reason(section):
    assert section.reason_absent(whole()) is None and len(text_of(section, whole())) > 40
    reason = section.reason_absent(bare())
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
    assert "4.00 × 4.00 × 4.00" in said["place"] and "training photos9" in said["place"]
    assert (
        "400 of 400 rows" in said["data"]
        and "median number of participants within 0.25 m of a viewpoint" in said["people"]
    )
    assert "The observer stands somewhere. Gaze densities are in 1/sr" in said["gaze"]
    assert "mean of all 2 observers" in said["stage"] and "participants' paths" in said["stage"]
    assert "25.00 [20.00, 30.00]" in said["objects"] and "3 of 4" in said["objects"]
    assert "gain in KLD, nats" in said["scores"]
    assert "mean of 2 members" in said["uncertainty"] and "CC 0.700, KLD 0.400" in said["uncertainty"]
    assert "3 positions, 1 participants, and all samples within 0.5 m" in said["settings"]
    assert "Head direction is not gaze direction" in said["limits"] and "scene is static" in said["limits"]
    assert "ab" * 32 in said["provenance"]


def test_who_was_held_out_is_counted_and_not_named():
    assert "Ada" not in text_of(SETTINGS, replace(whole(), gaze={"provenance": {"test": {"people": ["Ada"]}}}))


def test_shares_that_few_people_could_see_are_hidden():
    objects = next(s for s in SECTIONS if s.name == "objects")
    said = text_of(objects, replace(whole(), min_participants=3))
    assert "otherhidden" in said and "fewer than 3" in said and said.count("25.00") == 2
    assert "hidden" not in text_of(objects, whole())


def test_without_people_there_are_no_intervals_of_shares():
    objects = next(s for s in SECTIONS if s.name == "objects")
    (first, *_) = whole().objects
    alone = replace(first, recorded=None, num_could_see=None, num_looked=None, num_participants=None)
    said = text_of(objects, replace(whole(), objects=(alone,), num_viewpoints=1))
    assert "over 1 viewpoint." in said and "share of samples" not in said


def test_one_split_each():
    both = whole().results[0]
    run = replace(whole(), results=(both, replace(both, split="pos", num_participants=3)))
    verdict, scores = (next(s for s in SECTIONS if s.name == n) for n in ("verdict", "scores"))
    assert "No verdict for known people at new places: 3 people" in text_of(verdict, run)
    assert "Known people at new places (3 participants, 60 positions)" in text_of(scores, run)
    assert HOSTILE not in scores.render(replace(run, results=(replace(both, split=HOSTILE),)))
