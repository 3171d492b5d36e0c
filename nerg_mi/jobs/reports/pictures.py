"""The pictures of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.figures import maps, overlay
from nerg_mi.figures.overlay import Heat, Layers, Style, find_overlay, srgb, to_bytes, top_of, unknown_of
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, encode
from nerg_mi.files.images import encode_png
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import Channels
from nerg_mi.report.data import Picture


@dataclass(frozen=True, eq=False)
class Views:
    """What was rendered: ``seen`` from the "camera", the observer's "own" view and the "sphere"; ``marker``: pixel of
    the camera's picture at which the observer is; ``supported``: whether anybody was recorded around there; ``basis``:
    rays and people that the gaze rests on, in words."""

    seen: Mapping[str, Channels]
    marker: tuple[float, float] | None = None
    supported: bool = True
    basis: str = ""

    def layers(self, name: str, quantity: str = "gaze") -> Layers:
        """A ``quantity`` over the picture ``name``."""
        view, marker = self.seen[name], self.marker if name == "camera" else None
        return Layers(view.color, view.aovs[quantity], view.mask, marker, self.supported, self.basis)


def gaze_top(views: Mapping[str, Channels]) -> float | None:
    """One end of the scale (1/sr) for all pictures of gaze, so that a colour means the same in each; None where there
    is no gaze."""
    tops = [top_of(v.aovs["gaze"], v.mask) for v in views.values() if np.any(v.aovs["gaze"][v.mask] > 0)]
    return max(tops) if tops else None


def pictures_of_views(views: Views, top: float | None, place_known: bool, about: Provenance) -> dict[str, Picture]:
    """Colour and gaze from the camera, and the observer's own view and sphere, hatched where nothing is known;
    ``about``: what the header of each says."""
    out, text = {}, about.text()
    camera = views.seen["camera"]
    if place_known:
        out["color"] = Picture(
            _png(srgb(camera.color), text), "The place in colour.", "The place, as the camera sees it."
        )
    if top is None:
        return out
    heat = Heat(top)
    hatched = lambda of: unknown_of(of, True) if place_known or not of.supported else None

    def draw(name: str, title: str) -> bytes:
        of = views.layers(name)
        arrays = of.color, of.values, of.mask
        drawn = overlay.gaze_figure(*arrays, heat, title, marker=of.marker, unknown=hatched(of), note=of.basis)
        return encode(drawn, ".png", text)

    if place_known:
        out["gaze"] = Picture(
            draw("camera", "Where the observer looks"),
            "Gaze of the observer over the colours of the place.",
            "The observer's gaze on the place. What the observer cannot see has none.",
        )
        spread = camera.aovs.get("gaze_std")
        if spread is not None and np.any(spread[camera.mask] > 0):
            out["spread"] = _spread(views.layers("camera", "gaze_std"), text)
    out["own"] = Picture(
        draw("own", "The observer's own view"), "Gaze in the observer's own view.", "What the observer sees ahead."
    )
    sphere = views.layers("sphere")
    arrays = sphere.color, sphere.values, sphere.mask
    drawn = sphere_figure(*arrays, heat, unknown=hatched(sphere), note=sphere.basis)
    out["sphere"] = Picture(
        encode(drawn, ".png", text),
        "Gaze in all directions around the observer.",
        "All that the observer could turn to.",
    )
    return out


def _spread(of: Layers, text: Mapping[str, str]) -> Picture:
    spread = find_overlay("gaze_std")
    drawn = spread.draw(of, spread.limits(of), Style(colors="viridis", title="Where the fields disagree"))
    return Picture(
        encode(drawn, ".png", text),
        "Standard deviation of the gaze of the ensemble's members.",
        "How far the members of the ensemble are apart: where this is as large as the gaze itself, nothing is known.",
    )


def pictures_of_rays(rays: Rays, test: Mapping[str, Any] | None, about: Provenance) -> dict[str, Picture]:
    """Plans of the floor. ``test``: what was held out of the training; ``about``: what the header of each says."""
    plan = encode(maps.floor_plan(rays), ".png", about.text())
    held_out = {}
    words = "Each ray's place."
    if test and test.get("centres"):
        held_out = {"centres": np.array(test["centres"], float), "radius": float(test.get("radius", 0.25))}
        words += " Circles: positions that were held out of the training."
    layout = encode(maps.layout_figure(rays, title="Rays", **held_out), ".png", about.text())
    return {
        "plan": Picture(plan, "Plan of how densely the floor is walked.", "How densely the floor is walked."),
        "layout": Picture(layout, "Plan of the places of all rays.", words),
    }


def _png(display: np.ndarray, text: Mapping[str, str]) -> bytes:
    import mitsuba as mi

    return encode_png(mi.Bitmap(to_bytes(display)), text)
