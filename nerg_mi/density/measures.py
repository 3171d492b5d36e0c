"""What a probe's density is like: its integral, its entropy, how many rays and people it rests on, and samples of
it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays

from .kde.estimate import Backend
from .probes import Probes

_LEAST, _MOST = 2048, 1 << 17


def resolving_count(kappa: float) -> int:
    """Directions of equal area that resolve kernels of ``kappa``: four in a kernel's width 1/sqrt(κ), 2,048 to
    131,072."""
    return int(np.clip(np.ceil(4.0 * np.pi * 16.0 * kappa), _LEAST, _MOST))


def integral(probes: Probes, count: int | None = None, backend: Backend = None) -> np.ndarray:
    """∫ p over the sphere by quadrature with ``count`` directions, (P,): one, as far as they resolve the kernels.

    ``count``: None for as many as `resolving_count` of the sharpest kernel.
    """
    return _average(probes, count, backend, lambda p: p)


def entropy(probes: Probes, count: int | None = None, backend: Backend = None) -> np.ndarray:
    """Differential entropy -∫ p log p, (P,), natural, by quadrature; at most log 4π = 2.53, that of the uniform
    density."""
    return -_average(probes, count, backend, lambda p: p * np.log(np.where(p > 0, p, 1.0)))


def effective_rays(probes: Probes) -> np.ndarray:
    """Rays that count, (P,): (Σw)²/Σw² (Kish 1965); the number of rays where their weights are equal."""
    if probes.weights is None:
        return probes.counts.astype(np.float64)
    sums = [np.add.reduceat(v, probes.offsets[:-1]) for v in (probes.weights, probes.weights**2)]
    return sums[0] ** 2 / sums[1]


def effective_persons(probes: Probes, rays: Rays) -> np.ndarray:
    """People who count, (P,): the same of the people's summed weights.

    Successive rays of one person say the same over and over, so this, and not the rays, is what a probe's certainty
    rests on. ``rays``: those the probes were placed on.
    """
    w = np.ones(len(probes.indices)) if probes.weights is None else probes.weights
    persons = rays.person[probes.indices]
    out = np.empty(len(probes))
    for p, (a, b) in enumerate(zip(probes.offsets[:-1], probes.offsets[1:])):
        share = np.bincount(persons[a:b], weights=w[a:b])
        out[p] = share.sum() ** 2 / (share**2).sum()
    return out


def sample(probes: Probes, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` independent directions from each probe's density, (P, count, 3): a ray by its weight, then its
    kernel."""
    w = np.ones(len(probes.indices)) if probes.weights is None else probes.weights
    up_to = np.concatenate([[0.0], np.cumsum(w)])
    low, high = up_to[probes.offsets[:-1]], up_to[probes.offsets[1:]]
    at = low[:, None] + rng.random((len(probes), count)) * (high - low)[:, None]
    ray = np.clip(np.searchsorted(up_to, at, side="right") - 1, probes.offsets[:-1, None], probes.offsets[1:, None] - 1)
    mu = probes.directions[ray.ravel()]
    return vmf.sample(mu, np.repeat(probes.kappa, count), rng).reshape(len(probes), count, 3)


def _average(probes: Probes, count: int | None, backend: Backend, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """4π times the mean of a function of the density over directions of equal area, in blocks of probes."""
    x = fibonacci_directions(count or resolving_count(float(probes.kappa.max())))
    kde = probes.kde(backend)
    out, step = np.empty(len(probes)), max(1, (1 << 24) // len(x))
    for start in range(0, len(probes), step):
        density = kde.part(start, min(start + step, len(probes))).evaluate(x)
        out[start : start + step] = 4.0 * np.pi * of(density.astype(np.float64)).mean(axis=1)
    return out
