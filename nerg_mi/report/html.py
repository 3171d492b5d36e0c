"""HTML of a report: elements, tables and charts."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# ---- Html ----
#
# HTML by hand: text is escaped unless it is HTML already, so that no name of a file or a person becomes markup.

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


def table(header: Sequence[Content], rows: Iterable[Sequence[Content]], numeric_columns: Sequence[int] = ()) -> Html:
    """A table with a line of names; the columns ``numbers``, counted from 0, are aligned to the right."""
    side = lambda column: "number" if column in numeric_columns else None
    line = lambda tag, cells: element("tr", [element(tag, c, class_=side(i)) for i, c in enumerate(cells)])
    body = [line("td", row) for row in rows]
    return element("div", element("table", element("thead", line("th", header)), element("tbody", body)), class_="scroll")


def key_value_table(rows: Iterable[tuple[Content, Content]]) -> Html:
    """A table of names and what belongs to them."""
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in rows]
    return element("div", element("table", element("tbody", lines), class_="pairs"), class_="scroll")


def image(png: bytes, alt: str, kind: str | None = None) -> Html:
    """A PNG file within the page; ``alt``: what it shows, in words."""
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", alt=alt, class_=kind)


def figure(content: Html, caption: Content) -> Html:
    """``content`` with a line below it."""
    return element("figure", content, element("figcaption", caption))


# ---- Charts ----
#
# Small charts as SVG within the page: values with their intervals, side by side.

ROW, TOP, FOOT = 22, 26, 30
_LABELS, _WIDTH = 190, 250
_INK, _OWN, _GRID = "#5c5c58", "#1d4f91", "#dcdad4"


@dataclass(frozen=True)
class Point:
    """A ``value`` and its interval, NaN where it has none; ``own``: the one that the chart is about."""

    label: str
    value: float
    low: float = math.nan
    high: float = math.nan
    is_highlighted: bool = False


def interval_chart(panels: Sequence[tuple[str, Sequence[Point]]]) -> Html:
    """``panels`` side by side, each a title and points, which have the labels of the first panel's from the top on."""
    rows = len(panels[0][1])
    width, height = _LABELS + len(panels) * _WIDTH, TOP + rows * ROW + FOOT
    shown = [
        _text(_LABELS - 12, _middle(i), p.label, anchor="end", weight=600 if p.is_highlighted else None)
        for i, p in enumerate(panels[0][1])
    ]
    for k, (title, points) in enumerate(panels):
        shown.append(_panel(_LABELS + k * _WIDTH, title, points))
    words = "; ".join(f"{title}: {', '.join(f'{p.label} {p.value:.3g}' for p in points)}" for title, points in panels)
    box = {"viewBox": f"0 0 {width} {height}", "role": "img", "width": width, "height": height}
    return element("svg", Html("".join(shown)), xmlns="http://www.w3.org/2000/svg", aria_label=words, **box)


def _panel(left: float, title: str, points: Sequence[Point]) -> Html:
    known = [v for p in points for v in (p.value, p.low, p.high) if math.isfinite(v)] or [0.0, 1.0]
    ticks = nice_ticks(min(known), max(known))
    low, high = min(ticks[0], *known), max(ticks[-1], *known)
    x = lambda v: left + 10 + (v - low) / (high - low) * (_WIDTH - 34)
    bottom = TOP + len(points) * ROW
    parts = [_text(left + 10, 14, title, weight=600)]
    for tick in ticks:
        parts.append(_line(x(tick), TOP, x(tick), bottom, _GRID if tick else _INK, 1))
        parts.append(_text(x(tick), bottom + 15, f"{tick:g}", anchor="middle", kind="faint"))
    for i, p in enumerate(points):
        color, y = _OWN if p.is_highlighted else _INK, _middle(i)
        if math.isfinite(p.low) and math.isfinite(p.high):
            parts.append(_line(x(p.low), y, x(p.high), y, color, 2))
        if math.isfinite(p.value):
            parts.append(element("circle", cx=_short(x(p.value)), cy=_short(y), r=4.5 if p.is_highlighted else 3.5, fill=color))
    return Html("".join(parts))


def nice_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers, at most ``most`` and two at least, that span ``low`` to ``high`` or lie just within it."""
    if not high > low:
        low, high = low - 0.5, low + 0.5
    for exponent in range(math.floor(math.log10(high - low)) - 1, 400):
        for factor in (1, 2, 5):
            step = factor * 10.0**exponent
            first, last = math.floor(low / step), math.ceil(high / step)
            if last - first < most:
                return [round(k * step, 12) for k in range(first, last + 1)]
    raise ValueError(f"no ticks between {low} and {high}")


def _middle(row: int) -> float:
    return TOP + (row + 0.5) * ROW


def _line(x0: float, y0: float, x1: float, y1: float, color: str, width: float) -> Html:
    ends = {"x1": _short(x0), "y1": _short(y0), "x2": _short(x1), "y2": _short(y1)}
    return element("line", stroke=color, stroke_width=width, **ends)


def _text(
    x: float, y: float, text: str, anchor: str = "start", weight: int | None = None, kind: str | None = None
) -> Html:
    about = {"x": _short(x), "y": _short(y), "text_anchor": anchor, "dominant_baseline": "central", "class_": kind}
    return element("text", markup(text), font_weight=weight, **about)


def _short(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
