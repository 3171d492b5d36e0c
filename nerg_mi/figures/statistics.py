"""Figures of statistics: shares of areas with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerg_mi.statistics.tables import is_too_low

from .style import INK, label_axes, label_bar, new_page

MAX_BARS = 40
"""So many things are drawn, those of the greatest share."""

_COLORS = {"tracked": "#2b6cb0", "field": "#d9730d"}
_GRID = "#dddddd"
Row = dict[str, Any]


def things_figure(rows: Sequence[Row], title: str = "Attention on things") -> Any:
    """Share of time, reach and dwell of each thing, from ``rows`` of one cell: a bar for what was counted and a point
    for what the field foretells, with 95 % intervals; hollow, and said to be so, where it comes out too low."""
    panels = (("share", "share of time [%]", 100), ("reach", "reach [% of people]", 100), ("dwell", "dwell [s]", 1))
    best: dict[str, float] = {}
    for row in rows:
        best[row["thing"]] = max(best.get(row["thing"], 0.0), row.get("share") or 0.0)
    names = sorted(best, key=lambda n: -best[n])[:MAX_BARS][::-1]
    place = {name: k for k, name in enumerate(names)}
    page = new_page(1100, 130 + 24 * max(len(names), 3))
    height = page.get_figheight() * 100
    axes = page.subplots(1, len(panels), sharey=True)
    sources = [s for s in _COLORS if any(row["source"] == s for row in rows)]
    for axis, (key, label, scale) in zip(axes, panels):
        for source in sources:
            some = [r for r in rows if r["source"] == source and r["thing"] in place and r.get(key) is not None]
            y = np.array([place[r["thing"]] for r in some], float)
            x = scale * np.array([r[key] for r in some], float)
            # A field's numbers stand below the middle of the bar, and in their colour.
            shift, color = (0.0, INK) if source == "tracked" else (-0.2, _COLORS[source])
            if source == "tracked":
                axis.barh(y, x, 0.62, color=_COLORS[source], alpha=0.6, zorder=2)
            else:
                hollow = [is_too_low(r, key) for r in some]
                face = "white" if any(hollow) else color
                axis.plot(x, y + shift, "o", markersize=4.5, color=color, markerfacecolor=face, zorder=4)
                places = min((r["places"] for r, is_low in zip(some, hollow) if is_low), default=None)
                label += "" if places is None else f"\n○ too low: from {places:.1f} places a person"
            for r, at in zip(some, y):
                low, high = r.get(f"{key}_low"), r.get(f"{key}_high")
                if low is not None and high is not None:
                    axis.plot([scale * low, scale * high], [at + shift] * 2, "-", color=color, linewidth=1.1, zorder=3)
        axis.set_xlabel(label, fontsize=8, color=INK)
        axis.tick_params(labelsize=7.5, colors=INK, length=2)
        axis.grid(axis="x", color=_GRID, linewidth=0.6, zorder=0)
        axis.set_xlim(left=0)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
    axes[0].set_yticks(range(len(names)), [n if len(n) <= 34 else n[:33] + "…" for n in names])
    axes[0].set_ylim(-0.7, len(names) - 0.3)
    page.suptitle(title, fontsize=10, color=INK, x=0.01, ha="left", y=1 - 14 / height)
    words = {"tracked": "counted in rays", "field": "foretold by the field"}
    handles = [axes[0].plot([], [], "s", markersize=5, color=_COLORS[s], label=words[s])[0] for s in sources]
    page.legend(handles=handles, fontsize=8, frameon=False, loc="upper right", ncols=2)
    page.subplots_adjust(left=0.24, right=0.985, wspace=0.08, top=1 - 44 / height, bottom=58 / height)
    return page


def moves_figure(names: Sequence[str], moves: np.ndarray, title: str = "From thing to thing") -> Any:
    """The matrix ``moves`` (K, K), each row in percent of the moves from there."""
    total = moves.sum(axis=1, keepdims=True)
    share = 100 * moves / np.where(total > 0, total, 1)
    side = 26 * max(len(names), 4)
    short = [n if len(n) <= 30 else n[:29] + "…" for n in names]
    room = 45 + 5.5 * max(map(len, short), default=0)
    page = new_page(room + side + 120, room + side + 50)
    width, height = (100 * v for v in page.get_size_inches())
    axis = page.add_axes((room / width, room / height, side / width, side / height))
    image = axis.imshow(np.ma.masked_equal(share, 0), cmap="viridis", vmin=0, vmax=max(float(share.max()), 1.0))
    axis.set_xticks(range(len(names)), short, rotation=90, fontsize=7, color=INK)
    axis.set_yticks(range(len(names)), short, fontsize=7, color=INK)
    axis.set_xlabel("next look at", fontsize=8, color=INK)
    axis.set_ylabel("after a look at", fontsize=8, color=INK)
    axis.set_title(title, fontsize=10, color=INK, loc="left")
    bar = page.colorbar(
        image, cax=page.add_axes(((room + side + 10) / width, room / height, 12 / width, side / height))
    )
    label_bar(bar, "% of the moves from there", 7)
    return page


def map_figure(points: np.ndarray, values: np.ndarray, step: float, label: str, title: str) -> Any:
    """``values`` (G,) at places (G, 2 or 3) of a grid of edge ``step``, seen from above."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    low, high = points[:, :2].min(axis=0) - step, points[:, :2].max(axis=0) + step
    scale = 620 / max(high - low)
    size = (high - low) * scale
    page = new_page(size[0] + 170, size[1] + 100)
    width, height = (100 * v for v in page.get_size_inches())
    axis = page.add_axes((60 / width, 50 / height, size[0] / width, size[1] / height))
    squares = [Rectangle((x - step / 2, y - step / 2), step, step) for x, y in points[:, :2]]
    cells = PatchCollection(squares, cmap="viridis", linewidth=0)
    cells.set_array(np.asarray(values, float))
    axis.add_collection(cells)
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(low[1], high[1])
    axis.set_aspect("equal")
    label_axes(axis, "x [m]", "y [m]")
    axis.set_title(title, fontsize=10, color=INK, loc="left")
    bar = page.colorbar(cells, cax=page.add_axes((1 - 95 / width, 50 / height, 14 / width, size[1] / height)))
    label_bar(bar, label)
    return page
