"""Where people were."""

from __future__ import annotations

from nerg_mi.report.html import Html, element, figure, image, markup, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_people(run: Run) -> Html:
    """Plans of the floor."""
    shown = [run.pictures[name] for name in ("plan", "layout") if name in run.pictures]
    sides = [figure(image(p.png, p.alt), p.caption) for p in shown]
    return markup([element("div", sides, class_="side"), *(paragraph(w) for w in _company(run))])


def _company(run: Run) -> list[str]:
    if not run.company:
        return []
    radius = (run.provenance.get("probes") or {}).get("radius")
    within = f"{radius:g} m" if isinstance(radius, (int, float)) else "half a metre"
    alone, middle = sum(n <= 1 for n in run.company), sorted(run.company)[len(run.company) // 2]
    words = f"At the {len(run.company)} places that were looked from, the median number of people within {within} is"
    if not alone:
        return [f"{words} {middle}, and nowhere fewer than two."]
    return [
        f"{words} {middle}; at {alone} of them there was only one person. What a field says of a place where one "
        "person stood is what one person did."
    ]


def _explain_absent_people(run: Run) -> str | None:
    return None if run.rays is not None else "The rays are not at hand, so that it is not known where people were."


PEOPLE = Section("people", "Where people were", _show_people, _explain_absent_people)
