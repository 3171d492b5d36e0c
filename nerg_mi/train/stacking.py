"""Stacking: weights of a mixture of densities, fitted to held-out gaze (Wolpert 1992; Smyth and Wolpert 1999).

The weights v maximise Σ_p n/|R_p| Σ_{i in R_p} log Σ_c v_c f_c(i) + Σ_c a_c log v_c, where R_p are the held-out rays of
participant p, n the number of independent rays that a participant counts as, f_c the densities, and a_c pseudo-rays,
the parameters of a Dirichlet prior less one. The rays of a participant resemble each other, so that they are worth far
less than their number; the pseudo-rays keep few participants from deciding.
"""

from __future__ import annotations

import numpy as np

_RAYS_PER_PARTICIPANT = 5.0  # Independent rays that a participant counts as
_NUM_PSEUDO_RAYS = 5.0
SURFACES, NO_SURFACES = (0.85, 0.10, 0.05), (0.3, 0.5, 0.2)
"""Fractions of the pseudo-rays: of the field, of the prior, and of all kernels of re-aimed hits together. Without
surfaces a field can only interpolate between positions, and is trusted less."""
MAX_STACKED = 6  # Maximum number of kernels of re-aimed hits in a mixture, because each costs time
_MIN_WEIGHT = 0.02  # Minimum weight of a kernel, for the same reason
_NEGLIGIBLE_WEIGHT = 0.002  # Weight below which a kernel leaves at once
_MAX_ITERATIONS, _TOLERANCE = 2000, 1e-6


def fit_weights(
    log_densities: np.ndarray, participant: np.ndarray, pseudo_rays: np.ndarray, start: np.ndarray | None = None
) -> np.ndarray:
    """Fit the weights (C,) of a mixture of C densities by expectation maximisation.

    Parameters
    ----------
    log_densities : array (C, n)
        Log densities of the components at n held-out rays.
    participant : array (n,)
        Participant of each ray, as an integer. Participants have equal weights.
    pseudo_rays : array (C,)
        Rays that count as those of each component in addition.
    start : array (C,), optional
        Positive weights from which to start; None: those of ``pseudo_rays``. The maximum is the same.
    """
    _, index, counts = np.unique(participant, return_inverse=True, return_counts=True)
    ray_weights = _RAYS_PER_PARTICIPANT / counts[index]
    relative = np.exp(log_densities - log_densities.max(axis=0))
    weights = pseudo_rays if start is None else start
    weights = weights / weights.sum()
    for _ in range(_MAX_ITERATIONS):
        before, joint = weights, weights[:, None] * relative
        weights = pseudo_rays + joint @ (ray_weights / joint.sum(axis=0))
        weights /= weights.sum()
        if np.abs(weights - before).max() < _TOLERANCE:
            break
    return weights


def fit_sparse_weights(
    log_densities: np.ndarray, participant: np.ndarray, fractions: tuple[float, float, float] = SURFACES
) -> np.ndarray:
    """Fit the weights (2 + K,) of a field, of the prior, and of K kernels of re-aimed hits, in this order; those of all
    but a few kernels are zero.

    ``fractions``: of the pseudo-rays, `SURFACES` or `NO_SURFACES`; the other arguments are those of `fit_weights`.
    """
    hits = np.arange(2, len(log_densities))

    def fit(start: np.ndarray | None = None) -> np.ndarray:
        return fit_weights(log_densities[[0, 1, *hits]], participant, _make_pseudo_rays(len(hits), *fractions), start)

    fitted = fit()
    # One by one, because the weight of a kernel moves to those that resemble it, and the largest ones may all be alike;
    # kernels that hardly count leave at once.
    while len(hits) > MAX_STACKED:
        is_kept = fitted[2:] >= min(_NEGLIGIBLE_WEIGHT, np.sort(fitted[2:])[-MAX_STACKED])
        is_kept[fitted[2:].argmin()] = False
        hits, start = hits[is_kept], fitted[np.concatenate([[True, True], is_kept])]
        fitted = fit(start)
    hits = hits[fitted[2:] >= _MIN_WEIGHT]
    weights = np.zeros(len(log_densities))
    weights[[0, 1, *hits]] = fit()
    return weights


def _make_pseudo_rays(num_kernels: int, field: float, prior: float, hits: float) -> np.ndarray:
    fractions = np.array([field, prior, *[hits / max(num_kernels, 1)] * num_kernels])
    return _NUM_PSEUDO_RAYS * fractions / fractions.sum()
