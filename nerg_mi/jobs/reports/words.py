"""What a report says of its place, its observer and itself."""

from __future__ import annotations

from nerg_mi.jobs.options.report import ReportOptions
from nerg_mi.jobs.scene import SceneResult

from .files import ReportFiles


def place_words(given: ReportFiles) -> str:
    """The place, in a sentence."""
    name = "" if given.scene.place is None else given.scene.place.name
    if given.scene.splats:
        return f"Gaussian splats, {name}."
    return {
        "field": f"A radiance field trained on photos, {name}.",
        "mesh": f"The mesh {name}.",
        "scene": f"The Mitsuba scene {name}.",
        "hits": f"No pictures of the place are at hand: it is made of what people looked at, {name}, in greys.",
        "none": "Nothing is known of the place: directions alone are shown.",
    }[given.scene.kind]


def observer_words(scene: SceneResult, asked: bool) -> str:
    """The observer, in a sentence; ``asked``: whether somebody said where."""
    if scene.observer is None:
        return "The camera is the observer, for nothing says where people were."
    at = ", ".join(f"{v:.2f}" for v in scene.observer.origin)
    where = "where it was asked for" if asked else "where most rays are"
    return f"The observer stands {where}, at ({at})."


def setting_words(options: ReportOptions) -> dict[str, str]:
    """What the report was made with, by what it is called."""
    return {
        "width": f"{options.width} pixels",
        "samples a pixel": str(options.spp),
        "seed": str(options.seed),
        "places looked from": f"{options.eyes} at most",
        "names of people": "shown" if options.names else "numbered",
        "fewest people of a share": str(options.min_persons),
    }
