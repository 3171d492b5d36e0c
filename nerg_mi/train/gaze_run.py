"""A training of a gaze field from its data to its checkpoint, and the folds that choose its architecture and its share
of the blind density."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from types import ModuleType
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHead, GazeHeadConfig, summarize_provenance
from nerg_mi.interruption import Interruption
from nerg_mi.probes.probes import Probes, calibrate_levels, compute_region_levels
from nerg_mi.rays.filters import purge, split_by_position
from nerg_mi.rays.rays import Rays

from .gaze_data import (
    GazeTargets,
    Supervision,
    TargetRequirements,
    concatenate_targets,
    compute_observer_bounds,
    make_probes,
    split_validation,
    make_targets_from_probes,
    make_targets_from_rays,
    make_targets_from_views,
)
from .gaze_trainer import (
    GazeFit,
    GazePlan,
    GazeProgress,
    GazeRunFile,
    ProgressCallback,
    StateSettings,
    alignment_to_json,
    refit,
    fit_with_validation,
    read_run_identity,
    round_scores,
)
from .geometry import TrainingGeometry
from .trainer import saving_on_failure

# ---- Mixing ----
#
# How much of the blind density a gaze field is given, so that it is not worse than one that knows no position.
#
# Where few people were tracked, or hardly moved, a field follows those whom it has seen, and is worse for others than
# where people look wherever they stand. Folds of the training rays tell: in each some people are held out, at places
# that are held out too, and a field is trained on the others. The share of the blind density is that which foretells
# those who were held out best, by a mixture of both densities (stacking, Wolpert 1992; Smyth and Wolpert 1999). Of
# shares that are alike the largest is taken: the simpler density unless the field is better by half a standard error,
# in place of the whole one of Breiman et al. (1984), which costs places that are sure of their field. Where the field
# needs none of it in the first folds, the others are left out. The same looks that were held out tell which regions of
# the mixture hold 80 % of the gaze of others.

PRIOR_WEIGHTS = np.linspace(0.05, 1.0, 20)
"""Shares of the blind density that are tried: never none, so that no density is zero."""
FOLD_TIME_FRACTION = 0.5  # Share of the minutes of a training that the folds take
# Zones, positions in all of them and rays at each, of what a fold holds out; and directions that it is judged in.
_ZONES, _POSITIONS, _RAYS, _DIRECTIONS = 3, 48, 16, 1024
# Folds after which a field that needs no more than the least share in any is believed; probes of a fold at most, and
# its steps as a share of the training's: both end alike for this question.
_ENOUGH, _PROBES, _STEPS = 2, 512, 0.5
_DOUBT = 0.5  # Standard errors by which a share may be worse than the best
_LEAST = 1e-9  # Of a density (1/sr), so that its logarithm is finite


@dataclass(frozen=True)
class PriorWeightSelection:
    """The share of the blind density that was chosen, and why; of no folds the given share alone."""

    mix: float  # The share
    folds: int  # How many folds had people and positions enough to be judged by
    # KLD (nats) of what was held out, means over folds: with this share, of the field as it is (with the least share
    # that is tried), and of the blind density alone; of kernel densities, so that none reaches zero.
    kld: float | None = None
    kld_field: float | None = None
    kld_blind: float | None = None
    # Shares that are to be asked for so that regions hold those of ``probes.probes.LEVELS``, by their names.
    regions: dict[str, float] | None = None
    # Of several variants (`choose_variant`) the one that was chosen, and the KLD of each, with its share,
    # in the folds that all have.
    variant: str | None = None
    variants: dict[str, float] | None = None

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return {k: _rounded(v) for k, v in asdict(self).items()}

    @staticmethod
    def from_dict(found: dict) -> PriorWeightSelection:
        """The one of which `to_dict` was kept. Raises ``TypeError`` and ``ValueError`` for what is none."""
        choice = PriorWeightSelection(**found)
        if not 0 <= choice.mix <= 1:
            raise ValueError(f'the share "mix" must be from 0 to 1, got {choice.mix}')
        return choice


def selects_prior_weight(plan: GazePlan) -> bool:
    """Whether ``plan`` asks for a share that folds choose."""
    return plan.settings.mix_folds > 0 and plan.config.prior > 0


class _Judgement(NamedTuple):
    """What a fold tells of regions: densities (P, D) of the field and of the blind density, and the directions (n,)
    that the rays of those who are held out are nearest to, probe after probe by ``offsets`` (P + 1,)."""

    field: np.ndarray
    blind: np.ndarray
    bins: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class FoldResults:
    """What folds tell of one architecture."""

    default_weight: float  # The share that it has of itself
    kld_curves: np.ndarray  # KLD (F, S) in each fold with each of ``SHARES``
    densities: list[_Judgement]  # Of each fold

    def select_weight(self) -> PriorWeightSelection:
        """The share that it is given: its own where there is no fold."""
        if not len(self.kld_curves):
            return PriorWeightSelection(self.default_weight, 0)
        choice = _choose(self.kld_curves)
        return replace(choice, regions=_regions(self.densities, choice.mix))


def evaluate_folds(
    supervision: Supervision, geometry: TrainingGeometry, plan: GazePlan, ns: ModuleType, on_progress: ProgressCallback = lambda progress: None
) -> FoldResults:
    """How well fields that ``plan`` trains on ``supervision``, which has rays, in ``place`` foretell people and
    positions that are held out, with each share of the blind density.

    ``tell`` is told how it goes. Raises ``KeyboardInterrupt`` after Ctrl-C, or where ``tell`` does. The place is that
    of all rays in each fold: one of hit points knows the surfaces that held-out people have met, not who looked there.
    """
    rays, config, curves, judgements = supervision.rays, plan.config, [], []
    if rays is None or not config.prior:
        raise ValueError("folds are of rays, and of fields that have a density that does not depend on the position")
    if plan.settings.minutes is not None:
        plan = plan.with_settings(minutes=FOLD_TIME_FRACTION * plan.settings.minutes / plan.settings.mix_folds)
    settings, needs = plan.settings, TargetRequirements.from_config(plan.config)
    probes = replace(plan.probes, count=min(plan.probes.count, _PROBES), fresh=False)
    if settings.steps is not None:
        settings = replace(settings, steps=math.ceil(_STEPS * settings.steps))
    box = compute_observer_bounds(geometry.points_to_field(rays.origin), geometry.box)
    for k, (learn, held, centres) in enumerate(iter_folds(rays, plan)):
        try:
            targets = make_targets_from_rays(learn, geometry, probes, needs, seed=settings.seed)
        except NergError:
            # Those who are left make no probe: this fold says nothing.
            continue
        judged = replace(probes, directions=_DIRECTIONS, min_rays=1)
        probes_held = make_probes(held, judged, centres, settings.seed + 3)
        truth = make_targets_from_probes(probes_held, geometry, _DIRECTIONS, judged.depth, needs, settings.seed + 3)
        trainer = plan.trainer(replace(targets, observer_bounds=box), geometry.box, config, settings, ns)
        with Interruption() as stop:
            while trainer.progress < 1:
                trainer.step()
                done = (k + trainer.progress) / settings.mix_folds
                on_progress(GazeProgress(f"fold {k + 1}", done, trainer.steps, trainer.seconds, None))
                stop.check()
        field, blind = trainer.evaluate_densities(truth)
        curves.append([_kld(truth.truth, (1 - m) * field + m * blind) for m in PRIOR_WEIGHTS])
        judgements.append(_Judgement(field, blind, _bins(probes_held, geometry, truth.directions), probes_held.offsets))
        if len(curves) == _ENOUGH and all(int(np.argmin(curve)) == 0 for curve in curves):
            break
    on_progress(GazeProgress("folds", 1.0, settings.steps or 0, 0.0, None))
    return FoldResults(config.mix, np.array(curves), judgements)


def iter_folds(rays: Rays, plan: GazePlan) -> Iterator[tuple[Rays, Rays, np.ndarray]]:
    """``(learn, held, centres)`` of each fold: the rays of some people away from ``centres`` (T, 3), and those of the
    others, who are judged there. One person alone is held out at places only. A fold without such places is left out.
    """
    settings, radius = plan.settings, plan.probes.radius
    rng = np.random.default_rng(settings.seed + 7)
    people = rng.permutation(np.unique(rays.person))
    alone = len(people) == 1
    groups = [people] * settings.mix_folds if alone else np.array_split(people, min(settings.mix_folds, len(people)))
    for k, group in enumerate(groups):
        mask = np.isin(rays.person, group)
        held = rays.select(mask)
        try:
            # Those who hardly moved leave nothing of their own to learn from: the others are learnt from.
            split = split_by_position(
                held,
                radius,
                zones=_ZONES,
                test_probes=_POSITIONS,
                min_rays=_RAYS,
                min_train=0,
                seed=1000 * settings.seed + k,
            )
        except NergError:
            # These people have no zones with rays enough.
            continue
        learn = purge(rays, split.test_centres, 2 * radius)
        if not alone:
            learn &= ~mask
        if learn.any():
            yield rays.select(learn), held, split.test_centres


def _rounded(value):
    """``value`` with its numbers to four digits."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return round(value, 4) if isinstance(value, float) else value


def _kld(truth: np.ndarray, density: np.ndarray) -> float:
    """Mean over observers of KLD (nats) of densities (P, D) in directions of equal area, each normalised."""
    p = truth / truth.sum(axis=1, keepdims=True, dtype=np.float64)
    q = np.maximum(density, _LEAST)
    q = q / q.sum(axis=1, keepdims=True, dtype=np.float64)
    return float((p * np.log(np.maximum(p, _LEAST / p.shape[1]) / q)).sum(axis=1).mean())


def _bins(probes: Probes, place: TrainingGeometry, directions: np.ndarray) -> np.ndarray:
    """Which of the ``directions`` (P, D, 3), those of its probe, each ray of ``probes`` is nearest to, (n,)."""
    along, o = place.directions_to_field(probes.directions), probes.offsets
    return np.concatenate([np.argmax(along[a:b] @ d.T, axis=1) for a, b, d in zip(o[:-1], o[1:], directions)])


def _regions(judgements: Sequence[_Judgement], mix: float) -> dict[str, float]:
    """Shares to ask for so that regions hold `probes.probes.LEVELS` of the looks in all folds; positions count
    alike."""
    levels, weights = [], []
    for of in judgements:
        density = (1 - mix) * of.field + mix * of.blind
        for p, (a, b) in enumerate(zip(of.offsets[:-1], of.offsets[1:])):
            levels.append(compute_region_levels(density[p : p + 1], density[p : p + 1, of.bins[a:b]])[0])
            weights.append(np.full(b - a, 1 / (b - a)))
    return calibrate_levels(np.concatenate(levels), np.concatenate(weights))


def within_half_se(curves: np.ndarray) -> np.ndarray:
    """Indices of the columns of ``curves`` (F, S), a row a fold, that are worse than the one of the least mean by no
    more than half a standard error over folds."""
    more = curves - curves[:, [int(curves.mean(axis=0).argmin())]]
    error = more.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else np.zeros(curves.shape[1])
    return np.flatnonzero(more.mean(axis=0) <= _DOUBT * error)


def _choose(curves: np.ndarray) -> PriorWeightSelection:
    """The largest of `SHARES` that is nearly the best over folds (F, S)."""
    mean, chosen = curves.mean(axis=0), int(within_half_se(curves)[-1])
    return PriorWeightSelection(float(PRIOR_WEIGHTS[chosen]), len(curves), float(mean[chosen]), float(mean[0]), float(mean[-1]))


# ---- Variants ----
#
# Which of several architectures a place gets, by the folds that choose its share of the blind density.
#
# Where no surfaces are known, emit is told of points at one distance whatever is there. In some places it tells where
# others look from elsewhere all the same, in others it follows whom it has seen: those who are held out tell which.

SELECTION_KEY = "choice"  # Entry of what a run must agree on (``GazePlan.identity``): what was chosen before it began


def select_variant(
    supervision: Supervision,
    geometry: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    on_progress: ProgressCallback = lambda progress: None,
    resumed_identity: dict | None = None,
) -> tuple[GazePlan, PriorWeightSelection | None]:
    """``plan`` with one architecture, and the share of the blind density where folds have chosen both.

    That of `GazePlan.config` stays, unless one of the ``alternatives`` foretells those who are held out better by half
    a standard error over folds, each with its own share. Without alternatives, rays or folds nothing is chosen.
    ``kept``: what a run that is gone on with has been started as; its choice stands. ``tell``: is told how it goes.
    Raises ``KeyboardInterrupt`` after Ctrl-C, or where ``tell`` does.
    """
    configs, plan = (plan.config, *plan.alternatives), replace(plan, alternatives=())
    if len(configs) == 1 or not selects_prior_weight(plan) or supervision.rays is None:
        return plan, None
    if resumed_identity is not None:
        return _kept(plan, configs, resumed_identity)
    each, judging = [], plan
    if plan.settings.minutes is not None:
        judging = plan.with_settings(minutes=plan.settings.minutes / len(configs))
    try:
        for k, config in enumerate(configs):
            told = scale_progress(on_progress, k, len(configs), f"{{}} of {config.variant}")
            each.append(evaluate_folds(supervision, geometry, replace(judging, config=config), ns, told))
    except KeyboardInterrupt as error:
        names = " and ".join(config.variant for config in configs)
        raise KeyboardInterrupt(f"interrupted while folds chose between {names}; nothing was kept") from error
    return _best(plan, configs, each)


def _kept(plan: GazePlan, configs: tuple[GazeHeadConfig, ...], kept: dict) -> tuple[GazePlan, PriorWeightSelection | None]:
    """What was chosen among ``configs``; that of another run is found out when the two are compared."""
    started = [c for c in configs if json.loads(json.dumps(c.to_dict())) == kept.get("architecture")]
    plan = replace(plan, config=started[0]) if started else plan
    if SELECTION_KEY not in kept:
        return plan, None
    try:
        return plan, PriorWeightSelection.from_dict(kept[SELECTION_KEY])
    except (TypeError, ValueError) as error:
        raise NergError(f"what the run had chosen is damaged ({error}); start anew without --resume") from error


def _best(
    plan: GazePlan, configs: tuple[GazeHeadConfig, ...], each: list[FoldResults]
) -> tuple[GazePlan, PriorWeightSelection | None]:
    """The plan with the best of ``configs``, which were judged as ``each`` says, and its share."""
    choices = [judged.select_weight() for judged in each]
    # Folds end early for a field that needs none of the blind density.
    folds = min(len(judged.kld_curves) for judged in each)
    if not folds:
        return plan, choices[0]
    shares = [int(np.abs(PRIOR_WEIGHTS - choice.mix).argmin()) for choice in choices]
    curves = np.stack([judged.kld_curves[:folds, s] for judged, s in zip(each, shares)], axis=1)
    k = int(within_half_se(curves)[0])
    variants = {config.variant: float(kld) for config, kld in zip(configs, curves.mean(axis=0))}
    return replace(plan, config=configs[k]), replace(choices[k], variant=configs[k].variant, variants=variants)


def scale_progress(on_progress: ProgressCallback, k: int, count: int, stage: str) -> ProgressCallback:
    """Tells how the whole of ``count`` parts goes by how number ``k`` does; its stages are named as ``stage`` says."""

    def told(progress: GazeProgress) -> None:
        on_progress(replace(progress, stage=stage.format(progress.stage), fraction=(k + progress.fraction) / count))

    return told


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
    geometry: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    on_progress: ProgressCallback | None = None,
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
    on_progress, state, started = on_progress or (lambda progress: None), state or StateSettings(), time.perf_counter()
    plan, choice = select_variant(supervision, geometry, plan, ns, on_progress, read_run_identity(state))
    if choice is not None:
        state = replace(state, identity={**state.identity, SELECTION_KEY: choice.to_dict()})
    settings, needs = plan.settings, TargetRequirements.from_config(plan.config)
    file = GazeRunFile(state.path, plan.make_identity(supervision, geometry, state), state.interval, state.resume)
    file.seconds += time.perf_counter() - started
    started = time.perf_counter()
    on_progress(GazeProgress("probes", 0.0, 0, 0.0, None))
    split, watched = split_validation(supervision, geometry, settings, plan.probes), None
    if split.validation is not None:
        watched = make_targets(split.validation, geometry, plan, needs, settings.seed + 2, split.centres)
    refits, mixed = settings.refit and watched is not None, selects_prior_weight(plan) and supervision.rays is not None
    share = (0.5 if refits else 1.0) * (1 - FOLD_TIME_FRACTION if mixed else 1.0)
    prepared, again = 0.0, file.stage == "refit"
    used = supervision if again else split.training
    targets = make_targets(used, geometry, plan, needs, settings.seed)
    if again:
        first = GazeFit.from_dict(file.validation_state)
    else:
        prepared = time.perf_counter() - started
        first = fit_with_validation(targets, watched, geometry.box, plan, ns, share, file, on_progress)
        again = refits and not first.interrupted
        if again:
            # Making the targets of everything may take long: what was found is kept before.
            file.save("refit", None, first.to_dict(), {}, force=True)
            used, targets = supervision, make_targets(supervision, geometry, plan, needs, settings.seed)
    last = refit(targets, first, geometry.box, plan, ns, file, on_progress) if again else first
    trainer = last.trainer
    interrupted = first.interrupted or last.interrupted
    if mixed and choice is None and not interrupted:
        try:
            choice = evaluate_folds(supervision, geometry, plan, ns, on_progress).select_weight()
        except KeyboardInterrupt:
            interrupted = True
    field = trainer.make_field(last.weights)
    if choice is not None:
        field.set_prior_weight(choice.mix)
    field.support = used.make_support(plan.probes.radius, geometry)
    field.basis = summarize_provenance(supervision.count_data())
    provenance = _provenance(supervision, geometry, plan, targets) | {
        "steps": trainer.steps,
        "seconds": round(file.elapsed, 1),
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
            **round_scores(first.scores),
            "history": first.history,
        }
    if write is not None:
        stage, weights = ("refit", {}) if again else ("fit", last.weights)
        keep = lambda: file.save(stage, trainer, first.to_dict(), weights, force=True)
        with saving_on_failure(state.path, keep, is_done=not provenance["interrupted"]):
            write(field, provenance)
    return TrainedGaze(field, provenance)


def make_targets(
    supervision: Supervision,
    geometry: TrainingGeometry,
    plan: GazePlan,
    requirements: TargetRequirements,
    seed: int,
    centres: np.ndarray | None = None,
) -> GazeTargets:
    """Targets of the rays and the views of ``supervision``; ``centres`` (T, 3): where its rays make probes, in their
    frame; None: where the plan places them."""
    rays, views, probes = supervision.rays, supervision.views, plan.probes
    if rays is None:
        return make_targets_from_views(views, geometry, probes, requirements, seed)
    targets = make_targets_from_rays(rays, geometry, probes, requirements, centres, seed)
    if not views:
        return targets
    # The blind density is that of the rays.
    requirements = TargetRequirements(requirements.semantic, requirements.fill_misses)
    return concatenate_targets(targets, make_targets_from_views(views, geometry, probes, requirements, seed))


def _provenance(supervision: Supervision, place: TrainingGeometry, plan: GazePlan, targets: GazeTargets) -> dict:
    """What the field was trained with and on (JSON)."""
    return {
        "settings": plan.settings.to_dict(),
        "probes": plan.probes.to_dict(),
        "align": alignment_to_json(place),
        **supervision.count_data(),
        "probes_made": len(targets.truth),
        "escaped_directions": round(targets.miss_fraction, 6),
        "escaped_gaze": round(targets.miss_gaze_fraction, 6),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
