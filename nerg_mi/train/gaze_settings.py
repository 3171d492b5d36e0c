"""Settings of a gaze field's training: sizes of networks, losses, steps."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig
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
)

# ---- Losses between predicted and true gaze densities of probes, in Dr.Jit ----
#
# Densities are flat arrays, probe after probe with the same D directions each
# (P * D values, 1/sr): value p * D + d is probe p in direction d. Sums over a
# probe are weighted by solid angle. Definitions as in
# :mod:`nerg_mi.evaluation.metrics`; NeRG, Section 4.3 (whose text adds the
# correlation itself; it is 1 - CC that is minimised).


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


# ---- Settings ----
#
# What a gaze field is trained with: how rays become probes, and how the weights are moved.


LOSSES = {"paper": PAPER, "code": CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the parts of each loss; of the likelihood, which rays give, those by which a validation is judged."""


@dataclass(frozen=True)
class ProbeSettings(Checked):
    """How rays become probes, and probes targets; lengths in metres, in the rays' frame."""

    # Radius R of a probe.
    radius: float = ranged(0.25, LENGTHS)
    # Probes at most.
    count: int = ranged(2048, Range(1, 10**6))
    # Rays in a probe at most, the nearest.
    cap: int = ranged(1024, Range(1, 10**6))
    # Rays in a probe at least.
    min_rays: int = ranged(64, Range(1, 10**6))
    # How a probe chooses the concentration of its rays' kernels (`probes.probes.place_probes`).
    kappa_rule: str = "fixed"
    # Concentration of the rule "fixed".
    kappa: float = ranged(50.0, KAPPAS)
    # Directions of equal area of each probe, turned at random and fixed, so that depths are traced once.
    directions: int = ranged(1024, DIRECTIONS)
    # Kind of depth that is the surface (`transport.depth`).
    depth: str = "median"
    # Where probes are placed (`probes.probes`).
    placement: str = "data"
    # Distance between probes, of placements that have one.
    spacing: float | None = ranged(None, LENGTHS)
    # Whether directions are turned anew, and depths traced again, for every epoch.
    fresh: bool = False
    # What a probe's rays count by (`probes.probes.place_probes`).
    weights: str = "equal"
    # Concentration of the kernels of the blind density, of fields that have one. Wide: such a field learns what it
    # lacks from many probes, but nothing takes back the peaks of a few people, which others do not share.
    mix_kappa: float = ranged(10.0, KAPPAS)

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(Checked):
    """How weights are moved, for how long, and what a validation watches. Of ``steps`` and ``minutes`` one is given."""

    # Steps of the run.
    steps: int | None = ranged(None, STEPS)
    # Or its length in minutes.
    minutes: float | None = ranged(None, MINUTES)
    # Of probes, directions, weights, batches and the validation's split.
    seed: int = ranged(0, SEEDS)
    # "paper" (KLD + (1 - CC) + MAE), "code" (MAE + 0.1 (1 - CC), as published) or "likelihood", of a log density.
    loss: str = "paper"
    # Weight of the squared error of a probe's integral, which KLD and CC do not see; MAE alone pulls it to the median.
    integral: float = ranged(1.0, LOSS_WEIGHTS)
    # Probes of a step, drawn at random.
    probes: int = ranged(16, Range(1, 10**6))
    # Directions of each, drawn at random.
    directions: int = ranged(256, Range(1, 1 << 20))
    # Rays of each, drawn from its density, for the likelihood.
    rays: int = ranged(64, Range(1, 10**6))
    # Learning rate at the start.
    learning_rate: float = ranged(1e-2, LEARNING_RATES)
    # What it comes to at the end, a share of that at the start; it decays exponentially.
    final_rate: float = ranged(0.03, Range(0, 1))
    # Share of the run for which the rate is held before it decays.
    hold: float = ranged(0.3, Range(0, 0.999))
    # Decoupled (AdamW): share of the weights a step, a unit of learning rate.
    weight_decay: float = ranged(0.3, WEIGHT_DECAYS)
    # Decay a step of the averaged weights, which are the result.
    average: float = ranged(0.98, Range(0, 1))
    # How often in a run the validation is looked at.
    looks: int = ranged(20, Range(1, 10**6))
    # Looks without an improvement after which the run ends; 0: it never ends early.
    patience: int = ranged(6, Range(0, 10**6))
    # Groups of positions that the validation watches; 0: there is none.
    zones: int = ranged(3, Range(0, 1000))
    # Probes in all of them.
    watched: int = ranged(60, Range(1, 10**6))
    # Rays that each of these has at least; None: as many as those of the training.
    watched_rays: int | None = ranged(None, Range(1, 10**6))
    # Whether to train again on everything, the validation's part too, for as many steps as were best.
    refit: bool = True
    # Folds of people and positions that choose a log density's share of the blind density; 0: it is the architecture's.
    mix_folds: int = ranged(0, Range(0, 1000))
    # Whether weights that were given to begin with stay as they are.
    frozen: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')

    def rate(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.hold) / (1 - self.hold)
        return self.learning_rate * self.final_rate ** min(late, 1.0)

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)


# ---- Sizes ----
#
# Architectures of a gaze field that is a product (equation 1), by one word, and the scale that they begin with.


# (levels, log2 rows, base and finest resolution, width, geometry features). "paper" has the paper's sizes, 10.6 million
# entries; "small" is what generalises to positions that nobody trained on, and stores in 0.4 MB as fp16.
_SIZES = {"small": (8, 14, 4, 128, 64, 15), "paper": (16, 19, 16, 512, 64, 15)}
SIZES = tuple(_SIZES)


def sized_gaze_config(size: str = "small", variant: str = "emit_capture", activation: str = "softplus") -> GazeConfig:
    """Architecture of a ``size``: ``small`` or ``paper``. Raises `NergError` for another word."""
    if size not in _SIZES:
        raise NergError(f'size must be one of {", ".join(_SIZES)}, got "{size}"')
    levels, rows, base, finest, width, geometry = _SIZES[size]
    grid = HashGridConfig(levels=levels, log2_rows=rows, base=base, finest=finest)
    return GazeConfig(
        grid=grid,
        variant=variant,
        activation=activation,
        width=width,
        geometry=geometry,
        emit_scale=uniform_scale(variant, activation),
    )


def uniform_scale(variant: str, activation: str) -> float:
    """The ``emit_scale`` with which weights of zero are the uniform density, 1/(4π).

    Networks without biases fall to zero under weight decay. Were that a density of another integral, they would have to
    spend weight on the scale alone, and do: fields that must fight for it follow their probes much less well.
    """
    at_zero = {"softplus": math.log(2.0), "exp": 1.0}.get(activation)
    if at_zero is None:
        return 1.0
    return 1 / (4 * math.pi * at_zero * (0.5 if variant == "emit_capture" else 1.0))
