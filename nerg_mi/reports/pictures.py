"""Images of a report: views of the scene and its gaze on one colour scale, and floor plans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.environment.bands import Channels
from nerg_mi.figures import maps, overlay
from nerg_mi.figures.layers import describe_smoothing
from nerg_mi.figures.overlay import Heat, OverlayLayers, find_overlay, robust_max, srgb, to_bytes, unknown_mask
from nerg_mi.figures.settings import Style
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, encode
from nerg_mi.files.images import encode_png
from nerg_mi.tracking.rays import Rays

from .data import ReportPicture


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """Rendered images.

    Attributes
    ----------
    images
        Images of the "camera", the observer's "own" view and the "sphere".
    marker
        Pixel of the observer in the camera's image.
    supported
        Whether rays were recorded around the observer.
    basis
        Description of the data behind the gaze.
    """

    images: Mapping[str, Channels]
    marker: tuple[float, float] | None = None
    supported: bool = True
    basis: str = ""

    def layers(self, name: str, quantity: str = "gaze") -> OverlayLayers:
        """Return a ``quantity`` over the image ``name``."""
        view, marker = self.images[name], self.marker if name == "camera" else None
        is_smoothed = quantity == "gaze" and name != "sphere"
        basis = describe_smoothing(self.basis) if is_smoothed else self.basis
        return OverlayLayers(view.color, view.aovs[quantity], view.mask, marker, self.supported, basis)


def gaze_vmax(views: Mapping[str, Channels]) -> float | None:
    """Return the upper end of the common colour scale (1/sr) of all images of gaze; None if there is no gaze."""
    tops = [robust_max(v.aovs["gaze"], v.mask) for v in views.values() if np.any(v.aovs["gaze"][v.mask] > 0)]
    return max(tops) if tops else None


def draw_views(
    views: RenderedViews, top: float | None, has_geometry: bool, record: Provenance
) -> dict[str, ReportPicture]:
    """Draw colour and gaze from the camera, and the observer's view and sphere, hatched where the gaze is unknown.

    ``record`` is the provenance for image headers.
    """
    import mitsuba as mi

    out, text = {}, record.text()
    camera = views.images["camera"]
    if has_geometry:
        out["color"] = ReportPicture(
            encode_png(mi.Bitmap(to_bytes(srgb(camera.color))), text),
            "The scene in colour.",
            "The scene from the camera.",
        )
    if top is None:
        return out
    heat = Heat(top)
    hatched = lambda values: unknown_mask(values, True) if has_geometry or not values.has_support else None

    def draw(name: str, title: str) -> bytes:
        layers = views.layers(name)
        arrays = layers.color, layers.values, layers.mask
        drawn = overlay.gaze_figure(
            *arrays, heat, title, marker=layers.marker, unknown=hatched(layers), note=layers.support_note
        )
        return encode(drawn, ".png", text)

    if has_geometry:
        out["gaze"] = ReportPicture(
            draw("camera", "Where the observer looks"),
            "Gaze of the observer over the colours of the scene.",
            "The observer's gaze on the scene. There is none where the observer's view is occluded.",
        )
        spread = camera.aovs.get("gaze_std")
        if spread is not None and np.any(spread[camera.mask] > 0):
            out["spread"] = _spread(views.layers("camera", "gaze_std"), text)
    out["own"] = ReportPicture(
        draw("own", "The observer's own view"), "Gaze in the observer's own view.", "The view straight ahead."
    )
    sphere = views.layers("sphere")
    arrays = sphere.color, sphere.values, sphere.mask
    drawn = sphere_figure(*arrays, heat, unknown=hatched(sphere), note=sphere.support_note)
    out["sphere"] = ReportPicture(
        encode(drawn, ".png", text),
        "Gaze in all directions around the observer.",
        "All directions that the observer could turn to.",
    )
    return out


def _spread(layers: OverlayLayers, text: Mapping[str, str]) -> ReportPicture:
    spread = find_overlay("gaze_std")
    drawn = spread.draw(layers, spread.limits(layers), Style(cmap="viridis", title="Disagreement of the ensemble"))
    return ReportPicture(
        encode(drawn, ".png", text),
        "Standard deviation of the gaze of the ensemble's members.",
        "Standard deviation of the ensemble members: where it is as large as the gaze itself, the gaze is unknown.",
    )


def draw_rays(rays: Rays, test: Mapping[str, Any] | None, record: Provenance) -> dict[str, ReportPicture]:
    """Draw floor plans. ``test`` describes the held-out data; ``record`` is the provenance for image headers."""
    plan = encode(maps.floor_plan(rays), ".png", record.text())
    held_out = {}
    words = "Position of each ray."
    if test and test.get("centres"):
        held_out = {"centres": np.array(test["centres"], float), "radius": float(test.get("radius", 0.25))}
        words += " Circles: held-out positions."
    layout = encode(maps.layout_figure(rays, title="Rays", **held_out), ".png", record.text())
    return {
        "plan": ReportPicture(plan, "Plan of the density of recorded positions.", "Density of recorded positions."),
        "layout": ReportPicture(layout, "Plan of the positions of all rays.", words),
    }
