"""Losses between predicted and true gaze densities of probes, in Dr.Jit.

Densities are flat arrays, probe after probe with the same D directions each
(P * D values, 1/sr): value p * D + d is probe p in direction d. Sums over a
probe are weighted by solid angle. Definitions as in
:mod:`nerg_mi.evaluation.saliency`; NeRG, Section 4.3 (whose text adds the
correlation itself; it is 1 - CC that is minimised).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

# Of the uniform density: what a density of zero counts as inside a logarithm.
KLD_EPS = 1e-6
# 1/sr (uniform is 0.08): a density whose mean is lower is a map of zeros. Its gradient
# grows as one over the mean, and would leave float32 before the mean does.
VANISHED = 1e-12
# A probe whose spread is below this fraction of its mean is constant: no correlation.
FLAT = 1e-5

PAPER = {"kld": 1.0, "cc": 1.0, "mae": 1.0}  # KLD + (1 - CC) + MAE
CODE = {"kld": 0.0, "cc": 0.1, "mae": 1.0}  # the published code's: MAE + 0.1 (1 - CC)


class GazeLoss(NamedTuple):
    """``total``, differentiable, and its unweighted parts ``kld`` (nats),
    ``cc`` (the correlation itself) and ``mae`` (1/sr): arrays of one value, the
    mean over the probes. A part of weight zero is ``None``: it is not traced."""

    total: Any
    kld: Any
    cc: Any
    mae: Any


def gaze_loss(
    prediction: Any,
    truth: Any,
    directions: int,
    solid_angle: Any = None,
    *,
    kld: float = 1.0,
    cc: float = 1.0,
    mae: float = 1.0,
) -> GazeLoss:
    """kld · KLD + cc · (1 - CC) + mae · MAE, averaged over the probes.

    ``prediction``, ``truth``: (P * D,) Dr.Jit floats of one type, in 1/sr;
    gradients flow to the prediction only. ``directions``: D. ``solid_angle``:
    (D,) for every probe alike, or (P * D,), or ``None`` for equal areas.
    :data:`PAPER` and :data:`CODE` are ready weights: ``gaze_loss(..., **CODE)``.

    KLD normalises both densities over the probe's directions, and counts a
    negative prediction as zero. MAE does not normalise, so that it alone holds
    the scale. Raises ``ValueError`` for lengths that do not fit, and when every
    weight is zero.
    """
    if not (kld or cc or mae):
        raise ValueError("every weight of the gaze loss is zero; give kld, cc or mae a weight")
    n = _lengths(prediction, truth, directions)
    w = _shares(type(truth), directions, n, solid_angle)
    truth = dr.detach(truth)

    parts: dict[str, Any] = {"kld": None, "cc": None, "mae": None}
    total = type(truth)(0)
    if kld:
        parts["kld"] = dr.mean(probe_kld(prediction, truth, directions, w))
        total += kld * parts["kld"]
    if cc:
        parts["cc"] = dr.mean(probe_cc(prediction, truth, directions, w))
        total += cc * (1 - parts["cc"])
    if mae:
        parts["mae"] = dr.mean(dr.block_sum(w * dr.abs(prediction - truth), directions))
        total += mae * parts["mae"]
    return GazeLoss(total, **parts)


def probe_kld(prediction: Any, truth: Any, directions: int, w: Any) -> Any:
    """KL(truth || prediction) of each probe, (P,) nats; ``w`` (P * D,) shares
    of solid angle that sum to one in each probe."""
    p = _relative(truth, directions, w) + KLD_EPS
    q = _relative(dr.maximum(prediction, 0), directions, w) + KLD_EPS
    return dr.block_sum(w * p * (dr.log(p) - dr.log(q)), directions) / (1 + KLD_EPS)


def probe_cc(prediction: Any, truth: Any, directions: int, w: Any) -> Any:
    """Pearson's correlation of each probe, (P,); 0 with zero gradient where
    either density is constant."""
    x, spread_x = _centred(prediction, directions, w)
    y, spread_y = _centred(truth, directions, w)
    live = (spread_x > 0) & (spread_y > 0)
    # The root's argument is replaced before the root: a masked infinite
    # derivative times zero would still be NaN.
    scale = dr.rsqrt(dr.select(live, spread_x, 1)) * dr.rsqrt(dr.select(live, spread_y, 1))
    return dr.select(live, dr.block_sum(w * x * y, directions) * scale, 0)


def _relative(density: Any, directions: int, w: Any) -> Any:
    """Density in units of the uniform one of equal integral."""
    mean = dr.block_sum(w * density, directions)
    live = mean > VANISHED
    inverse = dr.select(live, dr.rcp(dr.select(live, mean, 1)), 0)
    # A map of zeros has no shape: it counts as uniform, without a gradient.
    return density * dr.repeat(inverse, directions) + dr.repeat(dr.select(live, type(density)(0), 1), directions)


def _centred(values: Any, directions: int, w: Any) -> tuple[Any, Any]:
    """Values minus their mean, and their variance per probe, which is exactly
    zero (and without gradient) where rounding is all there is."""
    mean = dr.block_sum(w * values, directions)
    centred = values - dr.repeat(mean, directions)
    variance = dr.block_sum(w * centred * centred, directions)
    return centred, dr.select(variance > dr.square(FLAT * dr.detach(mean)), variance, 0)


def _lengths(prediction: Any, truth: Any, directions: int) -> int:
    n = dr.width(truth)
    if dr.width(prediction) != n or directions < 1 or n % directions:
        raise ValueError(
            f"{dr.width(prediction)} predictions, {n} true densities and {directions} directions do not fit: "
            "both are flat, probe after probe, with the same directions each"
        )
    return n


def _shares(Float: type, directions: int, n: int, solid_angle: Any) -> Any:
    if solid_angle is None:
        return Float(1.0 / directions)
    w = Float(solid_angle)
    if dr.width(w) not in (directions, n):
        raise ValueError(f"{dr.width(w)} solid angles for {directions} directions; give one a direction or one a value")
    if dr.width(w) != n:
        w = dr.tile(w, n // directions)
    return w / dr.repeat(dr.block_sum(w, directions), directions)
