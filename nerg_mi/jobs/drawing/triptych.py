"""The paper's occlusion figure of any scene: the observer's view, and another camera without and with occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_overlay, occlusion_figure, shared_limits
from nerg_mi.jobs.options import option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import Range
from nerg_mi.rendering.scene_writer import pixel_of

from .kind import Drawing, Kind, SceneOptions


@dataclass(frozen=True, kw_only=True)
class TriptychOptions(SceneOptions):
    """How occlusion is shown."""

    sensor: int = option(0, "The other camera, counted from 0.", "-s", "--sensor", within=Range(0, 65535))


def _draw_triptych(files: Sequence[Path], options: TriptychOptions, reporter: Reporter) -> Drawing:
    """Three pictures with one scale; the scene file needs an observer who is not the camera."""
    from nerg_mi.transport.observer import center

    from .scene import open_scene

    style = options.style()
    (path,) = files
    overlay = find_overlay("gaze")
    with open_scene(path, options, reporter, 3) as opened:
        camera, nerg = opened.camera(options.sensor), opened.nerg
        if nerg.observer is None:
            raise NergError(
                f'"{path}" has no observer beside its camera, so that nothing is hidden from either; give its '
                'integrator a <sensor name="observer">'
            )
        if camera.class_name() != "PerspectiveCamera":
            raise NergError(f'sensor {options.sensor} of "{path}" is no perspective camera; choose another with -s')
        own = opened.see(_own_camera(nerg.observer, camera), overlay)
        with_occlusion, nerg.occlusion = nerg.occlusion, False
        try:
            without = opened.see(camera, overlay)
        finally:
            nerg.occlusion = with_occlusion
        seen = opened.see(camera, overlay)
        marker = pixel_of(camera, center(nerg.observer))
    limits = shared_limits([overlay.limits(of) for of in (own, without, seen)], options.top)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    first, second, third = ((of.color, of.values, of.mask) for of in (own, without, seen))
    figure = occlusion_figure(first, second, third, heat, marker, style.hatched, seen.basis)
    return Drawing(figure, [path], options.seed)


def _own_camera(observer: Any, camera: Any) -> Any:
    """A camera with the field of view and film of ``camera`` where the ``observer`` is, turned as they are."""
    import mitsuba as mi

    from .scene import film, sampler_like

    width, height = map(int, camera.film().crop_size())
    matrix = np.array(observer.world_transform().matrix, np.float64).reshape(4, 4)
    own = {
        "type": "perspective",
        "fov": float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0]),
        "fov_axis": "x",
        "near_clip": camera.near_clip(),
        "far_clip": camera.far_clip(),
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "film": film(width, height),
        "sampler": sampler_like(camera),
    }
    return mi.load_dict(own)


TRIPTYCH_KIND = Kind(
    "triptych", "Occlusion: three views of a gaze.", "scene file (.xml)", 1, TriptychOptions, _draw_triptych
)
