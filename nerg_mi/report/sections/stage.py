"""The place in 3D."""

from __future__ import annotations

from nerg_mi.report.html import Html, element, image, markup, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_stage(run: Run) -> Html:
    """The viewer with its data, and the picture that stands for it without scripts and without WebGL. On paper all of
    it is left out, for the picture is in the section before."""
    assert run.stage is not None
    still = run.pictures.get("gaze") or run.pictures.get("color")
    picture = None if still is None else image(still.png, still.alt, "still")
    everyone = [f"the mean of all {run.stage_observers}"] if run.stage_observers != 1 else []
    names = [*everyone, *(f"observer {k + 1}" for k in range(run.stage_observers))]
    choices = [element("option", name, value=k) for k, name in enumerate(names)]
    kinds = [("gaze", "gaze"), ("paths", "people's paths"), ("boxes", "named objects")]
    there = {"gaze": run.stage_observers, "paths": run.stage_paths, "boxes": run.stage_boxes}
    switches = [
        element("label", element("input", type="checkbox", name=name, checked=True), " ", words)
        for name, words in kinds
        if there[name] or name == "gaze"
    ]
    controls = element(
        "div",
        element("label", "Gaze of ", element("select", choices)),
        element("output"),
        switches,
        element("button", "Back to the start", type="button"),
        class_="controls",
    )
    canvas = element("canvas", aria_label="The place in 3D with the gaze of observers", role="img")
    data = element("script", Html(run.stage), type="application/json", id="stage-data")
    words = (
        f"{run.stage_points:,} points of surfaces as they were seen from where people can stand. Drag to turn, "
        "shift and drag to move, the wheel comes closer; backs of surfaces are left out, so that one looks into "
        "rooms from outside. Blue marks are observers. Where scripts or WebGL are off, a picture stands for it."
        f"{f' The gaze is {run.basis}.' if run.basis else ''}"
    )
    return markup([paragraph(words), element("div", controls, canvas, picture, data)])


def _explain_absent_stage(run: Run) -> str | None:
    return None if run.stage is not None else "There is no 3D scene, for nothing is known of the place's surfaces."


STAGE = Section("stage", "In 3D", _show_stage, _explain_absent_stage)
