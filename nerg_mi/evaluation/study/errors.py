"""How far a picture is from the truth: the errors that a study reports."""

from __future__ import annotations

import numpy as np

from nerg_mi.evaluation import saliency as metrics
from nerg_mi.maths.color import decibels

from .reference import Truth

SURFACE = 0.5
"""Opacity from which on a ray meets a surface."""
TRACE = 1e-3
"""Opacity from which on a depth is compared."""
KLD_EPS = 1e-6
"""Of the mean: what a gaze of zero costs where the truth is not zero is bounded by it (13.8 nats)."""

NAMES = (
    "color_rmse",
    "color_psnr",
    "opacity_mae",
    "depth_mae",
    "depth_p99",
    "visibility_mae",
    "visibility_wrong",
    "gaze_mae",
    "gaze_kld",
    "surface_mae",
    "surface_p99",
)


def errors(
    seen: dict[str, np.ndarray], known: Truth, exact: tuple[np.ndarray, np.ndarray] | None = None
) -> dict[str, float]:
    """Errors of the channels ``seen`` (N,), colour (N, 3), by name; what was not rendered is left out.

    ``color_rmse``: linear radiance, over pixels and channels; ``color_psnr``: -20 log10 of it in dB; ``depth_mae``,
    ``depth_p99``: mean and 99th percentile of |depth - truth| in scene units, over rays of opacity >= `TRACE`, a ray
    that met nothing counting with its depth of 0; ``visibility_mae``, ``gaze_mae`` (1/sr): over pixels that truly show
    a surface; ``gaze_kld``: nats, of both pictures as densities over those pixels. With ``exact`` distances and
    visibilities: ``surface_mae``, ``surface_p99``: |depth - exact| over exact hits; ``visibility_wrong``: share of
    these pixels that are shown (above 1/2) and hidden, or the reverse.
    """
    out = {}
    if "color" in seen and np.any(seen["color"]):
        out["color_rmse"] = float(np.sqrt(np.mean((seen["color"] - known.color) ** 2)))
        out["color_psnr"] = decibels(out["color_rmse"] ** 2, 1e-24)
    if "opacity" in seen:
        out["opacity_mae"] = float(np.mean(np.abs(seen["opacity"] - known.opacity)))
    traced = known.opacity >= TRACE
    if "depth" in seen and traced.any():
        off = np.abs(seen["depth"] - known.depth)[traced]
        out["depth_mae"], out["depth_p99"] = float(off.mean()), float(np.percentile(off, 99))
    surface = known.opacity >= SURFACE
    if "visibility" in seen and surface.any():
        out["visibility_mae"] = float(np.mean(np.abs(seen["visibility"] - known.visibility)[surface]))
    if "gaze" in seen and np.any(known.gaze[surface] > 0):
        out["gaze_mae"] = float(np.mean(np.abs(seen["gaze"] - known.gaze)[surface]))
        out["gaze_kld"] = float(metrics.kld(known.gaze[surface], seen["gaze"][surface], eps=KLD_EPS))
    if exact is not None:
        distance, visible = exact
        hit = np.isfinite(distance)
        if "depth" in seen:
            off = np.abs(seen["depth"] - np.where(hit, distance, 0))[hit]
            out["surface_mae"], out["surface_p99"] = float(off.mean()), float(np.percentile(off, 99))
        if "visibility" in seen:
            out["visibility_wrong"] = float(np.mean(((seen["visibility"] > 0.5) != visible)[hit]))
    return out
