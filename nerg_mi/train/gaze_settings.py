"""Settings of gaze training: probes, losses, optimisation."""

from __future__ import annotations

from dataclasses import asdict, dataclass

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
    Range,
    ValidatedDataclass,
    range_field,
)

from .radiance_settings import RunSettings

# ---- Settings of probes and of the optimisation ----


# 1/sr (uniform is 0.08). A density with a lower mean counts as zero: the gradient grows as one over the mean and would
# overflow float32.
MIN_MEAN_DENSITY = 1e-12

PAPER = {"kld": 1.0, "cc": 1.0, "mae": 1.0}  # KLD + (1 - CC) + MAE
CODE = {"kld": 0.0, "cc": 0.1, "mae": 1.0}  # the published code: MAE + 0.1 (1 - CC)


LOSSES = {"paper": PAPER, "code": CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the terms of each loss. Those of "likelihood" are not used: its trainer has its own loss."""


@dataclass(frozen=True)
class ProbeSettings(ValidatedDataclass):
    """How rays become probes and probes become targets. Lengths are in metres, in the frame of the rays."""

    # The fields that are no keywords of `nerg_mi.train.gaze.train_gaze` are set by a recipe.
    radius: float = range_field(0.25, LENGTHS)
    probes: int = range_field(2048, Range(1, 10**6))  # Maximum number of probes
    max_rays: int = range_field(1024, Range(1, 10**6))  # Maximum number of rays in a probe; the nearest are used
    min_rays: int = range_field(64, Range(1, 10**6))
    # How the concentration of a ray's kernel is chosen: fixed (by kappa), silverman (rule of thumb) or loo
    # (leave-one-out likelihood).
    kappa_rule: str = "fixed"
    # Concentration of the von Mises-Fisher kernel (unitless) for the rule fixed
    kappa: float = range_field(50.0, KAPPAS)
    # Directions of equal area, randomly rotated and fixed, so that depths are traced once.
    directions: int = range_field(1024, DIRECTIONS)
    depth: str = "median"  # Depth estimator (`transport.depth`)
    placement: str = "data"  # Placement of probes: data (at ray origins), grid, random, or blue (blue noise)
    spacing: float | None = range_field(None, LENGTHS)  # Distance between probes, for placements that use it
    resample_directions: bool = False  # Draw new directions for each epoch, not once per probe
    # Weights of the rays in a probe: equal, distance (1 - d/R), or person (equal for each participant)
    ray_weights: str = "equal"
    # Concentration of the kernels of the position-independent prior of the default recipe. None: chosen by leaving out
    # participants, or 30 without ``prior_folds``.
    prior_kappa: float | None = range_field(None, KAPPAS)

    def to_dict(self) -> dict:
        """Return the settings as JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(RunSettings):
    """Settings of the optimisation and the validation. Exactly one of ``steps`` and ``minutes`` is set."""

    steps: int | None = range_field(None, STEPS)
    minutes: float | None = range_field(None, MINUTES)
    seed: int = range_field(0, SEEDS)
    # Loss of the recipes small and paper: paper is KLD + (1 - CC) + MAE, code is MAE + 0.1 (1 - CC). "likelihood" is
    # the loss of the log density.
    loss: str = "paper"
    # Weight of the squared error of the integral over the sphere, for the recipes small and paper: KLD and CC do not
    # depend on the integral, and MAE alone pulls it to the median.
    integral_weight: float = range_field(1.0, LOSS_WEIGHTS)
    probes: int = range_field(16, Range(1, 10**6))  # Random probes per step
    directions: int = range_field(256, Range(1, 1 << 20))  # Random directions per probe
    rays: int = range_field(64, Range(1, 10**6))  # Rays per probe, drawn from its density, for the likelihood
    learning_rate: float = range_field(1e-2, LEARNING_RATES)  # Initial learning rate
    # Final learning rate as a fraction of the initial one; the decay is exponential.
    lr_final_ratio: float = range_field(0.03, Range(0, 1))
    # Fraction of the run with constant learning rate, before it decays
    lr_hold_fraction: float = range_field(0.3, Range(0, 0.999))
    # Decoupled weight decay (AdamW): fraction of the weights per step and unit of learning rate
    weight_decay: float = range_field(0.3, WEIGHT_DECAYS)
    # Decay per step of the exponential moving average of the weights, which is the result
    ema_decay: float = range_field(0.98, Range(0, 1))
    num_validations: int = range_field(20, Range(1, 10**6))  # Number of validations per run
    # Validations without an improvement after which the run stops; 0 disables early stopping.
    patience: int = range_field(6, Range(0, 10**6))
    validation_zones: int = range_field(3, Range(0, 1000))
    validation_probes: int = range_field(60, Range(1, 10**6))  # Validation probes in all zones
    # Minimum rays per validation probe; None: as for training probes.
    validation_min_rays: int | None = range_field(None, Range(1, 10**6))
    refit: bool = True  # Train again on all rays, for the number of steps that validation found best
    prior_folds: int = range_field(0, Range(0, 1000))
    reaimed_hits: bool = False
    freeze: bool = False  # Keep the weights that come from the radiance field fixed

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
