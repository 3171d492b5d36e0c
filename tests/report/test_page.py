"""The page: whole, bare, with hostile names, and loading nothing."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from nerg_mi.report.sections import SECTIONS, page
from tests.report.made import HOSTILE, bare, packed_scene, whole
from tests.report.test_html import Parsed

SIZE = 6_000_000


def test_every_section_is_there():
    for run in (whole(), bare()):
        tags = Parsed(page(run)).tags
        assert [a["id"] for t, a in tags if t == "section"] == [s.name for s in SECTIONS]
        assert [a["href"] for t, a in tags if t == "a"] == [f"#{s.name}" for s in SECTIONS]


def test_equal_runs_give_equal_bytes():
    assert page(whole()) == page(whole()) and len(page(whole()).encode()) < SIZE


def test_names_never_become_markup():
    tame, hostile = (Parsed(page(whole(name))) for name in ("shelf", HOSTILE))
    assert [t for t, _ in hostile.tags] == [t for t, _ in tame.tags]
    keys = lambda found: [sorted(a) for _, a in found.tags]
    assert keys(hostile) == keys(tame)
    assert not any(key.startswith("on") for _, a in hostile.tags for key in a)
    assert "alert(1)" in hostile.text and "\u202e" not in page(whole(HOSTILE))


@pytest.mark.parametrize("run", [whole(), bare(), whole(HOSTILE)], ids=["whole", "bare", "hostile"])
def test_nothing_is_loaded(run):
    text = page(run)
    for tag, attributes in Parsed(text).tags:
        assert tag not in ("link", "iframe", "object", "embed", "form", "base", "video", "audio", "source"), tag
        assert attributes.get("src", "data:image/png;base64,").startswith("data:image/png;base64,"), tag
        assert attributes.get("href", "#").startswith("#") and "style" not in attributes, tag
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    assert "url(" not in style and "@import" not in style


def test_the_policy_allows_what_is_in_the_page_and_no_more():
    text = page(whole())
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
    text = page(bare())
    assert "<script" not in text and "script-src 'none'" in text.replace("&#x27;", "'")


def test_the_scene_is_data():
    assert packed_scene(page(whole(HOSTILE)))["count"] == whole().stage_points
