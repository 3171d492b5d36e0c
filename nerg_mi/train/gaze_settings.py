"""Settings of a gaze field's training: sizes of networks, weights of losses, steps."""

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
    ValidatedDataclass,
    Range,
    range_field,
    setting,
)

from .radiance_settings import RunSettings

# ---- What a gaze field is trained with: how rays become probes, and how the weights are moved ----


# 1/sr (uniform is 0.08): a density whose mean is lower is a map of zeros. Its gradient
# grows as one over the mean, and would leave float32 before the mean does.
MIN_MEAN_DENSITY = 1e-12

PAPER = {"kld": 1.0, "cc": 1.0, "mae": 1.0}  # KLD + (1 - CC) + MAE
CODE = {"kld": 0.0, "cc": 0.1, "mae": 1.0}  # the published code's: MAE + 0.1 (1 - CC)


LOSSES = {"paper": PAPER, "code": CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the parts of each loss; of the likelihood, which rays give, those by which a validation is judged."""


@dataclass(frozen=True)
class ProbeSettings(ValidatedDataclass):
    """How rays become probes, and probes targets; lengths in metres, in the rays' frame."""

    radius: float = setting(0.25, "Radius R of a probe in metres.", allowed=LENGTHS)
    count: int = setting(2048, "Number of probes at most.", allowed=Range(1, 10**6), option="probes")
    cap: int = setting(1024, "Rays in a probe at most, the nearest.", allowed=Range(1, 10**6))
    min_rays: int = setting(64, "Rays in a probe at least.", allowed=Range(1, 10**6))
    kappa_rule: str = setting("fixed", "Concentration of a ray's kernel: fixed, silverman or loo.")
    kappa: float = setting(50.0, "That of the rule fixed.", allowed=KAPPAS)
    # Of equal area, turned at random and fixed, so that depths are traced once.
    directions: int = setting(1024, "Directions of a probe.", allowed=DIRECTIONS)
    depth: str = "median"  # Kind of depth that is the surface (`transport.depth`)
    placement: str = setting("data", "Of probes: data, grid, random or blue.")
    spacing: float | None = range_field(None, LENGTHS)  # Distance between probes, of placements that have one
    fresh: bool = setting(False, "Draw the directions again for every epoch, not once a probe.", "--fresh-directions")
    weights: str = setting(
        "equal", "Of a probe's rays: equal, distance (1 - d/R), or person (all people of a probe count alike)."
    )
    # Wide: such a field learns what it lacks from many probes, but nothing takes back the peaks of a few people, which
    # others do not share.
    mix_kappa: float = setting(
        10.0, "Concentration of the kernels of that blind density, which default also begins with.", allowed=KAPPAS
    )

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings(RunSettings):
    """How weights are moved, for how long, and what a validation watches. Of ``steps`` and ``minutes`` one is set."""

    steps: int | None = setting(None, "Train for so many steps.", allowed=STEPS)
    minutes: float | None = setting(None, "Or: train for so many minutes, both fits together.", allowed=MINUTES)
    seed: int = setting(0, "Seed of probes, directions, weights, batches and splits.", allowed=SEEDS)
    # "likelihood" is that of a log density.
    loss: str = setting("paper", "Of small and paper. paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")
    # KLD and CC do not see the integral; MAE alone pulls it to the median.
    integral: float = setting(1.0, "Weight of the squared error of the integral over the sphere.", allowed=LOSS_WEIGHTS)
    probes: int = range_field(16, Range(1, 10**6))  # Probes of a step, drawn at random
    directions: int = range_field(256, Range(1, 1 << 20))  # Directions of each, drawn at random
    rays: int = range_field(64, Range(1, 10**6))  # Rays of each, drawn from its density, for the likelihood
    learning_rate: float = setting(1e-2, "Learning rate at the start.", allowed=LEARNING_RATES)
    # What it comes to at the end, a share of that at the start; it decays exponentially.
    lr_final_ratio: float = range_field(0.03, Range(0, 1))
    lr_hold_fraction: float = range_field(0.3, Range(0, 0.999))  # Share of the run for which the rate is held before it decays
    # AdamW: share of the weights a step, a unit of learning rate.
    weight_decay: float = setting(0.3, "Decoupled weight decay.", allowed=WEIGHT_DECAYS)
    ema_decay: float = range_field(0.98, Range(0, 1))  # Decay a step of the averaged weights, which are the result
    num_validations: int = range_field(20, Range(1, 10**6))  # How often in a run the validation is looked at
    # Looks without an improvement after which the run ends; 0: it never ends early.
    patience: int = range_field(6, Range(0, 10**6))
    zones: int = setting(
        3, "Zones of positions watched as validation, whose best weights count; 0: none.", allowed=Range(0, 1000)
    )
    validation_probes: int = range_field(60, Range(1, 10**6))  # Probes in all of them
    # Rays that each of these has at least; None: as many as those of the training.
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
