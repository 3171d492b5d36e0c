"""Gaussian splats along rays in plain NumPy, float64, by looking at all of them."""

from __future__ import annotations

import numpy as np

from nerg_mi.maths.sphere import eval_harmonics


def peaks(splats, o, d, extent=3.0):
    """``(t, absorbed)``, (R, N) each, of rays ``o + t d`` (R, 3): the share is 0 where a Gaussian is cut off."""
    o, d = np.asarray(o, np.float64), np.asarray(d, np.float64)
    inverse = splats.axes().transpose(0, 2, 1) / splats.scales.astype(np.float64)[:, :, None]
    start = np.einsum("nij,rnj->rni", inverse, o[:, None] - splats.centers.astype(np.float64))
    along = np.einsum("nij,rj->rni", inverse, d)
    t = -(start * along).sum(-1) / (along * along).sum(-1)
    distance = ((start + t[..., None] * along) ** 2).sum(-1)
    absorbed = np.minimum(splats.opacities * np.exp(-0.5 * distance), 0.9999)
    return t, np.where(distance < extent**2, absorbed, 0)


def trace(splats, o, d, t0=0.0, t1=np.inf, stop=1e-4):
    """``(opacity, color, expected depth, median depth)`` along rays from ``t0`` to ``t1``: sorted by the peaks."""
    t, absorbed = peaks(splats, o, d)
    absorbed = np.where((t >= t0) & (t < t1), absorbed, 0)
    order = np.argsort(t, axis=1)
    t, absorbed = np.take_along_axis(t, order, 1), np.take_along_axis(absorbed, order, 1)
    through = np.cumprod(1 - absorbed, axis=1)
    before = np.concatenate([np.ones((len(t), 1)), through[:, :-1]], axis=1)
    weight = before * absorbed * (before > stop)
    basis = eval_harmonics(d, splats.degree)
    color = np.maximum(np.einsum("rk,nkc->rnc", basis, splats.harmonics.astype(np.float64)) + 0.5, 0)
    color = np.take_along_axis(color, order[..., None], 1)
    opacity = weight.sum(1)
    hits = np.maximum(opacity, 1e-30)
    half = np.argmax(np.cumsum(weight, 1) >= 0.5 * opacity[:, None], axis=1)
    median = np.where(opacity > 0, t[np.arange(len(t)), half], 0)
    return opacity, (weight[..., None] * color).sum(1), (weight * t).sum(1) / hits, median
