"""The two fits of a training: one that a validation watches, and a second one on everything, as long as was best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox

from .plan import GazePlan
from .state import GazeRunFile
from .targets import Targets
from .trainer import GazeTrainer, Scores


@dataclass(frozen=True)
class GazeProgress:
    """State of a run."""

    # "probes", "fit" or "refit"; of an ensemble with the member before it.
    stage: str
    # Share of the stage that is done, 0..1; of an ensemble, of all members.
    done: float
    # Steps taken.
    steps: int
    # Wall time of the fit.
    seconds: float
    # The last validation; None before the first.
    scores: Scores | None


Listener = Callable[[GazeProgress], object]
"""Is told how a run goes; may raise `KeyboardInterrupt` to end it."""


@dataclass
class Fit:
    """What a fit has come to."""

    # The `GazeTrainer`; None: of an earlier process, which kept no more than what was found.
    trainer: Any = None
    # The best weights.
    weights: dict = field(default_factory=dict)
    # After how many steps they were.
    best_step: int = 0
    # Steps that the schedule spans.
    schedule: int = 0
    # Of the best weights.
    scores: Scores | None = None
    # Every validation (JSON).
    history: list[dict] = field(default_factory=list)
    # Whether it ended by Ctrl-C.
    interrupted: bool = False
    # Looks without an improvement.
    since: int = 0
    # Which look is due.
    next_look: int = 0

    def found(self) -> dict:
        """What a resumed run needs to know besides arrays (JSON)."""
        scores = None if self.scores is None else [float(v) for v in self.scores]
        return {
            **{k: getattr(self, k) for k in ("best_step", "schedule", "history", "since", "next_look")},
            "scores": scores,
        }

    @staticmethod
    def of(found: dict, trainer: GazeTrainer | None = None, weights: dict | None = None) -> Fit:
        """The fit of which ``found`` was kept."""
        scores = found.get("scores")
        return Fit(trainer, weights or {}, **{**found, "scores": None if scores is None else Scores(*scores)})


def fit_watched(
    targets: Targets,
    watched: Targets | None,
    box: AnyBox,
    plan: GazePlan,
    ns: ModuleType,
    share: float,
    file: GazeRunFile,
    tell: Listener,
) -> Fit:
    """Train until the schedule ends, or validation on ``watched`` has not improved for ``patience`` looks. ``share``:
    of the minutes."""
    settings = plan.settings
    if settings.minutes is not None:
        settings = replace(settings, minutes=settings.minutes * share)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, initial=plan.initial)
    out = Fit.of(file.found, trainer, file.restore("fit", trainer))
    out.schedule = settings.steps or 0
    looks, recent = np.arange(1, settings.looks + 1) / settings.looks, out.scores
    with Interruption() as stop:
        while (
            trainer.progress < 1 and not out.interrupted and not (settings.patience and out.since >= settings.patience)
        ):
            trainer.step()
            if watched is not None and trainer.progress >= looks[out.next_look]:
                out.next_look = min(int(np.searchsorted(looks, trainer.progress, "right")), len(looks) - 1)
                recent = trainer.measure(watched)
                out.history.append({"steps": trainer.steps, **rounded(recent)})
                out.since += 1
                if out.scores is None or np.isnan(out.scores.loss) or recent.loss < out.scores.loss:
                    out.weights, out.best_step, out.scores, out.since = trainer.weights(), trainer.steps, recent, 0
            file.keep("fit", trainer, out.found(), out.weights)
            out.interrupted = _stopped(
                stop, tell, GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, recent)
            )
    if out.interrupted:
        file.keep("fit", trainer, out.found(), out.weights, now=True)
    if watched is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.measure(watched), trainer.steps, trainer.weights()
    if not out.weights:
        out.weights, out.best_step = trainer.weights(), trainer.steps
    if settings.minutes is not None:
        # What the clock's schedule came to in steps, so that a second fit can follow the same one.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def fit_again(
    targets: Targets, first: Fit, box: AnyBox, plan: GazePlan, ns: ModuleType, file: GazeRunFile, tell: Listener
) -> Fit:
    """Train for as many steps as were best in the ``first`` fit, along the same schedule."""
    settings = replace(plan.settings, steps=first.best_step, minutes=None)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, first.schedule, plan.initial)
    file.restore("refit", trainer)
    interrupted = False
    with Interruption() as stop:
        while trainer.steps < first.best_step and not interrupted:
            trainer.step()
            file.keep("refit", trainer, first.found(), {})
            done = trainer.steps / first.best_step
            interrupted = _stopped(
                stop, tell, GazeProgress("refit", done, trainer.steps, trainer.seconds, first.scores)
            )
    if interrupted:
        file.keep("refit", trainer, first.found(), {}, now=True)
    return Fit(trainer, trainer.weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def _stopped(stop: Interruption, tell: Listener, progress: GazeProgress) -> bool:
    """Tell ``progress``; whether there was a Ctrl-C. Heard only here: within a step, weights and random numbers are of
    different steps."""
    try:
        tell(progress)
        stop.check()
    except KeyboardInterrupt:
        return True
    return False


def rounded(scores: Scores) -> dict[str, float]:
    """``scores`` by name, with five digits (JSON)."""
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}
