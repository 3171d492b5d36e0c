"""Scanpaths: numbered fixations and the saccades between them, drawn over an image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .maps import participant_color
from .overlay import srgb
from .style import INK, PAPER, SMALL, Sheet

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
