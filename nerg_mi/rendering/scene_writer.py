"""Scene files as text: elements with comments, escaped, in the layout in which people write them by hand.

Nothing here knows what a scene is for: `scene_parts` says what belongs into one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np

from nerg_mi.errors import NergError, plain

_INDENT = "    "
_WIDTH = 120
# What XML 1.0 holds besides tabs and line ends; halves of pairs come from file names that are no text.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


@dataclass(frozen=True)
class Comment:
    """A sentence or more, broken into lines where it is written."""

    text: str


@dataclass(frozen=True)
class Verbatim:
    """XML that is written as it is, line by line, such as parts of somebody else's file."""

    text: str


@dataclass(frozen=True)
class Blank:
    """An empty line between groups."""


@dataclass(frozen=True)
class Element:
    """An XML element: its ``tag``, its ``attributes`` in their order, and what stands within it."""

    tag: str
    attributes: tuple[tuple[str, str], ...]
    children: tuple[Node, ...] = ()


Node = Element | Comment | Verbatim | Blank


def element(tag: str, *children: Node, **attributes: object) -> Element:
    """An element; attributes in the order in which they are given, a trailing underscore of their name left out."""
    return Element(tag, tuple((name.rstrip("_"), str(value)) for name, value in attributes.items()), children)


def prop(kind: str, name: str, value: object) -> Element:
    """A property: ``<kind name="name" value="value"/>``."""
    return element(kind, name=name, value=value)


def numbers(values: Iterable[float]) -> str:
    """Numbers with commas between them, with nine digits or, of single precision, as many as tell them apart; no
    "-0"."""
    return ", ".join(f"{_shortest(float(v)) + 0.0:.9g}" for v in values)


def _shortest(value: float) -> float:
    single = np.float32(value)
    return float(str(single)) if float(single) == value else value


def transform(*steps: Node, name: str = "to_world") -> Element:
    """A transform of ``steps``, of which the later apply after the earlier."""
    return element("transform", *steps, name=name)


def matrix(values: np.ndarray) -> Element:
    """A step of a transform: the (4, 4) matrix ``values``, in double precision."""
    return element("matrix", value=" ".join(f"{float(v) + 0.0:.15g}" for v in np.asarray(values).ravel()))


def document(nodes: Sequence[Node], head: str, version: str = "3.0.0") -> str:
    """A scene file of ``nodes`` whose first comment is ``head``, its paragraphs apart.

    Raises `NergError` for characters that no XML holds.
    """
    lines = _comment(head, "")
    lines.append(f"<scene version={_quoted(version)}>")
    for node in nodes:
        lines += _lines(node, _INDENT)
    return "\n".join([*lines, "</scene>", ""])


def value_of(name: str) -> str:
    """A file's ``name`` as the value of an attribute. Raises `NergError` for one that Mitsuba would not take as it is:
    it fills in what follows a dollar sign."""
    if "$" in name or _UNFIT.search(name):
        raise NergError(
            f'the name "{plain(name)}" cannot stand in a scene file, because of "$" or of characters that are no text; '
            "rename the file or its folder"
        )
    return name


def _lines(node: Node, indent: str) -> list[str]:
    match node:
        case Blank():
            return [""]
        case Comment(text):
            return _comment(text, indent)
        case Verbatim(text):
            return [indent + line if line.strip() else "" for line in text.splitlines()]
        case Element(tag, attributes, children):
            head = "".join(f" {name}={_quoted(value)}" for name, value in attributes)
            if not children:
                return [f"{indent}<{tag}{head}/>"]
            inner = [line for child in children for line in _lines(child, indent + _INDENT)]
            return [f"{indent}<{tag}{head}>", *inner, f"{indent}</{tag}>"]


def _quoted(value: str) -> str:
    if _UNFIT.search(value):
        raise NergError(f'"{plain(value)}" cannot stand in a scene file: it holds characters that are no text')
    return '"' + escape(value, {'"': "&quot;", "\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}) + '"'


def _comment(text: str, indent: str) -> list[str]:
    """``<!-- text -->`` in lines of at most 120 columns; two hyphens, which end a comment, become one."""
    text = re.sub("-{2,}", "-", _UNFIT.sub("?", text)).rstrip("-")
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            if line and len(indent) + 9 + len(line) + len(word) > _WIDTH:
                lines.append(line)
                line = ""
            line += f" {word}" if line else word
        lines.append(line)
    first, *others = lines
    out = [f"{indent}<!-- {first}", *(f"{indent}     {line}" if line else "" for line in others)]
    out[-1] += " -->"
    return out
