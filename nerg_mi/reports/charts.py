"""Charts of a report: small SVG charts of values with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nerg_mi.files.html import Html, element, markup

ROW, TOP, FOOT = 22, 26, 30
_LABELS, _WIDTH = 190, 250
_INK, _HIGHLIGHT, _GRID = "#5c5c58", "#1d4f91", "#dcdad4"


@dataclass(frozen=True)
class Point:
    """A value with its confidence interval, NaN if there is none; a highlighted point is drawn in colour."""

    label: str
    value: float
    low: float = math.nan
    high: float = math.nan
    is_highlighted: bool = False


def interval_chart(panels: Sequence[tuple[str, Sequence[Point]]]) -> Html:
    """Draw ``panels``, pairs of a title and points, side by side; the labels are those of the first panel's points."""
    rows = len(panels[0][1])
    width, height = _LABELS + len(panels) * _WIDTH, TOP + rows * ROW + FOOT
    elements = [
        _text(_LABELS - 12, _row_center(i), p.label, anchor="end", weight=600 if p.is_highlighted else None)
        for i, p in enumerate(panels[0][1])
    ]
    for k, (title, points) in enumerate(panels):
        elements.append(_panel(_LABELS + k * _WIDTH, title, points))
    description = "; ".join(
        f"{title}: {', '.join(f'{p.label} {p.value:.3g}' for p in points)}" for title, points in panels
    )
    box = {"viewBox": f"0 0 {width} {height}", "role": "img", "width": width, "height": height}
    return element("svg", Html("".join(elements)), xmlns="http://www.w3.org/2000/svg", aria_label=description, **box)


def _panel(left: float, title: str, points: Sequence[Point]) -> Html:
    finite = [v for p in points for v in (p.value, p.low, p.high) if math.isfinite(v)] or [0.0, 1.0]
    ticks = nice_ticks(min(finite), max(finite))
    low, high = min(ticks[0], *finite), max(ticks[-1], *finite)
    x = lambda v: left + 10 + (v - low) / (high - low) * (_WIDTH - 34)
    bottom = TOP + len(points) * ROW
    parts = [_text(left + 10, 14, title, weight=600)]
    for tick in ticks:
        parts.append(_line(x(tick), TOP, x(tick), bottom, _GRID if tick else _INK, 1))
        parts.append(_text(x(tick), bottom + 15, f"{tick:g}", anchor="middle", kind="faint"))
    for i, p in enumerate(points):
        color, y = _HIGHLIGHT if p.is_highlighted else _INK, _row_center(i)
        if math.isfinite(p.low) and math.isfinite(p.high):
            parts.append(_line(x(p.low), y, x(p.high), y, color, 2))
        if math.isfinite(p.value):
            parts.append(
                element(
                    "circle",
                    cx=_format_number(x(p.value)),
                    cy=_format_number(y),
                    r=4.5 if p.is_highlighted else 3.5,
                    fill=color,
                )
            )
    return Html("".join(parts))


def nice_ticks(low: float, high: float, max_ticks: int = 5) -> list[float]:
    """Return 2 to ``max_ticks`` round numbers that cover the range from ``low`` to ``high``."""
    if not high > low:
        low, high = low - 0.5, low + 0.5
    for exponent in range(math.floor(math.log10(high - low)) - 1, 400):
        for factor in (1, 2, 5):
            step = factor * 10.0**exponent
            first, last = math.floor(low / step), math.ceil(high / step)
            if last - first < max_ticks:
                return [round(k * step, 12) for k in range(first, last + 1)]
    raise ValueError(f"no ticks between {low} and {high}")


def _row_center(row: int) -> float:
    return TOP + (row + 0.5) * ROW


def _line(x0: float, y0: float, x1: float, y1: float, color: str, width: float) -> Html:
    ends = {"x1": _format_number(x0), "y1": _format_number(y0), "x2": _format_number(x1), "y2": _format_number(y1)}
    return element("line", stroke=color, stroke_width=width, **ends)


def _text(
    x: float, y: float, text: str, anchor: str = "start", weight: int | None = None, kind: str | None = None
) -> Html:
    attributes = {
        "x": _format_number(x),
        "y": _format_number(y),
        "text_anchor": anchor,
        "dominant_baseline": "central",
        "class_": kind,
    }
    return element("text", markup(text), font_weight=weight, **attributes)


def _format_number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
