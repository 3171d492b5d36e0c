"""Figures of attention statistics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerg_mi.figures.style import INK, as_axes, font_size, label_bar, new_page, text_scale

from .tables import Row, is_underestimate

MAX_BARS = 40
"""Maximum number of areas; those with the largest shares are drawn."""

_COLORS = {"measured": "#2b6cb0", "predicted": "#d9730d"}
_GRID = "#dddddd"


def aois_figure(rows: Sequence[Row], title: str = "Attention on AOIs", axes: Any = None) -> np.ndarray:
    """Draw the share of time, the hit ratio and the dwell time of each area, from the ``rows`` of one cell. Return the
    axes (3,).

    Bars are measured values, points are predictions, both with 95 % confidence intervals. Hollow points are biased low.
    ``axes``: three axes to draw in. Default: a new figure with its title and legend.
    """
    panels = (
        ("share", "share of time [%]", 100),
        ("hit_ratio", "hit ratio [% of participants]", 100),
        ("dwell", "dwell time [s]", 1),
    )
    max_share: dict[str, float] = {}
    for row in rows:
        max_share[row["aoi"]] = max(max_share.get(row["aoi"], 0.0), row.get("share") or 0.0)
    names = sorted(max_share, key=lambda n: -max_share[n])[:MAX_BARS][::-1]
    row_of = {name: k for k, name in enumerate(names)}
    page = None if axes is not None else new_page(1100, (130 + 24 * max(len(names), 3)) * text_scale())
    axes = as_axes(axes, len(panels)) if page is None else page.subplots(1, len(panels), sharey=True)
    sources = [s for s in _COLORS if any(row["source"] == s for row in rows)]
    for axis, (key, label, scale) in zip(axes, panels):
        for source in sources:
            rows_of_source = [
                r for r in rows if r["source"] == source and r["aoi"] in row_of and r.get(key) is not None
            ]
            y = np.array([row_of[r["aoi"]] for r in rows_of_source], float)
            x = scale * np.array([r[key] for r in rows_of_source], float)
            # Draw predictions below the centre of the bar.
            shift, color = (0.0, INK) if source == "measured" else (-0.2, _COLORS[source])
            if source == "measured":
                axis.barh(y, x, 0.62, color=_COLORS[source], alpha=0.6, zorder=2)
            else:
                is_underestimate_row = [is_underestimate(r, key) for r in rows_of_source]
                face = "white" if any(is_underestimate_row) else color
                axis.plot(x, y + shift, "o", markersize=4.5, color=color, markerfacecolor=face, zorder=4)
                min_viewpoints = min(
                    (r["viewpoints"] for r, is_low in zip(rows_of_source, is_underestimate_row) if is_low), default=None
                )
                label += (
                    "" if min_viewpoints is None else f"\n○ biased low: {min_viewpoints:.1f} viewpoints per participant"
                )
            for r, at in zip(rows_of_source, y):
                low, high = r.get(f"{key}_low"), r.get(f"{key}_high")
                if low is not None and high is not None:
                    axis.plot([scale * low, scale * high], [at + shift] * 2, "-", color=color, linewidth=1.1, zorder=3)
        axis.set_xlabel(label, fontsize=font_size(8), color=INK)
        axis.tick_params(labelsize=font_size(7.5), colors=INK, length=2)
        axis.grid(axis="x", color=_GRID, linewidth=0.6, zorder=0)
        axis.set_xlim(left=0)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
    axes[0].set_yticks(range(len(names)), [n if len(n) <= 34 else n[:33] + "…" for n in names])
    axes[0].set_ylim(-0.7, len(names) - 0.3)
    labels = {"measured": "measured", "predicted": "predicted by the field"}
    handles = [axes[0].plot([], [], "s", markersize=5, color=_COLORS[s], label=labels[s])[0] for s in sources]
    legend = dict(handles=handles, fontsize=font_size(8), frameon=False)
    if page is None:
        axes[0].set_title(title, fontsize=font_size(10), color=INK, loc="left")
        axes[-1].legend(loc="best", **legend)
        return axes
    height = page.get_figheight() * 100 / text_scale()
    page.suptitle(title, fontsize=font_size(10), color=INK, x=0.01, ha="left", y=1 - 14 / height)
    page.legend(loc="upper right", ncols=2, **legend)
    page.subplots_adjust(left=0.24, right=0.985, wspace=0.08, top=1 - 44 / height, bottom=58 / height)
    return axes


def transitions_figure(
    names: Sequence[str], transitions: np.ndarray, title: str = "Transitions between AOIs", axes: Any = None
) -> Any:
    """Draw the matrix of transitions (K, K), each row in percent of its sum. Return the axes.

    ``axes``: axes to draw in. Default: a new figure.
    """
    total = transitions.sum(axis=1, keepdims=True)
    share = 100 * transitions / np.where(total > 0, total, 1)
    short = [n if len(n) <= 30 else n[:29] + "…" for n in names]
    axis, bar_axes = axes, None
    if axes is None:
        side = 26 * max(len(names), 4)
        label_space = (45 + 5.5 * max(map(len, short), default=0)) * text_scale()
        page = new_page(label_space + side + 120, label_space + side + 50)
        width, height = (100 * v for v in page.get_size_inches())
        axis = page.add_axes((label_space / width, label_space / height, side / width, side / height))
        beside = ((label_space + side + 10) / width, label_space / height, 12 / width, side / height)
        bar_axes = page.add_axes(beside)
    image = axis.imshow(np.ma.masked_equal(share, 0), cmap="viridis", vmin=0, vmax=max(float(share.max()), 1.0))
    axis.set_xticks(range(len(names)), short, rotation=90, fontsize=font_size(7), color=INK)
    axis.set_yticks(range(len(names)), short, fontsize=font_size(7), color=INK)
    axis.set_xlabel("next visit", fontsize=font_size(8), color=INK)
    axis.set_ylabel("visit", fontsize=font_size(8), color=INK)
    axis.set_title(title, fontsize=font_size(10), color=INK, loc="left")
    bar = axis.figure.colorbar(image, cax=bar_axes, ax=axis)
    label_bar(bar, "% of the transitions from the area", 7)
    return axis
