"""Tests of `nerg_mi.report.html`."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest

from nerg_mi.report import html
from nerg_mi.report.html import Point, interval_chart, nice_ticks
from tests.report.made import HOSTILE, PNG

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
    assert Parsed(html.pairs([("x", "<y>")])).text == "x<y>"


def test_pictures_are_within_the_page():
    ((_, attributes),) = Parsed(html.image(PNG, "a <picture>")).tags
    assert attributes["src"].startswith("data:image/png;base64,iVBOR") and attributes["alt"] == "a <picture>"
    assert Parsed(html.figure(html.image(PNG, ""), "<words>")).text == "<words>"
