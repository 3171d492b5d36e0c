"""Volume rendering of one ray in float64 NumPy: piecewise constant density, exact first moment, no skipping.

Also closed forms of a homogeneous slab, Mitsuba's trilinear grid look-up, and the slab test.
"""

import math

import numpy as np


def slab(sigma, near, far):
    """``(opacity, expected depth, median depth)`` of constant density between ``near`` and ``far``."""
    tau = sigma * (far - near)
    opacity = -math.expm1(-tau)
    if tau < 1e-5:  # 1/τ - 1/expm1(τ) cancels; its series does not
        share = 0.5 - tau / 12
    else:
        share = 1 / tau - (1 / math.expm1(tau) if tau < 700 else 0)
    median = -math.log1p(-opacity / 2) / sigma if tau < 36 else math.log(2) / sigma
    return opacity, near + (far - near) * share, near + median


def steps(t0, t1, step, dt_gamma=0.0, offset=1.0):
    """Borders of the steps; the first is ``offset`` of a full one, the last ends at ``t1``."""
    borders, share = [t0], offset
    while borders[-1] < t1:
        t = borders[-1]
        borders.append(min(t + max(step, dt_gamma * t) * share, t1))
        if borders[-1] <= t:
            if share == 1:
                break
            borders.pop()
        share = 1.0
    return np.array(borders)


def march(density, o, d, borders, color=None):
    """``(tau, expected depth, median depth, weighted colour sum, weights)`` along ``o + t d``.

    ``density``, ``color``: functions of points (N, 3). The median is where half of the ray's own opacity is reached.
    """
    t, delta = borders[:-1], np.diff(borders)
    p = np.asarray(o, float) + np.asarray(d, float) * (t + delta / 2)[:, None]
    tau = density(p) * delta
    before = np.concatenate([[0], np.cumsum(tau)])
    absorbed = -np.expm1(-tau)
    weights = np.exp(-before[:-1]) * absorbed
    # ∫ s σ exp(-σ s) ds / (1 - exp(-σ δ)), by Gauss-Legendre where the closed form cancels
    share = np.empty_like(tau)
    for i, x in enumerate(tau):
        share[i] = 0.5 - x / 12 + x**3 / 720 if x < 1e-2 else 1 / x - (1 / math.expm1(x) if x < 700 else 0)
    total = -math.expm1(-before[-1])
    expected = float((weights * (t + delta * share)).sum() / total) if total > 0 else 0.0
    median = 0.0
    if total > 0:
        goal = -math.log1p(-total / 2) if total < 1 else math.log(2)
        i = min(int(np.searchsorted(before[1:], goal)), len(tau) - 1)
        median = float(t[i] + delta[i] * (goal - before[i]) / tau[i])
    summed = None if color is None else (weights[:, None] * color(p)).sum(0)
    return float(before[-1]), expected, median, summed, weights


def box(o, d, lower, upper):
    """``(near, far)`` of the slab test, or None for a miss; axis by axis, no division by zero."""
    near, far = -math.inf, math.inf
    for oc, dc, lo, hi in zip(o, d, lower, upper):
        if dc == 0:
            if not lo <= oc <= hi:
                return None
            continue
        a, b = sorted(((lo - oc) / dc, (hi - oc) / dc))
        near, far = max(near, a), min(far, b)
    return (near, far) if near < far else None


def trilinear(data, p):
    """Mitsuba's ``gridvolume`` at points (N, 3) of the unit cube: texel centres at (i + 1/2) / N, clamped.

    ``data``: (Z, Y, X) or (Z, Y, X, C).
    """
    data = np.asarray(data, np.float64)
    shape = np.array(data.shape[2::-1])
    x = np.asarray(p, np.float64) * shape - 0.5
    i = np.floor(x).astype(int)
    f = x - i
    out = 0.0
    for corner in range(8):
        bits = np.array([(corner >> axis) & 1 for axis in range(3)])
        j = np.clip(i + bits, 0, shape - 1)
        w = np.where(bits == 1, f, 1 - f).prod(-1)
        value = data[j[:, 2], j[:, 1], j[:, 0]]
        out = out + (w if value.ndim == 1 else w[:, None]) * value
    return out
