"""What a gaze field is trained with."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from nerg_mi.errors import NergError
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.product import GazeConfig

from . import losses as gaze_losses

# The likelihood has a trainer of its own; what is here weighs the parts of a validation.
LOSSES = {"paper": gaze_losses.PAPER, "code": gaze_losses.CODE, "likelihood": {"kld": 1.0, "cc": 0.0, "mae": 0.0}}

# (levels, log2 rows, base and finest resolution, width, geometry features). "paper" has the paper's sizes, 10.6 million
# entries; "small" is what generalises to positions that nobody trained on, and stores in 0.4 MB as fp16.
_SIZES = {"small": (8, 14, 4, 128, 64, 15), "paper": (16, 19, 16, 512, 64, 15)}
SIZES = tuple(_SIZES)


def sized_gaze_config(size: str = "small", variant: str = "emit_capture", activation: str = "softplus") -> GazeConfig:
    """Architecture of a ``size``: ``small`` or ``paper``. Raises ``NergError`` for unknown words."""
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


@dataclass(frozen=True)
class ProbeSettings:
    """How rays become supervision; lengths in metres, in the rays' frame.

    ``radius``, ``placement``, ``count``, ``spacing``, ``cap``, ``min_rays``, ``kappa_rule``, ``kappa``, ``weights``:
    see ``density.probes.place_probes``. ``directions``: how many of equal area each probe has, turned at random, fixed
    for the whole training, so that depths are traced once; ``fresh``: turned anew, and traced again, for every epoch
    (as many steps as draw as many probes as there are). ``depth``: kind of depth that is the surface
    (``transport.march.depth``).
    """

    radius: float = 0.25
    count: int = 2048
    cap: int = 1024
    min_rays: int = 64
    kappa_rule: str = "fixed"
    kappa: float = 50.0
    directions: int = 1024
    depth: str = "median"
    placement: str = "data"
    spacing: float | None = None
    fresh: bool = False
    weights: str = "equal"

    def __post_init__(self):
        if self.directions < 16 or self.count < 1:
            raise NergError(
                f"supervision needs at least one probe and 16 directions, got {self.count} probes and {self.directions} directions"
            )

    def to_dict(self) -> dict:
        return asdict(self)


@dataclass(frozen=True)
class GazeSettings:
    """Controls of a training run.

    ``steps`` or ``minutes``: how long, exactly one of them. ``loss``: ``paper`` (KLD + (1 - CC) + MAE), ``code`` (MAE +
    0.1 (1 - CC), as the authors published) or, for a log density, ``likelihood`` (``gaze_likelihood``), for which a
    step draws ``rays`` rays of each probe besides; ``integral``: weight of the squared error of a probe's integral,
    which the authors compute and do not train (0: not here either; KLD and CC do not see the scale, and MAE alone pulls
    it towards the median, far below a peaked density's mean). ``probes``, ``directions``: of a step, drawn at random.
    ``learning_rate``: held for the share ``hold`` of the run, then decayed exponentially to ``final_rate`` times
    itself; ``weight_decay``: decoupled (AdamW), a share of the weights a step a unit of learning rate; ``average``:
    decay a step of the averaged weights, which are the result. ``looks``: how often in a run the validation is looked
    at; ``patience``: looks without an improvement after which the run ends (0: never). ``zones``, ``watched``,
    ``watched_rays``: of the validation, groups of positions, probes in them, and rays that each has at least (default:
    as many as those of the training); no zones, no validation. ``refit``: train again on all rays, the validation's
    too, for as many steps as were best. ``frozen``: weights that were given to begin with are not trained.
    """

    steps: int | None = None
    minutes: float | None = None
    seed: int = 0
    loss: str = "paper"
    integral: float = 1.0
    probes: int = 16
    directions: int = 256
    rays: int = 64
    learning_rate: float = 1e-2
    final_rate: float = 0.03
    hold: float = 0.3
    weight_decay: float = 0.3
    average: float = 0.98
    looks: int = 20
    patience: int = 6
    zones: int = 3
    watched: int = 60
    watched_rays: int | None = None
    refit: bool = True
    frozen: bool = False

    def __post_init__(self):
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")
        if (self.steps if self.steps is not None else self.minutes) <= 0:
            raise NergError(f"a training must last longer than 0, got steps={self.steps}, minutes={self.minutes}")
        if self.loss not in LOSSES:
            raise NergError(f'the loss must be one of {", ".join(LOSSES)}, got "{self.loss}"')
        if (
            min(self.probes, self.directions, self.rays, self.looks) < 1
            or min(self.weight_decay, self.integral) < 0
            or min(self.zones, self.patience) < 0
        ):
            raise NergError(f"a training needs probes, directions and looks, and nothing negative, got {self}")

    def rate(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.hold) / (1 - self.hold)
        return self.learning_rate * self.final_rate ** min(late, 1.0)

    def to_dict(self) -> dict:
        return asdict(self)
