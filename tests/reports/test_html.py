"""HTML of the report: escaping, sections and the page."""

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

from nerg_mi.files import html
from nerg_mi.reports.charts import Point, interval_chart, nice_ticks
from nerg_mi.reports.data import RAYS
from nerg_mi.reports.sections import LIMITS, SECTIONS, SETTINGS, render_page
from nerg_mi.tracking.rays import TRACKING
from tests.reports.made import HOSTILE, PNG, full_run, minimal_run, packed_scene

# ---- Charts ----

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("low, high", [(0, 1), (-2.3, 0.01), (1e-7, 3e-7), (5, 5), (-1e6, 1e9), (0.97, 1.02)])
def test_ticks_are_round_and_span_the_range(low, high):
    ticks = nice_ticks(low, high)
    steps = np.diff(ticks)
    assert 2 <= len(ticks) <= 6 and np.allclose(steps, steps[0]) and ticks[0] <= low and ticks[-1] >= high
    digits = f"{steps[0]:.6e}".split("e")[0]
    assert float(digits) in (1, 2, 5)


def test_chart_positions_match_the_scale():
    points = [Point("a", 0.0, -1.0, 1.0, True), Point("b", 2.0), Point("c", math.nan, math.nan, math.nan)]
    root = ET.fromstring(interval_chart([("score", points), ("other", points)]))
    circles = root.findall(f"{SVG}circle")
    assert len(circles) == 4  # of c nothing is known
    ticks = {t.text: float(t.get("x")) for t in root.findall(f"{SVG}text") if t.get("class") == "faint"}
    assert float(circles[0].get("cx")) < float(circles[1].get("cx"))
    for circle, value in zip(circles[2:], ("0", "2")):
        assert float(circle.get("cx")) == pytest.approx(ticks[value], abs=0.02)
    assert "a 0, b 2, c nan" in root.get("aria-label")


def test_chart_labels_are_escaped():
    root = ET.fromstring(interval_chart([(HOSTILE, [Point(HOSTILE, 1.0)])]))
    assert {e.tag for e in root.iter()} == {f"{SVG}{t}" for t in ("svg", "text", "line", "circle")}


# ---- Markup ----


class Parsed(HTMLParser):
    """Tags, attributes and text of markup, as parsed by a browser's rules."""

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
def test_text_is_escaped(text):
    shown = "".join(c if c.isprintable() else "?" for c in text)
    result = Parsed(html.element("p", text, title=text, data_name=text))
    assert result.tags == [("p", {"title": shown, "data-name": shown})] and result.text == shown


def test_invisible_characters_are_replaced():
    assert html.markup("a\u202eb\u200fc\x00d\x1b[0m") == "a?b?c?d?[0m"
    assert html.markup("two\nlines") == "two lines"


def test_markup_is_not_escaped_twice():
    bold = html.element("b", "x")
    assert html.markup([bold, " & ", 3, None, ["<", bold]]) == "<b>x</b> &amp; 3&lt;<b>x</b>"
    assert html.element("input", type="checkbox", checked=True, disabled=False, name=None) == (
        '<input type="checkbox" checked>'
    )


def test_tables():
    result = html.table(["name", "value"], [["a<b", "1"], ["c", 2.5]], [1])
    parsed = Parsed(result)
    assert [t for t, _ in parsed.tags].count("tr") == 3 and parsed.text == "namevaluea<b1c2.5"
    assert [a for t, a in parsed.tags if t == "td"] == [{}, {"class": "number"}] * 2
    assert Parsed(html.key_value_table([("x", "<y>")])).text == "x<y>"


def test_images_are_embedded():
    ((_, attributes),) = Parsed(html.image(PNG, "a <picture>")).tags
    assert attributes["src"].startswith("data:image/png;base64,iVBOR") and attributes["alt"] == "a <picture>"
    assert Parsed(html.figure(html.image(PNG, ""), "<words>")).text == "<words>"


# ---- Page ----

SIZE = 6_000_000


def test_page_contains_every_section():
    for run in (full_run(), minimal_run()):
        tags = Parsed(render_page(run)).tags
        assert [a["id"] for t, a in tags if t == "section"] == [s.name for s in SECTIONS]
        assert [a["href"] for t, a in tags if t == "a"] == [f"#{s.name}" for s in SECTIONS]


def test_page_is_reproducible():
    assert render_page(full_run()) == render_page(full_run()) and len(render_page(full_run()).encode()) < SIZE


def test_names_cannot_inject_markup():
    tame, hostile = (Parsed(render_page(full_run(name))) for name in ("shelf", HOSTILE))
    assert [t for t, _ in hostile.tags] == [t for t, _ in tame.tags]
    keys = lambda page: [sorted(a) for _, a in page.tags]
    assert keys(hostile) == keys(tame)
    assert not any(key.startswith("on") for _, a in hostile.tags for key in a)
    assert "alert(1)" in hostile.text and "\u202e" not in render_page(full_run(HOSTILE))


@pytest.mark.parametrize("run", [full_run(), minimal_run(), full_run(HOSTILE)], ids=["full", "minimal", "hostile"])
def test_page_loads_no_resources(run):
    text = render_page(run)
    for tag, attributes in Parsed(text).tags:
        assert tag not in ("link", "iframe", "object", "embed", "form", "base", "video", "audio", "source"), tag
        assert attributes.get("src", "data:image/png;base64,").startswith("data:image/png;base64,"), tag
        assert attributes.get("href", "#").startswith("#") and "style" not in attributes, tag
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    assert "url(" not in style and "@import" not in style


def test_content_security_policy_matches_the_page():
    text = render_page(full_run())
    (policy,) = [a["content"] for t, a in Parsed(text).tags if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    hashed = lambda kind: [
        f"'sha256-{base64.b64encode(hashlib.sha256(part.encode()).digest()).decode()}'"
        for part in re.findall(rf"<{kind}>(.*?)</{kind}>", text, re.S)
    ]
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:" and "connect-src" not in rules
    assert rules["script-src"].split() == hashed("script") and rules["style-src"].split() == hashed("style")
    assert len(hashed("script")) == 1
    # The policy must precede what it governs.
    assert text.index("Content-Security-Policy") < min(text.index("<style>"), text.index("<title>"))


def test_page_without_3d_view_has_no_script():
    text = render_page(minimal_run())
    assert "<script" not in text and "script-src 'none'" in text.replace("&#x27;", "'")


def test_3d_view_is_embedded_as_data():
    assert packed_scene(render_page(full_run(HOSTILE)))["count"] == full_run().stage_points


# ---- Sections ----

ABSENT = {"verdict", "data", "people", "gaze", "stage", "objects", "scores"}
"""Sections that need more than a gaze field."""


def text_of(section, run) -> str:
    return Parsed(section.render(run)).text


@pytest.mark.parametrize("section", SECTIONS, ids=lambda s: s.name)
def test_empty_sections_state_a_reason(section):
    assert section.reason_absent(full_run()) is None and len(text_of(section, full_run())) > 40
    reason = section.reason_absent(minimal_run())
    assert (reason is not None) == (section.name in ABSENT)
    if reason is None:
        assert section.render(minimal_run())
    else:
        assert reason.endswith(".") and len(reason) > 40 and reason.count(".") <= 2


def test_limits_of_heads_are_not_those_of_eyes():
    run = full_run()
    training = lambda tracking: {**run.gaze, "provenance": {"tracking": tracking}}
    limits = lambda tracking: text_of(LIMITS, replace(run, gaze=training(tracking)))
    assert "eads" not in limits("eye") and all("directions" in limits(kind) for kind in ("head", "mixed", "unknown"))


def test_section_names_and_titles_are_unique():
    assert len({s.name for s in SECTIONS}) == len({s.title for s in SECTIONS}) == len(SECTIONS)


def test_section_texts():
    said = {s.name: text_of(s, full_run()) for s in SECTIONS}
    assert said["verdict"].startswith("Better than the nearest rays, the strongest baseline, for held-out participants")
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


@pytest.mark.parametrize(
    "choice, expected",
    [
        ({"validation_views": ["a"]}, "22.0 dB PSNR on 2 held-out photos"),
        ({"psnr_watched": {"views": ["a"], "result": {}}}, "22.0 dB PSNR on 2 held-out photos"),
        ({"psnr_watched": {"views": ["a"]}}, "25.0 dB PSNR on 3 held-out photos"),
    ],
)
def test_photos_that_chose_the_state_of_a_field_do_not_score_it(choice, expected):
    """Also in checkpoints of earlier versions, whose stored mean includes them."""
    provenance = {"psnr_held_out": {"mean": 25.0, "views": {"a": 31.0, "b": 21.0, "c": 23.0, "d": None}}, **choice}
    assert expected in render_page(replace(minimal_run(), radiance={"provenance": provenance}))


def test_held_out_participants_are_not_named():
    assert "Ada" not in text_of(SETTINGS, replace(full_run(), gaze={"provenance": {"test": {"people": ["Ada"]}}}))


def test_settings_name_what_was_tracked():
    for provenance, kind in (({"rays": 3, "tracking": "head"}, "head"), ({"rays": 3}, "unknown")):
        assert TRACKING[kind] in text_of(SETTINGS, replace(full_run(), gaze={"provenance": provenance}))


def test_shares_of_few_participants_are_hidden():
    objects = next(s for s in SECTIONS if s.name == "objects")
    said = text_of(objects, replace(full_run(), min_participants=3))
    assert "otherhidden" in said and "fewer than 3" in said and said.count("25.00") == 2
    assert "hidden" not in text_of(objects, full_run())


def test_shares_of_a_part_of_the_samples_say_so():
    """Their numbers differ from those of statistics, which are of all samples."""
    objects, rays = next(s for s in SECTIONS if s.name == "objects"), full_run().rays
    for count in (RAYS, RAYS + 1):
        many = rays.select(np.arange(count) % len(rays))
        assert (f"of {RAYS:,} of the {count:,} samples" in text_of(objects, replace(full_run(), rays=many))) == (
            count > RAYS
        )


def test_shares_without_participants_have_no_intervals():
    objects = next(s for s in SECTIONS if s.name == "objects")
    (first, *_) = full_run().objects
    alone = replace(first, recorded=None, num_could_see=None, num_looked=None, num_participants=None)
    said = text_of(objects, replace(full_run(), objects=(alone,), num_viewpoints=1))
    assert "over 1 viewpoint." in said and "share of samples" not in said


def test_each_split_has_a_verdict():
    both = full_run().results[0]
    run = replace(full_run(), results=(both, replace(both, split="pos", num_participants=3)))
    verdict, scores = (next(s for s in SECTIONS if s.name == n) for n in ("verdict", "scores"))
    assert re.search("No verdict for .*: 3 participants", text_of(verdict, run))
    assert "(3 participants, 60 positions)" in text_of(scores, run)
    seen = text_of(verdict, replace(run, results=(replace(both, split="pos"),)))
    assert "Evaluated on training participants at held-out positions (" in seen
    assert HOSTILE not in scores.render(replace(run, results=(replace(both, split=HOSTILE),)))
