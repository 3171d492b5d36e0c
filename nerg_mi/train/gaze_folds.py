"""Cross-validation of gaze fields that selects their architecture and the weight of the prior."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHeadConfig
from nerg_mi.interruption import Interruption
from nerg_mi.probes.probes import Probes, calibrate_levels, compute_region_levels
from nerg_mi.rays.filters import purge, split_by_position
from nerg_mi.rays.rays import Rays

from .gaze_data import (
    Supervision,
    TargetRequirements,
    compute_observer_bounds,
    make_probes,
    make_targets_from_probes,
    make_targets_from_rays,
)
from .gaze_trainer import GazePlan, GazeProgress, ProgressCallback
from .geometry import TrainingGeometry

# ---- Selection of the prior weight ----
#
# The weight of the position-independent prior, so that a field is not worse than the prior alone.
#
# With few or stationary participants a field overfits and scores below the position-independent prior. The weight is
# therefore chosen by cross-validation on the training rays: each fold holds out some participants at held-out positions
# and trains a field on the others. The weight is the one whose mixture predicts the held-out rays best (stacking;
# Wolpert 1992, Smyth and Wolpert 1999). Among weights within half a standard error of the best, the largest is taken,
# that is, the simpler density; the full standard error of Breiman et al. (1984) would cost too much where the field is
# reliable. If the field needs no prior in the first folds, the others are skipped. The held-out rays also calibrate the
# highest-density regions of the mixture.

PRIOR_WEIGHTS = np.linspace(0.05, 1.0, 20)
"""Candidate weights of the prior. Zero is excluded, so that no density is zero."""
FOLD_TIME_FRACTION = 0.5  # Fraction of a training's time limit that the folds take
# Zones, positions in all zones and minimum rays per position that a fold holds out; directions per validation probe.
_NUM_ZONES, _NUM_POSITIONS, _MIN_RAYS, _NUM_DIRECTIONS = 3, 48, 16, 1024
# Number of folds after which the smallest weight is accepted if each fold prefers it; maximum number of probes of a
# fold; its steps as a fraction of the training's. Fewer probes and steps select the same weight.
_MIN_FOLDS, _MAX_PROBES, _STEP_FRACTION = 2, 512, 0.5
_SE_FACTOR = 0.5  # Standard errors by which a weight may be worse than the best
_MIN_DENSITY = 1e-9  # Minimum density (1/sr), so that its logarithm is finite


_KEYS = {"prior_weight": "mix", "kld_prior": "kld_blind"}  # Fields with another name in checkpoints


@dataclass(frozen=True)
class PriorWeightSelection:
    """The selected prior weight and the scores behind it. Without folds it is the default weight."""

    prior_weight: float  # Selected weight
    folds: int  # Number of folds with enough participants and positions
    # KLD (nats) of the held-out data, means over folds: with the selected weight, of the field alone (with the smallest
    # candidate weight), and of the prior alone. Each is computed from kernel densities, so that none reaches zero.
    kld: float | None = None
    kld_field: float | None = None
    kld_prior: float | None = None
    # Nominal levels at which the regions hold `probes.probes.REGION_LEVELS` of the held-out gaze, by level name.
    regions: dict[str, float] | None = None
    # The variant selected by `select_variant`, and the KLD of each variant with its own weight in the common folds.
    variant: str | None = None
    variants: dict[str, float] | None = None

    def to_dict(self) -> dict:
        """Return the selection as JSON, for the provenance."""
        return {_KEYS.get(k, k): _round_values(v) for k, v in asdict(self).items()}

    @staticmethod
    def from_dict(data: dict[str, Any]) -> PriorWeightSelection:
        """Restore a selection from `to_dict`. Raises ``TypeError`` or ``ValueError`` for invalid data."""
        names: dict[str, str] = {key: name for name, key in _KEYS.items()}
        selection = PriorWeightSelection(**{names.get(k, k): v for k, v in dict(data).items()})
        if not 0 <= selection.prior_weight <= 1:
            raise ValueError(f'its "mix" must be from 0 to 1, got {selection.prior_weight}')
        return selection


def selects_prior_weight(plan: GazePlan) -> bool:
    """Return whether ``plan`` selects the prior weight by folds."""
    return plan.settings.mix_folds > 0 and plan.config.prior > 0


class _FoldDensities(NamedTuple):
    """Densities of a fold (P, D): of the field and of the prior, and for each held-out ray the index of its nearest
    direction (n,), probe by probe according to ``offsets`` (P + 1,).
    """

    field: np.ndarray
    prior: np.ndarray
    bins: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class FoldResults:
    """Scores of one architecture in the folds."""

    default_weight: float  # Default prior weight of the architecture
    kld_curves: np.ndarray  # KLD (F, S) in each fold with each of ``PRIOR_WEIGHTS``
    densities: list[_FoldDensities]  # Densities of each fold

    def select_weight(self) -> PriorWeightSelection:
        """Select the prior weight; the default weight if there are no folds."""
        if not len(self.kld_curves):
            return PriorWeightSelection(self.default_weight, 0)
        selection = _select_weight(self.kld_curves)
        return replace(selection, regions=_calibrate_regions(self.densities, selection.prior_weight))


def evaluate_folds(
    supervision: Supervision,
    geometry: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    on_progress: ProgressCallback = lambda progress: None,
) -> FoldResults:
    """Train and score a field in each fold, with each candidate weight of the prior.

    Parameters
    ----------
    supervision : Supervision
        Training data with rays.
    geometry : TrainingGeometry
        Training geometry, the same in all folds. Geometry made of hit points includes the surfaces that held-out
        participants looked at, but not who looked at them.
    plan : GazePlan
        Training plan of the field.
    ns : module
        Dr.Jit backend.
    on_progress : ProgressCallback
        Called with the progress.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, or if ``on_progress`` raises it.
    """
    rays, config, curves, densities = supervision.rays, plan.config, [], []
    if rays is None or not config.prior:
        raise ValueError("folds need rays and a field with a position-independent prior")
    if plan.settings.minutes is not None:
        plan = plan.with_settings(minutes=FOLD_TIME_FRACTION * plan.settings.minutes / plan.settings.mix_folds)
    settings, needs = plan.settings, TargetRequirements.from_config(plan.config)
    probes = replace(plan.probes, count=min(plan.probes.count, _MAX_PROBES), fresh=False)
    if settings.steps is not None:
        settings = replace(settings, steps=math.ceil(_STEP_FRACTION * settings.steps))
    box = compute_observer_bounds(geometry.points_to_field(rays.origin), geometry.box)
    for k, (train, held_out, centres) in enumerate(iter_folds(rays, plan)):
        try:
            targets = make_targets_from_rays(train, geometry, probes, needs, seed=settings.seed)
        except NergError:
            # The remaining participants make no probe: skip this fold.
            continue
        validation_settings = replace(probes, directions=_NUM_DIRECTIONS, min_rays=1)
        validation_probes = make_probes(held_out, validation_settings, centres, settings.seed + 3)
        truth = make_targets_from_probes(
            validation_probes, geometry, _NUM_DIRECTIONS, validation_settings.depth, needs, settings.seed + 3
        )
        trainer = plan.trainer(replace(targets, observer_bounds=box), geometry.box, config, settings, ns)
        with Interruption() as stop:
            while trainer.progress < 1:
                trainer.step()
                fraction = (k + trainer.progress) / settings.mix_folds
                on_progress(GazeProgress(f"fold {k + 1}", fraction, trainer.steps, trainer.seconds, None))
                stop.check()
        field, prior = trainer.evaluate_densities(truth)
        curves.append([_mean_kld(truth.truth, (1 - m) * field + m * prior) for m in PRIOR_WEIGHTS])
        densities.append(
            _FoldDensities(
                field,
                prior,
                _find_nearest_directions(validation_probes, geometry, truth.directions),
                validation_probes.offsets,
            )
        )
        if len(curves) == _MIN_FOLDS and all(int(np.argmin(curve)) == 0 for curve in curves):
            break
    on_progress(GazeProgress("folds", 1.0, settings.steps or 0, 0.0, None))
    return FoldResults(config.mix, np.array(curves), densities)


def iter_folds(rays: Rays, plan: GazePlan) -> Iterator[tuple[Rays, Rays, np.ndarray]]:
    """Yield ``(training rays, held-out rays, centres)`` of each fold.

    Each fold holds out a group of participants at test positions ``centres`` (T, 3) and removes other rays near these
    positions from the training rays. With one participant, only positions are held out. Folds without enough rays are
    skipped.
    """
    settings, radius = plan.settings, plan.probes.radius
    rng = np.random.default_rng(settings.seed + 7)
    participants = rng.permutation(np.unique(rays.person))
    is_single = len(participants) == 1
    groups = (
        [participants] * settings.mix_folds
        if is_single
        else np.array_split(participants, min(settings.mix_folds, len(participants)))
    )
    for k, group in enumerate(groups):
        mask = np.isin(rays.person, group)
        held_out = rays.select(mask)
        try:
            # The other participants provide the training rays, so no minimum applies to those who hardly moved.
            split = split_by_position(
                held_out,
                radius,
                zones=_NUM_ZONES,
                test_probes=_NUM_POSITIONS,
                min_rays=_MIN_RAYS,
                min_train=0,
                seed=1000 * settings.seed + k,
            )
        except NergError:
            # These participants have no zones with enough rays.
            continue
        is_training = purge(rays, split.test_centres, 2 * radius)
        if not is_single:
            is_training &= ~mask
        if is_training.any():
            yield rays.select(is_training), held_out, split.test_centres


def _round_values(value):
    """Round the numbers in ``value`` to four digits."""
    if isinstance(value, dict):
        return {k: _round_values(v) for k, v in value.items()}
    return round(value, 4) if isinstance(value, float) else value


def _mean_kld(truth: np.ndarray, density: np.ndarray) -> float:
    """Return the mean KLD (nats) of densities (P, D) in directions of equal area, each normalised."""
    p = truth / truth.sum(axis=1, keepdims=True, dtype=np.float64)
    q = np.maximum(density, _MIN_DENSITY)
    q = q / q.sum(axis=1, keepdims=True, dtype=np.float64)
    return float((p * np.log(np.maximum(p, _MIN_DENSITY / p.shape[1]) / q)).sum(axis=1).mean())


def _find_nearest_directions(probes: Probes, place: TrainingGeometry, directions: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of its probe's ``directions`` (P, D, 3) for each ray of ``probes``, (n,)."""
    along, o = place.directions_to_field(probes.directions), probes.offsets
    return np.concatenate([np.argmax(along[a:b] @ d.T, axis=1) for a, b, d in zip(o[:-1], o[1:], directions)])


def _calibrate_regions(densities: Sequence[_FoldDensities], mix: float) -> dict[str, float]:
    """Calibrate the region levels on the held-out rays of all folds, with equal weight for each position."""
    levels, weights = [], []
    for fold in densities:
        density = (1 - mix) * fold.field + mix * fold.prior
        for p, (a, b) in enumerate(zip(fold.offsets[:-1], fold.offsets[1:])):
            levels.append(compute_region_levels(density[p : p + 1], density[p : p + 1, fold.bins[a:b]])[0])
            weights.append(np.full(b - a, 1 / (b - a)))
    return calibrate_levels(np.concatenate(levels), np.concatenate(weights))


def within_half_se(curves: np.ndarray) -> np.ndarray:
    """Return the columns of ``curves`` (F, S), one row per fold, whose mean is within half a standard error of the
    smallest.

    The standard error is that of the difference to the best column, over folds.
    """
    excess = curves - curves[:, [int(curves.mean(axis=0).argmin())]]
    error = excess.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else np.zeros(curves.shape[1])
    return np.flatnonzero(excess.mean(axis=0) <= _SE_FACTOR * error)


def _select_weight(curves: np.ndarray) -> PriorWeightSelection:
    """Select the largest of `PRIOR_WEIGHTS` that is within half a standard error of the best over folds (F, S)."""
    mean, index = curves.mean(axis=0), int(within_half_se(curves)[-1])
    return PriorWeightSelection(
        float(PRIOR_WEIGHTS[index]), len(curves), float(mean[index]), float(mean[0]), float(mean[-1])
    )


# ---- Selection of the variant ----
#
# The folds also select between several architectures.
#
# Without surfaces, emit sees points at one constant distance. In some environments it still predicts the gaze of
# others, in others it overfits to the training participants; the held-out participants decide.

SELECTION_KEY = "choice"  # Key of the selection in the run identity (``GazePlan.make_identity``)


def select_variant(
    supervision: Supervision,
    geometry: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    on_progress: ProgressCallback = lambda progress: None,
    resumed_identity: dict | None = None,
) -> tuple[GazePlan, PriorWeightSelection | None]:
    """Select one architecture of ``plan``, and its prior weight, by folds.

    ``GazePlan.config`` is kept unless one of the ``alternatives`` predicts the held-out participants better by half a
    standard error over folds, each with its own prior weight. Without alternatives, rays or folds nothing is selected.

    Parameters
    ----------
    supervision, geometry, plan, ns, on_progress
        As for `evaluate_folds`.
    resumed_identity : dict, optional
        Identity of the run to resume; its selection is reused.

    Returns
    -------
    plan : GazePlan
        Plan with one architecture.
    selection : PriorWeightSelection or None
        Prior weight, if it was selected.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, or if ``on_progress`` raises it.
    """
    configs, plan = (plan.config, *plan.alternatives), replace(plan, alternatives=())
    if len(configs) == 1 or not selects_prior_weight(plan) or supervision.rays is None:
        return plan, None
    if resumed_identity is not None:
        return _restore_selection(plan, configs, resumed_identity)
    results, fold_plan = [], plan
    if plan.settings.minutes is not None:
        fold_plan = plan.with_settings(minutes=plan.settings.minutes / len(configs))
    try:
        for k, config in enumerate(configs):
            report = scale_progress(on_progress, k, len(configs), f"{{}} of {config.variant}")
            results.append(evaluate_folds(supervision, geometry, replace(fold_plan, config=config), ns, report))
    except KeyboardInterrupt as error:
        names = " and ".join(config.variant for config in configs)
        raise KeyboardInterrupt(f"interrupted while selecting between {names}; no state was saved") from error
    return _select_best(plan, configs, results)


def _restore_selection(
    plan: GazePlan, configs: tuple[GazeHeadConfig, ...], identity: dict
) -> tuple[GazePlan, PriorWeightSelection | None]:
    """Return the selection of the run to resume. A selection of another run is detected when the identities are
    compared.
    """
    matching = [c for c in configs if json.loads(json.dumps(c.to_dict())) == identity.get("architecture")]
    plan = replace(plan, config=matching[0]) if matching else plan
    if SELECTION_KEY not in identity:
        return plan, None
    try:
        return plan, PriorWeightSelection.from_dict(identity[SELECTION_KEY])
    except (TypeError, ValueError) as error:
        raise NergError(f"the saved selection of the run is damaged ({error}); start again without --resume") from error


def _select_best(
    plan: GazePlan, configs: tuple[GazeHeadConfig, ...], results: list[FoldResults]
) -> tuple[GazePlan, PriorWeightSelection | None]:
    """Return the plan with the best of ``configs`` and its prior weight, given the fold results of each."""
    selections = [judged.select_weight() for judged in results]
    # Folds stop early for a field that needs no prior.
    folds = min(len(judged.kld_curves) for judged in results)
    if not folds:
        return plan, selections[0]
    weight_indices = [int(np.abs(PRIOR_WEIGHTS - choice.prior_weight).argmin()) for choice in selections]
    curves = np.stack([judged.kld_curves[:folds, s] for judged, s in zip(results, weight_indices)], axis=1)
    k = int(within_half_se(curves)[0])
    variants = {config.variant: float(kld) for config, kld in zip(configs, curves.mean(axis=0))}
    return replace(plan, config=configs[k]), replace(selections[k], variant=configs[k].variant, variants=variants)


def scale_progress(on_progress: ProgressCallback, k: int, count: int, stage: str) -> ProgressCallback:
    """Return a callback that reports part ``k`` of ``count`` as progress of the whole; ``stage`` formats the stage
    names.
    """

    def report(progress: GazeProgress) -> None:
        on_progress(replace(progress, stage=stage.format(progress.stage), fraction=(k + progress.fraction) / count))

    return report
