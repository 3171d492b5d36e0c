"""The whole state of a gaze training in a file: of both of its fits, and of what validation has found so far."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.training.common.run_state import (
    count_of,
    optimiser_state,
    require_same,
    require_shape,
    restore_optimiser,
    restoring,
)

from .trainer import GazeTrainer

KIND = "gaze run"
STAGES = ("fit", "refit")


@dataclass(frozen=True, kw_only=True)
class StateSettings:
    """Whether a run can be gone on with, and from where."""

    # File that holds the whole state of the run; None: none is kept.
    path: Path | None = None
    # Go on from the state in that file; probes and depths are made again.
    resume: bool = False
    # Seconds between two states; it is also written when the run is interrupted.
    every: float = 60.0
    # What else a run must agree on to be gone on with (JSON), such as the files of its place.
    about: dict = field(default_factory=dict)


def kept_identity(state: StateSettings) -> dict | None:
    """What the run that ``state`` goes on with has been started as (`GazePlan.identity`); None where it starts anew.
    Raises `NergError` where nothing was kept, and for a damaged file."""
    if not state.resume:
        return None
    path = _kept_file(state.path)
    with restoring(path):
        about = read_checkpoint(path, KIND)[1]["about"]
        if not isinstance(about, dict):
            raise TypeError("it does not say what it was started as")
    return about


def _kept_file(path: Path | None) -> Path:
    if path is None or not path.is_file():
        raise NergError(f'there is nothing to resume: "{path}" does not exist; leave out --resume to start')
    return path


class GazeRunFile:
    """State of one training, kept in ``path`` (None: not at all) every ``every`` seconds.

    ``about``: what a run must agree on to go on (JSON). With ``resume`` the state is read at once: `NergError` where
    there is none, or one of another run. ``stage``: that of the state, ``fit`` or ``refit``, None without one;
    ``seconds``: that were spent before this process.
    """

    def __init__(self, path: Path | None, about: dict, every: float = 60.0, resume: bool = False):
        self.path, self.about, self.every = path, about, every
        self.stage, self.found, self.seconds, self._tensors = None, {}, 0.0, {}
        self._started = self._kept = time.perf_counter()
        if resume:
            path = _kept_file(path)
            self._tensors, self._meta = read_checkpoint(path, KIND)
            with restoring(path):
                require_same(path, self._meta["about"], about)
                self.stage, self.found = self._meta["stage"], self._meta["found"]
                self.seconds = count_of(self._meta, "spent")
                if self.stage not in STAGES or not isinstance(self.found, dict):
                    raise ValueError(f'its "stage" is {plain(self.stage, 40)} and not one of {", ".join(STAGES)}')

    @property
    def spent(self) -> float:
        """Wall time of the run in seconds, without that between an interruption and its resumption."""
        return self.seconds + time.perf_counter() - self._started

    def restore(self, stage: str, trainer: GazeTrainer) -> dict:
        """Set ``trainer`` to the state of ``stage``, where that is what was read; returns the weights that ``keep`` was
        given."""
        if self.path is None or stage != self.stage or "random" not in self._meta:
            return {}
        with restoring(self.path):
            restore_optimiser(trainer, self._tensors, self._meta["taken"])
            steps, seconds = (count_of(self._meta, name) for name in ("steps", "seconds"))
            trainer.restore(int(steps), seconds, self._meta["random"])
            best = {k: v for k, v in trainer.averaged.items() if f"best.{k}" in self._tensors}
            for k, v in best.items():
                require_shape(self._tensors, f"best.{k}", v)
            return {k: type(v)(self._tensors[f"best.{k}"]) for k, v in best.items()}

    def keep(self, stage: str, trainer: GazeTrainer | None, found: dict, weights: dict, now: bool = False) -> None:
        """Write the state, atomically, when it is time (or ``now``). ``trainer``: None between two fits; ``found``:
        what validation has come to (JSON); ``weights``: the best ones so far."""
        if self.path is None or not (now or time.perf_counter() - self._kept > self.every):
            return
        tensors, meta = {f"best.{k}": v.numpy() for k, v in weights.items()}, {}
        if trainer is not None:
            state, taken = optimiser_state(trainer)
            tensors |= state
            meta = {
                "taken": taken,
                "steps": trainer.steps,
                "seconds": trainer.seconds,
                "random": trainer.rng.bit_generator.state,
            }
        write_checkpoint(
            self.path, KIND, tensors, {"about": self.about, "stage": stage, "found": found, "spent": self.spent, **meta}
        )
        self._kept = time.perf_counter()
