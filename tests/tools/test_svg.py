"""Drawings are well-formed, and the same each time."""

from __future__ import annotations

from xml.etree import ElementTree

from tools.svg import Drawing

SPACE = "{http://www.w3.org/2000/svg}"


def made() -> Drawing:
    drawing = Drawing(120, 60, "a < b")
    drawing.rectangle(1, 2, 30, 10, fill="#fff", line="#000")
    drawing.dot(5, 6, 2)
    drawing.arrow(10, 40, 20)
    drawing.arrow(40, 10, 30)
    drawing.words(3, 50, "R & D <i>", bold=True, turned=-60)
    return drawing


def test_the_document_holds_what_was_drawn():
    root = ElementTree.fromstring(made().text())
    assert root.get("viewBox") == "0 0 120 60" and root.find(f"{SPACE}title").text == "a < b"
    (words,) = root.iter(f"{SPACE}text")
    assert words.text == "R & D <i>" and words.get("transform") == "rotate(-60 3 50)"
    assert made().text() == made().text()


def test_arrows_point_to_their_end():
    right, left = (p.get("points") for p in ElementTree.fromstring(made().text()).iter(f"{SPACE}polygon"))
    assert right.split()[0] == "40,20" and right.split()[1].startswith("34,")
    assert left.split()[0] == "10,30" and left.split()[1].startswith("16,")
