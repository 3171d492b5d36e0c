"""Plan views of a scene: alignment, cameras, floor plans, gaze samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.transforms import transform_points
from nerg_mi.tracking_kinds import TRACKING_NOTES

from .style import (
    DPI,
    INK,
    PAPER,
    SMALL,
    TITLE,
    as_axes,
    figure_of,
    font_size,
    label_axes,
    label_bar,
    new_page,
    text_scale,
    wrap,
)

# ---- Alignment ----

_PLACE, _HITS, _HEADS, _TARGETS = "#b9b4aa", "#d9730d", "#2b6cb0", "#1c7c3c"
_MAX_POINTS = 20_000  # maximum number of drawn points per kind
_ALIGNMENT_SIDE = 420


def alignment_figure(
    place: np.ndarray | None,
    points: np.ndarray,
    heads: np.ndarray | None,
    matrix: np.ndarray,
    targets: np.ndarray | None = None,
    title: str = "Alignment",
    cut_height: float | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Draw the tracking before and after an alignment, from above and from the side; z is up. Return the axes (2, 2).

    Parameters
    ----------
    place
        Points of the scene, (K, 3), or None.
    points, heads
        Points (N, 3) and head positions (M, 3) of the tracking.
    matrix
        Similarity (4, 4) from the tracking to the scene.
    targets
        Positions (N, 3) to which the points should be mapped.
    title
        Title of the figure.
    cut_height
        Height above which the scene is omitted in views from above, such as a ceiling.
    axes
        Axes (2, 2) to draw in. Default: a new figure with its title.
    """
    grid = _grid_of(axes, (2, 2), 2 * _ALIGNMENT_SIDE, 2 * _ALIGNMENT_SIDE + 60)
    moved_heads = None if heads is None else transform_points(matrix, heads)
    rows = ((points, heads, "before"), (transform_points(matrix, points), moved_heads, "after"))
    for line, (p, h, when) in zip(grid, rows):
        for panel, (a, b), view in zip(line, ((0, 1), (0, 2)), ("from above", "from the side")):
            shown = place
            if shown is not None and cut_height is not None and b == 1:
                shown = shown[shown[:, 2] < cut_height]
            name = "hit points" if h is not None else "points"
            _draw_points(panel, shown, (a, b), _PLACE, 1.2, "scene")
            _draw_points(panel, targets, (a, b), _TARGETS, 30, "targets", "+")
            _draw_points(panel, p, (a, b), _HITS, 2 if len(p) > 100 else 14, name)
            _draw_points(panel, h, (a, b), _HEADS, 2, "heads")
            _set_limits(panel, [v for v in (shown, targets, p, h) if v is not None and len(v)], (a, b))
            panel.set_title(f"{when}, {view}", fontsize=font_size(9), color=INK, loc="left")
            label_axes(panel, "xyz"[a], "xyz"[b], 7, labelpad=1)
    grid[0, 0].legend(fontsize=font_size(7), frameon=False, markerscale=5, loc="upper right")
    _finish_grid(grid, title, axes is None)
    return grid


def _grid_of(axes: Any, shape: tuple[int, ...], width: float, height: float) -> np.ndarray:
    """Return given ``axes`` in this shape, or those of a new figure."""
    if axes is None:
        return np.reshape(new_page(width, height).subplots(*shape), shape)
    return as_axes(axes, int(np.prod(shape))).reshape(shape)


def _finish_grid(grid: np.ndarray, title: str, is_new: bool) -> None:
    """Give a new figure its title and its layout."""
    if is_new:
        figure = figure_of(grid)
        figure.suptitle(title, fontsize=font_size(TITLE), color=INK)
        figure.tight_layout()


def _draw_points(
    axes, points: np.ndarray | None, axis_pair: tuple[int, int], color: str, size: float, name: str, mark="."
) -> None:
    if points is None or not len(points):
        return
    subset = points[np.random.default_rng(0).permutation(len(points))[:_MAX_POINTS]]
    edge = 0 if mark == "." else 1
    x, y = subset[:, axis_pair].T
    axes.scatter(x, y, s=size, c=color, marker=mark, linewidths=edge, label=name, rasterized=True)


def _set_limits(axes, parts: Sequence[np.ndarray], axis_pair: tuple[int, int]) -> None:
    """Set limits of equal scale that contain all parts except outliers."""
    low = np.min([np.percentile(p[:, axis_pair], 1, axis=0) for p in parts], axis=0)
    high = np.max([np.percentile(p[:, axis_pair], 99, axis=0) for p in parts], axis=0)
    edge = 0.06 * max(float(np.max(high - low)), 1e-9)
    axes.set_xlim(low[0] - edge, high[0] + edge)
    axes.set_ylim(low[1] - edge, high[1] + edge)
    axes.set_aspect("equal", adjustable="box")


# ---- Cameras ----

_CAMERA, _PATH = "#c0392b", "#e2a49c"
_MAX_CAMERA_POINTS = 40_000  # maximum number of drawn points
_CAMERA_SIDE = 520  # pixels of each of the two plans


def camera_figure(
    to_world: np.ndarray, points: np.ndarray, colors: np.ndarray, title: str, axes: Any = None
) -> np.ndarray:
    """Draw cameras and points from above (x, y) and from the side (x, z); z is up, lengths are in units of the poses.
    Return the axes (2,).

    Parameters
    ----------
    to_world
        OpenGL camera-to-world poses, (N, 4, 4). A camera is a wedge that opens in the viewing direction.
    points, colors
        Points (M, 3), without outliers, and their colours (M, 3), uint8.
    title
        Title of the figure.
    axes
        Two axes to draw in. Default: a new figure with its title.
    """
    panels = _grid_of(axes, (1, 2), 2 * _CAMERA_SIDE, _CAMERA_SIDE + 50)[0]
    centers = to_world[:, :3, 3]
    low, high = _camera_bounds(centers, points)
    size = 0.04 * float(np.max(high - low)) or 1.0
    near = np.all((points >= low) & (points <= high), axis=1)
    points, colors = points[near], colors[near]
    if len(points) > _MAX_CAMERA_POINTS:
        subset = np.random.default_rng(0).choice(len(points), _MAX_CAMERA_POINTS, replace=False)
        points, colors = points[subset], colors[subset]
    for panel, (a, b), name in zip(panels, ((0, 1), (0, 2)), ("from above", "from the side")):
        panel.scatter(points[:, a], points[:, b], s=1.5, c=colors / 255.0, linewidths=0, rasterized=True)
        panel.plot(centers[:, a], centers[:, b], color=_PATH, linewidth=0.6)
        for pose in to_world:
            corners = size * np.array([[0, 0, 0], [-0.6, 0, -1], [0.6, 0, -1], [0, 0, 0]])
            wedge = transform_points(pose, corners)
            panel.plot(wedge[:, a], wedge[:, b], color=_CAMERA, linewidth=0.8)
        panel.set_aspect("equal")
        panel.set_title(name, fontsize=font_size(9), color=INK)
        label_axes(panel, "xyz"[a], "xyz"[b])
        panel.set_xlim(low[a] - size, high[a] + size)
        panel.set_ylim(low[b] - size, high[b] + size)
    _finish_grid(panels, title, axes is None)
    return panels


def _camera_bounds(centers: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners that contain all cameras, and the points except outliers."""
    low, high = centers.min(axis=0), centers.max(axis=0)
    if len(points):
        lower, upper = np.quantile(points, [0.05, 0.95], axis=0)
        low, high = np.minimum(low, lower - 0.1 * (upper - lower)), np.maximum(high, upper + 0.1 * (upper - lower))
    return low, high


# ---- Floor plans ----
#
# Floor plan with walls, participants' paths, gaze targets and fields of view. Axes are in metres; z is up.

PARTICIPANT_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#332288")
"""Colours of participants, distinguishable with colour vision deficiencies (Okabe and Ito; Tol)."""

_FLOOR_SIDE = 720  # pixels of the plan's longer side
_LEFT, _FOOT, _RIGHT = 56, 50, 16
_GREYS = (0.94, 0.62)  # grey of the lowest and of the highest objects below the cut
_CUT_GREY = 0.25
_MAX_LEGEND_PATHS = 8


@dataclass(frozen=True, eq=False)
class Walls:
    """A horizontal cut through a scene.

    ``low``, ``high`` (2,): corners of the grid on the floor; ``height`` (ny, nx): height of the first surface below the
    cut, NaN if there is none; a mask (ny, nx) of the cells in which the cut passes through a solid; the height of the
    cut. Rows start at the smallest y.
    """

    low: np.ndarray
    high: np.ndarray
    height: np.ndarray
    is_cut: np.ndarray
    cut_height: float


@dataclass(frozen=True, eq=False)
class ParticipantPath:
    """Path of a participant: positions (N, 2) sorted by time, and whether a new segment starts at each, (N,)."""

    name: str
    positions: np.ndarray
    is_start: np.ndarray


@dataclass(frozen=True, eq=False)
class SightLines:
    """``origins`` and ``ends`` (N, 2) on the floor, and the index of the ``participant`` of each (N,)."""

    origins: np.ndarray
    ends: np.ndarray
    participant: np.ndarray


def floor_figure(
    low: np.ndarray,
    high: np.ndarray,
    walls: Walls | None = None,
    paths: list[ParticipantPath] | None = None,
    rays: SightLines | None = None,
    fields: SightLines | None = None,
    fov: float = 60.0,
    title: str = "Floor plan",
    axes: Any = None,
) -> Any:
    """Draw a floor plan between the corners ``low`` and ``high`` (2,), in metres. Return the axes.

    Parameters
    ----------
    low, high
        Corners of the plan.
    walls
        Cut through the scene.
    paths
        Paths, one colour per participant.
    rays
        Lines from observers to gaze targets.
    fields
        Fields of view, drawn as wedges that end at the first surface.
    fov
        Angle of the fields of view in degrees.
    title
        Title of the figure.
    axes
        Axes to draw in. Default: a new figure.
    """
    size = np.asarray(high, float) - low
    pixels = np.maximum(size / size.max() * _FLOOR_SIDE, 200)
    names = _legend_entries(walls, paths or [], rays, fields, fov)
    scale = text_scale()
    columns = max(int(pixels[0] // (190 * scale)), 1)
    head = (30 + 17 * -(-len(names) // columns)) * scale
    if axes is None:
        left, foot = _LEFT * scale, _FOOT * scale
        width, height = left + pixels[0] + _RIGHT, foot + pixels[1] + head
        page = new_page(width, height)
        axes = page.add_axes((left / width, foot / height, pixels[0] / width, pixels[1] / height))
        page.text(
            left / width,
            1 - 8 / height,
            wrap(title, pixels[0], font_size(TITLE)),
            fontsize=font_size(TITLE),
            color=INK,
            va="top",
        )
    else:
        axes.set_title(title, fontsize=font_size(TITLE), color=INK, loc="left", pad=head * 72 / DPI)
    if walls is not None:
        extent = (walls.low[0], walls.high[0], walls.low[1], walls.high[1])
        axes.imshow(_shade_plan(walls), origin="lower", extent=extent, interpolation="nearest", zorder=0)
    if fields is not None:
        _draw_fields(axes, fields, fov)
    if rays is not None:
        _draw_rays(axes, rays)
    for k, walk in enumerate(paths or []):
        starts = walk.positions[walk.is_start]
        axes.plot(*_with_gaps(walk).T, color=participant_color(k), linewidth=1.4, zorder=4, solid_joinstyle="round")
        axes.plot(
            *starts.T,
            "o",
            color=participant_color(k),
            markersize=3.5,
            markeredgecolor=PAPER,
            markeredgewidth=0.6,
            zorder=5,
        )
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="datalim")
    label_axes(axes, "x [m]", "y [m]", ticks=SMALL)
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)
    if names:
        handles = [axes.plot([], [], label=name, **how)[0] for name, how in names]
        where = dict(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.3, columnspacing=1.4)
        axes.legend(
            handles=handles, fontsize=font_size(SMALL), frameon=False, ncols=columns, handletextpad=0.5, **where
        )
    return axes


def participant_color(index: int) -> str:
    """Return the colour of a participant; colours repeat after the last one."""
    return PARTICIPANT_COLORS[index % len(PARTICIPANT_COLORS)]


def _with_gaps(walk: ParticipantPath) -> np.ndarray:
    """Return the positions of a path with a NaN before each new segment."""
    return np.insert(walk.positions.astype(float), np.flatnonzero(walk.is_start), np.nan, axis=0)


def _shade_plan(walls: Walls) -> np.ndarray:
    """Return greys (ny, nx, 3): darker for higher surfaces, white without a surface, darkest at the cut."""
    fraction = np.clip(np.nan_to_num(walls.height) / walls.cut_height, 0.0, 1.0)
    grey = _GREYS[0] + fraction * (_GREYS[1] - _GREYS[0])
    grey = np.where(np.isnan(walls.height), 1.0, grey)
    return np.repeat(np.where(walls.is_cut, _CUT_GREY, grey)[..., None], 3, axis=-1)


def _draw_rays(axes: Any, rays: SightLines) -> None:
    from matplotlib.collections import LineCollection

    lines = np.stack([rays.origins, rays.ends], axis=1)
    colors = [participant_color(k) for k in rays.participant]
    axes.add_collection(LineCollection(list(lines), colors=colors, linewidths=0.6, alpha=0.45, zorder=3))
    axes.scatter(*rays.ends.T, s=5, c=colors, linewidths=0, zorder=3.5)


def _draw_fields(axes: Any, fields: SightLines, fov: float) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Wedge

    along = fields.ends - fields.origins
    angle, length = np.degrees(np.arctan2(along[:, 1], along[:, 0])), np.linalg.norm(along, axis=1)
    wedges = [Wedge(tuple(o), r, a - fov / 2, a + fov / 2) for o, r, a in zip(fields.origins, length, angle)]
    colors = [participant_color(k) for k in fields.participant]
    axes.add_collection(
        PatchCollection(wedges, facecolor=colors, edgecolor=colors, alpha=0.22, linewidth=0.7, zorder=2)
    )


def _legend_entries(
    walls: Walls | None, walks: list[ParticipantPath], rays: SightLines | None, fields: SightLines | None, fov: float
) -> list[tuple[str, dict[str, Any]]]:
    square = dict(linestyle="none", marker="s", markersize=6)
    entries: list[tuple[str, dict[str, Any]]] = []
    if walls is not None:
        entries.append((f"cut at {walls.cut_height:g} m", {**square, "color": str(_CUT_GREY)}))
        entries.append(("lower objects", {**square, "color": str(_GREYS[1])}))
        if np.isnan(walls.height[~walls.is_cut]).any():
            edge = dict(color=PAPER, markeredgecolor="0.6", markeredgewidth=0.6)
            entries.append(("no surface below", {**square, **edge}))
    for k, walk in enumerate(walks[:_MAX_LEGEND_PATHS]):
        entries.append(
            (
                walk.name if len(walk.name) <= 22 else walk.name[:21] + "…",
                dict(color=participant_color(k), linewidth=1.4),
            )
        )
    if len(walks) > _MAX_LEGEND_PATHS:
        entries.append((f"and {len(walks) - _MAX_LEGEND_PATHS} more participants", dict(color="none")))
    if rays is not None:
        entries.append(("lines of sight", dict(color="0.4", linewidth=0.8, marker="o", markersize=2.5)))
    if fields is not None:
        entries.append((f"field of view, {fov:g}°", {**square, "color": "0.75"}))
    return entries


# ---- Gaze samples ----
#
# Both functions draw in matplotlib ``Axes`` in metres and return them.

_POINTS, _HELD_OUT, _SURFACES = "#2b6cb0", "#d9730d", "#b9b4aa"
_MAX_RAY_POINTS = 60_000  # maximum number of drawn points
_MAX_CELLS = 4_000_000
_PLAN_SIDE = 640  # pixels of the plan's longer side


def floor_plan(rays, cell: float | None = None, title: str = "Participants' positions", axes: Any = None) -> Any:
    """Draw the density of the samples' origins on the floor in samples/m², on a logarithmic scale; empty cells are
    white. Return the axes.

    Arrows show the mean horizontal gaze direction in coarser cells; longer arrows mean more agreement. Raises
    `NergError` if there are no samples, and for an invalid cell size.

    Parameters
    ----------
    rays
        Gaze samples.
    cell
        Edge length of a cell in metres. Default: a fiftieth of the shorter side, at least 5 cm.
    title
        Title of the figure.
    axes
        Axes to draw in. Default: a new figure.
    """
    from matplotlib.colors import LogNorm

    xy = rays.origin[:, :2]
    low, high = _bounding_box(xy)
    size = high - low
    cell = max(0.05, round(float(size.min()) / 50, 2)) if cell is None else cell
    if not 0 < cell < np.inf:
        raise NergError(
            f"the edge length of a cell must be positive, in metres; got {cell:g} ({parameter('cell_size')})"
        )
    if not np.prod(size / cell + 1) <= _MAX_CELLS:
        raise NergError(
            f"a plan of {size[0]:.4g} x {size[1]:.4g} m has more than {_MAX_CELLS:,} cells of {cell:g} m; choose "
            f"larger cells ({parameter('cell_size')})"
        )
    edges = [np.arange(a, b + cell, cell) for a, b in zip(low, high)]
    counts, *_ = np.histogram2d(xy[:, 0], xy[:, 1], edges)
    density = np.ma.masked_equal(counts.T / cell**2, 0)
    axes, bar_axes = _plan_axes(axes, low, high, f"{title}: {_describe_rays(rays)}", bar=True)
    top = float(density.max())
    bottom = max(float(density.min()), top * 1e-4)
    image = axes.pcolormesh(
        *edges, density, cmap="viridis", norm=LogNorm(bottom, max(top, bottom * 1.01)), rasterized=True
    )
    _draw_arrows(axes, rays, low, high)
    bar = axes.figure.colorbar(image, cax=bar_axes, ax=axes)
    label_bar(bar, f"samples/m² in cells of {cell:g} m; white: no sample", 7)
    return axes


def layout_figure(
    rays, test=None, centres=None, radius: float | None = None, title: str = "Layout", axes: Any = None
) -> Any:
    """Draw the origin of every sample (blue) in the scene, with its dimensions in metres. Return the axes.

    The scene is outlined by the hit points between 0.3 and 2 m above the floor, in grey.

    Parameters
    ----------
    rays
        Gaze samples.
    test
        Held-out samples, in orange, on top of the others.
    centres, radius
        Centres (T, 3) and radius of test positions, drawn as circles on top of all samples.
    title
        Title of the figure.
    axes
        Axes to draw in. Default: a new figure.
    """
    points = [rays.origin[:, :2]] + ([] if test is None else [test.origin[:, :2]])
    walls = _hit_outline([rays] if test is None else [rays, test])
    low, high = _bounding_box(np.concatenate([*points, *([] if walls is None else [walls])]))
    axes, _ = _plan_axes(axes, low, high, f"{title}: {_describe_rays(rays, test)}", pad=0.13)
    if walls is not None:
        axes.plot(*_subsample(walls).T, ",", color=_SURFACES, rasterized=True, zorder=1)
    for level, (xy, color) in enumerate(zip(points, (_POINTS, _HELD_OUT))):
        size = 3.5 - 0.5 * np.log10(max(len(xy), 10))  # few points are drawn larger
        axes.plot(
            *_subsample(xy).T,
            ".",
            markersize=max(size, 1.1),
            markeredgewidth=0,
            color=color,
            rasterized=True,
            zorder=2 + level,
        )
    if centres is not None and radius is not None:
        from matplotlib.collections import PatchCollection
        from matplotlib.patches import Circle

        circles = [Circle(c, radius) for c in np.asarray(centres)[:, :2]]
        axes.add_collection(PatchCollection(circles, facecolor=_HELD_OUT, edgecolor="none", alpha=0.02, zorder=1.5))
        edges = PatchCollection(
            circles, facecolor="none", edgecolor=INK, linewidth=0.6, alpha=_edge_alpha(len(circles))
        )
        axes.add_collection(edges)
        edges.set_zorder(4)
    first, last = _bounding_box(np.concatenate(points), margin=0.0)
    _draw_dimensions(axes, first, last)
    names = [(_POINTS, "samples" if test is None else "training samples")]
    names += ([] if test is None else [(_HELD_OUT, "test samples")]) + (
        [] if walls is None else [(_SURFACES, "gaze hit points")]
    )
    handles = [axes.plot([], [], "s", markersize=5, color=color, label=name)[0] for color, name in names]
    axes.legend(
        handles=handles,
        fontsize=font_size(7),
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=3,
        borderaxespad=0.2,
        handletextpad=0.1,
    )
    return axes


def _edge_alpha(count: int) -> float:
    """Return the opacity of the outlines of ``count`` circles, which may overlap."""
    return float(np.clip(8 / max(count, 1), 0.08, 0.9))


def _hit_outline(sets) -> np.ndarray | None:
    hits = [r.hit[np.isfinite(r.hit).all(axis=1)] for r in sets if r.hit is not None]
    outlines = [h[(h[:, 2] > 0.3) & (h[:, 2] < 2.0), :2] for h in hits]
    outlines = [f for f in outlines if len(f)]
    if not outlines:
        return None
    walls = np.concatenate(outlines)
    # Drop outliers, such as gaze through a window.
    low, high = np.percentile(walls, [1, 99], axis=0)
    return walls[((walls >= low) & (walls <= high)).all(axis=1)]


def _bounding_box(xy: np.ndarray, margin: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    if not len(xy):
        raise NergError("there are no gaze samples to draw; relax the selection")
    low, high = xy.min(axis=0), xy.max(axis=0)
    edge = np.maximum(margin * (high - low).max(), 0.05 if margin else 0.0)
    return low - edge, high + edge


def _subsample(xy: np.ndarray) -> np.ndarray:
    return (
        xy
        if len(xy) <= _MAX_RAY_POINTS
        else xy[np.random.default_rng(0).choice(len(xy), _MAX_RAY_POINTS, replace=False)]
    )


def _describe_rays(rays, test=None) -> str:
    num_participants = np.unique(
        np.concatenate([np.asarray(rays.persons)[np.unique(r.person)] for r in (rays, test) if r is not None])
    ).size
    count = f"{len(rays):,} samples" if test is None else f"{len(rays):,} + {len(test):,} samples"
    what = f", {TRACKING_NOTES[rays.tracking]}" if rays.tracking in TRACKING_NOTES else ""
    return f"{count} of {num_participants} {'participant' if num_participants == 1 else 'participants'}{what}"


def _draw_arrows(axes, rays, low, high) -> None:
    step = float((high - low).max()) / 24
    cell_index = np.floor((rays.origin[:, :2] - low) / step).astype(int)
    width = int(np.ceil((high - low)[0] / step)) + 1
    _, cell, count = np.unique(cell_index[:, 1] * width + cell_index[:, 0], return_inverse=True, return_counts=True)
    mean = lambda v: np.stack([np.bincount(cell, weights=c) for c in v.T], axis=1) / count[:, None]
    mean_position, level = mean(rays.origin[:, :2]), mean(rays.direction[:, :2])
    is_sufficient = count >= max(20, len(rays) * 1e-4)
    mean_position, level = mean_position[is_sufficient], level[is_sufficient]
    axes.quiver(
        *mean_position.T,
        *(level.T * step),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0028,
        color="white",
        edgecolor=INK,
        linewidth=0.4,
        headwidth=4,
        headlength=4,
        headaxislength=3.5,
        zorder=3,
    )


def _draw_dimensions(axes, low, high) -> None:
    """Draw dimension lines with the extent of the samples."""
    x0, x1 = axes.get_xlim()
    y0, y1 = axes.get_ylim()
    line = dict(
        arrowprops=dict(arrowstyle="|-|, widthA=0.25, widthB=0.25", color=INK, linewidth=0.8, shrinkA=0, shrinkB=0)
    )
    y, x = y0 + 0.045 * (y1 - y0), x1 - 0.045 * (x1 - x0)
    axes.annotate("", (low[0], y), (high[0], y), **line)
    axes.annotate("", (x, low[1]), (x, high[1]), **line)
    label_style = dict(
        fontsize=font_size(7), color=INK, ha="center", va="center", bbox=dict(facecolor=PAPER, edgecolor="none", pad=1)
    )
    axes.text(0.5 * (low[0] + high[0]), y, f"{high[0] - low[0]:.2f} m", **label_style)
    axes.text(x, 0.5 * (low[1] + high[1]), f"{high[1] - low[1]:.2f} m", rotation=90, **label_style)


def _plan_axes(axes: Any, low, high, title: str, bar: bool = False, pad: float = 0.0) -> tuple[Any, Any]:
    """Return ``axes``, or those of a new figure, in metres of equal scale, and axes for a colour ``bar``; None if these
    are taken from given axes."""
    # Margin for the dimension lines.
    margin = pad * (high - low).max()
    low, high = low - (0, margin), high + (margin, 0)
    size = np.maximum((high - low) / (high - low).max() * _PLAN_SIDE, 160)
    bar_axes = None
    if axes is None:
        left, foot, head, right = (text_scale() * v for v in (48, 40, 46, 96 if bar else 14))
        width, height = left + size[0] + right, foot + size[1] + head
        figure = new_page(width, height)
        axes = figure.add_axes((left / width, foot / height, size[0] / width, size[1] / height))
        if bar:
            bar_axes = figure.add_axes(((left + size[0] + 12) / width, foot / height, 12 / width, size[1] / height))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="datalim")
    label_axes(axes, "x [m]", "y [m]", 7)
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)
    axes.set_title(title, fontsize=font_size(9), color=INK, loc="left", pad=19 if not bar else 6)
    return axes, bar_axes
