"""Cross-validation folds over participants and positions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError

from .filters import purge, split_by_position
from .rays import Rays

# Zones, positions in all zones and minimum rays per position that a fold holds out
_NUM_ZONES, _NUM_POSITIONS, _MIN_RAYS = 3, 48, 16


class Fold(NamedTuple):
    """Training rays of a fold, and the rays that it holds out."""

    train: Rays
    held_out: Rays


def iter_folds(
    rays: Rays, radius: float, count: int, seed: int = 0, *, participants: bool = True, positions: bool = True
) -> Iterator[Fold]:
    """Yield folds that hold out a group of participants, some positions, or both.

    Parameters
    ----------
    rays : Rays
        Rays; lengths in metres.
    radius : float
        Radius of a position. Training rays lie farther than 2 ``radius`` from the held-out positions, held-out rays
        within ``radius``.
    count : int
        Number of folds, at most the number of participants if these are held out.
    seed : int
        Seed of the groups and of the positions.
    participants, positions : bool
        What is held out. With one participant, positions are always held out.

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
        held_out = rays.select(is_held_out)
        is_training = ~is_held_out if participants else np.ones(len(rays), bool)
        if positions or not participants:
            try:
                # The other participants provide the training rays, so no minimum applies to those who hardly moved.
                split = split_by_position(
                    held_out,
                    radius,
                    zones=_NUM_ZONES,
                    test_probes=_NUM_POSITIONS,
                    min_rays=_MIN_RAYS,
                    min_train=0,
                    seed=1000 * seed + k,
                )
            except NergError:
                # These participants have no zones with enough rays.
                continue
            is_training &= purge(rays, split.test_centres, 2 * radius)
            held_out = held_out.select(~purge(held_out, split.test_centres, radius))
        if is_training.any() and len(held_out):
            yield Fold(rays.select(is_training), held_out)


def sample_participants_equally(rays: Rays, count: int, seed: int = 0) -> Rays:
    """Return at most ``count`` of ``rays``, drawn without replacement, with equal weight for each participant."""
    # The order of exponential variates over weights is that of draws without replacement (Efraimidis, Spirakis 2006).
    weights = 1.0 / np.bincount(rays.person)[rays.person]
    keys = np.random.default_rng(seed).exponential(size=len(rays)) / weights
    return rays.select(np.sort(np.argsort(keys)[:count]))
