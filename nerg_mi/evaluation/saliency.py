"""Saliency-benchmark practice: the best map for each metric from one predicted density, and all metrics of it.

A density that predicts single fixations best is not the map that a metric scores best. So each metric gets its own map,
derived from the density alone (Kümmerer, Wallis and Bethge, Saliency Benchmarking Made Easy, ECCV 2018), as in
pysaliency. Densities are arrays (D,) over directions or pixels; ``weights`` (D,) are solid angles in any unit, None:
equal areas, such as pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.files.values import to_numbers
from nerg_mi.maths.arrays import check_weights

from . import metrics

Smooth = Callable[[np.ndarray], np.ndarray]
"""Smooths densities (..., D) with the kernel of the empirical density, preserving their integrals."""

_SAMPLES, _COUNT = 200, 100
_BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class MetricMaps:
    """The map (D,) of each metric, derived from one density.

    Attributes
    ----------
    density
        For the information gain, NSS and AUC: the density itself. Any increasing function of it has the same AUC.
    ratio
        For sAUC: the density over that of the nonfixations, the position-independent prior.
    smooth
        For CC and KLD: the density smoothed with the kernel of the empirical density, which is the expected empirical
        density.
    sim
        For SIM: the density with the largest expected SIM.
    """

    density: np.ndarray
    ratio: np.ndarray
    smooth: np.ndarray
    sim: np.ndarray


def make_metric_maps(
    density: ArrayLike,
    prior: ArrayLike,
    smooth: Smooth,
    weights: ArrayLike | None = None,
    *,
    count: int = _COUNT,
    samples: int = _SAMPLES,
    seed: int = 0,
) -> MetricMaps:
    """Derive the map of each metric from a predicted ``density``.

    Parameters
    ----------
    density, prior
        Predicted density and position-independent prior (D,), in any unit.
    smooth
        Smooths densities with the kernel of the empirical density.
    weights
        Solid angles (D,).
    count
        Number of fixations of an empirical density, for SIM.
    samples
        Number of empirical densities that are drawn from ``density``, for SIM.
    seed
        Seed of these draws.

    Examples
    --------
    >>> import numpy as np
    >>> from nerg_mi.evaluation.saliency import make_metric_maps
    >>> maps = make_metric_maps([1, 2, 3], [1, 1, 1], smooth=lambda density: density)
    >>> maps.ratio.argmax()  # of direction 2, where the density exceeds the prior most
    np.int64(2)
    """
    w = _normalise_weights(np.shape(density)[-1], weights)
    p, reference = _normalise(density, w, "density"), _normalise(prior, w, "prior")
    ratio = p / np.maximum(reference, metrics.EPS)
    drawn = np.random.default_rng(seed).multinomial(count, w * p / (w * p).sum(), samples)
    empirical = smooth(drawn / np.where(w > 0, w * count, 1.0))
    return MetricMaps(p, ratio, smooth(p), _maximise_expected_sim(empirical, w))


def _to_indices(values: ArrayLike, name: str) -> np.ndarray:
    numbers = to_numbers(values, name)
    if not (numbers == np.floor(numbers)).all():
        raise NergError(f"{name} must be indices of directions or pixels, which are whole numbers")
    return numbers.astype(np.int64)


def _normalise_weights(count: int, weights: ArrayLike | None) -> np.ndarray:
    """Return weights (count,) that sum to 1; None: equal."""
    w = np.full(count, 1.0) if weights is None else check_weights(weights, count)
    return w / w.sum()


def _normalise(density: ArrayLike, w: np.ndarray, name: str) -> np.ndarray:
    """Return ``density`` (D,) with the weighted mean 1. Raises `NergError` for values without mass."""
    density = to_numbers(density, name)
    if not (np.isfinite(density).all() and (density >= 0).all() and w @ density > 0):
        raise NergError(f"the {name} must be finite, not negative and not 0 everywhere")
    return density / (w @ density)


def _maximise_expected_sim(samples: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the density q (D,) that maximises the mean of SIM(q, p) over densities p, ``samples`` (S, D).

    The mean of Σ w min(q, p) is concave and separable, so that at the maximum the fraction of samples above q is the
    same in all directions: q is a quantile of the samples, whose order follows from the integral of q.
    """
    ordered = np.sort(samples, axis=0)
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if w @ _quantile(ordered, middle) < 1 else (low, middle)
    q = _quantile(ordered, high)
    return q / max(w @ q, metrics.EPS)


def _quantile(ordered: np.ndarray, order: float) -> np.ndarray:
    """Return the quantile (D,) of sorted ``ordered`` (S, D), interpolated so that it is continuous in ``order``."""
    at = order * (len(ordered) - 1)
    below = min(int(at), len(ordered) - 2) if len(ordered) > 1 else 0
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (at - below) * (ordered[above] - ordered[below])


@dataclass(frozen=True)
class SaliencyScores:
    """Scores of a predicted density, each with the map of its metric.

    Attributes
    ----------
    information_gain
        Information gain over the position-independent prior in bits per fixation: the headline.
    nss
        Normalised scanpath saliency.
    auc
        Fraction of the area with a smaller density than a fixation (AUC-Judd with all thresholds).
    sauc
        The same against the nonfixations.
    cc, kld, sim
        Correlation, Kullback-Leibler divergence in nats, and similarity with the empirical density.
    """

    information_gain: float
    nss: float
    auc: float
    sauc: float
    cc: float
    kld: float
    sim: float

    def to_dict(self) -> dict[str, float]:
        """Return the scores by name, in this order."""
        return asdict(self)


def score_saliency(
    maps: MetricMaps,
    prior: ArrayLike,
    fixations: ArrayLike,
    nonfixations: ArrayLike,
    smooth: Smooth,
    weights: ArrayLike | None = None,
) -> SaliencyScores:
    """Score a predicted density against fixations, each metric with its own map.

    Parameters
    ----------
    maps
        Maps of the prediction.
    prior
        Position-independent prior (D,), the baseline of the information gain.
    fixations
        Index (K,) of the direction or pixel of each fixation.
    nonfixations
        Index (M,) of fixations at other positions or on other images, for sAUC.
    smooth
        Smooths the fixations to the empirical density.
    weights
        Solid angles (D,).
    """
    at, other = _to_indices(fixations, "fixations"), _to_indices(nonfixations, "nonfixations")
    if not len(at) or not len(other):
        raise NergError(f"a score needs fixations and nonfixations, got {len(at)} and {len(other)}")
    w = _normalise_weights(len(maps.density), weights)
    reference = _normalise(prior, w, "prior")
    counts = np.bincount(at, minlength=len(w))
    empirical = smooth(counts / np.where(w > 0, w * len(at), 1.0))
    return SaliencyScores(
        metrics.information_gain(maps.density[at], reference[at]).mean(),
        metrics.nss(maps.density, maps.density[at], w).mean(),
        metrics.auc(maps.density[at], maps.density, w).mean(),
        metrics.auc(maps.ratio[at], maps.ratio[other]).mean(),
        float(metrics.cc(empirical, maps.smooth, w)),
        float(metrics.kld(empirical, maps.smooth, w)),
        float(metrics.sim(empirical, maps.sim, w)),
    )
