"""The von Mises-Fisher distribution on the unit sphere.

f(x; μ, κ) = C(κ) exp(κ (x·μ - 1)) in 1/sr, C(κ) = κ / (2π (1 - exp(-2κ))): the normaliser of NeRG, Section 5.1, with
exp(κ) removed from both factors, so that neither overflows. Stable for κ from 1e-8 to 1e8.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

KAPPA_MIN, KAPPA_MAX = 1e-8, 1e8


def log_normaliser(kappa: np.ndarray | float) -> np.ndarray:
    """log C(κ), natural; -log 4π for κ -> 0. ``kappa``: any shape, >= 0.

    Raises ``ValueError`` for a negative or NaN κ.
    """
    kappa = _checked(kappa)
    # 1 - exp(-2κ) as -expm1(-2κ); its ratio to κ tends to 2.
    tiny = kappa < KAPPA_MIN
    safe = np.where(tiny, 1.0, kappa)
    ratio = np.where(tiny, 2.0, -np.expm1(-2.0 * safe) / safe)
    return -np.log(2.0 * np.pi) - np.log(ratio)


def one_minus_cosine(x: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """1 - x·μ for unit vectors (..., 3) as |x - μ|²/2, accurate where the two nearly agree."""
    return 0.5 * np.sum((np.asarray(x) - np.asarray(mu)) ** 2, axis=-1)


def log_density(x: np.ndarray, mu: np.ndarray, kappa: np.ndarray | float) -> np.ndarray:
    """log f(x; μ, κ), natural logarithm of 1/sr.

    ``x``, ``mu``: unit vectors (..., 3), ``kappa``: (...); all broadcast.
    """
    return log_normaliser(kappa) - np.asarray(kappa) * one_minus_cosine(x, mu)


def mean_resultant_length(kappa: np.ndarray | float) -> np.ndarray:
    """A(κ) = coth κ - 1/κ, the expected length of the mean direction."""
    kappa = _checked(kappa)
    small = kappa < 1e-2  # the two terms cancel; the series is accurate to 1e-16 there
    safe = np.where(small, 1.0, kappa)
    series = kappa / 3.0 * (1.0 - kappa**2 / 15.0 * (1.0 - 2.0 * kappa**2 / 21.0))
    return np.where(small, series, 1.0 / np.tanh(safe) - 1.0 / safe)


def kappa_from_mean_resultant_length(resultant: np.ndarray | float) -> np.ndarray:
    """Maximum-likelihood κ of a mean resultant length R̄: the root of A(κ) = R̄.

    ``resultant``: any shape, in [0, 1]. Limited to [1e-8, 1e8] as in the published code, whose root finder this
    replaces (it fails for R̄ above 1 - 1e-8). Raises ``ValueError`` outside [0, 1].
    """
    R = np.asarray(resultant, dtype=np.float64)
    if not np.all((R >= 0) & (R <= 1 + 1e-12)):
        raise ValueError("a mean resultant length lies in [0, 1]; average unit vectors")
    # Above κ = 20, coth κ is 1 to 1e-17 and the equation is explicit. Below, Newton's method from the estimate of
    # Banerjee et al. (2005), eq. 4.4.
    concentrated = R >= 0.95
    inner = np.where(concentrated, 0.5, R)
    kappa = np.maximum(inner * (3.0 - inner**2) / (1.0 - inner**2), KAPPA_MIN)
    for _ in range(6):
        A = mean_resultant_length(kappa)
        slope = np.where(kappa < 1e-2, 1.0 / 3.0 - kappa**2 / 15.0, 1.0 - A**2 - 2.0 * A / kappa)
        kappa = np.maximum(kappa - (A - inner) / slope, KAPPA_MIN)
    solved = np.where(concentrated, 1.0 / np.maximum(1.0 - R, 1.0 / KAPPA_MAX), kappa)
    return np.clip(solved, KAPPA_MIN, KAPPA_MAX)


def convolve_kappa(kappa: np.ndarray | float, other: np.ndarray | float) -> np.ndarray:
    """κ of the convolution of two von Mises-Fisher distributions: A(κ) = A(κ_1) A(κ_2).

    The convolution is not a von Mises-Fisher distribution, but close to the one with its mean direction and mean
    resultant length (Mardia & Jupp 2000, section 9.3.2), whose κ is returned. Broadcasts; κ is unchanged in the limit
    of large ``other``.
    """
    kappa, other = _checked(kappa), _checked(other)
    # 1 - A B from 1 - A and 1 - B: A itself has no significant digits left for large κ.
    a, b = _one_minus_resultant(kappa), _one_minus_resultant(other)
    one_minus = a + b - a * b
    with np.errstate(divide="ignore"):
        concentrated = 1.0 / np.maximum(one_minus, 1.0 / KAPPA_MAX)  # coth κ = 1 from 20 on
    return np.clip(
        np.where(one_minus < 0.05, concentrated, kappa_from_mean_resultant_length(1.0 - one_minus)),
        KAPPA_MIN,
        KAPPA_MAX,
    )


def _one_minus_resultant(kappa: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.where(kappa > 20.0, 1.0 / kappa, 1.0 - mean_resultant_length(kappa))


def silverman_kappa(resultant: np.ndarray | float, count: np.ndarray | int) -> np.ndarray:
    """κ of the published code's kernels: 1/h², h = 1.06 σ̂ N^(-1/5), σ̂ = κ̂^(-1/2) with κ̂ from the mean resultant
    length; σ̂ = 1 for a single ray.

    Silverman's rule for a line, applied to the sphere; it oversmooths multimodal densities. ``resultant``, ``count``:
    broadcast. Limited to [1e-8, 1e8].
    """
    count = np.asarray(count)
    if np.any(count < 1):
        raise NergError("a bandwidth needs at least one ray; raise min_rays")
    sigma2 = np.where(count == 1, 1.0, 1.0 / kappa_from_mean_resultant_length(resultant))
    h2 = 1.06**2 * sigma2 * count ** (-0.4)
    return np.clip(1.0 / h2, KAPPA_MIN, KAPPA_MAX)


def sample(mu: np.ndarray, kappa: np.ndarray | float, rng: np.random.Generator) -> np.ndarray:
    """One sample from each distribution: ``mu`` (N, 3) unit, ``kappa`` (N,) or a number; returns (N, 3).

    Exact inversion (Jakob 2012): with u uniform, 1 - x·μ = -log(1 + u (exp(-2κ) - 1)) / κ.
    """
    mu = np.asarray(mu, dtype=np.float64)
    kappa = np.broadcast_to(np.maximum(_checked(kappa), KAPPA_MIN), mu.shape[:-1])
    u, phi = rng.random(mu.shape[:-1]), 2.0 * np.pi * rng.random(mu.shape[:-1])
    v = np.minimum(-np.log1p(u * np.expm1(-2.0 * kappa)) / kappa, 2.0)
    r = np.sqrt(v * (2.0 - v))  # sine of the angle, from 1 - cos without cancellation
    a, b = tangent_frame(mu)
    x = (1.0 - v)[..., None] * mu + (r * np.cos(phi))[..., None] * a + (r * np.sin(phi))[..., None] * b
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def tangent_frame(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors orthogonal to ``n`` and to each other (Duff et al. 2017)."""
    x, y, z = np.moveaxis(n, -1, 0)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (
        np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1),
        np.stack([b, sign + y * y * a, -y], axis=-1),
    )


def _checked(kappa: np.ndarray | float) -> np.ndarray:
    kappa = np.asarray(kappa, dtype=np.float64)
    if not np.all(kappa >= 0):
        raise ValueError("kappa is negative or NaN; a concentration is at least 0 (0 is uniform)")
    return kappa
