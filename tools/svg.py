"""Drawings of boxes, dots, arrows and words, as SVG that is the same wherever it is made."""

from __future__ import annotations

from xml.sax.saxutils import escape, quoteattr

INK, PALE, FAINT = "#1f2933", "#52606d", "#cbd2d9"
"""Colours of words, of lesser words, and of lines in the background."""


class Drawing:
    """A picture of `width` x `height` pixels on white; `title` is what a screen reader says of it."""

    def __init__(self, width: float, height: float, title: str):
        self.head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
            f'viewBox="0 0 {width:g} {height:g}" font-family="DejaVu Sans, Verdana, sans-serif" role="img">'
        )
        self.parts = [f"<title>{escape(title)}</title>"]
        self.rectangle(0, 0, width, height, fill="#ffffff")

    def rectangle(self, x: float, y: float, width: float, height: float, *, fill: str, line: str = "none") -> None:
        size = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"'
        self.parts.append(f'<rect {size} rx="4" fill="{fill}" stroke="{line}"/>')

    def line(self, x0: float, y0: float, x1: float, y1: float, *, color: str = FAINT, width: float = 1) -> None:
        ends = f'x1="{x0:g}" y1="{y0:g}" x2="{x1:g}" y2="{y1:g}"'
        self.parts.append(f'<line {ends} stroke="{color}" stroke-width="{width:g}"/>')

    def arrow(self, x0: float, x1: float, y: float, *, color: str = INK) -> None:
        """A level arrow from `x0` to `x1`."""
        back = -6 if x1 > x0 else 6
        self.line(x0, y, x1 + back / 2, y, color=color, width=1.4)
        points = f"{x1:g},{y:g} {x1 + back:g},{y - 3.5:g} {x1 + back:g},{y + 3.5:g}"
        self.parts.append(f'<polygon points="{points}" fill="{color}"/>')

    def dot(self, x: float, y: float, radius: float, *, fill: str = INK, line: str = "none") -> None:
        self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{fill}" stroke="{line}"/>')

    def words(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 12,
        color: str = INK,
        bold: bool = False,
        anchor: str = "start",
        turned: float = 0,
    ) -> None:
        """`text` whose line stands on `y`, beginning, ending or centred at `x`; `turned` in degrees, clockwise."""
        place = f'x="{x:g}" y="{y:g}" font-size="{size:g}" fill="{color}" text-anchor={quoteattr(anchor)}'
        if bold:
            place += ' font-weight="bold"'
        if turned:
            place += f' transform="rotate({turned:g} {x:g} {y:g})"'
        self.parts.append(f"<text {place}>{escape(text)}</text>")

    def text(self) -> str:
        """The SVG document."""
        return "\n".join([self.head, *self.parts, "</svg>"]) + "\n"
