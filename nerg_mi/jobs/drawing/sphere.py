"""The gaze of a scene's observer over all directions, as a map of the sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.figures.overlay import find_overlay, shared_limits, unknown_of
from nerg_mi.figures.sphere import find_projection, sphere_figure
from nerg_mi.jobs.options import option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import Range
from nerg_mi.transport.geometry import pixel_solid_angles

from .kind import Drawing, Kind, SceneOptions


@dataclass(frozen=True, kw_only=True)
class SphereOptions(SceneOptions):
    """How an observer's sphere is drawn."""

    sensor: int = option(
        0, "Where no observer is: whose place it is, counted from 0.", "-s", "--sensor", within=Range(0, 65535)
    )
    projection: str = option("mollweide", "Projection: mollweide (equal areas) or equirectangular.")
    width: int = option(800, "Width of the map in pixels; it is half as high.", within=Range(64, 2896))


def _draw_sphere(files: Sequence[Path], options: SphereOptions, reporter: Reporter) -> Drawing:
    """The sphere of the observer of the scene file, or of its camera where it has none, turned to where they look."""
    import mitsuba as mi

    from .scene import film, open_scene, sampler_like, upright_pose

    find_projection(options.projection)
    style = options.style()
    (path,) = files
    overlay = find_overlay("gaze")
    with open_scene(path, options, reporter) as opened:
        camera = opened.camera(options.sensor)
        width = options.width // 2 * 2
        panorama = {
            "type": "panorama",
            "to_world": upright_pose(opened.nerg.observer or camera),
            "film": film(width, width // 2),
            "sampler": sampler_like(camera),
        }
        seen = opened.see(mi.load_dict(panorama), overlay)
    limits = shared_limits([overlay.limits(seen)], options.top)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    integral = float((seen.values.astype(np.float64) * pixel_solid_angles(width, width // 2)).sum())
    title = f"All that the observer can turn to: integral {integral:.3g}"
    unknown = unknown_of(seen, True) if style.hatched else None
    figure = sphere_figure(
        seen.color, seen.values, seen.mask, heat, title, options.projection, unknown, note=seen.basis
    )
    return Drawing(figure, [path], options.seed)


SPHERE_KIND = Kind(
    "sphere", "The gaze of an observer over all directions.", "scene file (.xml)", 1, SphereOptions, _draw_sphere
)
