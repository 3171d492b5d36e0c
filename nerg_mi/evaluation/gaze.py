"""Scores of a gaze field and of baselines on held-out rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.transforms import transform_points
from nerg_mi.maths.types import variant_types
from nerg_mi.tracking.filters import purge, split_by_person
from nerg_mi.tracking.folds import sample_participants_equally
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_batch import evaluate_densities
from nerg_mi.transport.observer_gaze import GazeFieldInstance, ObservedGaze

from . import metrics
from .baselines import Baseline

# ---- Densities of a trained gaze field at positions, and the table of scores ----


# Floor of a density in KLD relative to the uniform density. A kernel-density truth has nearly empty regions, whose
# exact values should not matter.
EPS = 1e-6

_RAY_TOLERANCE = 0.02  # Relative error of the integral at the origin of a single ray: about 0.005 bits


class FieldDensity:
    """Evaluates a gaze field in its geometry as a baseline: ``(positions (P, 3), directions) -> (P, D)`` in 1/sr.

    The values are those of the integrator ``nerg`` for an observer at that position, by the same functions: depths,
    integral of a normalised field, mean of an ensemble. Directions that hit no surface are evaluated as in training.

    Parameters
    ----------
    field : GazeNetwork
        Gaze field.
    medium : medium, SceneGeometry or None
        Medium or scene in which observer depths are traced, in the frame of the field; None for a field without
        geometry.
    align : Similarity, optional
        Similarity from the frame of the positions to that of the field.
    depth_kind : str
        Depth estimator.
    on_position : callable, optional
        Called with the number of evaluated positions after each new one.

    Raises
    ------
    NergError
        If the field needs surfaces and ``medium`` is None.

    Notes
    -----
    The integrals of positions are cached, so the field and its geometry must not change.
    """

    def __init__(
        self,
        field: GazeNetwork,
        medium,
        align: Similarity | None = None,
        depth_kind: str = "median",
        on_position: Callable[[int], None] | None = None,
    ):
        if medium is None and field.config.needs_surfaces:
            raise NergError(
                "this gaze field was trained with surfaces; pass the model of its environment with "
                f"{parameter('environment')}"
            )
        self._gaze, self._environment = (
            GazeFieldInstance(field),
            medium if isinstance(medium, SceneGeometry) else SceneGeometry(medium),
        )
        march = default_march_settings(self._environment)
        self._settings = ObserverSettings(march=march, depth=depth_kind)
        self._align, self._on_position = align or Similarity(), on_position
        self._observed: dict[bytes, ObservedGaze] = {}

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities (P, D) of positions (P, 3) in unit directions (D, 3) or (P, D, 3)."""
        return self.members(positions, directions).mean(axis=0)

    def members(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities of each member of an ensemble (M, P, D); M is 1 for a single field."""
        align = self._align
        positions = transform_points(align.matrix, np.atleast_2d(np.asarray(positions, np.float64)))
        directions = np.asarray(directions, np.float64) @ (align.matrix[:3, :3] / align.scale).T
        directions = np.broadcast_to(directions, (len(positions), *directions.shape[-2:]))
        if directions.shape[1] == 1:
            # About as many observers as directions share their launches.
            settings = replace(self._settings, integral_tolerance=_RAY_TOLERANCE)
            density = evaluate_densities(self._gaze, self._environment, settings, positions, directions[:, 0])
            return density[:, :, None]
        return np.stack([self._evaluate_members(p, d) for p, d in zip(positions, directions)], axis=1)

    def evaluate_rays(self, origins: np.ndarray, directions: np.ndarray, tolerance: float = 0.05) -> np.ndarray:
        """Evaluate the densities (N,) of rays with ``origins`` and unit ``directions`` (N, 3), for many origins.

        ``tolerance`` is the relative error of the integral at each origin, which is not cached.
        """
        align = self._align
        origins = transform_points(align.matrix, np.asarray(origins, np.float64))
        directions = np.asarray(directions, np.float64) @ (align.matrix[:3, :3] / align.scale).T
        settings = replace(self._settings, integral_tolerance=tolerance)
        return evaluate_densities(self._gaze, self._environment, settings, origins, directions).mean(axis=0)

    def _evaluate_members(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities (M, D) of one observer (3,), both in the frame of the field."""
        mi = variant_types()
        p_o, key = mi.Point3f(*position.tolist()), position.tobytes()
        new = key not in self._observed
        if new:
            self._observed[key] = self._gaze.for_observers([p_o], self._environment, self._settings)
        r_o = to_vector(mi.Vector3f, directions)
        density = np.stack([np.array(m) for m in self._observed[key].evaluate_members_along(p_o, r_o)])
        if new and self._on_position is not None:
            self._on_position(len(self._observed))
        return density


def format_score_table(rows: list[dict], title: str) -> str:
    """Format ``rows`` as a table for the terminal; a score that is not defined is left out."""
    from rich.console import Console
    from rich.table import Table

    out = Table(title=title, title_justify="left")
    for k in rows[0]:
        out.add_column(k, justify="left" if isinstance(rows[0][k], str) else "right")
    for row in rows:
        out.add_row(*(v if isinstance(v, str) else "" if np.isnan(v) else f"{v:.3f}" for v in row.values()))
    # Fixed width, so that a table in a file or pipe is not folded.
    console = Console(width=120, color_system=None)
    with console.capture() as text:
        console.print(out)
    return text.get().removesuffix("\n")


# ---- Evaluation at held-out positions and on held-out participants ----
#
# The truth at a test position is the kernel density of the rays within R. Maps are compared over directions of equal
# area. A density is smoothed with the kernel of the truth before it is compared as a map, because a density that
# predicts single rays best is sharper than the map that resembles a smoothed truth most (Kümmerer, Wallis and Bethge,
# Saliency Benchmarking Made Easy, 2018). Rays are compared individually: at the centre of their position and, "at own
# origin", at the origin of each ray. The confidence intervals treat participants as the sampling unit: a bootstrap
# draws whole participants with all of their rays (Efron and Tibshirani 1993).

SPLITS = ("both", "pos", "people")  # Held-out data: positions and participants, positions only, or participants only
MAP_SCORES, RAY_SCORES = ("KLD", "CC", "SIM", "MAE"), ("NSS", "AUC", "sAUC", "bits", "loglik")
OWN_SCORES = ("bits at own origin",)
HEADLINE = "bits"
SCORES = (HEADLINE, *MAP_SCORES, *(score for score in RAY_SCORES if score != HEADLINE), *OWN_SCORES)
"""The headline first: the information gain over the position-independent prior in bits per ray. KLD in nats, CC and SIM
of densities normalised over the sphere; MAE in 1/sr of unnormalised densities; NSS; AUC-Judd; sAUC of the ratio to the
prior, against rays of other test positions; mean log density (nats of 1/sr); information gain with each density
evaluated at the ray's own origin, not at the centre of its position.
"""
# Fraction of the progress for evaluating the methods; the rest is for the bootstrap.
_EVALUATION_FRACTION = 0.2
_RAYS_PER_POSITION = 128  # Rays drawn at each test position for the ray scores
_SMOOTHED_DIRECTIONS = 2048  # Directions that are smoothed together
_RESAMPLED_VALUES = 1 << 17  # Densities that are scored together: they fit into a cache of the processor
_MAX_OWN_RAYS = 512  # Rays that are scored at their own origins, with about as many of each participant


@dataclass(frozen=True, eq=False)
class GazeTest:
    """Test data at P positions, with N participants, D directions and K rays per position."""

    centres: np.ndarray  # Positions (P, 3) in metres, in the frame of the rays
    directions: np.ndarray  # Directions (D, 3) of equal area in which maps are compared
    truth: np.ndarray  # True densities (P, D), 1/sr
    participant_densities: np.ndarray  # Densities of each participant (P, N, D)
    counts: np.ndarray  # Number of rays of each participant at each position (P, N)
    participants: tuple[str, ...]  # Names of the participants
    sample_directions: np.ndarray  # Directions of rays drawn at each position (P, K, 3)
    sample_participants: np.ndarray  # Their participants (P, K)
    other_directions: np.ndarray  # Directions of rays drawn at other positions (P, K, 3)
    own_origins: np.ndarray  # Origins (n, 3) of rays near the positions, which are scored there
    own_directions: np.ndarray  # Their directions (n, 1, 3)
    own_participants: np.ndarray  # Their participants (n,)
    kappa: float | None = None  # Concentration of the kernels of the truth, which smooth a map; None: no smoothing

    def smooth(self, maps: np.ndarray) -> np.ndarray:
        """Return densities (P, D) in the directions of the test, smoothed with the kernel of the truth."""
        if self.kappa is None:
            return maps
        kde = SphericalKde(self.directions, np.arange(len(self.directions) + 1), self.kappa)
        parts = []
        for start in range(0, len(self.directions), _SMOOTHED_DIRECTIONS):
            # Double precision, so that a constant map remains constant.
            kernel = kde.evaluate(self.directions[start : start + _SMOOTHED_DIRECTIONS]).astype(np.float64)
            parts.append(maps @ (kernel / kernel.sum(axis=0)))
        return np.concatenate(parts, axis=1)

    @cached_property
    def query_directions(self) -> np.ndarray:
        """Directions (P, 2 K, 3) at which methods are evaluated: rays of each position, then rays of other
        positions."""
        return np.concatenate([self.sample_directions, self.other_directions], axis=1)


def select_held_out_rays(
    rays: Rays, holdout: dict, split: str = "both", seed: int = 0
) -> tuple[Rays, Rays, np.ndarray]:
    """Select training and test rays according to the ``holdout`` description of a checkpoint
    (``train.gaze_folds.hold_out``).

    Parameters
    ----------
    rays : Rays
        All rays.
    holdout : dict
        Description of the held-out data.
    split : str
        ``both``: held-out participants at held-out positions; ``pos``: training participants at held-out positions;
        ``people``: held-out participants at training positions.
    seed : int
        Seed of the test positions of ``people``.

    Returns
    -------
    train, test : Rays
        Training and test rays.
    centres : numpy.ndarray
        Test positions (T, 3).

    Raises
    ------
    NergError
        If the split needs held-out participants and there are none.
    """
    if split not in SPLITS:
        raise NergError(f'the split must be one of {", ".join(SPLITS)}, got "{split}"')
    centres, is_held_out = np.array(holdout["centres"]), np.zeros(len(rays), bool)
    if holdout.get("people"):
        is_held_out = split_by_person(rays, test_persons=holdout["people"])[1]
    elif split != "pos":
        raise NergError(
            f'this training held out no participants, so the split "{split}" is empty; train with '
            f"{parameter('test_participants')}"
        )
    is_far = purge(rays, centres, holdout["purged_within"])
    train = rays.select(~is_held_out & is_far)
    if split == "people":
        scored = rays.select(is_held_out & is_far)
        return train, scored, scored.origin[np.random.default_rng(seed).permutation(len(scored))[: len(centres)]]
    return train, rays.select(is_held_out if split == "both" else ~is_held_out), centres


# Memory limit of an evaluation: maps of each participant in single precision, and of a dozen methods in double.
_BYTES_PER_METHOD, _MAX_BYTES = 100, 2e9


def make_test(
    rays: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float = 20.0,
    directions: int = 2048,
    min_rays: int = 64,
    max_rays: int = 1024,
    seed: int = 0,
) -> GazeTest:
    """Make the test data at the ``centres`` with at least ``min_rays`` rays within ``radius`` metres.

    Parameters
    ----------
    rays : Rays
        Test rays.
    centres : numpy.ndarray
        Positions (T, 3).
    radius : float
        Probe radius in metres.
    kappa : float
        Concentration of the kernels of the truth.
    directions : int
        Number of directions in which maps are compared.
    min_rays, max_rays : int
        Minimum number of rays of a position, and maximum number of (nearest) rays that define its truth.
    seed : int
        Seed of the drawn rays.

    Raises
    ------
    NergError
        If no position has enough rays, or the maps exceed the memory limit.
    """
    has_enough = _has_enough_rays(rays, centres, radius, min_rays)
    if not has_enough.any():
        raise NergError(
            f"none of {len(centres)} test positions has {min_rays} rays within {radius} m; reduce "
            f"{parameter('min_rays')}"
        )
    probes = place_probes(
        rays,
        radius,
        queries=centres[has_enough],
        max_rays=max_rays,
        min_rays=1,
        kappa_rule="fixed",
        kappa=kappa,
        centre="query",
    )
    d, rng = fibonacci_directions(directions), np.random.default_rng(seed)
    person = rays.person[probes.indices]
    present = np.unique(person)
    P, N = len(probes), len(present)
    if (size := P * directions * (4 * N + _BYTES_PER_METHOD)) > _MAX_BYTES:
        raise NergError(
            f"maps of {directions:,} directions at {P} positions for {N} participants need {size / 1e9:.0f} GB; "
            f"use fewer {parameter('directions')} (a few thousand are enough)"
        )
    participant_densities, counts = np.zeros((P, N, directions), np.float32), np.zeros((P, N))
    probe = np.repeat(np.arange(P), probes.counts)
    # The rays of one participant at one position form a mixture.
    order = np.lexsort((person, probe))
    pair = np.stack([probe[order], np.searchsorted(present, person[order])], axis=1)
    runs, first = np.unique(pair, axis=0, return_index=True)
    kde = SphericalKde(probes.directions[order], np.append(first, len(order)), kappa)
    participant_densities[runs[:, 0], runs[:, 1]] = kde.evaluate(d)
    counts[runs[:, 0], runs[:, 1]] = np.diff(np.append(first, len(order)))
    drawn_rays = np.stack(
        [rng.integers(a, b, _RAYS_PER_POSITION) for a, b in zip(probes.offsets[:-1], probes.offsets[1:])]
    )
    sample_directions = probes.directions[drawn_rays]
    # Take rays from positions farther than 2R away if possible, so that no ray is on both sides.
    distance = np.linalg.norm(probes.queries[:, None] - probes.queries[None], axis=2)
    far = [
        np.flatnonzero(row > 2 * radius) if (row > 2 * radius).any() else np.flatnonzero(row > 0) for row in distance
    ]
    other_directions = np.stack(
        [
            sample_directions[
                rng.choice(f, _RAYS_PER_POSITION), rng.integers(0, _RAYS_PER_POSITION, _RAYS_PER_POSITION)
            ]
            if len(f)
            else sample_directions[i]
            for i, f in enumerate(far)
        ]
    )
    truth = np.einsum("pn,pnd->pd", counts / counts.sum(axis=1, keepdims=True), participant_densities)
    near = rays.select(~purge(rays, centres[has_enough], radius) & np.isin(rays.person, present))
    drawn = sample_participants_equally(near, _MAX_OWN_RAYS, seed)
    names = tuple(rays.persons[i] for i in present)
    return GazeTest(
        centres[has_enough],
        d,
        truth,
        participant_densities,
        counts,
        names,
        sample_directions,
        np.searchsorted(present, person[drawn_rays]),
        other_directions,
        drawn.origin,
        drawn.direction[:, None],
        np.searchsorted(present, drawn.person),
        kappa,
    )


def _has_enough_rays(rays: Rays, centres: np.ndarray, radius: float, min_rays: int) -> np.ndarray:
    """Return which of ``centres`` (P,) have at least ``min_rays`` rays within ``radius`` metres."""
    from scipy.spatial import KDTree

    return KDTree(rays.origin).query_ball_point(centres, radius, return_length=True) >= min_rays


def score_methods(
    test: GazeTest,
    methods: dict[str, Baseline],
    prior: Baseline,
    resamples: int = 200,
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
) -> list[dict]:
    """Score methods on test data, with bootstrap confidence intervals.

    Parameters
    ----------
    test : GazeTest
        Test data.
    methods : dict of str to Baseline
        Methods by name. The first is compared with each of the others.
    prior : Baseline
        Reference density of the information gain.
    resamples : int
        Number of bootstrap resamples of the participants. With fewer than three participants there are no intervals.
    seed : int
        Seed of the bootstrap.
    on_progress : callable, optional
        Called with the completed fraction.

    Returns
    -------
    list of dict
        A row per method with the scores of ``SCORES``, each with the ends ``.low`` and ``.high`` of its 95 % confidence
        interval, and the integral. The first row also has ``.less``, its difference to the last method; each other row
        has ``.gap``, the difference of the first method to it. Both have intervals.

    Notes
    -----
    An interval is ± 1.96 standard errors of the bootstrap. Quantiles are not used, because the truth of a resample has
    fewer participants and narrower peaks, which lowers every score. All methods share the same resamples. A resample in
    which no ray is scored does not count.
    """
    rng, N = np.random.default_rng(seed), len(test.participants)
    report = on_progress or (lambda share: None)
    evaluated = _evaluate_methods(test, methods, prior, lambda share: report(_EVALUATION_FRACTION * share))
    rows = [{"method": m.name, **compute_map_scores(test.truth, m.maps), **m.average_rays()} for m in evaluated]
    times = rng.multinomial(N, np.full(N, 1 / N), resamples if N >= 3 else 0)
    report_resampled = lambda share: report(_EVALUATION_FRACTION + (1 - _EVALUATION_FRACTION) * share)
    bootstrap = _resample_scores(test, evaluated, times, report_resampled)
    for row, resampled, m in zip(rows, bootstrap, evaluated):
        for k in SCORES if len(times) else ():
            half_width = _measure_half_width(resampled[k])
            row[f"{k}.low"], row[f"{k}.high"] = float(row[k] - half_width), float(row[k] + half_width)
        row["integral"] = float(4 * np.pi * m.maps.mean())
    for other, resampled in zip(rows[1:], bootstrap[1:]):
        for k in SCORES:
            other |= _make_difference(f"{k}.gap", rows[0][k] - other[k], bootstrap[0][k] - resampled[k])
    if len(rows) > 1:
        for k in SCORES:
            rows[0] |= {key.replace(".gap", ".less"): v for key, v in rows[-1].items() if key.startswith(f"{k}.gap")}
    return rows


def _resample_scores(
    test: GazeTest, evaluated: list[_EvaluatedMethod], times: np.ndarray, on_progress: Callable[[float], None]
) -> list[dict[str, np.ndarray]]:
    """Return the scores (R,) of each method, by name, in R resamples with ``times`` (R, N) of each participant.

    Positions come one after the other, because all methods and resamples there share the normalisation of maps.
    """
    maps = np.stack([m.maps for m in evaluated], axis=1)
    sums, counts = {k: np.zeros((len(times), len(evaluated))) for k in MAP_SCORES}, np.zeros((len(times), 1))
    size = max(1, _RESAMPLED_VALUES // maps[0].size)
    for p in range(len(maps) if len(times) else 0):
        on_progress(p / len(maps))
        densities, share = test.participant_densities[p].astype(np.float64), test.counts[p] * times
        has_rays = np.flatnonzero(share.any(axis=1))
        counts[has_rays] += 1
        for start in range(0, len(has_rays), size):
            rows = has_rays[start : start + size]
            truth = (share[rows] / share[rows].sum(axis=1, keepdims=True)) @ densities
            for k, values in _score_maps(truth[:, None], maps[p]).items():
                sums[k][rows] += values
    means = {k: _divide(total, counts) for k, total in sums.items()}
    return [{**{k: v[:, i] for k, v in means.items()}, **m.resample_rays(test, times)} for i, m in enumerate(evaluated)]


def _divide(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return means; not a number where nothing counts."""
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)


def _make_difference(name: str, value: float, resampled: np.ndarray) -> dict[str, float]:
    """Return ``value`` under ``name`` and, if ``resampled``, the ends of its 95 % confidence interval."""
    if not len(resampled):
        return {name: value}
    half_width = _measure_half_width(resampled)
    return {name: value, f"{name}.low": float(value - half_width), f"{name}.high": float(value + half_width)}


def _measure_half_width(resampled: np.ndarray) -> float:
    """Return half the width of the 95 % confidence interval; NaN if the score is not defined."""
    defined = resampled[~np.isnan(resampled)]
    return 1.96 * float(defined.std()) if defined.size else float("nan")


class _EvaluatedMethod(NamedTuple):
    """A method's smoothed maps (P, D), its scores of rays (P, K) by name, and those at own origins (n,) by name."""

    name: str
    maps: np.ndarray
    rays: dict[str, np.ndarray]
    own_rays: dict[str, np.ndarray]

    def average_rays(self) -> dict[str, float]:
        """Return the mean of each score of rays."""
        return {k: _average(v) for k, v in {**self.rays, **self.own_rays}.items()}

    def resample_rays(self, test: GazeTest, times: np.ndarray) -> dict[str, np.ndarray]:
        """Return the mean (R,) of each score of rays in R resamples with ``times`` (R, N) of each participant."""
        out, num_participants = {}, times.shape[1]
        for scores, who in ((self.rays, test.sample_participants), (self.own_rays, test.own_participants)):
            count = times @ np.bincount(who.ravel(), minlength=num_participants)
            for k, values in scores.items():
                out[k] = _divide(times @ np.bincount(who.ravel(), values.ravel(), num_participants), count)
        return out


def _average(values: np.ndarray) -> float:
    """Return the mean of ``values``; not a number if there are none."""
    return float(values.mean()) if values.size else float("nan")


def _evaluate_methods(
    test: GazeTest, methods: dict[str, Baseline], prior: Baseline, on_progress: Callable[[float], None] | None = None
) -> list[_EvaluatedMethod]:
    """Evaluate each method; ``on_progress`` is called with the completed fraction."""
    K = test.sample_directions.shape[1]

    def evaluate(method: Baseline) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        maps, at = (np.asarray(method(test.centres, v), np.float64) for v in (test.directions, test.query_directions))
        at_own = np.empty(0)
        if len(test.own_origins):
            at_own = np.asarray(method(test.own_origins, test.own_directions), np.float64)[:, 0]
        return maps, at, np.log(np.maximum(at_own, 0) + np.finfo(float).eps)

    maps, at_prior, log_own_prior = evaluate(prior)
    log_prior, out = _log_density(at_prior[:, :K], maps), []
    for name, method in methods.items():
        maps, at, log_own = evaluate(method)
        values = compute_ray_scores(maps, at, at_prior, log_prior)
        out.append(_EvaluatedMethod(name, maps, values, {OWN_SCORES[0]: (log_own - log_own_prior) / np.log(2)}))
        if on_progress is not None:
            on_progress(len(out) / len(methods))
    # Together, because the kernels take more time than the sums.
    smooth = np.split(test.smooth(np.concatenate([m.maps for m in out])), len(out))
    return [m._replace(maps=maps) for m, maps in zip(out, smooth)]


def score_participants(test: GazeTest, methods: dict[str, Baseline], prior: Baseline, min_rays: int = 64) -> list[dict]:
    """Score each method on each participant: ray scores, and map scores at positions with ``min_rays`` rays of the
    participant.
    """
    rows = []
    for method in _evaluate_methods(test, methods, prior):
        for i, person in enumerate(test.participants):
            has_enough = test.counts[:, i] >= min_rays
            scores = dict.fromkeys(MAP_SCORES, float("nan"))
            if has_enough.any():
                scores = compute_map_scores(test.participant_densities[has_enough, i], method.maps[has_enough])
            at_centre, at_own = (which == i for which in (test.sample_participants, test.own_participants))
            averages = {k: _average(v[at_centre]) for k, v in method.rays.items()}
            averages |= {k: _average(v[at_own]) for k, v in method.own_rays.items()}
            row = {"method": method.name, "person": person, "rays": int(test.counts[:, i].sum())}
            rows.append({**row, **scores, **averages})
    return rows


SPLIT_HALF = "split half"
"""Method of the row of `score_split_half`, a reference and no baseline."""

MIN_HALF_PARTICIPANTS = 5
"""Minimum number of participants of each half."""


def score_split_half(
    test_rays: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float,
    prior: Baseline,
    min_rays: int = 64,
    seed: int = 0,
    resamples: int = 200,
) -> tuple[dict | None, str]:
    """Score one half of the participants as predicted by the other half, at positions where both have ``min_rays``
    rays.

    This is a reference, not an upper bound. It is left out if its own score is not above that of the prior, so that the
    references that are shown are a little too good.

    Returns
    -------
    row : dict or None
        The scores; None if they are noise.
    note : str
        Why they are, see `find_split_half_fault`; "" with a row.
    """
    if len(np.unique(test_rays.person)) < 2:
        return None, "there is only one participant"
    halves = [test_rays.select(mask) for mask in split_by_person(test_rays, seed=seed)]
    has_both = np.logical_and(*(_has_enough_rays(half, centres, radius, min_rays) for half in halves))
    if not has_both.any():
        return None, f"at no position do both halves have {min_rays} rays"
    # The prediction is a kernel density of the same concentration, so it is as smooth as the truth.
    first = replace(make_test(halves[0], centres[has_both], radius, kappa, min_rays=min_rays), kappa=None)
    probes = place_probes(
        halves[1], radius, queries=first.centres, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query"
    )
    # The probes are at the centres of the positions, so nothing is predicted at other origins.
    first = replace(
        first, own_origins=np.empty((0, 3)), own_directions=np.empty((0, 1, 3)), own_participants=np.empty(0, int)
    )
    participants = min(len(first.participants), len(np.unique(halves[1].person[probes.indices])))
    predicted = lambda positions, directions: probes.density(directions)
    row = score_methods(first, {SPLIT_HALF: predicted}, prior, resamples, seed)[0]
    note = find_split_half_fault(participants, row[HEADLINE], row.get(f"{HEADLINE}.low", math.nan))
    return (None if note else {k: v for k, v in row.items() if "." not in k}), note


def find_split_half_fault(participants: int, bits: float, low: float = math.nan) -> str:
    """Return why the scores of a split half are noise; "" if they are a reference.

    Parameters
    ----------
    participants : int
        Number of participants of the smaller half.
    bits : float
        Information gain over the position-independent prior.
    low : float
        Lower end of its confidence interval over participants; NaN if unknown.
    """
    if participants < MIN_HALF_PARTICIPANTS:
        return f"the smaller half has fewer than {MIN_HALF_PARTICIPANTS} participants: {participants}"
    if not (bits if math.isnan(low) else low) > 0:
        return f"its information gain over the prior, {bits:.2f} bits, does not exceed 0 with 95 % confidence"
    return ""


def compute_map_scores(truth: np.ndarray, maps: np.ndarray) -> dict[str, float]:
    """Return the means over positions of ``MAP_SCORES``."""
    return {k: float(values.mean()) for k, values in _score_maps(truth, maps).items()}


def _score_maps(truth: np.ndarray, maps: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``MAP_SCORES`` of densities (..., D), whose leading axes are broadcast."""
    return {
        "KLD": metrics.kld(truth, maps, eps=EPS),
        "CC": metrics.cc(truth, maps),
        "SIM": metrics.sim(truth, maps),
        "MAE": metrics.mae(truth, maps),
    }


def compute_ray_scores(
    maps: np.ndarray, densities: np.ndarray, prior_densities: np.ndarray, log_prior: np.ndarray
) -> dict[str, np.ndarray]:
    """Compute ``RAY_SCORES`` of each ray (P, K).

    Parameters
    ----------
    maps : numpy.ndarray
        Densities (P, D) over the sphere.
    densities : numpy.ndarray
        Densities (P, K + M) at the rays and at M rays of other positions.
    prior_densities : numpy.ndarray
        Densities (P, K + M) of the position-independent prior at the same rays.
    log_prior : numpy.ndarray
        Log of the reference density (P, K) at the rays.

    Notes
    -----
    The AUC of a ray is the fraction of the sphere with a lower density, counting ties half. Its mean is AUC-Judd with a
    threshold at each value. sAUC compares the ratio of the density to the prior, which is the map with the largest
    expected sAUC (`nerg_mi.evaluation.saliency`).
    """
    K = log_prior.shape[1]
    at_rays, log = densities[:, :K], _log_density(densities[:, :K], maps)
    ratio = densities / np.maximum(prior_densities, metrics.EPS)
    below = lambda values, among: np.stack([metrics.auc(v, a) for v, a in zip(values, among)])
    return {
        "NSS": metrics.nss(maps, at_rays),
        "AUC": below(at_rays, maps),
        "sAUC": below(ratio[:, :K], ratio[:, K:]),
        "bits": (log - log_prior) / np.log(2),
        "loglik": log,
    }


def _log_density(sample_densities: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Return the log of densities at rays, normalised over the sphere; non-positive values count as the smallest
    float."""
    sphere = 4 * np.pi * np.maximum(maps, 0).mean(axis=1, keepdims=True)
    return np.log(np.maximum(sample_densities, 0) / np.where(sphere > 0, sphere, 1) + np.finfo(float).eps)
