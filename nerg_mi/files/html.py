"""HTML of reports and of notebooks: elements and tables.

Text is escaped unless it is an `Html` instance, so that names of files or participants cannot inject markup.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from nerg_mi.errors import spell_parameters

VOID_ELEMENTS = ("img", "br", "hr", "meta", "input")
"""Elements without content."""


class Html(str):
    """Markup that is not escaped again."""


Content = str | int | float | Html | None | Iterable["Content"]
"""Content of an element: markup, text, a number, None, or an iterable of these."""


def markup(content: Content) -> Html:
    """Convert ``content`` to markup.

    Text is escaped. Non-printable characters, such as those that change the text direction, become question marks.
    """
    if content is None:
        return Html("")
    if isinstance(content, Html):
        return content
    if isinstance(content, str):
        text = spell_parameters(content)
        return Html(html.escape("".join(c if c.isprintable() else " " if c == "\n" else "?" for c in text)))
    if isinstance(content, (int, float)):
        return Html(html.escape(str(content)))
    return Html("".join(markup(part) for part in content))


def element(tag: str, *content: Content, **attributes: str | int | float | bool | None) -> Html:
    """Return an HTML element.

    Parameters
    ----------
    tag
        Name of the element.
    content
        Children of the element.
    attributes
        Attributes by name; ``class_`` stands for ``class``, and other underscores for hyphens. None and False omit an
        attribute; True sets it without a value.
    """
    attribute_text = ""
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        name = name.rstrip("_").replace("_", "-")
        attribute_text += f" {name}" if value is True else f' {name}="{markup(str(value))}"'
    if tag in VOID_ELEMENTS:
        return Html(f"<{tag}{attribute_text}>")
    return Html(f"<{tag}{attribute_text}>{markup(content)}</{tag}>")


def paragraph(*content: Content, kind: str | None = None) -> Html:
    """Return a paragraph of the class ``kind``."""
    return element("p", *content, class_=kind)


def table(header: Sequence[Content], rows: Iterable[Sequence[Content]], numeric_columns: Sequence[int] = ()) -> Html:
    """Return a table with a header row. The columns with the given indices are right-aligned."""
    side = lambda column: "number" if column in numeric_columns else None
    line = lambda tag, cells: element("tr", [element(tag, c, class_=side(i)) for i, c in enumerate(cells)])
    body = [line("td", row) for row in rows]
    return element(
        "div", element("table", element("thead", line("th", header)), element("tbody", body)), class_="scroll"
    )


def key_value_table(rows: Iterable[tuple[Content, Content]]) -> Html:
    """Return an HTML table with one row per (label, value) pair."""
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in rows]
    return element("div", element("table", element("tbody", lines), class_="pairs"), class_="scroll")


def image(png: bytes, alt: str, kind: str | None = None) -> Html:
    """Return an HTML image of the CSS class ``kind`` that embeds the file ``png``; ``alt`` is its alternative text."""
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", alt=alt, class_=kind)


def figure(content: Html, caption: Content) -> Html:
    """Return ``content`` with a caption below it."""
    return element("figure", content, element("figcaption", caption))


# ---- Objects in notebooks ----

_MAX_SHOWN_VALUES = 8
_MAX_SHOWN_TEXT = 120


class Summary:
    """Base of dataclasses that consoles show as one line of their attributes, and notebooks as a table of them."""

    def __repr__(self) -> str:
        facts = ", ".join(f"{name} {value}" for name, value in _describe_values(_get_attributes(self)))
        return f"<{type(self).__name__}: {facts}>"

    def _repr_html_(self) -> str:
        return summary_table(_get_attributes(self))


def _get_attributes(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in fields(value) if not f.name.startswith("_")}


def summary_table(values: Mapping[str, Any]) -> Html:
    """Return a table of named values: sizes of arrays and containers, and text of others; empty ones are left out."""
    return key_value_table(_describe_values(values))


def _describe_values(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    texts = {name.replace("_", " "): _describe_value(value) for name, value in values.items()}
    return [(name, text) for name, text in texts.items() if text]


def _describe_value(value: Any) -> str:
    import numpy as np  # help, which shows no values, does without it

    if value is None or isinstance(value, (str, Path)):
        return "" if value is None else value.name if isinstance(value, Path) else value
    if isinstance(value, np.ndarray):
        return f"{' x '.join(f'{size:,}' for size in value.shape)} {value.dtype}"
    if isinstance(value, (Mapping, list, tuple, set, frozenset)):
        return _describe_container(value)
    if isinstance(value, (bool, int, float, np.generic)):
        return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN_TEXT and "\n" not in text else type(value).__name__


def _describe_container(value: Mapping[Any, Any] | Iterable[Any]) -> str:
    """Return a few numbers and words, and the number of others."""
    entries = list(value)
    items = [value[key] for key in entries] if isinstance(value, Mapping) else entries
    if len(items) > _MAX_SHOWN_VALUES or not all(isinstance(x, (str, int, float, Path)) for x in items):
        return f"{len(items):,} {'entry' if len(items) == 1 else 'entries'}" if items else ""
    texts = map(_describe_value, items)
    return ", ".join(map(" ".join, zip(map(str, entries), texts)) if isinstance(value, Mapping) else texts)
