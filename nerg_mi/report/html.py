"""HTML by hand: text is escaped unless it is HTML already, so that no name of a file or a person becomes markup."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

VOID = ("img", "br", "hr", "meta", "input")
"""Elements that hold nothing."""


class Html(str):
    """Text that is markup."""


Content = str | int | float | Html | None | Iterable["Content"]
"""What may stand in an element: markup, text, numbers, nothing, or several of these."""


def markup(content: Content) -> Html:
    """``content`` as markup. Text is escaped; characters that cannot be seen, such as those that turn the direction of
    what follows, become question marks, as in messages."""
    if content is None:
        return Html("")
    if isinstance(content, Html):
        return content
    if isinstance(content, str):
        return Html(html.escape("".join(c if c.isprintable() else " " if c == "\n" else "?" for c in content)))
    if isinstance(content, (int, float)):
        return Html(html.escape(str(content)))
    return Html("".join(markup(part) for part in content))


def element(tag: str, *content: Content, **attributes: str | int | float | bool | None) -> Html:
    """An element. ``attributes``: by their names, ``class_`` for ``class`` and ``data_x`` for ``data-x``; None and
    False leave one out, True gives it no value."""
    shown = ""
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        name = name.rstrip("_").replace("_", "-")
        shown += f" {name}" if value is True else f' {name}="{markup(str(value))}"'
    if tag in VOID:
        return Html(f"<{tag}{shown}>")
    return Html(f"<{tag}{shown}>{markup(content)}</{tag}>")


def paragraph(*content: Content, kind: str | None = None) -> Html:
    """A paragraph, of the class ``kind``."""
    return element("p", *content, class_=kind)


def table(head: Sequence[Content], rows: Iterable[Sequence[Content]], numbers: Sequence[int] = ()) -> Html:
    """A table with a line of names; the columns ``numbers``, counted from 0, are aligned to the right."""
    side = lambda column: "number" if column in numbers else None
    line = lambda tag, cells: element("tr", [element(tag, c, class_=side(i)) for i, c in enumerate(cells)])
    body = [line("td", row) for row in rows]
    return element("div", element("table", element("thead", line("th", head)), element("tbody", body)), class_="scroll")


def pairs(rows: Iterable[tuple[Content, Content]]) -> Html:
    """A table of names and what belongs to them."""
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in rows]
    return element("div", element("table", element("tbody", lines), class_="pairs"), class_="scroll")


def image(png: bytes, alt: str, kind: str | None = None) -> Html:
    """A PNG file within the page; ``alt``: what it shows, in words."""
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", alt=alt, class_=kind)


def figure(content: Html, caption: Content) -> Html:
    """``content`` with a line below it."""
    return element("figure", content, element("figcaption", caption))
