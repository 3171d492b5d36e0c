"""The pictures of a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerg_mi.figures import plots, ray_figures
from nerg_mi.figures.overlay import Heat, top_of
from nerg_mi.figures.saving import encode
from nerg_mi.figures.sphere_figures import sphere_figure
from nerg_mi.figures.tonemap import srgb, to_bytes
from nerg_mi.files.png import encode_png
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.channels import Channels
from nerg_mi.report.run import Picture


def gaze_top(views: Mapping[str, Channels]) -> float | None:
    """One end of the scale (1/sr) for all pictures of gaze, so that a colour means the same in each; None where there
    is no gaze."""
    tops = [top_of(v.aovs["gaze"], v.mask) for v in views.values() if np.any(v.aovs["gaze"][v.mask] > 0)]
    return max(tops) if tops else None


def pictures_of_views(
    views: Mapping[str, Channels], top: float | None, marker: tuple[float, float] | None, place_known: bool
) -> dict[str, Picture]:
    """Colour and gaze from the camera, and the observer's own view and sphere. ``views``: "camera", "own", "sphere";
    ``marker``: pixel of the camera's picture at which the observer is."""
    out = {}
    if place_known:
        out["color"] = Picture(
            _png(srgb(views["camera"].color)), "The place in colour.", "The place, as the camera sees it."
        )
    if top is None:
        return out
    heat = Heat(top)
    draw = lambda name, title, mark=None: encode(
        plots.gaze_figure(views[name].color, views[name].aovs["gaze"], views[name].mask, heat, title, marker=mark),
        ".png",
    )
    if place_known:
        out["gaze"] = Picture(
            draw("camera", "Where the observer looks", marker),
            "Gaze of the observer over the colours of the place.",
            "The observer's gaze on the place. What the observer cannot see has none.",
        )
        spread = views["camera"].aovs.get("gaze_std")
        if spread is not None and np.any(spread[views["camera"].mask] > 0):
            out["spread"] = _spread(views["camera"], spread)
    out["own"] = Picture(
        draw("own", "The observer's own view"), "Gaze in the observer's own view.", "What the observer sees ahead."
    )
    sphere = views["sphere"]
    drawn = sphere_figure(sphere.color, sphere.aovs["gaze"], sphere.mask, heat)
    out["sphere"] = Picture(
        encode(drawn, ".png"), "Gaze in all directions around the observer.", "All that the observer could turn to."
    )
    return out


def _spread(view: Channels, spread: np.ndarray) -> Picture:
    heat = Heat(top_of(spread, view.mask), colors="viridis")
    drawn = plots.gaze_figure(
        view.color, spread, view.mask, heat, "Where the fields disagree", label="standard deviation of the gaze [1/sr]"
    )
    return Picture(
        encode(drawn, ".png"),
        "Standard deviation of the gaze of the ensemble's members.",
        "How far the members of the ensemble are apart: where this is as large as the gaze itself, nothing is known.",
    )


def pictures_of_rays(rays: Rays, test: Mapping[str, Any] | None) -> dict[str, Picture]:
    """Plans of the floor. ``test``: what was held out of the training."""
    plan = encode(ray_figures.floor_plan(rays), ".png")
    about = {}
    words = "Each ray's place."
    if test and test.get("centres"):
        about = {"centres": np.array(test["centres"], float), "radius": float(test.get("radius", 0.25))}
        words += " Circles: positions that were held out of the training."
    layout = encode(ray_figures.layout_figure(rays, title="Rays", **about), ".png")
    return {
        "plan": Picture(plan, "Plan of how densely the floor is walked.", "How densely the floor is walked."),
        "layout": Picture(layout, "Plan of the places of all rays.", words),
    }


def _png(display: np.ndarray) -> bytes:
    import mitsuba as mi

    return encode_png(mi.Bitmap(to_bytes(display)))
