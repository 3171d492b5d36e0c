"""Scores of gaze densities, weighted by solid angle.

Definitions of saliency research (pysaliency, Kümmerer et al. 2018), which on a
sphere need the solid angle of each direction: on a latitude-longitude picture
the unweighted KLD of a known pair is 0.69 where the true one is 1.01.

Maps are arrays (..., D), directions along the last axis; scores have the
leading shape. ``weights`` (D,) or broadcastable: solid angles, in any unit;
``None`` says that all directions are of equal area. Everything is float64 and
defined: maps that are constant or zero give a number, not NaN.
"""

from __future__ import annotations

import numpy as np

# Of a map's mean: far below any density that matters, far above underflow.
EPS = 1e-20


def kld(
    truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None, *, eps: float = EPS
) -> np.ndarray:
    """Kullback-Leibler divergence KL(truth || prediction) in nats; 0 is best.

    Both are divided by their integral; negative values are lifted to zero by the
    map's minimum, as pysaliency does. ``eps``, in units of the uniform density,
    is added to both, and bounds what a prediction of zero costs: a sparse truth
    makes the score depend on it, so name it where it is not the default.
    """
    w = _shares(truth, prediction, weights)
    p, q = _relative(truth, w) + eps, _relative(prediction, w) + eps
    return np.sum(w * p * (np.log(p) - np.log(q)), axis=-1) / (1.0 + eps)


def cc(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Pearson's correlation with weighted means, in [-1, 1]; 0 when either map
    is constant (there is nothing to agree with)."""
    w = _shares(truth, prediction, weights)
    x, y = _standardised(truth, w), _standardised(prediction, w)
    return np.clip(np.sum(w * x * y, axis=-1), -1.0, 1.0)


def sim(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Histogram intersection of the two normalised densities, in [0, 1]; 1 is
    best. Not range-normalised first, as pysaliency and unlike Salient360."""
    w = _shares(truth, prediction, weights)
    return np.sum(w * np.minimum(_relative(truth, w), _relative(prediction, w)), axis=-1)


def mae(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Mean absolute difference over the sphere in the maps' unit, 1/sr; 4π times
    it is relative to uniform. Not normalised, so it sees a wrong integral; it
    grows with κ."""
    w = _shares(truth, prediction, weights)
    return np.sum(w * np.abs(np.asarray(truth, np.float64) - np.asarray(prediction, np.float64)), axis=-1)


def nss(density: np.ndarray, at_gaze: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Normalised scanpath saliency of each gaze: (value - mean) / standard
    deviation of the map (population, weighted). Average it over gazes.

    ``density`` (..., D); ``at_gaze`` (..., K): the map's values where people
    looked (rays or fixations, not a blurred map). Returns (..., K); 0 for a
    constant map.
    """
    w = _shares(density, density, weights)
    density, at_gaze = np.asarray(density, np.float64), np.asarray(at_gaze, np.float64)
    mean, deviation = _moments(density, w)
    return np.where(deviation > 0, (at_gaze - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)


def auc_judd(
    density: np.ndarray, at_gaze: np.ndarray, weights: np.ndarray | None = None, *, fixated: np.ndarray | None = None
) -> np.ndarray:
    """Area under the curve of hits against false alarms, thresholds at the gazes' own values (Judd et al. 2012); 0.5 is
    chance.

    ``density`` (..., D); ``at_gaze`` (..., K), the map's values where people looked. Hits: the share of gazes at or
    above the threshold; false alarms: the share of the map that is. ``fixated`` (..., D) bool leaves pixels out of the
    latter, as the original does on a picture; rays are no pixels, and leave out nothing.
    """
    from scipy.integrate import trapezoid

    w = _shares(density, density, weights)
    density, at_gaze = np.asarray(density, np.float64), np.asarray(at_gaze, np.float64)
    shape = np.broadcast_shapes(density.shape[:-1], at_gaze.shape[:-1])
    w = np.broadcast_to(w if fixated is None else w * ~np.asarray(fixated), (*shape, density.shape[-1]))
    density = np.broadcast_to(density, w.shape).reshape(-1, w.shape[-1])
    gazes = np.broadcast_to(at_gaze, (*shape, at_gaze.shape[-1])).reshape(len(density), -1)
    out = np.empty(len(density))
    for i, (row, share, gaze) in enumerate(zip(density, w.reshape(density.shape), gazes)):
        # Equal values are one threshold: a map that is constant where people look is not to be blamed for it.
        thresholds, last = np.unique(-gaze, return_counts=True)
        thresholds, hits = -thresholds, np.cumsum(last) / len(gaze)
        order = np.argsort(row)
        below = np.concatenate([[0], np.cumsum(share[order])])
        false = 1 - below[np.searchsorted(row[order], thresholds, "left")] / below[-1]
        out[i] = trapezoid(np.concatenate([[0], hits, [1]]), np.concatenate([[0], false, [1]]))
    return out.reshape(shape)


def sauc(at_gaze: np.ndarray, at_others: np.ndarray) -> np.ndarray:
    """Shuffled AUC: how often the map is higher where people looked, ``at_gaze`` (..., K), than where they looked from
    other positions, ``at_others`` (..., M); ties count half. 0.5 is chance, which what does not depend on the position
    has."""
    a, b = np.asarray(at_gaze, np.float64), np.asarray(at_others, np.float64)
    shape = np.broadcast_shapes(a.shape[:-1], b.shape[:-1])
    a, b = (np.broadcast_to(v, (*shape, v.shape[-1])).reshape(-1, v.shape[-1]) for v in (a, b))
    out = []
    for gaze, other in zip(a, np.sort(b)):
        lower, upper = (np.searchsorted(other, gaze, side) for side in ("left", "right"))
        out.append(np.mean(0.5 * (lower + upper)) / len(other))
    return np.reshape(out, shape)


def information_gain(
    at_gaze: np.ndarray, baseline_at_gaze: np.ndarray, *, eps: float = np.finfo(np.float64).eps
) -> np.ndarray:
    """Bits a gaze that a density knows beyond a baseline, averaged along the last
    axis: mean log2 p - log2 b at the rays that people took.

    Both (..., K) in 1/sr, of densities that integrate to one; ``eps`` (1/sr) is
    added to both. Name the baseline with the number: here it is the
    position-blind density unless said otherwise.
    """
    return (log_score(at_gaze, eps=eps) - log_score(baseline_at_gaze, eps=eps)) / np.log(2.0)


def log_score(at_gaze: np.ndarray, *, eps: float = np.finfo(np.float64).eps) -> np.ndarray:
    """Mean log density (nats of 1/sr) at held-out rays, along the last axis: a
    strictly proper score that needs no grid of directions. Negative values of a
    linear field count as ``eps``."""
    return np.mean(np.log(np.maximum(np.asarray(at_gaze, np.float64), 0.0) + eps), axis=-1)


def _shares(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Weights that sum to one along the last axis."""
    shape, other = np.shape(a), np.shape(b)
    if not shape or not other or shape[-1] != other[-1]:
        raise ValueError(f"maps of shape {shape} and {other} do not have the same directions along the last axis")
    if weights is None:
        return np.full(shape[-1], 1.0 / shape[-1])
    w = np.asarray(weights, dtype=np.float64)
    if w.shape[-1:] != shape[-1:] or not (w >= 0).all() or not (w.sum(axis=-1) > 0).all():
        raise ValueError(
            f"weights of shape {w.shape} must be non-negative solid angles of the {shape[-1]} directions, not all zero"
        )
    return w / w.sum(axis=-1, keepdims=True)


def _relative(density: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Density over its mean, that is in units of the uniform density of the same
    integral; a map of zeros is uniform."""
    density = np.asarray(density, dtype=np.float64)
    density = density - np.minimum(density.min(axis=-1, keepdims=True), 0.0)
    # Scaled by the maximum first: the mean of tiny values may underflow.
    top = density.max(axis=-1, keepdims=True)
    density = np.where(top > 0, density / np.where(top > 0, top, 1.0), 1.0)
    mean = np.sum(w * density, axis=-1, keepdims=True)
    return np.where(mean > 0, density / np.where(mean > 0, mean, 1.0), 1.0)


def _moments(values: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and population standard deviation, (..., 1); a deviation
    within rounding of a constant is zero."""
    # In units of the largest: squares of the values themselves under- or overflow beyond 1e±154.
    top = _largest(values)
    values = values / top
    mean = np.sum(w * values, axis=-1, keepdims=True)
    deviation = np.sqrt(np.sum(w * (values - mean) ** 2, axis=-1, keepdims=True))
    return mean * top, np.where(deviation > 1e-13, deviation, 0.0) * top


def _largest(values: np.ndarray) -> np.ndarray:
    """Largest magnitude along the last axis, (..., 1); 1 where all are zero."""
    top = np.abs(values).max(axis=-1, keepdims=True)
    return np.where(top > 0, top, 1.0)


def _standardised(values: np.ndarray, w: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    values = values / _largest(values)
    mean, deviation = _moments(values, w)
    return np.where(deviation > 0, (values - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)
