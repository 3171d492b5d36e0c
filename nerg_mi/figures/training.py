"""Figures of trainings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .style import INK, font_size, label_axes, new_page

HELD_OUT_COLOR, TRAINING_COLOR = "#d9730d", "#2b6cb0"
"""Colours of the curves of held-out views and of training views."""

_MIN_TICK_DISTANCE = 0.07  # of the width of the axes


def psnr_figure(history: Sequence[dict], result: dict | None = None, axes: Any = None) -> Any:
    """Draw the PSNR of held-out and training views during a radiance training.

    Parameters
    ----------
    history : sequence of dict
        Evaluations with ``steps``, ``seconds``, and ``psnr`` and ``psnr_train`` in dB (None if unknown).
    result : dict, optional
        Evaluation of the state that was written, which is marked.
    axes : matplotlib.axes.Axes, optional
        Axes to draw in. Default: a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        The axes, with training time at the bottom; their twin has the steps at the top.
    """
    seconds = np.array([row["seconds"] for row in history], float)
    page = None if axes is not None else new_page(720, 460)
    axes = axes if page is None else page.subplots()
    for key, label, color in (
        ("psnr_train", "training views", TRAINING_COLOR),
        ("psnr", "held-out views", HELD_OUT_COLOR),
    ):
        values = np.array([row.get(key) for row in history], float)
        axes.plot(seconds, values, "o-", color=color, label=label, markersize=4, linewidth=1.5)
    if result is not None:
        label = f"written state: step {result['steps']}, {result['psnr']:.2f} dB on these held-out views"
        axes.axvline(result["seconds"], color=INK, linewidth=0.8, linestyle=":")
        axes.plot(
            [result["seconds"]], [result["psnr"]], "*", color=INK, markersize=13, markerfacecolor="white", label=label
        )
    axes.set_xlim(0, max(1.04 * seconds.max(initial=0.0), 1e-3))
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.margins(y=0.12)
    label_axes(axes, "training time [s]", "PSNR [dB]")
    axes.legend(fontsize=font_size(8), loc="best")
    top = axes.twiny()
    top.set_xlim(axes.get_xlim())
    ticks: list[int] = []
    for k in range(len(seconds) - 1, -1, -1):
        if not ticks or seconds[ticks[-1]] - seconds[k] > _MIN_TICK_DISTANCE * axes.get_xlim()[1]:
            ticks.append(k)
    top.set_xticks(seconds[ticks], [str(history[k]["steps"]) for k in ticks])
    top.set_xlabel("training step", fontsize=font_size(8), color=INK)
    top.tick_params(labelsize=font_size(7), colors=INK, length=2)
    title = "Radiance training: evaluations on a few views"
    if page is None:
        axes.set_title(title, fontsize=font_size(10), color=INK)
    else:
        page.suptitle(title, fontsize=font_size(10), color=INK)
        page.subplots_adjust(left=0.09, right=0.97, bottom=0.11, top=0.82)
    return axes
