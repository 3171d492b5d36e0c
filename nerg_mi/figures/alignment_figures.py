"""How tracking lies in a place, before and after it is aligned: from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .sheet import INK, new_page

_PLACE, _HITS, _HEADS, _WANTED = "#b9b4aa", "#d9730d", "#2b6cb0", "#1c7c3c"
_MOST = 20_000  # points drawn of a kind; more of them only hide each other
_SIDE = 420


def alignment_figure(
    place: np.ndarray | None,
    points: np.ndarray,
    heads: np.ndarray | None,
    matrix: np.ndarray,
    targets: np.ndarray | None = None,
    title: str = "Alignment",
    cut: float | None = None,
):
    """``points`` (N, 3) and ``heads`` (M, 3) of the tracking as they are and by ``matrix`` (4, 4), over points (K, 3)
    of the ``place`` and the ``targets`` (N, 3) that they belong to; all z up.

    ``cut``: height above which the place is left out of the plans from above, so that no ceiling hides it.
    """
    figure = new_page(2 * _SIDE, 2 * _SIDE + 60)
    moved = lambda p: p @ matrix[:3, :3].T + matrix[:3, 3]
    rows = ((points, heads, "before"), (moved(points), None if heads is None else moved(heads), "after"))
    for line, (p, h, when) in zip(figure.subplots(2, 2), rows):
        for axes, (a, b), view in zip(line, ((0, 1), (0, 2)), ("from above", "from the side")):
            shown = place
            if shown is not None and cut is not None and b == 1:
                shown = shown[shown[:, 2] < cut]
            _dots(axes, shown, (a, b), _PLACE, 1.2, "the place")
            _dots(axes, targets, (a, b), _WANTED, 30, "where they belong", "+")
            _dots(axes, p, (a, b), _HITS, 2 if len(p) > 100 else 14, "hit points" if h is not None else "points")
            _dots(axes, h, (a, b), _HEADS, 2, "heads")
            _frame(axes, [v for v in (shown, targets, p, h) if v is not None and len(v)], (a, b))
            axes.set_title(f"{when}, {view}", fontsize=9, color=INK, loc="left")
            axes.set_xlabel("xyz"[a], fontsize=7, color=INK, labelpad=1)
            axes.set_ylabel("xyz"[b], fontsize=7, color=INK, labelpad=1)
            axes.tick_params(labelsize=7, colors=INK, length=2)
    figure.axes[0].legend(fontsize=7, frameon=False, markerscale=5, loc="upper right")
    figure.suptitle(title, fontsize=10, color=INK)
    figure.tight_layout()
    return figure


def _dots(axes, points: np.ndarray | None, at: tuple[int, int], color: str, size: float, name: str, mark=".") -> None:
    if points is None or not len(points):
        return
    some = points[np.random.default_rng(0).permutation(len(points))[:_MOST]]
    edge = 0 if mark == "." else 1
    x, y = some[:, at].T
    axes.scatter(x, y, s=size, c=color, marker=mark, linewidths=edge, label=name, rasterized=True)


def _frame(axes, parts: Sequence[np.ndarray], at: tuple[int, int]) -> None:
    """Axes of equal scale that hold all parts but for their strays."""
    low = np.min([np.percentile(p[:, at], 1, axis=0) for p in parts], axis=0)
    high = np.max([np.percentile(p[:, at], 99, axis=0) for p in parts], axis=0)
    edge = 0.06 * max(float(np.max(high - low)), 1e-9)
    axes.set_xlim(low[0] - edge, high[0] + edge)
    axes.set_ylim(low[1] - edge, high[1] + edge)
    axes.set_aspect("equal", adjustable="box")
