"""Cross-validation folds over participants and positions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .filters import purge
from .rays import Rays

# Zones of positions that a fold holds out, and the fraction of the other participants' rays that they contain
_NUM_ZONES, _ZONE_FRACTION = 3, 0.25
_MIN_RAYS = 16  # Minimum numbers of training rays and of held-out rays of a fold
NEW_POSITION_DISTANCE = 0.25
"""Distance in metres from every training position beyond which a position is new."""


class Fold(NamedTuple):
    """Training rays of a fold, and the rays that it holds out."""

    train: Rays
    held_out: Rays
    is_new_position: np.ndarray  # Whether the origin of each held-out ray is far from every training ray (n,)
    train_fraction: float  # Fraction of all rays that are training rays

    def sample(self, count: int, seed: int = 0) -> Rays:
        """Return at most ``count`` held-out rays, drawn with equal weight for each participant. Half of them are at new
        positions, if there are both kinds."""
        kinds = [
            rows for rows in (np.flatnonzero(self.is_new_position == value) for value in (False, True)) if len(rows)
        ]
        drawn = [rows[_draw_equally(self.held_out.person[rows], count // len(kinds), seed)] for rows in kinds]
        return self.held_out.select(np.sort(np.concatenate(drawn)))


def iter_folds(
    rays: Rays, radius: float, count: int, seed: int = 0, *, participants: bool = True, positions: bool = True
) -> Iterator[Fold]:
    """Yield folds that hold out a group of participants, zones of positions, or both.

    Participants are held out with all their rays, in the zones and outside. The training rays in the zones, at most a
    quarter of those of the other participants, are removed, so that some of the held-out rays are at new positions.

    Parameters
    ----------
    rays : Rays
        Rays; lengths in metres.
    radius : float
        Distance from every training ray beyond which a position is new.
    count : int
        Number of folds, at most the number of participants if these are held out.
    seed : int
        Seed of the groups and of the positions.
    participants, positions : bool
        What is held out. With one participant, positions are always held out. If only positions are held out, all
        held-out rays are at new positions.

    Yields
    ------
    Fold
        Folds without enough rays are skipped.
    """
    names = np.random.default_rng(seed + 7).permutation(np.unique(rays.person))
    participants &= len(names) > 1
    groups = np.array_split(names, min(count, len(names))) if participants else [names] * count
    for k, group in enumerate(groups):
        is_held_out = np.isin(rays.person, group)
        is_training = ~is_held_out if participants else np.ones(len(rays), bool)
        # A single fold holds out everybody.
        if is_training.any() and (positions or not participants):
            is_training &= ~_find_zones(rays.origin, is_held_out, is_training, radius, 1000 * seed + k)
        if is_training.sum() < _MIN_RAYS:
            continue
        train = rays.select(is_training)
        is_new = is_held_out & purge(rays, train.origin, radius)
        is_test = is_held_out if participants else is_new
        if is_test.sum() >= _MIN_RAYS:
            yield Fold(train, rays.select(is_test), is_new[is_test], float(is_training.mean()))


def _find_zones(
    origins: np.ndarray, is_held_out: np.ndarray, is_training: np.ndarray, radius: float, seed: int
) -> np.ndarray:
    """Return whether each of ``origins`` (N, 3) is in one of the zones around held-out positions.

    The centres are origins of held-out rays: zones where few participants stood would be large, and far from all
    others. Zones that are too small to contain a new position are not made.
    """
    from scipy.spatial import KDTree

    centres = np.random.default_rng(seed).permutation(np.flatnonzero(is_held_out))[:_NUM_ZONES]
    distance = KDTree(origins[centres]).query(origins)[0]
    size = np.quantile(distance[is_training], _ZONE_FRACTION, method="lower")
    return distance < size if size > radius else np.zeros(len(origins), bool)


def sample_participants_equally(rays: Rays, count: int, seed: int = 0) -> Rays:
    """Return at most ``count`` of ``rays``, drawn without replacement, with equal weight for each participant."""
    return rays.select(np.sort(_draw_equally(rays.person, count, seed)))


def _draw_equally(person: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Draw at most ``count`` indices of rays of ``person`` (n,) with equal weight for each participant."""
    # The order of exponential variates over weights is that of draws without replacement (Efraimidis, Spirakis 2006).
    weights = 1.0 / np.bincount(person)[person]
    keys = np.random.default_rng(seed).exponential(size=len(person)) / weights
    return np.argsort(keys)[:count]
