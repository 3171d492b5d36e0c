"""The gaze: pictures of it."""

from __future__ import annotations

from nerg_mi.report.html import Html, element, figure, image, markup, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_gaze(run: Run) -> Html:
    """The overview, and the observer's own view and sphere."""
    shown = lambda names: [
        figure(image(p.png, p.alt), p.caption) for p in (run.pictures.get(n) for n in names) if p is not None
    ]
    basis = f" The field is {run.basis}." if run.basis else ""
    words = (
        f"{run.observer}{basis} Densities are in 1/sr: what a colour stands for, times the solid angle that "
        "it covers for the observer, is the probability that they look there."
    )
    return markup([paragraph(words), *shown(["gaze"]), element("div", shown(["own", "sphere"]), class_="side")])


def _explain_absent_gaze(run: Run) -> str | None:
    if {"gaze", "own", "sphere"} & set(run.pictures):
        return None
    return "There are no pictures of the gaze, for it is nowhere above zero around the observer."


GAZE = Section("gaze", "The gaze", _show_gaze, _explain_absent_gaze)
