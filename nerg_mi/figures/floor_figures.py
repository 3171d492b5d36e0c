"""The floor plan of a place: what stands there, where people walked, what they looked at and what they could see.

Axes are in metres, x to the right and y up, z the height; +z is up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .sheet import INK, PAPER, SMALL, TITLE, new_page, wrap

PEOPLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#332288")
"""Colours of people, which can be told apart with any kind of colour blindness (Okabe and Ito; Tol), and in grey by
their lightness as far as eight can."""

_SIDE = 720  # pixels of the plan's longer side
_LEFT, _FOOT, _RIGHT = 56, 50, 16
_GREYS = (0.94, 0.62)  # of the lowest and of the highest things below the cut
_CUT = 0.25
_NAMED = 8


@dataclass(frozen=True, eq=False)
class Walls:
    """A place cut at a height. ``low``, ``high`` (2,): corners of the grid on the floor; ``height`` (ny, nx): that of
    what is met below the cut, NaN where nothing is; ``cut`` (ny, nx), bool: where the cut goes through something. Rows
    from the least y on. ``level``: the height of the cut."""

    low: np.ndarray
    high: np.ndarray
    height: np.ndarray
    cut: np.ndarray
    level: float


@dataclass(frozen=True, eq=False)
class Walk:
    """Where a person was: ``places`` (N, 2) in the order of time, ``breaks`` (N,) bool where a new walk begins."""

    name: str
    places: np.ndarray
    breaks: np.ndarray


@dataclass(frozen=True, eq=False)
class Sight:
    """``origins`` (N, 2), and unit ``directions`` (N, 2) or ``ends`` (N, 2) on the floor, of the people numbered
    ``person`` (N,)."""

    origins: np.ndarray
    ends: np.ndarray
    person: np.ndarray


def floor_figure(
    low: np.ndarray,
    high: np.ndarray,
    walls: Walls | None = None,
    walks: list[Walk] | None = None,
    rays: Sight | None = None,
    fields: Sight | None = None,
    fov: float = 60.0,
    title: str = "Floor plan",
) -> Any:
    """The plan between the corners ``low`` and ``high`` (2,), metres.

    ``walks``: paths, a colour a person; ``rays``: lines from eyes to what was looked at; ``fields``: fields of view
    ``fov`` degrees wide, as wedges that end where the sight does. Each kind is explained by a legend.
    """
    size = np.asarray(high, float) - low
    pixels = np.maximum(size / size.max() * _SIDE, 200)
    names = _legend_entries(walls, walks or [], rays, fields, fov)
    columns = max(int(pixels[0] // 190), 1)
    head = 30 + 17 * -(-len(names) // columns)
    width, height = _LEFT + pixels[0] + _RIGHT, _FOOT + pixels[1] + head
    page = new_page(width, height)
    axes = page.add_axes((_LEFT / width, _FOOT / height, pixels[0] / width, pixels[1] / height))
    if walls is not None:
        extent = (walls.low[0], walls.high[0], walls.low[1], walls.high[1])
        axes.imshow(_plan(walls), origin="lower", extent=extent, interpolation="nearest", zorder=0)
    if fields is not None:
        _draw_fields(axes, fields, fov)
    if rays is not None:
        _draw_rays(axes, rays)
    for k, walk in enumerate(walks or []):
        starts = walk.places[walk.breaks]
        axes.plot(*_with_gaps(walk).T, color=color_of(k), linewidth=1.4, zorder=4, solid_joinstyle="round")
        axes.plot(
            *starts.T, "o", color=color_of(k), markersize=3.5, markeredgecolor=PAPER, markeredgewidth=0.6, zorder=5
        )
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]", fontsize=SMALL, color=INK)
    axes.set_ylabel("y [m]", fontsize=SMALL, color=INK)
    axes.tick_params(labelsize=SMALL, colors=INK, length=2)
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)
    page.text(_LEFT / width, 1 - 8 / height, wrap(title, pixels[0], TITLE), fontsize=TITLE, color=INK, va="top")
    if names:
        handles = [axes.plot([], [], label=name, **how)[0] for name, how in names]
        where = dict(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.3, columnspacing=1.4)
        axes.legend(handles=handles, fontsize=SMALL, frameon=False, ncols=columns, handletextpad=0.5, **where)
    return page


def color_of(person: int) -> str:
    """The colour of the person with this number; those beyond the last colour begin anew."""
    return PEOPLE[person % len(PEOPLE)]


def _with_gaps(walk: Walk) -> np.ndarray:
    """The places of a walk with a NaN before each at which a new one begins."""
    return np.insert(walk.places.astype(float), np.flatnonzero(walk.breaks), np.nan, axis=0)


def _plan(walls: Walls) -> np.ndarray:
    """Greys (ny, nx, 3): the higher the darker, white where nothing is met, and darkest where the cut goes through."""
    share = np.clip(np.nan_to_num(walls.height) / walls.level, 0.0, 1.0)
    grey = _GREYS[0] + share * (_GREYS[1] - _GREYS[0])
    grey = np.where(np.isnan(walls.height), 1.0, grey)
    return np.repeat(np.where(walls.cut, _CUT, grey)[..., None], 3, axis=-1)


def _draw_rays(axes: Any, rays: Sight) -> None:
    from matplotlib.collections import LineCollection

    lines = np.stack([rays.origins, rays.ends], axis=1)
    colors = [color_of(k) for k in rays.person]
    axes.add_collection(LineCollection(list(lines), colors=colors, linewidths=0.6, alpha=0.45, zorder=3))
    axes.scatter(*rays.ends.T, s=5, c=colors, linewidths=0, zorder=3.5)


def _draw_fields(axes: Any, fields: Sight, fov: float) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Wedge

    along = fields.ends - fields.origins
    angle, reach = np.degrees(np.arctan2(along[:, 1], along[:, 0])), np.linalg.norm(along, axis=1)
    wedges = [Wedge(tuple(o), r, a - fov / 2, a + fov / 2) for o, r, a in zip(fields.origins, reach, angle)]
    colors = [color_of(k) for k in fields.person]
    axes.add_collection(
        PatchCollection(wedges, facecolor=colors, edgecolor=colors, alpha=0.22, linewidth=0.7, zorder=2)
    )


def _legend_entries(
    walls: Walls | None, walks: list[Walk], rays: Sight | None, fields: Sight | None, fov: float
) -> list[tuple[str, dict[str, Any]]]:
    square = dict(linestyle="none", marker="s", markersize=6)
    found: list[tuple[str, dict[str, Any]]] = []
    if walls is not None:
        found.append((f"cut at {walls.level:g} m", {**square, "color": str(_CUT)}))
        found.append(("lower things", {**square, "color": str(_GREYS[1])}))
        if np.isnan(walls.height[~walls.cut]).any():
            edge = dict(color=PAPER, markeredgecolor="0.6", markeredgewidth=0.6)
            found.append(("nothing below", {**square, **edge}))
    for k, walk in enumerate(walks[:_NAMED]):
        found.append(
            (walk.name if len(walk.name) <= 22 else walk.name[:21] + "…", dict(color=color_of(k), linewidth=1.4))
        )
    if len(walks) > _NAMED:
        found.append((f"and {len(walks) - _NAMED} more people", dict(color="none")))
    if rays is not None:
        found.append(("to what was looked at", dict(color="0.4", linewidth=0.8, marker="o", markersize=2.5)))
    if fields is not None:
        found.append((f"field of view, {fov:g}°", {**square, "color": "0.75"}))
    return found
