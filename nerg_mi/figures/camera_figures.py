"""Where pictures were taken: cameras and points of a place, from above and from the side."""

from __future__ import annotations

import numpy as np

from .sheet import INK, new_page

_CAMERA, _PATH = "#c0392b", "#e2a49c"
_MOST_POINTS = 40_000  # drawn; more of them only hide each other
_SIDE = 520  # pixels of each of the two plans


def camera_figure(to_world: np.ndarray, points: np.ndarray, colors: np.ndarray, title: str):
    """OpenGL camera-to-world poses (N, 4, 4), as wedges that open to where they look, and ``points`` (M, 3) in their
    ``colors`` (M, 3), uint8: x and y from above, x and z from the side, +z up. Lengths are in units of the poses.

    Points far beyond the others are left out of the plans.
    """
    figure = new_page(2 * _SIDE, _SIDE + 50)
    centers = to_world[:, :3, 3]
    low, high = _bounds(centers, points)
    size = 0.04 * float(np.max(high - low)) or 1.0
    near = np.all((points >= low) & (points <= high), axis=1)
    points, colors = points[near], colors[near]
    if len(points) > _MOST_POINTS:
        some = np.random.default_rng(0).choice(len(points), _MOST_POINTS, replace=False)
        points, colors = points[some], colors[some]
    for axes, (a, b), name in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), ("from above", "from the side")):
        axes.scatter(points[:, a], points[:, b], s=1.5, c=colors / 255.0, linewidths=0, rasterized=True)
        axes.plot(centers[:, a], centers[:, b], color=_PATH, linewidth=0.6)
        for pose in to_world:
            wedge = (np.array([[0, 0, 0], [-0.6, 0, -1], [0.6, 0, -1], [0, 0, 0]]) * size) @ pose[:3, :3].T + pose[
                :3, 3
            ]
            axes.plot(wedge[:, a], wedge[:, b], color=_CAMERA, linewidth=0.8)
        axes.set_aspect("equal")
        axes.set_title(name, fontsize=9, color=INK)
        axes.set_xlabel("xyz"[a], fontsize=8, color=INK)
        axes.set_ylabel("xyz"[b], fontsize=8, color=INK)
        axes.set_xlim(low[a] - size, high[a] + size)
        axes.set_ylim(low[b] - size, high[b] + size)
        axes.tick_params(labelsize=7, colors=INK, length=2)
    figure.suptitle(title, fontsize=10, color=INK)
    figure.tight_layout()
    return figure


def _bounds(centers: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners that hold all cameras, and the points but for those far off."""
    low, high = centers.min(axis=0), centers.max(axis=0)
    if len(points):
        lower, upper = np.quantile(points, [0.05, 0.95], axis=0)
        low, high = np.minimum(low, lower - 0.1 * (upper - lower)), np.maximum(high, upper + 0.1 * (upper - lower))
    return low, high
