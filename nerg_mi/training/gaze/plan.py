"""How one gaze field is trained: its architecture, the settings, and the trainer of its kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from nerg_mi.fields.gaze_base import GazeFieldConfig
from nerg_mi.training.geometry.places import GazePlace

from .settings import GazeSettings, ProbeSettings
from .state import StateSettings
from .supervision import Supervision
from .trainer import GazeTrainer


@dataclass(frozen=True, kw_only=True)
class GazePlan:
    """All that decides a training but for what it learns from and where."""

    # Architecture of the field.
    config: GazeFieldConfig
    # Others that folds may choose in its place (`variants.choose_variant`).
    alternatives: tuple[GazeFieldConfig, ...] = ()
    # How weights are moved, and for how long.
    settings: GazeSettings
    # How rays become probes.
    probes: ProbeSettings
    # Moves the weights of a field of this kind.
    trainer: type[GazeTrainer]
    # Arrays to begin with in place of random ones, by name (`semantics.initial_weights`); None: random ones.
    initial: dict[str, Any] | None = None

    def with_settings(self, **changes: Any) -> GazePlan:
        """The same with other ``settings``."""
        return replace(self, settings=replace(self.settings, **changes))

    def identity(self, supervision: Supervision, place: GazePlace, state: StateSettings) -> dict:
        """What a run must agree on to be gone on with (JSON): of two runs that differ in any of it, neither goes on
        with the other's state."""
        return {
            **state.about,
            **supervision.digest(),
            "settings": self.settings.to_dict(),
            "probes": self.probes.to_dict(),
            "architecture": self.config.to_dict(),
            "box": place.box.to_dict(),
            "align": alignment(place),
        }


def alignment(place: GazePlace) -> list[list[float]] | None:
    """The similarity from the rays' frame to that of ``place``, as JSON; None where they are one."""
    return None if place.align.identity else place.align.matrix.tolist()
