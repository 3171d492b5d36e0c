"""Held-out gaze: splits for tests and validation, and folds that select the architecture and the prior's weight."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeHead, GazeHeadConfig, interpolate_table
from nerg_mi.fields.gaze_hits import MAX_HITS, HitKernel, ReaimedHits, place_missing_points
from nerg_mi.maths.arrays import to_vector
from nerg_mi.photos.salience import SalienceView
from nerg_mi.ranges import KAPPAS, LENGTHS
from nerg_mi.tracking.filters import purge, split_by_person, split_by_position
from nerg_mi.tracking.folds import Fold, iter_folds, sample_participants_equally
from nerg_mi.tracking.probes import calibrate_levels, compute_region_levels
from nerg_mi.tracking.rays import Rays

from .gaze_data import (
    Supervision,
    TargetRequirements,
    compute_observer_bounds,
    find_hit_points,
    make_observer_targets,
    make_rotated_directions,
    make_targets_from_rays,
)
from .gaze_recipes import GazePlan
from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazeProgress, GazeTrainer, ProgressCallback, scale_progress
from .prior import make_prior_from_rays, select_prior_kappa
from .stacking import NO_SURFACES, SURFACES, fit_sparse_weights

# ---- Splits ----
#
# Positions and participants that are held out for testing, and positions that are held out for validation.

_VALIDATION_FRACTION = 0.12  # Fraction of the views held out for validation


@dataclass(frozen=True, eq=False)
class ValidationSplit:
    """Training and validation data of the first fit."""

    training: Supervision  # Data to train on
    validation: Supervision | None = None  # Data to validate on; None: no validation
    # Positions (T, 3) of the validation probes in the frame of the rays; None: at the views
    centres: np.ndarray | None = None
    rays_held_out: int = 0  # Rays and views excluded from the training data
    views_held_out: int = 0


def split_validation(
    supervision: Supervision, geometry: Environment, settings: GazeSettings, probes: ProbeSettings
) -> ValidationSplit:
    """Hold out zones of positions for validation, as many as ``settings.validation_zones``.

    Training data within 2R of a validation position are removed, where R is the probe radius: rays and views, or only
    views if there are no rays.

    Raises `NergError` if too little training data would remain.
    """
    rays, views = supervision.rays, supervision.views
    if not settings.validation_zones:
        return ValidationSplit(supervision)
    if rays is None:
        train, validation = split_views(views, settings.validation_zones, 2 * probes.radius, settings.seed + 1)
        return ValidationSplit(
            Supervision(None, tuple(train)),
            Supervision(None, tuple(validation)),
            views_held_out=len(views) - len(train),
        )
    split = split_by_position(
        rays,
        probes.radius,
        zones=settings.validation_zones,
        test_probes=settings.validation_probes,
        min_rays=settings.validation_min_rays or probes.min_rays,
        seed=settings.seed + 1,
    )
    far_from_test = select_far_views(
        views, geometry.points_to_field(split.test_centres), 2 * probes.radius * geometry.align.scale
    )
    return ValidationSplit(
        Supervision(rays.select(split.train), tuple(far_from_test)),
        # Validation uses all rays around the centres, because the truth is the gaze of everybody who was there.
        Supervision(rays),
        split.test_centres,
        rays_held_out=int((~split.train).sum()),
        views_held_out=len(views) - len(far_from_test),
    )


def hold_out(
    rays: Rays,
    radius: float,
    zones: int,
    positions: int,
    seed: int = 0,
    min_rays: int = 64,
    participant_fraction: float = 0.0,
) -> tuple[Rays, dict]:
    """Hold out test positions, and optionally participants.

    Parameters
    ----------
    rays : Rays
        All gaze rays.
    radius : float
        Probe radius R in metres. Rays within 2R of a test position are removed (``rays.filters``), so that no training
        probe comes within R of one.
    zones, positions : int
        Number of zones and total number of test positions.
    seed : int
        Seed of the split.
    min_rays : int
        Minimum number of rays around a test position.
    participant_fraction : float
        Fraction of the participants to hold out everywhere; the test positions are then chosen among theirs. 0 holds
        out none.

    Returns
    -------
    train : Rays
        Rays to train on.
    holdout : dict
        Description of the split (JSON), with the test ``centres`` in the frame of the rays and the names of the
        held-out participants (``people``).
    """
    is_training, names = np.ones(len(rays), bool), []
    test_rays = rays
    if participant_fraction:
        is_training, is_held_out = split_by_person(rays, test_fraction=participant_fraction, seed=seed)
        names = [rays.persons[i] for i in np.unique(rays.person[is_held_out])]
        test_rays = rays.select(is_held_out)
    split = split_by_position(test_rays, radius, zones=zones, test_probes=positions, min_rays=min_rays, seed=seed)
    train = is_training & purge(rays, split.test_centres, 2 * radius)
    holdout = {
        "centres": split.test_centres.round(6).tolist(),
        "zone": split.zone.tolist(),
        "radius": radius,
        "purged_within": 2 * radius,
        "seed": seed,
        "rays": len(rays),
        "rays_to_train": int(train.sum()),
        "rays_near_tests": int(split.test.sum()),
        "people": names,
    }
    return rays.select(train), holdout


def split_views(
    views: Sequence[SalienceView], zones: int, distance: float, seed: int = 0
) -> tuple[list[SalienceView], list[SalienceView]]:
    """Split views into ``(training, validation)``.

    An eighth of the views, in ``zones`` groups of neighbours, are held out for validation. Views within ``distance`` of
    a validation view are excluded from training.

    Raises `NergError` if too few views would remain.
    """
    centres = np.array([v.camera.center for v in views])
    rng = np.random.default_rng(seed)
    seeds = [int(rng.integers(len(views)))]
    distances = np.full(len(views), np.inf)
    while len(seeds) < min(zones, len(views)):
        distances = np.minimum(distances, np.linalg.norm(centres - centres[seeds[-1]], axis=1))
        seeds.append(int(rng.choice(np.argsort(-distances)[: max(1, len(views) // 4)])))
    group_size = max(1, round(_VALIDATION_FRACTION * len(views) / len(seeds)))
    seed_distances = np.linalg.norm(centres[:, None] - centres[seeds], axis=2)
    validation = np.unique(np.argsort(seed_distances, axis=0, kind="stable")[:group_size])
    train = select_far_views(views, centres[validation], distance)
    if len(train) < max(2, len(views) // 4):
        raise NergError(
            f"only {len(train)} of {len(views)} views remain for training; the others are validation views or "
            f"within {distance:g} of one; use fewer {parameter('validation_zones')} (0: no validation) or a "
            f"smaller {parameter('radius')}"
        )
    return train, [views[k] for k in validation]


def select_far_views(views: Sequence[SalienceView], points: np.ndarray, distance: float) -> list[SalienceView]:
    """Return the ``views`` whose camera is farther than ``distance`` from each of ``points`` (T, 3), all in one
    frame."""
    return [v for v in views if np.linalg.norm(points - v.camera.center, axis=1).min(initial=np.inf) > distance]


# ---- Selection of the prior ----
#
# The kernels and the weight of the position-independent prior, so that a field is not worse than the prior alone.
#
# With few or stationary participants a field overfits and scores below the position-independent prior, and where many
# stood it resolves less than re-aimed hits (`fields.gaze_hits`). The gaze field is therefore a mixture of field, prior
# and several kernels of re-aimed hits, whose weights predict held-out rays best (`stacking`): each fold holds out some
# participants, and zones of positions, and trains a field on the other rays with the same number of steps. One half of
# the held-out rays that are scored are at recorded positions, the other half at new ones. Densities are those at the
# rays' own origins. A weight that depends on the distance to the nearest recorded positions predicted no better than a
# constant one in two recorded places. Neither did kernels of a constant size in metres, next to those of a constant
# angle, nor a field as a factor of the mixture of kernels, trained without the participant of each ray: it lost 0.1 to
# 0.6 bits at new positions in three of four trials.
#
# Few held-out participants say little about others, and a mixture that is better for them by chance is worse for the
# next. So the gain over the prior is that with weights of the other folds, averaged over each participant's rays, and
# the mixture only counts as it is where it is clearly better than the prior: by _CLEAR_GAIN after a deduction of
# a standard error over participants. Elsewhere the prior is added with the weight of the best gain after that
# deduction; it is zero for the prior alone, so where nothing can be learned from position the weight is one. Without
# surfaces the stacking expects more of the prior and of the hits: a deduction of two standard errors instead lost .04
# bits at recorded positions and .02 at new ones (means over nine splits of eight environments that chose nothing). If
# the field needs no prior in the first folds, and enough participants were held out for the weights of the hits, the
# others are skipped. The held-out rays also calibrate the highest-density regions of the mixture.

PRIOR_WEIGHTS = np.array([0.01, 0.02, *(0.05 * np.arange(1, 21))])
"""Weights of the prior in a mixture with the field alone. Zero is excluded, so that no density is zero."""
FOLD_TIME_FRACTION = 0.5  # Fraction of a training's time limit that the folds take
# Maximum number of held-out rays of a fold, and directions over which the density at their origins is integrated
_MAX_RAYS, _NUM_DIRECTIONS = 320, 1024
# Maximum number of rays of a fold at which the re-aimed hits are evaluated in all directions, because that takes long
_MAX_HIT_MAPS = 64
_CLEAR_GAIN = 0.1  # Nats per ray
_SHRINKAGES = 0.05 * np.arange(21)  # Candidate weights of the prior that is added to a mixture
# Numbers of folds and of held-out participants after which a small weight is accepted, if the mean of each fold is best
# with a weight up to _SMALL_WEIGHT and exceeds the prior by _CLEAR_GAIN
_MIN_FOLDS, _MIN_PARTICIPANTS, _SMALL_WEIGHT = 2, 12, 0.1
_SE_FACTOR = 0.5  # Standard errors by which the first variant may be worse than the best
_MIN_DENSITY = 1e-9  # Minimum density (1/sr), so that its logarithm is finite

HIT_KERNELS = tuple(
    (bandwidth, kappa)
    for bandwidth in (0.1, 0.2, 0.4, 0.8, 1.6, 5.0)
    for kappa in (10.0, 40.0, 120.0, 300.0, 800.0, 2000.0)
)
"""Candidate bandwidths (metres) and concentrations of the re-aimed hits."""
ALL_HIT_KERNELS = tuple(HitKernel(1 / len(HIT_KERNELS), *kernel) for kernel in HIT_KERNELS)
"""All candidates with equal weights."""


_KEYS = {"prior_weight": "mix"}  # Fields with another name in checkpoints


@dataclass(frozen=True)
class PriorSelection:
    """The selected prior and the scores behind it. Without folds it is the default prior."""

    prior_weight: float  # Selected weight
    folds: int  # Number of folds with enough participants and positions
    # Concentration of the prior's kernels; None if it was not selected.
    prior_kappa: float | None = None
    # Mean log density of the held-out rays over that of the prior alone, in bits: with the weights that these rays
    # selected, of the field alone (with the smallest candidate weight), and with the weights that the rays of the other
    # folds select (None for a single fold).
    bits: float | None = None
    bits_field: float | None = None
    bits_crossed: float | None = None
    # Nominal levels at which the regions hold `tracking.probes.REGION_LEVELS` of the held-out gaze, by level name.
    regions: dict[str, float] | None = None
    # The variant selected by `select_variant`, and the bits of each variant with its own weight in the common folds,
    # whose rays selected both.
    variant: str | None = None
    variants: dict[str, float] | None = None
    # Weights, bandwidths (metres) and concentrations of the re-aimed hits
    hits: tuple[HitKernel, ...] = ()
    # Mean fraction of the rays on which the field of a fold was trained
    train_fraction: float | None = None

    @property
    def hits_weight(self) -> float:
        return sum(kernel.weight for kernel in self.hits)

    def to_dict(self) -> dict:
        """Return the selection as JSON, for the provenance."""
        entries = asdict(replace(self, hits=()))
        entries["hits"] = [list(kernel) for kernel in self.hits]
        return {_KEYS.get(k, k): _round_values(v) for k, v in entries.items()}

    @staticmethod
    def from_dict(data: dict[str, Any]) -> PriorSelection:
        """Restore a selection from `to_dict`. Raises ``TypeError`` or ``ValueError`` for invalid data."""
        names, values = {key: name for name, key in _KEYS.items()}, dict(data)
        values["hits"] = tuple(HitKernel(*map(float, row)) for row in values.get("hits", ()))
        selection = PriorSelection(**{names.get(k, k): v for k, v in values.items()})
        if not 0 <= selection.prior_weight <= 1:
            raise ValueError(f'its "mix" must be from 0 to 1, got {selection.prior_weight}')
        if selection.prior_kappa is not None and selection.prior_kappa not in KAPPAS:
            raise ValueError(f'its "prior_kappa" must be positive, got {selection.prior_kappa}')
        if not 0 <= selection.hits_weight <= 1 - selection.prior_weight + 1e-3:
            raise ValueError(f'the weights of its "hits" must sum to at most 1, got {selection.hits_weight:g}')
        if any(k.weight <= 0 or k.bandwidth not in LENGTHS or k.kappa not in KAPPAS for k in selection.hits):
            raise ValueError('the weights, bandwidths and concentrations of its "hits" must be positive')
        return selection

    def apply_prior(self, field: GazeHead, rays: Rays | None, geometry: Environment, plan: GazePlan) -> None:
        """Set the prior of a ``field`` that was trained on ``rays``."""
        table = None
        if self.prior_kappa is not None and rays is not None:
            table = make_prior_from_rays(
                rays, field.config.prior, geometry, plan.settings.seed, plan.probes.ray_weights, self.prior_kappa
            )
        # The hits are mixed into the mixture of field and prior.
        rest = 1 - self.hits_weight
        field.set_prior(round(min(self.prior_weight / rest, 1.0), 6) if rest else 1.0, table)

    def make_hits(self, rays: Rays | None, geometry: Environment, plan: GazePlan) -> ReaimedHits | None:
        """Make the re-aimed hits of ``rays`` for the field; None if their weight is zero."""
        if not self.hits or rays is None:
            return None
        rays = sample_participants_equally(rays, MAX_HITS, plan.settings.seed + 5)
        rays = replace(rays, hit=find_hit_points(rays, geometry, plan.probes.depth))
        return make_hits(rays, geometry, self.hits)


def selects_prior_weight(plan: GazePlan, rays: Rays | None) -> bool:
    """Return whether ``plan`` selects the prior by folds of ``rays``."""
    return plan.settings.prior_folds > 0 and plan.config.prior > 0 and rays is not None


class FoldDensities(NamedTuple):
    """Densities (1/sr) of a fold at n held-out rays, each at its own origin."""

    person: np.ndarray  # Participant of each ray (n,)
    # In the direction of each ray: of the field, of the prior, and of the re-aimed hits with each of `HIT_KERNELS`, if
    # they are used (n, 2 or 2 + K)
    densities: np.ndarray
    field_maps: np.ndarray  # Of the field in D directions of equal area (n, D)
    prior_maps: np.ndarray  # Of the prior (n, D)
    # Maps (m, D) of the density of re-aimed hits with these kernels at some of the rays
    make_hit_maps: Callable[[Sequence[HitKernel], slice], np.ndarray]
    train_fraction: float = 1.0  # Fraction of the rays on which the field was trained


@dataclass(frozen=True)
class FoldResults:
    """Scores of one architecture in the folds."""

    default_weight: float  # Default prior weight of the architecture
    kappa: float | None  # Concentration of the prior's kernels; None if it was not selected
    folds: list[FoldDensities]
    # Fractions of the pseudo-rays (`stacking.fit_sparse_weights`)
    fractions: tuple[float, float, float] = SURFACES

    def select(self) -> PriorSelection:
        """Select the weights of the prior and of the re-aimed hits; the default weight if there are no folds."""
        if not self.folds:
            return PriorSelection(self.default_weight, 0)
        densities = np.concatenate([fold.densities for fold in self.folds])
        fold = np.repeat(np.arange(len(self.folds)), [len(fold.person) for fold in self.folds])
        participant = np.concatenate([fold.person for fold in self.folds])
        # Each participant of each fold; participants of several folds are others in each.
        unit = np.unique(np.stack([fold, participant]), axis=1, return_inverse=True)[1].ravel()
        log = _log(densities).T
        weights = fit_sparse_weights(log, unit, self.fractions)
        groups = fold if len(self.folds) > 1 else unit
        is_crossed = len(np.unique(groups)) > 1
        gains = np.empty((unit.max() + 1, len(_SHRINKAGES)))
        for k in np.unique(groups):
            others = groups != k if is_crossed else np.ones(len(groups), bool)
            of_others = fit_sparse_weights(log[:, others], unit[others], self.fractions)
            candidates = _shrink(of_others, _SHRINKAGES)
            of_group = np.unique(unit[groups == k])
            gains[of_group] = _compute_gains(densities, unit, candidates)[of_group]
        index = _select_weight(gains)
        # Rounded as stored, so that a resumed training has the same weights
        weights = _shrink(weights, _SHRINKAGES[[index]]).round(4)
        weights[0, 0] = 1 - weights[0, 1:].sum()
        alone = np.zeros((1, len(log)))
        alone[0, :2] = 1 - PRIOR_WEIGHTS[0], PRIOR_WEIGHTS[0]
        to_bits = lambda nats: float(nats.mean() / np.log(2))
        _, prior_weight, *hit_weights = weights[0].tolist()
        selection = PriorSelection(
            prior_weight,
            len(self.folds),
            self.kappa,
            to_bits(_compute_gains(densities, unit, weights)),
            to_bits(_compute_gains(densities, unit, alone)),
            to_bits(gains[:, index]) if is_crossed else None,
            hits=tuple(HitKernel(v, *kernel) for v, kernel in zip(hit_weights, HIT_KERNELS) if v),
            train_fraction=float(np.mean([fold.train_fraction for fold in self.folds])),
        )
        return replace(selection, regions=_calibrate_regions(self.folds, selection))

    def compute_selected_gains(self, selection: PriorSelection, folds: int) -> np.ndarray:
        """Return the mean log density over that of the prior alone, in nats, of each participant of the first ``folds``
        folds (N,), with the weights of ``selection``."""
        parts = [
            _compute_gains(fold.densities, fold.person, _to_weights(selection, fold)[None])[:, 0]
            for fold in self.folds[:folds]
        ]
        return np.concatenate(parts)


def _to_weights(selection: PriorSelection, fold: FoldDensities) -> np.ndarray:
    """Return the weights of ``selection`` for the columns of ``fold.densities``."""
    weights = np.zeros(fold.densities.shape[1])
    weights[:2] = 1 - selection.prior_weight - selection.hits_weight, selection.prior_weight
    for kernel in selection.hits:
        weights[2 + HIT_KERNELS.index((kernel.bandwidth, kernel.kappa))] = kernel.weight
    return weights


def _shrink(weights: np.ndarray, shrinkages: np.ndarray) -> np.ndarray:
    """Add the prior, the second component, with each of ``shrinkages`` (S,) to a mixture; returns weights (S, C)."""
    is_prior = np.arange(len(weights)) == 1
    return (1 - shrinkages[:, None]) * weights + shrinkages[:, None] * is_prior


def _compute_gains(densities: np.ndarray, participant: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean log density over that of the prior alone, in nats, of each participant and for each row of
    ``weights`` (N, S)."""
    gain = _log(densities @ weights.T) - _log(densities[:, [1]])
    return np.array([gain[participant == p].mean(axis=0) for p in np.unique(participant)])


def _standard_error(values: np.ndarray) -> np.ndarray:
    """Return the standard error of the means of the rows of ``values`` (N, ...); zero for one row."""
    return values.std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.zeros_like(values[0])


def _log(density: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(density, _MIN_DENSITY))


def evaluate_folds(
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    ns: ModuleType,
    on_progress: ProgressCallback = lambda progress: None,
) -> FoldResults:
    """Train a field in each fold, and evaluate it and the prior at held-out rays.

    Parameters
    ----------
    supervision : Supervision
        Training data with rays.
    geometry : Environment
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
    rays, config, folds = supervision.rays, plan.config, []
    if rays is None or not config.prior:
        raise ValueError("folds need rays and a field with a position-independent prior")
    if plan.settings.minutes is not None:
        plan = plan.with_settings(minutes=FOLD_TIME_FRACTION * plan.settings.minutes / plan.settings.prior_folds)
    settings, needs = plan.settings, TargetRequirements.from_config(plan.config)
    probes, kappa = replace(plan.probes, resample_directions=False), plan.probes.prior_kappa
    if kappa is None and not config.prior_factor:
        kappa = select_prior_kappa(rays, probes.ray_weights, settings.seed)
    plan = replace(plan, probes=replace(probes, prior_kappa=kappa))
    box = compute_observer_bounds(geometry.points_to_field(rays.origin), geometry.box)
    if settings.reaimed_hits:
        rays = replace(rays, hit=find_hit_points(rays, geometry, probes.depth))
    for k, fold in enumerate(iter_folds(rays, probes.radius, settings.prior_folds, settings.seed)):
        try:
            targets = make_targets_from_rays(fold.train, geometry, plan.probes, needs, seed=settings.seed)
        except NergError:
            # The remaining participants make no probe: skip this fold.
            continue
        trainer = plan.trainer(replace(targets, observer_bounds=box), geometry.box, config, settings, ns)
        _train(trainer, scale_progress(on_progress, k, settings.prior_folds, f"fold {k + 1}"))
        assert targets.prior_table is not None  # The field has a prior
        folds.append(_evaluate_fold(trainer, targets.prior_table, fold, geometry, plan, needs))
        if len(folds) == _MIN_FOLDS and all(map(_needs_no_prior, folds)):
            # To select the re-aimed hits, enough participants must be held out.
            num_participants = sum(len(np.unique(fold.person)) for fold in folds)
            if not settings.reaimed_hits or num_participants >= _MIN_PARTICIPANTS:
                break
    on_progress(GazeProgress("folds", 1.0, settings.steps or 0, 0.0, None))
    fractions = NO_SURFACES if geometry.medium is None else SURFACES
    return FoldResults(config.mix, None if config.prior_factor else kappa, folds, fractions)


def _train(trainer: GazeTrainer, on_progress: ProgressCallback) -> None:
    """Run all steps. Raises `KeyboardInterrupt` after Ctrl-C, or if ``on_progress`` raises it."""
    report = lambda: on_progress(GazeProgress("", trainer.progress, trainer.steps, trainer.seconds, None))
    if trainer.run(lambda: trainer.progress >= 1, lambda: None, report):
        raise KeyboardInterrupt


def _evaluate_fold(
    trainer: GazeTrainer,
    prior_table: np.ndarray,
    fold: Fold,
    geometry: Environment,
    plan: GazePlan,
    needs: TargetRequirements,
) -> FoldDensities:
    """Evaluate the field of ``trainer``, the prior in ``prior_table`` and the hits of the training rays at some of the
    held-out rays."""
    seed, rows, ns = plan.settings.seed, plan.config.prior, trainer.ns
    test = fold.sample(_MAX_RAYS, seed + 3)
    maps = make_rotated_directions(_NUM_DIRECTIONS, len(test), np.random.default_rng(seed + 3))
    directions = geometry.directions_to_field(np.concatenate([maps, test.direction[:, None]], axis=1))
    positions = geometry.points_to_field(test.origin)
    targets = make_observer_targets(
        positions, directions, np.zeros(directions.shape[:2]), geometry, plan.probes.depth, needs
    )
    field = trainer.evaluate_densities(targets).astype(np.float64)
    # The trainer normalises over all directions, among which that of the ray is one too many.
    field /= 4 * np.pi * field[:, :-1].mean(axis=1, keepdims=True)
    log = interpolate_table(ns.Float(prior_table.ravel()), rows, to_vector(ns.Array3f, directions.reshape(-1, 3)))
    prior = np.exp(np.asarray(log, np.float64)).reshape(field.shape)
    columns = [field[:, -1:], prior[:, -1:]]
    train = sample_participants_equally(fold.train, MAX_HITS, seed + 5)
    if plan.settings.reaimed_hits:
        columns.append(make_hits(train, geometry, ALL_HIT_KERNELS).evaluate_kernels(positions, directions[:, -1]))

    def make_hit_maps(kernels: Sequence[HitKernel], rows: slice) -> np.ndarray:
        return make_hits(train, geometry, kernels).observe(positions[rows], ns).evaluate(directions[rows, :-1])

    densities = np.concatenate(columns, axis=1)
    return FoldDensities(test.person, densities, field[:, :-1], prior[:, :-1], make_hit_maps, fold.train_fraction)


def make_hits(rays: Rays, geometry: Environment, kernels: Sequence[HitKernel]) -> ReaimedHits:
    """Make the re-aimed hits of ``rays`` with hit points, if any; bandwidths of ``kernels`` are in metres."""
    scale = geometry.align.scale
    origins, directions = geometry.points_to_field(rays.origin), geometry.directions_to_field(rays.direction)
    points = None if rays.hit is None else geometry.points_to_field(rays.hit)
    points = place_missing_points(origins, directions, points, scale * max(kernel.bandwidth for kernel in kernels))
    return ReaimedHits(origins, points, [kernel._replace(bandwidth=scale * kernel.bandwidth) for kernel in kernels])


def _needs_no_prior(fold: FoldDensities) -> bool:
    """Return whether a small weight of the prior is best by far in a mixture with the field of this fold."""
    weights = np.stack([1 - PRIOR_WEIGHTS, PRIOR_WEIGHTS], axis=1)
    gains = _compute_gains(fold.densities[:, :2], fold.person, weights).mean(axis=0)
    return bool(PRIOR_WEIGHTS[gains.argmax()] <= _SMALL_WEIGHT and gains.max() > _CLEAR_GAIN)


def _round_values(value):
    """Round the numbers in ``value`` to four digits."""
    if isinstance(value, dict):
        return {k: _round_values(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_round_values(v) for v in value]
    return round(value, 4) if isinstance(value, float) else value


def _calibrate_regions(folds: Sequence[FoldDensities], selection: PriorSelection) -> dict[str, float]:
    """Calibrate the region levels of the mixture ``selection`` on held-out rays of all folds."""
    levels = []
    for fold in folds:
        weights = _to_weights(selection, fold)
        maps = weights[0] * fold.field_maps + weights[1] * fold.prior_maps
        # The rays are in the order of the recording: every n-th, so that they are those of all participants.
        rows = slice(None, None, -(-len(maps) // _MAX_HIT_MAPS) if selection.hits else 1)
        maps = maps[rows]
        if selection.hits:
            maps = maps + selection.hits_weight * fold.make_hit_maps(selection.hits, rows)
        levels.append(compute_region_levels(maps, (fold.densities[rows] @ weights)[:, None])[:, 0])
    return calibrate_levels(np.concatenate(levels), np.ones(sum(map(len, levels))))


def _select_weight(gains: np.ndarray) -> int:
    """Return the index of the best of S mixtures by their ``gains`` (N, S) over the prior for N participants.

    A standard error is deducted from the gains.
    """
    mean = gains.mean(axis=0)
    cautious = mean - _standard_error(gains)
    return int((mean if cautious.max() > _CLEAR_GAIN else cautious).argmax())


# ---- Selection of the variant ----
#
# The folds also select between several architectures.
#
# Without surfaces, emit sees points at one constant distance. In some environments it still predicts the gaze of
# others, in others it overfits to the training participants; the held-out participants decide.

SELECTION_KEY = "choice"  # Key of the selection in the run identity (``GazePlan.make_identity``)


def select_variant(
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    ns: ModuleType,
    on_progress: ProgressCallback = lambda progress: None,
    resumed_identity: dict | None = None,
) -> tuple[GazePlan, PriorSelection | None]:
    """Select one architecture of ``plan``, and its prior weight, by folds.

    ``GazePlan.config`` is kept unless one of the ``alternatives`` predicts the held-out participants better by half a
    standard error over participants, each with its own prior weight. Without alternatives, rays or folds nothing is
    selected.

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
    selection : PriorSelection or None
        Prior weight, if it was selected.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, or if ``on_progress`` raises it.
    """
    configs, plan = (plan.config, *plan.alternatives), replace(plan, alternatives=())
    if len(configs) == 1 or not selects_prior_weight(plan, supervision.rays):
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
) -> tuple[GazePlan, PriorSelection | None]:
    """Return the selection of the run to resume. A selection of another run is detected when the identities are
    compared.
    """
    matching = [c for c in configs if json.loads(json.dumps(c.to_dict())) == identity.get("architecture")]
    plan = replace(plan, config=matching[0]) if matching else plan
    if SELECTION_KEY not in identity:
        return plan, None
    try:
        return plan, PriorSelection.from_dict(identity[SELECTION_KEY])
    except (TypeError, ValueError) as error:
        raise NergError(
            f"the saved selection of the run is damaged ({error}); start again without {parameter('resume', True)}"
        ) from error


def _select_best(
    plan: GazePlan, configs: tuple[GazeHeadConfig, ...], results: list[FoldResults]
) -> tuple[GazePlan, PriorSelection | None]:
    """Return the plan with the best of ``configs`` and its prior weight, given the fold results of each."""
    selections = [scored.select() for scored in results]
    # Folds stop early for a field that needs no prior.
    count = min(len(scored.folds) for scored in results)
    if not count:
        return plan, selections[0]
    gains = [scored.compute_selected_gains(selection, count) for scored, selection in zip(results, selections)]
    losses = -np.stack(gains, axis=1)
    excess = losses - losses[:, [losses.mean(axis=0).argmin()]]
    k = int((excess.mean(axis=0) <= _SE_FACTOR * _standard_error(excess)).argmax())  # The first that is good enough
    variants = {c.variant: float(-loss / np.log(2)) for c, loss in zip(configs, losses.mean(axis=0))}
    return replace(plan, config=configs[k]), replace(selections[k], variant=configs[k].variant, variants=variants)


def compute_fold_cost(plan: GazePlan) -> float:
    """Return the cost of all folds of all architectures of ``plan``, relative to a fit."""
    if plan.settings.minutes is not None:
        return FOLD_TIME_FRACTION / (1 - FOLD_TIME_FRACTION)
    return plan.settings.prior_folds * (1 + len(plan.alternatives))
