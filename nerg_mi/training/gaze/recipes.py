"""Ready-made ways to train a gaze field, by one word."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerg_mi.errors import NergError
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.log_density import LogGazeConfig
from nerg_mi.field.gaze.product import GazeConfig

from .settings import SIZES, sized_gaze_config

RECIPES = ("default", "small", "paper")


@dataclass(frozen=True)
class Recipe:
    """``config``: of the field; ``settings``, ``probes``: keywords of ``GazeSettings`` and ``ProbeSettings`` (steps
    too);
    ``views_alone``: those of ``settings`` that differ where salience images are all there is."""

    config: GazeConfig | LogGazeConfig
    settings: dict
    probes: dict
    # What views share comes late, after a plateau at their blind density.
    views_alone: dict = field(default_factory=lambda: {"patience": 10})


def gaze_recipe(
    name: str = "default", variant: str = "emit_capture", activation: str | None = None, size: str | None = None
) -> Recipe:
    """The recipe ``name``.

    ``default``: a log density that is normalised over the sphere, trained by the likelihood of rays; the one that
    generalises best to positions and people that it was not trained on. ``small``: a density without normalisation on a
    small grid, trained on the paper's losses and its integral. ``paper``: the paper's networks and losses, R = 0.1 m,
    4,096 probes with the bandwidth of the authors' code, as many steps as 50 epochs have. ``activation``, ``size``: of
    ``small`` and ``paper``. Raises ``NergError`` for another name, and for an activation or a size of ``default``.
    """
    if name == "default":
        if activation or size:
            raise NergError(
                "the default recipe has an activation and sizes of its own; choose --recipe small or paper to set them"
            )
        return Recipe(
            LogGazeConfig(
                grid=HashGridConfig(levels=5, log2_rows=14, base=2, finest=32), variant=variant, sh_degree=3, mix=0.05
            ),
            # No zones: fits without those that a validation takes, and all around them, lack most of the probes. The
            # decay and the few harmonics keep longer trainings from following the people at hand: two or three times
            # the steps end alike.
            {
                "steps": 160,
                "zones": 0,
                "loss": "likelihood",
                "integral": 0.0,
                "probes": 24,
                "directions": 512,
                "rays": 64,
                "learning_rate": 3e-3,
                "final_rate": 0.1,
                "hold": 0.5,
                "weight_decay": 4.0,
                "average": 0.95,
                "watched_rays": 64,
            },
            # Evenly over where people stood: as many at each place as there are rays would follow where people linger.
            {
                "placement": "blue",
                "spacing": 0.08,
                "count": 1024,
                "min_rays": 1,
                "kappa": 30.0,
                "directions": 2048,
                # Not by time: whoever stays long at a place says little of others.
                "weights": "person",
            },
            {"steps": 200, "zones": 3, "patience": 10},
        )
    if name == "small":
        return Recipe(sized_gaze_config(size or "small", variant, activation or "softplus"), {"steps": 600}, {})
    if name == "paper":
        return Recipe(
            sized_gaze_config(size or "paper", variant, activation or "linear"),
            {
                "steps": 12_800,
                "loss": "paper",
                "integral": 0.0,
                "probes": 16,
                "directions": 1024,
                "learning_rate": 1e-3,
                "final_rate": 0.1,
                "hold": 0.0,
                "weight_decay": 0.0,
            },
            {"radius": 0.1, "count": 4096, "cap": 1024, "kappa_rule": "silverman", "directions": 1024, "min_rays": 8},
        )
    raise NergError(f'the recipe must be one of {", ".join(RECIPES)}, got "{name}" (sizes: {", ".join(SIZES)})')
