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
    count: int = setting(2048, "Number of probes at most.", allowed=Range(1, 10**6), option="probes")
    cap: int = setting(1024, "Rays in a probe at most, the nearest.", allowed=Range(1, 10**6))
    min_rays: int = setting(64, "Rays in a probe at least.", allowed=Range(1, 10**6))
    kappa_rule: str = setting("fixed", "Concentration of a ray's kernel: fixed, silverman or loo.")
    kappa: float = setting(50.0, "That of the rule fixed.", allowed=KAPPAS)
    # Directions of equal area, randomly rotated and fixed, so that depths are traced once.
    directions: int = setting(1024, "Directions of a probe.", allowed=DIRECTIONS)
    depth: str = "median"  # Depth estimator (`transport.depth`)
    placement: str = setting("data", "Of probes: data, grid, random or blue.")
    spacing: float | None = range_field(None, LENGTHS)  # Distance between probes, for placements that use it
    fresh: bool = setting(False, "Draw the directions again for every epoch, not once a probe.", "--fresh-directions")
    weights: str = setting(
        "equal", "Of a probe's rays: equal, distance (1 - d/R), or person (all people of a probe count alike)."
    )
    # Wide kernels: the field can learn missing detail from many probes, but it cannot remove the peaks of a few
    # participants.
    mix_kappa: float = setting(
        10.0, "Concentration of the kernels of that blind density, which default also begins with.", allowed=KAPPAS
    )

    def to_dict(self) -> dict:
        """Return the settings as JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(RunSettings):
    """Settings of the optimisation and the validation. Exactly one of ``steps`` and ``minutes`` is set."""

    steps: int | None = setting(None, "Train for so many steps.", allowed=STEPS)
    minutes: float | None = setting(None, "Or: train for so many minutes, both fits together.", allowed=MINUTES)
    seed: int = setting(0, "Seed of probes, directions, weights, batches and splits.", allowed=SEEDS)
    # "likelihood" is the loss of the log density.
    loss: str = setting("paper", "Of small and paper. paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")
    # KLD and CC do not depend on the integral. MAE alone pulls it to the median.
    integral: float = setting(1.0, "Weight of the squared error of the integral over the sphere.", allowed=LOSS_WEIGHTS)
    probes: int = range_field(16, Range(1, 10**6))  # Random probes per step
    directions: int = range_field(256, Range(1, 1 << 20))  # Random directions per probe
    rays: int = range_field(64, Range(1, 10**6))  # Rays per probe, drawn from its density, for the likelihood
    learning_rate: float = setting(1e-2, "Learning rate at the start.", allowed=LEARNING_RATES)
    # Final learning rate as a fraction of the initial one; the decay is exponential.
    lr_final_ratio: float = range_field(0.03, Range(0, 1))
    # Fraction of the run with constant learning rate, before it decays
    lr_hold_fraction: float = range_field(0.3, Range(0, 0.999))
    # AdamW: fraction of the weights per step and unit of learning rate.
    weight_decay: float = setting(0.3, "Decoupled weight decay.", allowed=WEIGHT_DECAYS)
    # Decay per step of the exponential moving average of the weights, which is the result
    ema_decay: float = range_field(0.98, Range(0, 1))
    num_validations: int = range_field(20, Range(1, 10**6))  # Number of validations per run
    # Validations without an improvement after which the run stops; 0 disables early stopping.
    patience: int = range_field(6, Range(0, 10**6))
    zones: int = setting(
        3, "Zones of positions watched as validation, whose best weights count; 0: none.", allowed=Range(0, 1000)
    )
    validation_probes: int = range_field(60, Range(1, 10**6))  # Validation probes in all zones
    # Minimum rays per validation probe; None: as for training probes.
    validation_min_rays: int | None = range_field(None, Range(1, 10**6))
    refit: bool = setting(True, "Train again on all rays once the best number of steps is known.")
    mix_folds: int = setting(
        0,
        "Folds of people and positions that choose how much of the blind density default mixes in; 0: a twentieth.",
        allowed=Range(0, 1000),
    )
    frozen: bool = setting(False, "Do not train the weights that --begin field gives.", option="freeze")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
