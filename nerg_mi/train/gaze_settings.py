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
    setting,
)

from .radiance_settings import RunSettings

# ---- Settings of probes and of the optimisation ----


# 1/sr (uniform is 0.08). A density with a lower mean counts as zero: the gradient grows as one over the mean and would
# overflow float32.
MIN_MEAN_DENSITY = 1e-12

PAPER = {"kld": 1.0, "cc": 1.0, "mae": 1.0}  # KLD + (1 - CC) + MAE
CODE = {"kld": 0.0, "cc": 0.1, "mae": 1.0}  # the published code: MAE + 0.1 (1 - CC)


LOSSES = {"paper": PAPER, "code": CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the terms of each loss. For "likelihood" they only define the validation objective."""


@dataclass(frozen=True)
class ProbeSettings(ValidatedDataclass):
    """How rays become probes and probes become targets. Lengths are in metres, in the frame of the rays."""

    radius: float = setting(0.25, "Radius R of a probe in metres.", allowed=LENGTHS)
    probes: int = setting(2048, "Maximum number of probes.", allowed=Range(1, 10**6))
    max_rays: int = setting(1024, "Maximum number of rays in a probe; the nearest are used.", allowed=Range(1, 10**6))
    min_rays: int = setting(64, "Minimum number of rays in a probe.", allowed=Range(1, 10**6))
    kappa_rule: str = setting(
        "fixed",
        "How the concentration of a ray's kernel is chosen: fixed (by kappa), silverman (rule of thumb) or loo "
        "(leave-one-out likelihood).",
    )
    kappa: float = setting(
        50.0,
        "Concentration of the von Mises-Fisher kernel (unitless), or its standard deviation such as 4deg, for the rule "
        "fixed.",
        allowed=KAPPAS,
    )
    # Directions of equal area, randomly rotated and fixed, so that depths are traced once.
    directions: int = setting(
        1024, "Number of directions of a probe at which its density is evaluated.", allowed=DIRECTIONS
    )
    depth: str = "median"  # Depth estimator (`transport.depth`)
    placement: str = setting("data", "Placement of probes: data (at ray origins), grid, random, or blue (blue noise).")
    spacing: float | None = range_field(None, LENGTHS)  # Distance between probes, for placements that use it
    resample_directions: bool = setting(False, "Draw new directions for each epoch, not once per probe.")
    ray_weights: str = setting(
        "equal", "Weights of the rays in a probe: equal, distance (1 - d/R), or person (equal for each participant)."
    )
    prior_kappa: float | None = setting(
        None,
        "Only for the recipe named default: concentration (unitless), or standard deviation such as 10deg, of the "
        "kernels of the position-independent prior. Default: chosen by leaving out participants, or 30 without "
        "--prior-folds.",
        allowed=KAPPAS,
    )

    def to_dict(self) -> dict:
        """Return the settings as JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(RunSettings):
    """Settings of the optimisation and the validation. Exactly one of ``steps`` and ``minutes`` is set."""

    steps: int | None = setting(None, "Number of training steps.", allowed=STEPS)
    minutes: float | None = setting(
        None, "Training time in minutes, in place of --steps; includes the second fit.", allowed=MINUTES
    )
    seed: int = setting(0, "Seed of probes, directions, weights, batches and splits.", allowed=SEEDS)
    # "likelihood" is the loss of the log density.
    loss: str = setting(
        "paper",
        "Only for the recipes small and paper: loss; paper is KLD + (1 - CC) + MAE, code is MAE + 0.1 (1 - CC).",
    )
    # KLD and CC do not depend on the integral. MAE alone pulls it to the median.
    integral_weight: float = setting(
        1.0,
        "Only for the recipes small and paper: weight of the squared error of the integral over the sphere.",
        allowed=LOSS_WEIGHTS,
    )
    probes: int = range_field(16, Range(1, 10**6))  # Random probes per step
    directions: int = range_field(256, Range(1, 1 << 20))  # Random directions per probe
    rays: int = range_field(64, Range(1, 10**6))  # Rays per probe, drawn from its density, for the likelihood
    learning_rate: float = setting(1e-2, "Initial learning rate.", allowed=LEARNING_RATES)
    # Final learning rate as a fraction of the initial one; the decay is exponential.
    lr_final_ratio: float = range_field(0.03, Range(0, 1))
    # Fraction of the run with constant learning rate, before it decays
    lr_hold_fraction: float = range_field(0.3, Range(0, 0.999))
    # AdamW: fraction of the weights per step and unit of learning rate.
    weight_decay: float = setting(0.3, "Decoupled weight decay (AdamW).", allowed=WEIGHT_DECAYS)
    # Decay per step of the exponential moving average of the weights, which is the result
    ema_decay: float = range_field(0.98, Range(0, 1))
    num_validations: int = range_field(20, Range(1, 10**6))  # Number of validations per run
    # Validations without an improvement after which the run stops; 0 disables early stopping.
    patience: int = range_field(6, Range(0, 10**6))
    validation_zones: int = setting(
        3, "Number of position zones held out for validation (early stopping); 0 disables it.", allowed=Range(0, 1000)
    )
    validation_probes: int = range_field(60, Range(1, 10**6))  # Validation probes in all zones
    # Minimum rays per validation probe; None: as for training probes.
    validation_min_rays: int | None = range_field(None, Range(1, 10**6))
    refit: bool = setting(True, "Train again on all rays, for the number of steps that validation found best.")
    prior_folds: int = setting(
        0,
        "Only for the recipe named default: number of cross-validation folds over participants and positions that "
        "choose the weight of the position-independent prior; 0: no folds, the weight is 0.05.",
        allowed=Range(0, 1000),
    )
    reaimed_hits: bool = setting(
        False,
        "Only for the recipe named default: mix a kernel density of the samples' hit points, seen from the observer, "
        "into the field, with a weight chosen by --prior-folds. The file then contains up to 32,768 samples without "
        "names and times.",
    )
    freeze: bool = setting(False, "Keep the weights of --init field fixed.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
