"""What a gaze field is trained with: how rays become probes, and how the weights are moved."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from nerg_mi.errors import NergError

from . import losses

LOSSES = {"paper": losses.PAPER, "code": losses.CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}
"""Weights of the parts of each loss; of the likelihood, which rays give, those by which a validation is judged."""


@dataclass(frozen=True)
class ProbeSettings:
    """How rays become probes, and probes targets; lengths in metres, in the rays' frame."""

    # Radius R of a probe.
    radius: float = 0.25
    # Probes at most.
    count: int = 2048
    # Rays in a probe at most, the nearest.
    cap: int = 1024
    # Rays in a probe at least.
    min_rays: int = 64
    # How a probe chooses the concentration of its rays' kernels (`density.probes.place_probes`).
    kappa_rule: str = "fixed"
    # Concentration of the rule "fixed".
    kappa: float = 50.0
    # Directions of equal area of each probe, turned at random and fixed, so that depths are traced once.
    directions: int = 1024
    # Kind of depth that is the surface (`transport.march.depth`).
    depth: str = "median"
    # Where probes are placed (`density.placement`).
    placement: str = "data"
    # Distance between probes, of placements that have one.
    spacing: float | None = None
    # Whether directions are turned anew, and depths traced again, for every epoch.
    fresh: bool = False
    # What a probe's rays count by (`density.probes.place_probes`).
    weights: str = "equal"
    # Concentration of the kernels of the blind density, of fields that have one. Wide: such a field learns what it
    # lacks from many probes, but nothing takes back the peaks of a few people, which others do not share.
    mix_kappa: float = 10.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mix_kappa) and self.mix_kappa > 0):
            raise NergError(f"the kernels of a blind density need a positive concentration, got {self.mix_kappa:g}")
        if self.directions < 16 or self.count < 1:
            raise NergError(
                "supervision needs at least one probe and 16 directions, "
                f"got {self.count} probes and {self.directions} directions"
            )

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings:
    """How weights are moved, for how long, and what a validation watches. Of ``steps`` and ``minutes`` one is given."""

    # Steps of the run.
    steps: int | None = None
    # Or its length in minutes.
    minutes: float | None = None
    # Of probes, directions, weights, batches and the validation's split.
    seed: int = 0
    # "paper" (KLD + (1 - CC) + MAE), "code" (MAE + 0.1 (1 - CC), as published) or "likelihood", of a log density.
    loss: str = "paper"
    # Weight of the squared error of a probe's integral, which KLD and CC do not see; MAE alone pulls it to the median.
    integral: float = 1.0
    # Probes of a step, drawn at random.
    probes: int = 16
    # Directions of each, drawn at random.
    directions: int = 256
    # Rays of each, drawn from its density, for the likelihood.
    rays: int = 64
    # Learning rate at the start.
    learning_rate: float = 1e-2
    # What it comes to at the end, a share of that at the start; it decays exponentially.
    final_rate: float = 0.03
    # Share of the run for which the rate is held before it decays.
    hold: float = 0.3
    # Decoupled (AdamW): share of the weights a step, a unit of learning rate.
    weight_decay: float = 0.3
    # Decay a step of the averaged weights, which are the result.
    average: float = 0.98
    # How often in a run the validation is looked at.
    looks: int = 20
    # Looks without an improvement after which the run ends; 0: it never ends early.
    patience: int = 6
    # Groups of positions that the validation watches; 0: there is none.
    zones: int = 3
    # Probes in all of them.
    watched: int = 60
    # Rays that each of these has at least; None: as many as those of the training.
    watched_rays: int | None = None
    # Whether to train again on everything, the validation's part too, for as many steps as were best.
    refit: bool = True
    # Folds of people and positions that choose a log density's share of the blind density; 0: it is the architecture's.
    mix_folds: int = 0
    # Whether weights that were given to begin with stay as they are.
    frozen: bool = False

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")
        if (self.steps or self.minutes or 0) <= 0:
            raise NergError(f"a training must last longer than 0, got steps={self.steps}, minutes={self.minutes}")
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
        if (
            min(self.probes, self.directions, self.rays, self.looks) < 1
            or min(self.weight_decay, self.integral) < 0
            or min(self.zones, self.patience, self.mix_folds) < 0
        ):
            raise NergError(f"a training needs probes, directions and looks, and nothing negative, got {self}")

    def rate(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.hold) / (1 - self.hold)
        return self.learning_rate * self.final_rate ** min(late, 1.0)

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)
