"""Floor plans of recorded positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np

from nerg_mi.environment.scene import Scene
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.values import FilePath, find_names
from nerg_mi.maths.types import Axes, Figure, MitsubaScene
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import COORDINATES, LENGTHS, Range, check_ranges
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.filters import find_sessions, read_position_split
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SURFACE_OPACITY, trace_depth

from .maps import ParticipantPath, SightLines, Walls, floor_figure, floor_plan, layout_figure
from .scene_views import list_files, open_scene
from .style import (
    changed_arguments,
    check_figure,
    existing_files,
    figure_of,
    finish_figure,
    make_provenance,
    save,
    show_figure,
)


@check_ranges
def plot_rays(
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    kind: Literal["density", "layout"] = "density",
    cell_size: Annotated[float, LENGTHS] | None = None,
    test: Rays | FilePath | None = None,
    axes: Axes | None = None,
    progress: Progress = None,
) -> Figure:
    """Draw a floor plan of recorded positions, as densities or as the layout of a split.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    output : path, optional
        Image to write (.png or .svg).
    kind : str
        What is drawn: density (rays per square metre, with mean directions) or layout (ray origins, with dimensions).
    cell_size : float, optional
        Edge length of a grid cell of the density in metres. Default: a fiftieth of the plan.
    test : Rays or path, optional
        Rays file of the test rays of a split, drawn in the same layout.
    axes : matplotlib.axes.Axes, optional
        Axes to draw in. Default: a new figure.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure.

    Raises
    ------
    NergError
        An argument is invalid, or there are no rays.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> len(nerg.plot_rays(rays).axes) > 0
    True
    """
    settings = changed_arguments(plot_rays, locals())
    settings.pop("axes", None)
    if kind == "density" and test is not None:
        raise NergError(f"{parameter('test')} applies to layouts only; add {parameter('kind', 'layout')}")
    check_figure(output)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "drawing rays")
        data = open_rays(rays)
        if kind == "density":
            drawn = floor_plan(data, cell_size, axes=axes)
        else:
            test_rays = None if test is None else open_rays(test)
            split = {} if test_rays is None else read_position_split(test_rays)
            drawn = layout_figure(data, test_rays, split.get("test_centres"), split.get("radius"), axes=axes)
        if output is not None:
            save(drawn, output, make_provenance("nerg rays plot", existing_files(rays, test), None, settings))
            reporter.message(f"wrote {output}")
    figure = figure_of(drawn)
    return show_figure(figure) if axes is None else figure


# ---- Plans of a scene: a horizontal cut, paths, gaze rays, and fields of view ----

_GAP = 1.0  # seconds without a ray that interrupt a path
_JUMP = 1.0  # metres between two rays that interrupt a path
_FINEST = 0.02  # metres between points of a drawn path
_DRAWN_LENGTH = 1.2  # drawn length in metres of fields of view and of rays without a hit point
CELLS = 360
"""Number of grid cells along the longer side of a cut through a scene."""


@check_ranges
def draw_floor(
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    scene: FilePath | Scene | MitsubaScene | None = None,
    defaults: Mapping[str, str] | None = None,
    persons: Sequence[str] = (),
    paths: bool = True,
    num_rays: Annotated[int, Range(0, 20000)] = 0,
    num_views: Annotated[int, Range(0, 1000)] = 0,
    fov: Annotated[float, Range(1, 180)] = 60.0,
    cut_height: Annotated[float, LENGTHS] = 1.2,
    floor_height: Annotated[float, COORDINATES] = 0.0,
    progress: Progress = None,
) -> Figure:
    """Draw the floor plan of rays in their scene.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    scene : path, Scene or mi.Scene, optional
        Scene file (.xml) whose walls and furniture are drawn. Default: none are drawn.
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    persons : sequence of str
        Name of a participant to draw. Default: all.
    paths : bool
        Draw the paths of the participants.
    num_rays : int
        Number of recorded rays to draw, evenly selected, from the eye to the hit point (or a point ahead where no hit
        point is recorded).
    num_views : int
        Number of fields of view to draw for each participant.
    fov : float
        Width of these fields of view in degrees.
    cut_height : float
        Height above the floor in metres at which the scene is cut.
    floor_height : float
        Height of the floor (z) in scene units.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or there are no rays.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> len(nerg.draw_floor(rays, num_views=3).axes) > 0
    True
    """
    changed = changed_arguments(draw_floor, locals())
    check_figure(output)
    with open_reporter(progress) as reporter:
        data = select_participants(open_rays(rays), persons)
        if not len(data):
            raise NergError(f"a floor plan needs rays, and there are none; give others as {parameter('rays')}")
        low, high = _corners(data)
        inputs, walls = existing_files(rays), None
        if scene is not None:
            reporter.progress(0.0, "loading the scene")
            opened = open_scene(scene, defaults)
            reporter.progress(0.2, "cutting the scene")
            walls = cut_scene(opened, low, high, floor_height + cut_height, floor_height)
            inputs += list_files(opened)
        number = {person: k for k, person in enumerate(np.unique(data.person))}
        figure = floor_figure(
            low,
            high,
            walls,
            _walks(data, number) if paths else [],
            _sights(data, number, num_rays),
            _fields(data, number, num_views),
            fov,
            f"{len(data):,} rays of {len(number)} {'participant' if len(number) == 1 else 'participants'}",
        )
        return finish_figure(figure, output, "nerg draw floor", inputs, None, changed, reporter)


def select_participants(rays: Rays, names: Sequence[str]) -> Rays:
    """Select the rays of the participants ``names``; none: all rays."""
    if not names:
        return rays
    return rays.select(np.isin(rays.person, find_names(names, rays.persons, "person")))


def _corners(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a plan that contains all positions and all but outlying hit points."""
    parts = [rays.origin[:, :2]]
    if rays.hit is not None:
        hits = rays.hit[np.isfinite(rays.hit).all(axis=1), :2]
        parts += [np.percentile(hits, [1, 99], axis=0)] if len(hits) else []
    every = np.concatenate(parts)
    low, high = every.min(axis=0), every.max(axis=0)
    edge = max(0.06 * float((high - low).max()), 0.5)
    return low - edge, high + edge


def _walks(rays: Rays, people: Mapping[int, int]) -> list[ParticipantPath]:
    """Return the path of each participant, simplified, and interrupted where there are no rays."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    label, walks = sessions.label_rays(), []
    for person in people:
        mine = rays.person[order] == person
        rows, recording = order[mine], label[mine]
        places, t = rays.origin[rows, :2], rays.t[rows]
        step = np.linalg.norm(np.diff(places, axis=0), axis=1)
        breaks = np.r_[True, (np.abs(np.diff(t)) > _GAP) | (step > _JUMP) | (np.diff(recording) != 0)]
        selected = breaks | np.r_[True, np.diff(np.floor(np.cumsum(np.r_[0.0, step]) / _FINEST)) > 0]
        walks.append(ParticipantPath(rays.persons[person], places[selected], breaks[selected]))
    return walks


def _sights(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """Return ``count`` evenly selected rays."""
    if not count:
        return None
    some = np.unique(np.linspace(0, len(rays) - 1, count).astype(int))
    origins, ends = rays.origin[some, :2], _ahead(rays, some)
    if rays.hit is not None:
        hit = rays.hit[some, :2]
        ends = np.where(np.isfinite(hit), hit, ends)
    return SightLines(origins, ends, np.array([number[p] for p in rays.person[some]]))


def _fields(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """Return fields of view at ``count`` evenly selected samples of each participant."""
    if not count:
        return None
    selected = []
    for person in number:
        mine = np.flatnonzero(rays.person == person)
        mine = mine[np.argsort(rays.t[mine], kind="stable")]
        selected.append(mine[np.unique(np.linspace(0, len(mine) - 1, count).astype(int))])
    some = np.concatenate(selected)
    return SightLines(rays.origin[some, :2], _ahead(rays, some), np.array([number[p] for p in rays.person[some]]))


def _ahead(rays: Rays, some: np.ndarray) -> np.ndarray:
    """Return floor positions (n, 2) at a fixed distance along the rays ``some``."""
    return rays.origin[some, :2] + _DRAWN_LENGTH * rays.direction[some, :2]


def cut_scene(scene: Scene, low: np.ndarray, high: np.ndarray, level: float, floor: float) -> Walls:
    """Cut the scene horizontally between the corners ``low`` and ``high`` (2,) at the height ``level``, +z up.

    From the centre of each cell rays are traced down, which gives the height of what is below, and to the neighbouring
    cells, which tells where the cut passes through objects. A cell inside an object hits it immediately. ``floor`` is
    the height from which heights are counted. All lengths are in scene units.
    """
    side = float(max(high - low)) / CELLS
    nx, ny = (max(int(np.ceil(v / side)), 1) for v in high - low)
    x, y = low[0] + (np.arange(nx) + 0.5) * side, low[1] + (np.arange(ny) + 0.5) * side
    centres = np.stack([*np.meshgrid(x, y), np.full((ny, nx), level)], axis=-1).reshape(-1, 3)

    def trace_hits(direction: tuple[float, float, float]) -> np.ndarray:
        directions = np.broadcast_to(direction, centres.shape)
        depth, opacity = trace_depth(scene.geometry, centres, directions, scene.integrator.settings)
        return np.where(opacity >= SURFACE_OPACITY, depth, np.inf).reshape(ny, nx)

    down = trace_hits((0, 0, -1))
    height = np.where(np.isfinite(down), level - floor - down, np.nan)
    cut = (
        (trace_hits((1, 0, 0)) < side)
        | (trace_hits((0, 1, 0)) < side)
        | (trace_hits((-1, 0, 0)) < side)
        | (trace_hits((0, -1, 0)) < side)
    )
    return Walls(low, low + side * np.array([nx, ny]), height, cut, level - floor)
