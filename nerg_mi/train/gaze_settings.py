"""Settings of a gaze field's training: sizes of networks, losses, steps."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.ranges import (
    DIRECTIONS,
    KAPPAS,
    LEARNING_RATES,
    LENGTHS,
    LOSS_WEIGHTS,
    MINUTES,
    SEEDS,
    STEPS,
    WEIGHT_DECAYS,
    Checked,
    Range,
    ranged,
    setting,
)

from .trainer import RunSettings

# ---- Losses between predicted and true gaze densities of probes, in Dr.Jit ----
#
# Densities are flat arrays, probe after probe with the same D directions each (P * D values, 1/sr): value p * D + d is
# probe p in direction d. Sums over a probe are weighted by solid angle. Definitions as in
# :mod:`nerg_mi.evaluation.metrics`; NeRG, Section 4.3 (whose text adds the correlation itself; it is 1 - CC that is
# minimised).

KLD_EPS = 1e-6  # Of the uniform density: what a density of zero counts as inside a logarithm
# 1/sr (uniform is 0.08): a density whose mean is lower is a map of zeros. Its gradient
# grows as one over the mean, and would leave float32 before the mean does.
VANISHED = 1e-12
FLAT = 1e-5  # A probe whose spread is below this fraction of its mean is constant: no correlation

PAPER = {"kld": 1.0, "cc": 1.0, "mae": 1.0}  # KLD + (1 - CC) + MAE
CODE = {"kld": 0.0, "cc": 0.1, "mae": 1.0}  # the published code's: MAE + 0.1 (1 - CC)


class GazeLoss(NamedTuple):
    """``total``, differentiable, and its unweighted parts ``kld`` (nats), ``cc`` (the correlation itself) and ``mae``
    (1/sr): arrays of one value, the mean over the probes. A part of weight zero is ``None``: it is not traced."""

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

    ``prediction``, ``truth``: (P * D,) Dr.Jit floats of one type, in 1/sr; gradients flow to the prediction only.
    ``directions``: D. ``solid_angle``: (D,) for every probe alike, or (P * D,), or ``None`` for equal areas.
    :data:`PAPER` and :data:`CODE` are ready weights: ``gaze_loss(..., **CODE)``.

    KLD normalises both densities over the probe's directions, and counts a negative prediction as zero. MAE does not
    normalise, so that it alone holds the scale. ``ValueError`` for lengths that do not fit, and when every weight is
    zero.
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
    """Pearson's correlation of each probe, (P,); 0 with zero gradient where either density is constant."""
    x, spread_x = _centred(prediction, directions, w)
    y, spread_y = _centred(truth, directions, w)
    live = (spread_x > 0) & (spread_y > 0)
    # The root's argument is replaced before the root: a masked infinite derivative times zero would still be NaN.
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


# ---- What a gaze field is trained with: how rays become probes, and how the weights are moved ----

LOSSES = {"paper": PAPER, "code": CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the parts of each loss; of the likelihood, which rays give, those by which a validation is judged."""


@dataclass(frozen=True)
class ProbeSettings(Checked):
    """How rays become probes, and probes targets; lengths in metres, in the rays' frame."""

    radius: float = setting(0.25, "Radius R of a probe in metres.", within=LENGTHS)
    count: int = setting(2048, "Number of probes at most.", within=Range(1, 10**6), option="probes")
    cap: int = setting(1024, "Rays in a probe at most, the nearest.", within=Range(1, 10**6))
    min_rays: int = setting(64, "Rays in a probe at least.", within=Range(1, 10**6))
    kappa_rule: str = setting("fixed", "Concentration of a ray's kernel: fixed, silverman or loo.")
    kappa: float = setting(50.0, "That of the rule fixed.", within=KAPPAS)
    # Of equal area, turned at random and fixed, so that depths are traced once.
    directions: int = setting(1024, "Directions of a probe.", within=DIRECTIONS)
    depth: str = "median"  # Kind of depth that is the surface (`transport.depth`)
    placement: str = setting("data", "Of probes: data, grid, random or blue.")
    spacing: float | None = ranged(None, LENGTHS)  # Distance between probes, of placements that have one
    fresh: bool = setting(False, "Draw the directions again for every epoch, not once a probe.", "--fresh-directions")
    weights: str = setting(
        "equal", "Of a probe's rays: equal, distance (1 - d/R), or person (all people of a probe count alike)."
    )
    # Wide: such a field learns what it lacks from many probes, but nothing takes back the peaks of a few people, which
    # others do not share.
    mix_kappa: float = setting(
        10.0, "Concentration of the kernels of that blind density, which default also begins with.", within=KAPPAS
    )

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(RunSettings):
    """How weights are moved, for how long, and what a validation watches. Of ``steps`` and ``minutes`` one is set."""

    steps: int | None = setting(None, "Train for so many steps.", within=STEPS)
    minutes: float | None = setting(None, "Or: train for so many minutes, both fits together.", within=MINUTES)
    seed: int = setting(0, "Seed of probes, directions, weights, batches and splits.", within=SEEDS)
    # "likelihood" is that of a log density.
    loss: str = setting("paper", "Of small and paper. paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")
    # KLD and CC do not see the integral; MAE alone pulls it to the median.
    integral: float = setting(1.0, "Weight of the squared error of the integral over the sphere.", within=LOSS_WEIGHTS)
    probes: int = ranged(16, Range(1, 10**6))  # Probes of a step, drawn at random
    directions: int = ranged(256, Range(1, 1 << 20))  # Directions of each, drawn at random
    rays: int = ranged(64, Range(1, 10**6))  # Rays of each, drawn from its density, for the likelihood
    learning_rate: float = setting(1e-2, "Learning rate at the start.", within=LEARNING_RATES)
    # What it comes to at the end, a share of that at the start; it decays exponentially.
    final_rate: float = ranged(0.03, Range(0, 1))
    hold: float = ranged(0.3, Range(0, 0.999))  # Share of the run for which the rate is held before it decays
    # AdamW: share of the weights a step, a unit of learning rate.
    weight_decay: float = setting(0.3, "Decoupled weight decay.", within=WEIGHT_DECAYS)
    average: float = ranged(0.98, Range(0, 1))  # Decay a step of the averaged weights, which are the result
    looks: int = ranged(20, Range(1, 10**6))  # How often in a run the validation is looked at
    # Looks without an improvement after which the run ends; 0: it never ends early.
    patience: int = ranged(6, Range(0, 10**6))
    zones: int = setting(
        3, "Zones of positions watched as validation, whose best weights count; 0: none.", within=Range(0, 1000)
    )
    watched: int = ranged(60, Range(1, 10**6))  # Probes in all of them
    # Rays that each of these has at least; None: as many as those of the training.
    watched_rays: int | None = ranged(None, Range(1, 10**6))
    refit: bool = setting(True, "Train again on all rays once the best number of steps is known.")
    mix_folds: int = setting(
        0,
        "Folds of people and positions that choose how much of the blind density default mixes in; 0: a twentieth.",
        within=Range(0, 1000),
    )
    frozen: bool = setting(False, "Do not train the weights that --begin field gives.", option="freeze")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
