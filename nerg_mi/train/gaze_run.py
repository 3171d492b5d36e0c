"""Gaze training from data to checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import NamedTuple

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.fields.gaze_base import GazeHead, summarize_provenance

from .gaze_data import (
    GazeTargets,
    Supervision,
    TargetRequirements,
    concatenate_targets,
    make_targets_from_rays,
    make_targets_from_views,
    split_validation,
)
from .gaze_folds import (
    FOLD_TIME_FRACTION,
    SELECTION_KEY,
    StagedProgress,
    compute_fold_cost,
    evaluate_folds,
    select_variant,
    selects_prior_weight,
)
from .gaze_trainer import (
    GazeFit,
    GazePlan,
    GazeProgress,
    GazeRunFile,
    ProgressCallback,
    StateSettings,
    alignment_to_json,
    fit_with_validation,
    read_run_identity,
    refit,
    round_scores,
)
from .trainer import saving_on_failure

# ---- Training run ----
#
# A complete gaze training with scores at held-out validation positions.
#
# Data flow: the supervision (rays, views) is split; each part becomes targets, rays through probes; trainers draw
# batches from the targets.


class TrainedGaze(NamedTuple):
    """Result of a training: the field and its provenance (JSON)."""

    field: GazeHead
    provenance: dict


def train_gaze(
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    on_progress: ProgressCallback | None = None,
    write: Callable[[GazeHead, dict], None] | None = None,
) -> TrainedGaze:
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
    TrainedGaze
        Field and provenance.

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
    the validation data count, and the run stops early when they no longer improve. With ``refit``, a second fit uses
    all data for the best number of steps; the reported scores remain those of the first fit. With
    ``plan.settings.prior_folds`` and rays, folds select the prior of a log density (`evaluate_folds`), and before
    that the variant, if there are several (`select_variant`).
    """
    on_progress, state, started = on_progress or (lambda progress: None), state or StateSettings(), time.perf_counter()
    progress, fold_cost = StagedProgress(on_progress), compute_fold_cost(plan)
    report = progress.start(fold_cost, 1.0, float(plan.settings.refit))
    plan, selection = select_variant(supervision, geometry, plan, ns, report, read_run_identity(state))
    if selection is not None:
        state = replace(state, identity={**state.identity, SELECTION_KEY: selection.to_dict()})
    settings, requirements = plan.settings, TargetRequirements.from_config(plan.config)
    file = GazeRunFile(state.path, plan.make_identity(supervision, geometry, state), state.interval, state.resume)
    file.seconds += time.perf_counter() - started
    started = time.perf_counter()
    progress.start(0.0)(GazeProgress("probes", 0.0, 0, 0.0, None))
    split, validation = split_validation(supervision, geometry, settings, plan.probes), None
    if split.validation is not None:
        validation = make_targets(split.validation, geometry, plan, requirements, settings.seed + 2, split.centres)
    needs_refit, selects_weight = (
        settings.refit and validation is not None,
        selects_prior_weight(plan) and supervision.rays is not None,
    )
    fold_cost = fold_cost if selects_weight and selection is None else 0.0
    minutes_fraction = (0.5 if needs_refit else 1.0) * (1 - FOLD_TIME_FRACTION if selects_weight else 1.0)
    preparation_seconds, is_refit = 0.0, file.stage == "refit"
    training = supervision if is_refit else split.training
    targets = make_targets(training, geometry, plan, requirements, settings.seed)
    if is_refit:
        first = GazeFit.from_dict(file.validation_state)
    else:
        preparation_seconds = time.perf_counter() - started
        report = progress.start(1.0, float(needs_refit), fold_cost)
        first = fit_with_validation(targets, validation, geometry.box, plan, ns, minutes_fraction, file, report)
        is_refit = needs_refit and not first.interrupted
        if is_refit:
            # Save first, because making the targets of all data may take long.
            file.save("refit", None, first.to_dict(), {}, force=True)
            training, targets = supervision, make_targets(supervision, geometry, plan, requirements, settings.seed)
    last = first
    if is_refit:
        # Relative to the first fit, which has usually ended before its last step.
        report = progress.start(first.best_step / max(first.schedule, 1), fold_cost)
        last = refit(targets, first, geometry.box, plan, ns, file, report)
    trainer = last.trainer
    interrupted = first.interrupted or last.interrupted
    if selects_weight and selection is None and not interrupted:
        try:
            selection = evaluate_folds(supervision, geometry, plan, ns, progress.start(fold_cost)).select()
        except KeyboardInterrupt:
            interrupted = True
    field = trainer.make_field(last.weights)
    if selection is not None:
        selection.apply_prior(field, training.rays, geometry, plan)
        field.hits = selection.make_hits(training.rays, geometry, plan)
    field.support = training.make_support(plan.probes.radius, geometry)
    field.basis = summarize_provenance(supervision.summarize_data())
    provenance = _make_provenance(supervision, geometry, plan, targets) | {
        "steps": trainer.steps,
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
        stage, weights = ("refit", {}) if is_refit else ("fit", last.weights)
        # The state of an interrupted fit is saved, without this result: a resumed fit continues as if it had none.
        is_saved = first.interrupted or last.interrupted
        save = lambda: None if is_saved else file.save(stage, trainer, first.to_dict(), weights, force=True)
        with saving_on_failure(state.path, save, is_done=not provenance["interrupted"]):
            write(field, provenance)
    return TrainedGaze(field, provenance)


def make_targets(
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    requirements: TargetRequirements,
    seed: int,
    centres: np.ndarray | None = None,
) -> GazeTargets:
    """Make targets of the rays and views of ``supervision``.

    ``centres`` (T, 3) are the probe positions in the frame of the rays; None: as placed by the plan.
    """
    rays, views, probes = supervision.rays, supervision.views, plan.probes
    if rays is None:
        return make_targets_from_views(views, geometry, probes, requirements, seed)
    targets = make_targets_from_rays(rays, geometry, probes, requirements, centres, seed)
    if not views:
        return targets
    # The prior is estimated from the rays.
    requirements = TargetRequirements(requirements.semantic, requirements.fill_misses)
    return concatenate_targets(targets, make_targets_from_views(views, geometry, probes, requirements, seed))


def _make_provenance(supervision: Supervision, environment: Environment, plan: GazePlan, targets: GazeTargets) -> dict:
    """Return the settings and data of the training (JSON)."""
    return {
        "settings": plan.settings.to_dict(),
        "probes": plan.probes.to_dict(),
        "align": alignment_to_json(environment),
        **supervision.summarize_data(),
        "probes_made": len(targets.truth),
        "escaped_directions": round(targets.miss_fraction, 6),
        "escaped_gaze": round(targets.miss_gaze_fraction, 6),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
