"""A law of what is looked at, learnt from features: the log of a density over directions is a sum of functions of one
feature each, piecewise linear (a generalised additive model), and the density is normalised over the sphere.

Maximum likelihood of such a law is convex: it has no seeds and no schedule.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

LOG_UNIFORM = -np.log(4 * np.pi)

# Knots of each of `prior_features.FEATURES`.
_KNOTS = (
    np.linspace(-1, 1, 11),
    np.log([0.3, 0.5, 0.8, 1.2, 1.8, 2.7, 4, 6, 9, 14]),
    np.array([-1.6, -1.2, -0.8, -0.4, -0.1, 0.2, 0.6, 1.2, 2]),
    np.linspace(-1.2, 1.2, 7),
    np.array([0, 0.4, 0.8, 1.2, 1.6, 2, 2.6, 3.4]),
    np.linspace(0.1, 1, 6),
    np.linspace(-1, 1, 5),
    np.array([0, 0.03, 0.07, 0.15, 0.3]),
)
_ROUNDS = 60
# Rays of a blind density at most.
_MOST = 1500


def concentration(mean: float) -> float:
    """κ of the von Mises-Fisher density whose directions have this ``mean`` cosine to its axis, nearly that of greatest
    likelihood (Banerjee et al. 2005, eq. 4.4)."""
    return mean * (3 - mean**2) / (1 - mean**2)


def basis(features: np.ndarray, count: int) -> np.ndarray:
    """Values (..., B) of the hat functions of the first ``count`` of ``features`` (..., F), clipped to their knots."""
    out = []
    for j, knots in enumerate(_KNOTS[:count]):
        x = np.clip(features[..., j], knots[0], knots[-1])
        i = np.clip(np.searchsorted(knots, x, "right") - 1, 0, len(knots) - 2)
        share = ((x - knots[i]) / (knots[i + 1] - knots[i])).astype(np.float32)
        hats = np.zeros((*x.shape, len(knots)), np.float32)
        np.put_along_axis(hats, i[..., None], 1 - share[..., None], -1)
        np.put_along_axis(hats, i[..., None] + 1, share[..., None], -1)
        out.append(hats)
    return np.concatenate(out, axis=-1)


Part = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of P observers: a basis (P, D, B) in directions of equal area, true densities (P, D), and the log of what the law is
multiplied by (P, D), or of 1."""


def fit(parts: Sequence[Part], ridge: float, start: np.ndarray | None = None) -> np.ndarray:
    """Weights (B,) of least cross-entropy, the mean over ``parts``, and ``ridge`` times the square of how far they are
    from ``start`` (0)."""
    width = parts[0][0].shape[-1]
    start = np.zeros(width) if start is None else start
    flat = [(b.reshape(-1, width), (t / t.sum(axis=1, keepdims=True)).astype(np.float32), o) for b, t, o in parts]

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        total, slope = 0.0, np.zeros(width)
        for values, truth, offset in flat:
            s = (values @ w.astype(np.float32)).reshape(truth.shape) + offset
            s -= s.max(axis=1, keepdims=True)
            e = np.exp(s)
            z = e.sum(axis=1, keepdims=True)
            total -= float((truth * (s - np.log(z))).sum()) / len(truth) / len(flat)
            slope += values.T @ ((e / z - truth) / len(truth)).ravel().astype(np.float32) / len(flat)
        away = w - start
        return total + ridge * float(away @ away), slope + 2 * ridge * away

    return minimize(loss, start.copy(), jac=True, method="L-BFGS-B", options={"maxiter": _ROUNDS}).x


def normalised(at_directions: np.ndarray, at_rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Logs of a density (1/sr) in directions of equal area (P, D), of which the mean is that over the sphere, and at
    rays (P, K), from logs up to a constant an observer."""
    highest = at_directions.max(axis=1, keepdims=True)
    z = highest + np.log(np.exp(at_directions - highest).mean(axis=1, keepdims=True)) - LOG_UNIFORM
    return at_directions - z, at_rays - z


def blind(directions: np.ndarray, people: np.ndarray, kappa: float, at: np.ndarray) -> np.ndarray:
    """Log of the kernel density (1/sr) of ``directions`` (N, 3), in ``at`` (..., 3), of which a tenth is uniform; each
    of ``people`` (N,) counts alike."""
    if len(directions) > _MOST:
        which = np.random.default_rng(0).permutation(len(directions))[:_MOST]
        directions, people = directions[which], people[which]
    _, number, counts = np.unique(people, return_inverse=True, return_counts=True)
    weight = (1 / counts[number] / len(counts)).astype(np.float32)
    scale = kappa / (2 * np.pi * (1 - np.exp(-2 * kappa)))
    flat, rays, out = at.reshape(-1, 3).astype(np.float32), directions.T.astype(np.float32), []
    for first in range(0, len(flat), 4096):
        out.append(np.exp(kappa * (flat[first : first + 4096] @ rays - 1)) @ weight)
    return np.log(0.9 * scale * np.concatenate(out) + 0.1 * np.exp(LOG_UNIFORM)).reshape(at.shape[:-1])
