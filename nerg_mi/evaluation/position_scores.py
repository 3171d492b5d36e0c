"""Scores of a gaze field where training participants stood and where none did, each against the best baseline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import t as student

from nerg_mi.tracking.folds import NEW_POSITION_DISTANCE, sample_participants_equally
from nerg_mi.tracking.probes import compute_region_levels
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import make_rotated_directions

from .baselines import PRIOR, Baseline, TunedBaseline

RECORDED, AWAY = "recorded positions", "new positions"
"""Kinds of positions: up to `NEW_POSITION_DISTANCE` from the nearest training ray, and farther away from all."""
_MAX_RAYS = 256  # Rays of each kind, with about as many of each participant
# The same for the levels of regions, and directions around each ray, because all of them are evaluated
_MAX_REGION_RAYS, _NUM_DIRECTIONS = 128, 512


def iter_kinds(train: Rays, held_out: Rays, count: int, seed: int = 0) -> Iterator[tuple[str, Rays]]:
    """Yield each kind of positions with rays, and at most ``count`` of the ``held_out`` rays there."""
    is_new = KDTree(train.origin).query(held_out.origin)[0] > NEW_POSITION_DISTANCE
    for kind, mask in ((RECORDED, ~is_new), (AWAY, is_new)):
        if mask.any():
            yield kind, sample_participants_equally(held_out.select(mask), count, seed)


def iter_region_levels(
    train: Rays, held_out: Rays, evaluate_rays: Callable[..., np.ndarray], seed: int = 0
) -> Iterator[tuple[str, np.ndarray, Rays]]:
    """Yield each kind of positions, the levels of the highest-density regions that contain rays there (n,), each for an
    observer at its own origin, and the rays. ``evaluate_rays`` is that of `gaze.FieldDensity`."""
    for kind, rays in iter_kinds(train, held_out, _MAX_REGION_RAYS, seed):
        around = make_rotated_directions(_NUM_DIRECTIONS, len(rays), np.random.default_rng(seed))
        directions = np.concatenate([around, rays.direction[:, None]], axis=1)
        origins = np.repeat(rays.origin, directions.shape[1], axis=0)
        density = evaluate_rays(origins, directions.reshape(-1, 3)).reshape(len(rays), -1)
        yield kind, compute_region_levels(density[:, :-1], density[:, -1:])[:, 0], rays


def choose_tunings(
    tunings: Sequence[Mapping[str, TunedBaseline]], origins: np.ndarray, directions: np.ndarray, person: np.ndarray
) -> dict[str, TunedBaseline]:
    """Return each baseline with the settings that are best at the scored rays, so that no field is better only because
    the folds of a baseline differ from the test.

    Parameters
    ----------
    tunings : sequence of mapping
        The same baselines, by name, with settings of several kinds of folds.
    origins : numpy.ndarray
        Origins (n, 3) of the scored rays in metres.
    directions : numpy.ndarray
        Their unit directions (n, 1, 3).
    person : numpy.ndarray
        Indices (n,) of their participants, who have equal weights.
    """
    weights = 1 / np.bincount(person)[person]
    score = lambda baseline: weights @ _log_bits(baseline.density(origins, directions)[:, 0])
    return {name: max((tuning[name] for tuning in tunings), key=score) for name in tunings[0]}


def score_kinds(
    train: Rays, held_out: Rays, field: Baseline, tunings: Sequence[Mapping[str, TunedBaseline]], seed: int = 0
) -> list[dict[str, Any]]:
    """Score a field and baselines on ``held_out`` rays at both kinds of positions, each ray at its own origin.

    Parameters
    ----------
    train, held_out : Rays
        Training rays, and rays of others.
    field : Baseline
        Density of the gaze field.
    tunings : sequence of mapping
        Baselines, with `PRIOR` among them, with settings of several kinds of folds (`choose_tunings`).
    seed : int
        Seed of the drawn rays.

    Returns
    -------
    list of dict
        For each kind with rays, a row per method, the field first and then the baselines from the best on: bits above
        the prior, averaged over each participant's rays, and the ``bits.gap`` of the field to the baseline. Both have
        95 % intervals of Student's t over participants, if there are at least three.
    """
    rows = []
    for kind, rays in iter_kinds(train, held_out, _MAX_RAYS, seed):
        # The same arrays for all, so that baselines which share a density evaluate it once.
        at = rays.origin, rays.direction[:, None]
        baselines = {name: tuned.density for name, tuned in choose_tunings(tunings, *at, rays.person).items()}
        evaluate = lambda method, at=at: _log_bits(method(*at)[:, 0])
        prior = evaluate(baselines[PRIOR])
        gains = {name: evaluate(method) - prior for name, method in {"gaze field": field, **baselines}.items()}
        people = np.unique(rays.person)
        by_person = {name: np.array([gain[rays.person == p].mean() for p in people]) for name, gain in gains.items()}
        ordered = sorted(baselines, key=lambda name: -by_person[name].mean())
        for name in ("gaze field", *ordered):
            row = {"kind": kind, "method": name, "rays": len(rays), "people": len(people)}
            row |= _make_interval("bits", by_person[name])
            if name in baselines:
                row |= _make_interval("bits.gap", by_person["gaze field"] - by_person[name])
            rows.append(row)
    return rows


def find_best(rows: list[dict[str, Any]], kind: str) -> dict[str, Any] | None:
    """Return the row of the best baseline at a kind of positions; None if there is none."""
    return next((row for row in rows if row["kind"] == kind and "bits.gap" in row), None)


def format_verdicts(rows: list[dict[str, Any]]) -> list[str]:
    """Return a sentence for each kind of positions with rays."""
    lines = []
    for kind in (RECORDED, AWAY):
        if (best := find_best(rows, kind)) is not None:
            interval = (
                f" [{best['bits.gap.low']:+.3f}, {best['bits.gap.high']:+.3f}]"
                if "bits.gap.low" in best
                else " (no interval: fewer than 3 participants)"
            )
            lines.append(
                f"{kind} ({best['people']} participants): {best['bits.gap']:+.3f}{interval} bits per sample over the "
                f"best baseline, {best['method']}"
            )
    return lines


def _log_bits(density: np.ndarray) -> np.ndarray:
    return np.log2(np.maximum(np.asarray(density, np.float64), 0) + np.finfo(float).eps)


def _make_interval(name: str, values: np.ndarray) -> dict[str, float]:
    """Return the mean of ``values`` (N,) of N participants under ``name``, with the ends of its interval."""
    mean, count = float(values.mean()), len(values)
    if count < 3:
        return {name: mean}
    half_width = float(student.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count))
    return {name: mean, f"{name}.low": mean - half_width, f"{name}.high": mean + half_width}
