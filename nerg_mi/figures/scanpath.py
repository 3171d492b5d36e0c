"""Scanpaths: numbered fixations and the saccades between them, drawn over an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_writer import project_to_pixel
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.values import FilePath
from nerg_mi.maths.types import Figure, MitsubaScene, variant_types
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import SEEDS, SPP, TIMES, Range, check_ranges
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.events import average_fixations, label_fixations, warn_unknown_tracking
from nerg_mi.tracking.measurement import warn_slow_sampling
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SURFACE_OPACITY, trace_depth
from nerg_mi.transport.observer import sensor_center

from .floor_plans import select_participants
from .layers import render_layers
from .maps import participant_color
from .overlay import find_overlay, srgb
from .scene_views import find_camera, list_files, name_scene, open_scene, report_views
from .style import INK, PAPER, SMALL, Sheet, changed_arguments, check_figure, existing_files, finish_figure

_AREA = 420.0  # points² of the circle of a fixation of one second
_MIN_AREA = 60.0
_DIM = 0.85


def scanpath_figure(
    color: ArrayLike,
    points: ArrayLike,
    durations: ArrayLike | None = None,
    participants: ArrayLike | None = None,
    names: tuple[str, ...] = (),
    title: str = "Scanpath",
    note: str = "",
    axes: Any = None,
) -> Any:
    """Draw fixations as numbered circles over the linear image ``color`` (h, w, 3), joined in order. Return the axes.

    Parameters
    ----------
    color
        Linear image.
    points
        Pixels (N, 2), x and y, of the fixations in temporal order; NaN: not in the image. The line is interrupted
        there, and the number is skipped.
    durations
        Seconds (N,), which the areas of the circles are proportional to. Default: equal circles.
    participants
        Index (N,) of the participant of each fixation; each has a colour and numbers of its own. Default: one.
    names
        Names of the participants, for a legend.
    title
        Title of the figure.
    note
        Note below the figure.
    axes
        Axes to draw in. Default: a new figure.
    """
    sheet = Sheet([_DIM * srgb(color)], [title], note=note, panels=axes)
    panel, unit = sheet.panels[0], sheet.unit
    xy = np.asarray(points, float).reshape(-1, 2)
    person = np.zeros(len(xy), int) if participants is None else np.asarray(participants, int)
    area = np.full(len(xy), _AREA / 3) if durations is None else _AREA * np.asarray(durations, float)
    area = np.maximum(area, _MIN_AREA) * unit**2
    limits = panel.get_xlim(), panel.get_ylim()
    for index in np.unique(person):
        rows = np.flatnonzero(person == index)
        dot = participant_color(int(index))
        where = xy[rows]
        is_visible = np.isfinite(where).all(axis=1)
        panel.plot(*where.T, color=PAPER, linewidth=2.2 * unit, alpha=0.6, zorder=3, solid_joinstyle="round")
        panel.plot(*where.T, color=dot, linewidth=1.2 * unit, zorder=3, solid_joinstyle="round")
        panel.scatter(
            *where[is_visible].T,
            s=area[rows[is_visible]],
            c=dot,
            alpha=0.75,
            edgecolors=PAPER,
            linewidths=0.8 * unit,
            zorder=4,
            label=names[index] if index < len(names) else None,
        )
        for number in np.flatnonzero(is_visible):
            panel.annotate(
                str(number + 1),
                where[number],
                ha="center",
                va="center",
                fontsize=0.8 * SMALL * unit,
                color=PAPER,
                fontweight="bold",
                zorder=5,
            )
    panel.set_xlim(limits[0])
    panel.set_ylim(limits[1])
    if names:
        legend = panel.legend(loc="best", fontsize=SMALL * unit, markerscale=0.6, labelcolor=INK)
        legend.set_zorder(6)
    return panel


@check_ranges
def draw_scanpath(
    rays: Rays | FilePath,
    scene: FilePath | Scene | MitsubaScene,
    output: FilePath | None = None,
    *,
    defaults: Mapping[str, str] | None = None,
    sensor: Annotated[int, Range(0, 65535)] = 0,
    persons: Sequence[str] = (),
    start: Annotated[float, TIMES] | None = None,
    end: Annotated[float, TIMES] | None = None,
    dispersion_threshold: Annotated[float, Range(1e-3, 90)] | None = None,
    max_fixations: Annotated[int, Range(1, 1000)] = 40,
    spp: Annotated[int, Range(0, SPP.high)] = 0,
    seed: Annotated[int, SEEDS] = 0,
    rules: EventRules = EventRules(),
    progress: Progress = None,
) -> Figure:
    """Draw numbered fixations over a view of the scene.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    scene : path, Scene or mi.Scene
        Scene file (.xml), in the coordinates of the rays.
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    sensor : int
        Index of the camera, counted from 0.
    persons : sequence of str
        Name of a participant to draw. Default: the first one.
    start : float, optional
        First time in seconds. Default: the first.
    end : float, optional
        Last time in seconds. Default: the last.
    dispersion_threshold : float, optional
        Dispersion in degrees, to detect fixations by it (I-DT). Default: fixations as in nerg rays events.
    max_fixations : int
        Maximum number of fixations of a participant; the first ones are drawn.
    spp : int
        Samples per pixel; 0: as in the scene file.
    seed : int
        Seed of the random numbers for sampling.
    rules : EventRules
        Limits between the kinds of events (`nerg_mi.tracking.event_settings.EventRules`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or there are no rays or fixations.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
    >>> len(nerg.draw_scanpath(rays, scene, spp=1).axes)
    1
    """
    changed = changed_arguments(draw_scanpath, locals())
    check_figure(output)
    with open_reporter(progress) as reporter:
        recorded = open_rays(rays)
        data = select_participants(recorded, list(persons) or recorded.persons[:1])
        first, last = (-np.inf if start is None else start), (np.inf if end is None else end)
        data = data.select((data.t >= first) & (data.t <= last))
        if not len(data):
            raise NergError(
                f"there are no rays of these participants in this time; change {parameter('persons')} or "
                f"{parameter('start')}"
            )
        warn_unknown_tracking(data.tracking, reporter.warn)
        warn_slow_sampling(data, rules, reporter)
        label, _ = label_fixations(data, rules, dispersion_threshold)
        fixations, durations = average_fixations(data, label, rules, dispersion_threshold)
        order = np.lexsort((fixations.t, fixations.person))
        rank = np.arange(len(order)) - np.searchsorted(fixations.person[order], fixations.person[order])
        rows = order[rank < max_fixations]
        opened = open_scene(scene, defaults)
        camera, overlay = find_camera(opened, sensor), find_overlay("depth")
        with report_views(reporter) as report_view:
            view = render_layers(name_scene(opened), opened.mitsuba, camera, overlay, spp, seed, report_view(0))
        origins, directions = fixations.origin[rows], fixations.direction[rows]
        depth, opacity = trace_depth(opened.geometry, origins, directions, opened.integrator.settings)
        targets = np.where(opacity[:, None] >= SURFACE_OPACITY, origins + depth[:, None] * directions, np.nan)
        pixels = _visible_pixels(camera, targets, view.values, np.ravel(np.array(sensor_center(camera))))
        people, index = np.unique(fixations.person[rows], return_inverse=True)
        threshold = f"I-VT, {rules.velocity_threshold:g}°/s"
        if dispersion_threshold is not None:
            threshold = f"I-DT, {dispersion_threshold:g}°"
        note = f"{len(rows)} fixations ({threshold}, at least {rules.min_fixation:g} s)"
        if hidden := int(np.isnan(pixels[:, 0]).sum()):
            note += f"; {hidden} outside of the image or hidden"
        names = tuple(data.persons[p] for p in people)
        axes = scanpath_figure(view.color, pixels, durations[rows], index, names, note=note)
        inputs = [*existing_files(rays), *list_files(opened)]
        changed |= {"fixations": rules.describe(dispersion_threshold)}
        return finish_figure(axes, output, "nerg draw scanpath", inputs, seed, changed, reporter)


def _visible_pixels(camera: Any, points: np.ndarray, depth: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of ``points`` (N, 3) in the image of ``camera``; NaN outside of it, or if they are more
    than 3 % farther than the surface at the pixel."""
    mi = variant_types()
    out = np.full((len(points), 2), np.nan)
    for row, point in enumerate(points):
        pixel = project_to_pixel(camera, mi.Point3f(*point.tolist())) if np.isfinite(point).all() else None
        if pixel is None:
            continue
        column, line = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(pixel, depth.shape[::-1]))
        if not 0 < 1.03 * depth[line, column] < np.linalg.norm(point - center):
            out[row] = pixel
    return out
