"""Figures of the gaze of a scene's observer: over all directions, and in three views that show its occlusion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_writer import project_to_pixel
from nerg_mi.environment.sensors import copy_sampler, make_film, make_observer_camera, upright_pose, warn_observer
from nerg_mi.errors import NergError
from nerg_mi.files.values import FilePath
from nerg_mi.maths.types import Figure, MitsubaScene
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import POSITIVE_VALUES, SEEDS, SPP, Range, check_ranges
from nerg_mi.transport.geometry import pixel_solid_angles
from nerg_mi.transport.observer import sensor_center

from .layers import render_layers
from .overlay import OverlayLayers, find_overlay, occlusion_figure, shared_limits, unknown_mask
from .scene_views import find_camera, list_files, name_scene, open_scene, report_views
from .settings import Style
from .sphere import sphere_figure
from .style import changed_arguments, check_figure, finish_figure


@check_ranges
def draw_sphere(
    scene: FilePath | Scene | MitsubaScene,
    output: FilePath | None = None,
    *,
    defaults: Mapping[str, str] | None = None,
    sensor: Annotated[int, Range(0, 65535)] = 0,
    projection: Literal["mollweide", "equirectangular"] = "mollweide",
    width: Annotated[int, Range(64, 2896)] = 800,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    spp: Annotated[int, Range(0, SPP.high)] = 0,
    seed: Annotated[int, SEEDS] = 0,
    style: Style = Style(),
    progress: Progress = None,
) -> Figure:
    """Draw the gaze of an observer over all directions.

    Parameters
    ----------
    scene : path, Scene or mi.Scene
        Scene file (.xml).
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    sensor : int
        Index of the sensor whose position is used if the scene has no observer, counted from 0.
    projection : str
        Map projection: mollweide (equal-area) or equirectangular.
    width : int
        Width of the map in pixels; its height is half of it.
    vmax : float, optional
        Upper end of the colour scale in 1/sr. Default: the 99.5th percentile.
    spp : int
        Samples per pixel; 0: as in the scene file.
    seed : int
        Seed of the random numbers for sampling.
    style : Style
        Colours (`nerg_mi.figures.settings.Style`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or the gaze is 0 in all directions.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> figure = nerg.draw_sphere(files("nerg_mi.scenes.store") / "scene.xml", width=64, spp=1)
    >>> len(figure.axes) > 0
    True
    """
    changed = changed_arguments(draw_sphere, locals())
    check_figure(output)
    overlay = find_overlay("gaze")
    overlay.check_style(style)
    with open_reporter(progress) as reporter:
        opened = open_scene(scene, defaults)
        camera, loaded = opened.resolve_sensor(sensor), opened.mitsuba
        panorama = _make_panorama(opened.integrator.observer or camera, camera, width)
        warn_observer(loaded, reporter)
        with report_views(reporter) as report_view:
            view = render_layers(name_scene(opened), loaded, panorama, overlay, spp, seed, report_view(0))
        limits = shared_limits([overlay.limits(view)], vmax)
        overlay.check_limits(limits)
        solid_angles = pixel_solid_angles(width // 2 * 2, width // 2)
        integral = float((view.values.astype(np.float64) * solid_angles).sum())
        figure = sphere_figure(
            view.color,
            view.values,
            view.mask,
            overlay.heat(limits, style),
            style.title or f"Gaze in all directions: integral {integral:.3g}",
            projection,
            unknown_mask(view, True) if style.hatching else None,
            note=view.support_note,
        )
        return finish_figure(figure, output, "nerg draw sphere", list_files(opened), seed, changed, reporter)


def _make_panorama(observer: Any, camera: Any, width: int) -> Any:
    """Return a level sensor of all directions around ``observer``, sampled like ``camera``."""
    import mitsuba as mi

    height = width // 2
    parts = {"film": make_film(2 * height, height), "sampler": copy_sampler(camera)}
    return mi.load_dict({"type": "panorama", "to_world": upright_pose(observer), **parts})


@check_ranges
def draw_triptych(
    scene: FilePath | Scene | MitsubaScene,
    output: FilePath | None = None,
    *,
    defaults: Mapping[str, str] | None = None,
    sensor: Annotated[int, Range(0, 65535)] = 0,
    smoothing: Annotated[float, Range(0, 30)] = 1.0,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    spp: Annotated[int, Range(0, SPP.high)] = 0,
    seed: Annotated[int, SEEDS] = 0,
    style: Style = Style(),
    progress: Progress = None,
) -> Figure:
    """Draw three views of a gaze that show its occlusion.

    The first is that of the observer, the others are those of a camera, without and with occlusion, on one colour
    scale.

    Parameters
    ----------
    scene : path, Scene or mi.Scene
        Scene file (.xml), with an observer other than the camera.
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    sensor : int
        Index of the camera, counted from 0.
    smoothing : float
        Standard deviation in degrees by which gaze is smoothed on surfaces before it is drawn; 0: as computed.
    vmax : float, optional
        Upper end of the colour scale in 1/sr. Default: the 99.5th percentile.
    spp : int
        Samples per pixel; 0: as in the scene file.
    seed : int
        Seed of the random numbers for sampling.
    style : Style
        Colours (`nerg_mi.figures.settings.Style`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, nothing can be occluded, or the gaze is 0 on all surfaces.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=24, height=16)
    >>> len(nerg.draw_triptych(scene, spp=1).axes)
    4
    """
    changed = changed_arguments(draw_triptych, locals())
    check_figure(output)
    overlay = find_overlay("gaze")
    overlay.check_style(style)
    with open_reporter(progress) as reporter:
        opened = open_scene(scene, defaults)
        integrator, loaded, name = opened.integrator, opened.mitsuba, name_scene(opened)
        camera, observer = find_camera(opened, sensor), integrator.observer
        if observer is None:
            raise NergError(
                f'"{name}" has no observer other than its camera, so nothing is occluded; add a <sensor '
                'name="observer"> to its integrator'
            )
        warn_observer(loaded, reporter)
        with report_views(reporter, 3) as report_view:
            render = lambda index, sensor: render_layers(
                name, loaded, sensor, overlay, spp, seed, report_view(index), smoothing
            )
            own_view = render(0, make_observer_camera(observer, camera))
            with_occlusion, integrator.occlusion = integrator.occlusion, False
            try:
                without = render(1, camera)
            finally:
                integrator.occlusion = with_occlusion
            occluded = render(2, camera)
        views = own_view, without, occluded
        limits = shared_limits([overlay.limits(view) for view in views], vmax)
        overlay.check_limits(limits)
        figure = occlusion_figure(
            _list_arrays(own_view),
            _list_arrays(without),
            _list_arrays(occluded),
            overlay.heat(limits, style),
            project_to_pixel(camera, sensor_center(observer)),
            style.hatching,
            occluded.support_note,
        )
        return finish_figure(figure, output, "nerg draw triptych", list_files(opened), seed, changed, reporter)


def _list_arrays(view: OverlayLayers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return view.color, view.values, view.mask
