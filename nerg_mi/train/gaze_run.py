"""A training of a gaze field from its data to its checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import NamedTuple

import numpy as np

from nerg_mi.fields.gaze_base import GazeHead, basis_of

from .gaze_data import (
    Supervision,
    TargetNeeds,
    Targets,
    concatenate,
    split_validation,
    targets_of_rays,
    targets_of_views,
)
from .gaze_folds import CHOICE, MINUTES, choose_mix, choose_variant, mixes
from .gaze_trainer import (
    Fit,
    GazePlan,
    GazeProgress,
    GazeRunFile,
    Listener,
    StateSettings,
    alignment,
    fit_again,
    fit_watched,
    kept_identity,
    rounded,
)
from .geometry import GazePlace
from .trainer import kept_unless

# ---- Run ----
#
# A whole gaze training: from rays and a place to a field, with its scores at positions that it was not trained on.
#
# The way of the data: supervision (rays, views) is split; each part becomes targets, rays by way of probes; trainers
# draw batches of these.


class TrainedGaze(NamedTuple):
    """What a training came to: the field, and its provenance (JSON)."""

    field: GazeHead
    provenance: dict


def train_gaze(
    supervision: Supervision,
    place: GazePlace,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    tell: Listener | None = None,
    write: Callable[[GazeHead, dict], None] | None = None,
) -> TrainedGaze:
    """Train a gaze field on ``supervision`` in ``place``, with arrays of the backend ``ns``.

    Some zones of positions are held out, purged by 2R, and watched: the weights that score best there count (the loss
    that is trained), and the run ends when they get no better. With ``refit`` a second fit then uses everything for as
    many steps; the scores stay those of the first. Where there are rays, and ``plan.settings.mix_folds`` asks for them,
    folds of people and positions then choose a log density's share of the blind density (``mixing``); of several
    architectures they choose one before (``variants``). Ctrl-C ends the run after the step at hand, with what it has
    come to; before the first fit it raises ``KeyboardInterrupt``. Raises `NergError` when the rays make no probe.

    ``state``: where the state of the run is kept, and whether to go on from it. ``tell``: is told how the run goes.
    ``write``: is given the result, which it puts into a file. Once it has done so, the state of a run that is done is
    removed; if it raises, the state is that of the end. Without it the state stays.
    """
    tell, state, started = tell or (lambda progress: None), state or StateSettings(), time.perf_counter()
    plan, choice = choose_variant(supervision, place, plan, ns, tell, kept_identity(state))
    if choice is not None:
        state = replace(state, about={**state.about, CHOICE: choice.to_dict()})
    settings, needs = plan.settings, TargetNeeds.of(plan.config)
    file = GazeRunFile(state.path, plan.identity(supervision, place, state), state.every, state.resume)
    file.seconds += time.perf_counter() - started
    started = time.perf_counter()
    tell(GazeProgress("probes", 0.0, 0, 0.0, None))
    split, watched = split_validation(supervision, place, settings, plan.probes), None
    if split.watched is not None:
        watched = make_targets(split.watched, place, plan, needs, settings.seed + 2, split.centres)
    refits, mixed = settings.refit and watched is not None, mixes(plan) and supervision.rays is not None
    share = (0.5 if refits else 1.0) * (1 - MINUTES if mixed else 1.0)
    prepared, again = 0.0, file.stage == "refit"
    used = supervision if again else split.learn
    targets = make_targets(used, place, plan, needs, settings.seed)
    if again:
        first = Fit.of(file.found)
    else:
        prepared = time.perf_counter() - started
        first = fit_watched(targets, watched, place.box, plan, ns, share, file, tell)
        again = refits and not first.interrupted
        if again:
            # Making the targets of everything may take long: what was found is kept before.
            file.keep("refit", None, first.found(), {}, now=True)
            used, targets = supervision, make_targets(supervision, place, plan, needs, settings.seed)
    last = fit_again(targets, first, place.box, plan, ns, file, tell) if again else first
    trainer = last.trainer
    interrupted = first.interrupted or last.interrupted
    if mixed and choice is None and not interrupted:
        try:
            choice = choose_mix(supervision, place, plan, ns, tell)
        except KeyboardInterrupt:
            interrupted = True
    field = trainer.field(last.weights)
    if choice is not None:
        field.set_mix(choice.mix)
    field.support = used.support(plan.probes.radius, place)
    field.basis = basis_of(supervision.counts())
    provenance = _provenance(supervision, place, plan, targets) | {
        "steps": trainer.steps,
        "seconds": round(file.spent, 1),
        "seconds_preparing": round(prepared, 1),
        "refitted": again,
        "interrupted": interrupted,
    }
    if choice is not None:
        provenance["mix"] = choice.to_dict()
    if watched is not None and first.scores is not None:
        provenance["validation"] = {
            "zones": settings.zones,
            "probes": len(watched.truth),
            "rays_held_out": split.rays_held_out,
            "views_held_out": split.views_held_out,
            "best_step": first.best_step,
            **rounded(first.scores),
            "history": first.history,
        }
    if write is not None:
        stage, weights = ("refit", {}) if again else ("fit", last.weights)
        keep = lambda: file.keep(stage, trainer, first.found(), weights, now=True)
        with kept_unless(state.path, keep, done=not provenance["interrupted"]):
            write(field, provenance)
    return TrainedGaze(field, provenance)


def make_targets(
    supervision: Supervision,
    place: GazePlace,
    plan: GazePlan,
    needs: TargetNeeds,
    seed: int,
    centres: np.ndarray | None = None,
) -> Targets:
    """Targets of the rays and the views of ``supervision``; ``centres`` (T, 3): where its rays make probes, in their
    frame; None: where the plan places them."""
    rays, views, probes = supervision.rays, supervision.views, plan.probes
    if rays is None:
        return targets_of_views(views, place, probes, needs, seed)
    targets = targets_of_rays(rays, place, probes, needs, centres, seed)
    if not views:
        return targets
    # The blind density is that of the rays.
    needs = TargetNeeds(needs.semantic, needs.fill)
    return concatenate(targets, targets_of_views(views, place, probes, needs, seed))


def _provenance(supervision: Supervision, place: GazePlace, plan: GazePlan, targets: Targets) -> dict:
    """What the field was trained with and on (JSON)."""
    return {
        "settings": plan.settings.to_dict(),
        "probes": plan.probes.to_dict(),
        "align": alignment(place),
        **supervision.counts(),
        "probes_made": len(targets.truth),
        "escaped_directions": round(targets.escape_share, 6),
        "escaped_gaze": round(targets.escaped_gaze, 6),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
