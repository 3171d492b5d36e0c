"""Markup by hand: whatever text is given, it stays text."""

from __future__ import annotations

from html.parser import HTMLParser

import pytest

from nerg_mi.report import html
from tests.report.made import HOSTILE, PNG


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
