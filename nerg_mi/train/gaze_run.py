"""A gaze training from data to field: its state in a file, its fits, and the run that combines them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.fields.gaze_base import GazeHead, summarize_provenance
from nerg_mi.files.schema import INDEX, Items, check_json
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import (
    GazeTargets,
    Supervision,
    TargetRequirements,
    concatenate_targets,
    make_targets_from_rays,
    make_targets_from_views,
)
from .gaze_folds import (
    FOLD_TIME_FRACTION,
    SELECTION_KEY,
    compute_fold_cost,
    evaluate_folds,
    select_variant,
    selects_prior_weight,
    split_validation,
)
from .gaze_recipes import GazePlan
from .gaze_trainer import GazeProgress, GazeTrainer, ProgressCallback, Scores, StagedProgress
from .trainer import check_same_run, check_shape, read_count, reading_run_state, saving_on_failure

# ---- State of a gaze training in a file: both fits and the validation results ----

KIND = "gaze run"
STAGES = ("fit", "refit")


@dataclass(frozen=True, kw_only=True)
class StateSettings:
    """Where the state of a run is stored, and whether to resume from it."""

    path: Path | None = None  # State file; None: no state is stored
    resume: bool = False  # Resume from the state file; probes and depths are computed again
    interval: float = 60.0  # Seconds between two states. The state is also written if the run is interrupted.
    # Additional data that must match for a run to be resumed (JSON), such as the files of its geometry.
    identity: dict = field(default_factory=dict)


def read_run_identity(state: StateSettings) -> dict | None:
    """Return the identity of the run to resume (`GazePlan.make_identity`), or None for a new run.

    Raises `NergError` if there is no state or the file is damaged.
    """
    if not state.resume:
        return None
    path = _require_state_file(state.path)
    with reading_run_state(path):
        identity = read_checkpoint(path, KIND)[1]["about"]
        if not isinstance(identity, dict):
            raise TypeError("it has no identity of the run")
    return identity


def _require_state_file(path: Path | None) -> Path:
    if path is None or not path.is_file():
        raise NergError(
            f'cannot resume: the state file "{path}" does not exist; leave out {parameter("resume", True)} to '
            "start a new run"
        )
    return path


class GazeRunFile:
    """State of one training in a file.

    Parameters
    ----------
    path : Path or None
        State file; None: no state is stored.
    identity : dict
        Data that must match for a run to be resumed (JSON).
    interval : float
        Seconds between two states.
    resume : bool
        Read the state at once. Raises `NergError` if there is none, or if it belongs to another run.

    Attributes
    ----------
    stage : str or None
        Stage of the state, ``fit`` or ``refit``.
    seconds : float
        Time spent before this process.
    """

    def __init__(self, path: Path | None, identity: dict, interval: float = 60.0, resume: bool = False):
        self.path, self.identity, self.interval = path, identity, interval
        self.stage, self.validation_state, self.seconds, self._tensors = None, {}, 0.0, {}
        self._started = self._last_saved = time.perf_counter()
        if resume:
            path = _require_state_file(path)
            self._tensors, self._meta = read_checkpoint(path, KIND)
            with reading_run_state(path):
                check_same_run(path, self._meta["about"], identity)
                self.stage, self.validation_state = self._meta["stage"], self._meta["found"]
                self.seconds = read_count(self._meta, "spent")
                if self.stage not in STAGES:
                    raise ValueError(f'its "stage" is {sanitize(self.stage, 40)}; expected one of {", ".join(STAGES)}')
                GazeFit.from_dict(self.validation_state)

    @property
    def elapsed(self) -> float:
        """Wall time of the run in seconds, excluding the time between an interruption and its resumption."""
        return self.seconds + time.perf_counter() - self._started

    def restore(self, stage: str, trainer: GazeTrainer) -> dict:
        """Restore ``trainer`` if the state is one of ``stage``; returns the best weights that `save` was given."""
        if self.path is None or stage != self.stage or "random" not in self._meta:
            return {}
        with reading_run_state(self.path):
            trainer.restore(self._tensors, self._meta)
            best = {k: v for k, v in trainer.averaged.items() if f"best.{k}" in self._tensors}
            for k, v in best.items():
                check_shape(self._tensors, f"best.{k}", v)
            return {k: type(v)(self._tensors[f"best.{k}"]) for k, v in best.items()}

    def save(
        self, stage: str, trainer: GazeTrainer | None, validation_state: dict, weights: dict, force: bool = False
    ) -> None:
        """Write the state atomically if the interval has passed (or with ``force``).

        Parameters
        ----------
        stage : str
            Stage of the run.
        trainer : GazeTrainer or None
            Current trainer; None between two fits.
        validation_state : dict
            Validation results so far (JSON).
        weights : dict
            Best weights so far.
        force : bool
            Write even if the interval has not passed.
        """
        if self.path is None or not (force or time.perf_counter() - self._last_saved > self.interval):
            return
        tensors, meta = {f"best.{k}": v.numpy() for k, v in weights.items()}, {}
        if trainer is not None:
            state, meta = trainer.get_state()
            tensors |= state
        write_checkpoint(
            self.path,
            KIND,
            tensors,
            {"about": self.identity, "stage": stage, "found": validation_state, "spent": self.elapsed, **meta},
        )
        self._last_saved = time.perf_counter()


# ---- Fit ----
#
# The two fits of a training: one with validation, and a refit on all data for the best number of steps.


_FIT_STATE = {
    **dict.fromkeys(("best_step?", "schedule?", "since?", "next_look?"), INDEX),
    "history?": Items({"steps": INDEX}),
}


@dataclass
class GazeFit:
    """Result of a fit."""

    trainer: Any = None  # The `GazeTrainer`; None if restored from the state of an earlier process
    weights: dict = field(default_factory=dict)  # Best weights
    best_step: int = 0  # Step of the best weights
    schedule: int = 0  # Number of steps that the schedule spans
    scores: Scores | None = None  # Scores of the best weights
    history: list[dict] = field(default_factory=list)  # All validations (JSON)
    interrupted: bool = False  # Whether Ctrl-C ended the fit
    evaluations_since_best: int = 0  # Validations since the best
    next_evaluation: int = 0  # Index of the next validation

    def to_dict(self) -> dict:
        """Return the validation results for the run state (JSON)."""
        scores = None if self.scores is None else [float(v) for v in self.scores]
        return {
            **{k: getattr(self, k) for k in ("best_step", "schedule", "history")},
            "since": self.evaluations_since_best,
            "next_look": self.next_evaluation,
            "scores": scores,
        }

    @staticmethod
    def from_dict(data: dict[str, Any], trainer: GazeTrainer | None = None, weights: dict | None = None) -> GazeFit:
        """Restore a fit from `to_dict`. Raises ``ValueError`` or ``TypeError`` for other ``data``."""
        check_json(data, _FIT_STATE, "found")
        names = {"since": "evaluations_since_best", "next_look": "next_evaluation"}
        values = {names.get(k, k): v for k, v in data.items()}
        scores = values.pop("scores", None)
        return GazeFit(trainer, weights or {}, scores=None if scores is None else Scores(*scores), **values)


def fit_with_validation(
    targets: GazeTargets,
    validation: GazeTargets | None,
    box: AnyBox,
    plan: GazePlan,
    ns: ModuleType,
    minutes_fraction: float,
    file: GazeRunFile,
    on_progress: ProgressCallback,
) -> GazeFit:
    """Train until the schedule ends, or until ``patience`` validations bring no improvement.

    ``minutes_fraction`` is the fraction of the time limit for this fit.
    """
    settings = plan.settings
    if settings.minutes is not None:
        settings = replace(settings, minutes=settings.minutes * minutes_fraction)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, initial=plan.initial_arrays)
    out = GazeFit.from_dict(file.validation_state, trainer, file.restore("fit", trainer))
    out.schedule = settings.steps or 0
    evaluation_times, last_scores = np.arange(1, settings.num_validations + 1) / settings.num_validations, out.scores

    def is_done() -> bool:
        return trainer.progress >= 1 or bool(settings.patience and out.evaluations_since_best >= settings.patience)

    def after_step() -> None:
        nonlocal last_scores
        if validation is not None and trainer.progress >= evaluation_times[out.next_evaluation]:
            out.next_evaluation = min(
                int(np.searchsorted(evaluation_times, trainer.progress, "right")), len(evaluation_times) - 1
            )
            last_scores = trainer.evaluate(validation)
            out.history.append({"steps": trainer.steps, **round_scores(last_scores)})
            out.evaluations_since_best += 1
            if out.scores is None or np.isnan(out.scores.loss) or last_scores.loss < out.scores.loss:
                out.weights, out.best_step = trainer.copy_weights(), trainer.steps
                out.scores, out.evaluations_since_best = last_scores, 0
        file.save("fit", trainer, out.to_dict(), out.weights)

    def report() -> None:
        on_progress(GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, last_scores))

    out.interrupted = trainer.run(is_done, after_step, report)
    if out.interrupted:
        file.save("fit", trainer, out.to_dict(), out.weights, force=True)
    if validation is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.evaluate(validation), trainer.steps, trainer.copy_weights()
    if not out.weights:
        out.weights, out.best_step = trainer.copy_weights(), trainer.steps
    if settings.minutes is not None:
        # Convert the time-based schedule to steps, so that a refit can follow the same schedule.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def refit(
    targets: GazeTargets,
    first: GazeFit,
    box: AnyBox,
    plan: GazePlan,
    ns: ModuleType,
    file: GazeRunFile,
    on_progress: ProgressCallback,
) -> GazeFit:
    """Train for the best number of steps of the ``first`` fit, with the same schedule."""
    settings = replace(plan.settings, steps=first.best_step, minutes=None)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, first.schedule, plan.initial_arrays)
    file.restore("refit", trainer)
    interrupted = trainer.run(
        lambda: trainer.steps >= first.best_step,
        lambda: file.save("refit", trainer, first.to_dict(), {}),
        lambda: on_progress(
            GazeProgress("refit", trainer.steps / first.best_step, trainer.steps, trainer.seconds, first.scores)
        ),
    )
    if interrupted:
        file.save("refit", trainer, first.to_dict(), {}, force=True)
    return GazeFit(trainer, trainer.copy_weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def round_scores(scores: Scores) -> dict[str, float]:
    """Return ``scores`` by name, rounded to five digits (JSON)."""
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}


# ---- Training run ----
#
# A complete gaze training with scores at held-out validation positions.
#
# Data flow: the supervision (rays, views) is split; each part becomes targets, rays through probes; trainers draw
# batches from the targets.


def fit_gaze(
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    on_progress: ProgressCallback | None = None,
    write: Callable[[GazeHead, dict], None] | None = None,
) -> tuple[GazeHead, dict]:
    """Train a gaze field.

    Parameters
    ----------
    supervision : Supervision
        Gaze rays and salience views.
    geometry : Environment
        Geometry in which the surface points are traced.
    plan : GazePlan
        Architecture, settings and trainer.
    ns : module
        Dr.Jit backend.
    state : StateSettings, optional
        Where to store the state of the run, and whether to resume from it.
    on_progress : ProgressCallback, optional
        Called with the progress.
    write : callable, optional
        Called with the field and its provenance to store them. The run state is removed after it returns; if it raises,
        the final state is saved. Without ``write`` the state remains.

    Returns
    -------
    field : GazeHead
        Field.
    provenance : dict
        Its provenance (JSON).

    Raises
    ------
    NergError
        If the rays make no probe.
    KeyboardInterrupt
        If Ctrl-C is pressed before the first fit. Later, Ctrl-C ends the run after the current step with the result so
        far.

    Notes
    -----
    Zones of positions are held out for validation, and training data within 2R of them are removed. The best weights on
    the validation data count, and the run stops early when they no longer improve, so that the scores of these data
    are a little too good. With ``refit``, a second fit uses all data for the best number of steps; the reported scores
    remain those of the first fit. With
    ``plan.settings.prior_folds`` and rays, folds select the prior of a log density (`evaluate_folds`), and before
    that the variant, if there are several (`select_variant`).
    """
    on_progress, state, started = on_progress or (lambda progress: None), state or StateSettings(), time.perf_counter()
    progress, fold_cost = StagedProgress(on_progress), compute_fold_cost(plan)

    # Select the variant.
    report = progress.start(fold_cost, 1.0, float(plan.settings.refit))
    plan, selection = select_variant(supervision, geometry, plan, ns, report, read_run_identity(state))
    if selection is not None:
        state = replace(state, identity={**state.identity, SELECTION_KEY: selection.to_dict()})
    identity = plan.make_identity(supervision, geometry)
    file = GazeRunFile(state.path, {**state.identity, **identity}, state.interval, state.resume)
    file.seconds += time.perf_counter() - started

    # Split the data, and make the targets.
    started = time.perf_counter()
    progress.start(0.0)(GazeProgress("probes", 0.0, 0, 0.0, None))
    settings, validation = plan.settings, None
    split = split_validation(supervision, geometry, settings, plan.probes)
    if split.validation is not None:
        validation = make_targets(split.validation, geometry, plan, settings.seed + 2, split.centres)
    needs_refit = settings.refit and validation is not None
    selects_weight = selects_prior_weight(plan, supervision.rays)
    needs_folds = selects_weight and selection is None
    fold_cost = fold_cost if needs_folds else 0.0
    is_refit = file.stage == "refit"
    training = supervision if is_refit else split.training
    targets = make_targets(training, geometry, plan, settings.seed)

    # Fit with validation, then again on all data for the best number of steps.
    preparation_seconds = 0.0
    if is_refit:
        first = GazeFit.from_dict(file.validation_state)
    else:
        preparation_seconds = time.perf_counter() - started
        minutes_fraction = (0.5 if needs_refit else 1.0) * (1 - FOLD_TIME_FRACTION if selects_weight else 1.0)
        report = progress.start(1.0, float(needs_refit), fold_cost)
        first = fit_with_validation(targets, validation, geometry.box, plan, ns, minutes_fraction, file, report)
        is_refit = needs_refit and not first.interrupted
        if is_refit:
            # Save first, because making the targets of all data may take long.
            file.save("refit", None, first.to_dict(), {}, force=True)
            training, targets = supervision, make_targets(supervision, geometry, plan, settings.seed)
    last = first
    if is_refit:
        # Relative to the first fit, which has usually ended before its last step.
        report = progress.start(first.best_step / max(first.schedule, 1), fold_cost)
        last = refit(targets, first, geometry.box, plan, ns, file, report)
    is_fit_interrupted = first.interrupted or last.interrupted

    def save() -> None:
        # The state of an interrupted fit is saved already, without this result, as if the fit went on.
        if not is_fit_interrupted:
            weights = {} if is_refit else last.weights
            file.save("refit" if is_refit else "fit", last.trainer, first.to_dict(), weights, force=True)

    # Select the prior.
    interrupted = is_fit_interrupted
    if needs_folds and not interrupted:
        try:
            selection = evaluate_folds(supervision, geometry, plan, ns, progress.start(fold_cost)).select()
        except KeyboardInterrupt:
            interrupted = True
            save()
    with saving_on_failure(state.path, save, is_done=write is not None and not interrupted):
        field = last.trainer.make_field(last.weights)
        if selection is not None:
            selection.apply_prior(field, training.rays, geometry, plan)
            field.hits = selection.make_hits(training.rays, geometry, plan)

        # Describe and store the result.
        field.support = training.make_support(plan.probes.radius, geometry)
        field.basis = summarize_provenance(supervision.summarize_data())
        provenance = {
            **{key: identity[key] for key in ("settings", "probes", "align")},
            **supervision.summarize_data(),
            "probes_made": len(targets.truth),
            "escaped_directions": round(targets.miss_fraction, 6),
            "escaped_gaze": round(targets.miss_gaze_fraction, 6),
            "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "steps": last.trainer.steps,
            "seconds": round(file.elapsed, 1),
            "seconds_preparing": round(preparation_seconds, 1),
            "refitted": is_refit,
            "interrupted": interrupted,
        }
        if selection is not None:
            provenance["mix"] = selection.to_dict()
        if validation is not None and first.scores is not None:
            provenance["validation"] = {
                "zones": settings.validation_zones,
                "probes": len(validation.truth),
                "rays_held_out": split.rays_held_out,
                "views_held_out": split.views_held_out,
                "best_step": first.best_step,
                **round_scores(first.scores),
                "history": first.history,
            }
        if write is not None:
            write(field, provenance)
    return field, provenance


def make_targets(
    supervision: Supervision, geometry: Environment, plan: GazePlan, seed: int, centres: np.ndarray | None = None
) -> GazeTargets:
    """Make targets of the rays and views of ``supervision``.

    ``centres`` (T, 3) are the probe positions in the frame of the rays; None: as placed by the plan.
    """
    rays, views, probes = supervision.rays, supervision.views, plan.probes
    requirements = TargetRequirements.from_config(plan.config)
    if rays is None:
        return make_targets_from_views(views, geometry, probes, requirements, seed)
    targets = make_targets_from_rays(rays, geometry, probes, requirements, centres, seed)
    if not views:
        return targets
    # The prior is estimated from the rays.
    requirements = replace(requirements, prior_rows=0)
    return concatenate_targets(targets, make_targets_from_views(views, geometry, probes, requirements, seed))
