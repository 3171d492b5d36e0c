"""What a gaze field is trained with: how rays become probes, and how the weights are moved."""

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
    Checked,
    Range,
    ranged,
)

from . import losses

LOSSES = {"paper": losses.PAPER, "code": losses.CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
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
