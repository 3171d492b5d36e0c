"""Text of scene files: what is escaped, what is refused, and how it is laid out."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.scene_writer import (
    Blank,
    Comment,
    Verbatim,
    document,
    element,
    matrix,
    numbers,
    prop,
    transform,
    value_of,
)

NASTY = "a<b>&\"c\"'d' \n\té"


def test_what_is_written_is_read_back():
    nodes = [
        prop("string", "filename", NASTY),
        Blank(),
        element("shape", Comment("one\ntwo"), prop("float", "x", 1.5), type="cube", id="a"),
    ]
    root = ElementTree.fromstring(document(nodes, "Head of the file"))
    assert root.tag == "scene" and root.get("version") == "3.0.0"
    assert root[0].attrib == {"name": "filename", "value": NASTY}
    assert root[1].attrib == {"type": "cube", "id": "a"} and root[1][0].get("value") == "1.5"


def test_comments_hold_nothing_that_ends_them():
    text = document([Comment("a -- b --> c ---")], "x--y -")
    assert text.count("-->") == 2 and "--" not in text.replace("<!--", "").replace("-->", "")
    ElementTree.fromstring(text)


def test_lines_are_short_and_indented():
    text = document(
        [element("sensor", Comment("word " * 100), prop("float", "fov", 70), type="perspective")], "w " * 200
    )
    assert max(map(len, text.splitlines())) <= 120
    assert '\n        <float name="fov" value="70"/>\n    </sensor>\n' in text
    assert document([Verbatim("<a>\n  <b/>\n</a>")], "h").endswith("    <a>\n      <b/>\n    </a>\n</scene>\n")


@pytest.mark.parametrize("name", ["a$b.ply", "a\x01.ply", "a\udc80.ply"])
def test_names_that_no_scene_file_holds(name):
    with pytest.raises(NergError, match="rename the file"):
        value_of(name)
    with pytest.raises(NergError, match="no text") if "$" not in name else pytest.raises(NergError, match="rename"):
        document([prop("string", "a", name if "$" not in name else value_of(name))], "h")


def test_numbers_and_matrices():
    assert numbers([np.float32(0.1), 5_600_000.25, np.float32(16777217)]) == "0.1, 5600000.25, 16777216"
    assert numbers([1, -0.0, 0.1, 1e-7, 123456.789]) == "1, 0, 0.1, 1e-07, 123456.789"
    values = np.arange(16).reshape(4, 4) / 3
    found = ElementTree.fromstring(document([transform(matrix(values))], "h"))[0][0].get("value")
    np.testing.assert_allclose(np.array(found.split(), float).reshape(4, 4), values, rtol=1e-14)
