"""Splits of rays into training and test that share no ray.

Neighbouring probes hold the same rays: a random choice of test probes is tested
on what it was trained on. So positions are held out in zones, with every ray
within reach of a test probe purged, and people are held out whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

from .index import RayIndex
from .rays import Rays


@dataclass(frozen=True, eq=False)
class PositionSplit:
    """Rays split by position; those on neither side were purged."""

    train: np.ndarray  # (N,) bool: farther than 2R from every test centre
    test: np.ndarray  # (N,) bool: within R of one
    test_centres: np.ndarray  # (T, 3) metres
    zone_centres: np.ndarray  # (Z, 3) metres
    zone: np.ndarray  # (T,) the zone of each test centre

    @property
    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks (N,) of training and test rays."""
        return self.train, self.test

    @property
    def purged(self) -> np.ndarray:
        """Rays used on neither side, (N,) bool."""
        return ~(self.train | self.test)


def split_by_position(
    rays: Rays,
    radius: float,
    *,
    zones: int = 3,
    zone_radius: float = 0.2,
    test_probes: int = 150,
    min_rays: int = 64,
    min_train: int | None = None,
    seed: int = 0,
) -> PositionSplit:
    """Hold out zones of positions for probes of ``radius`` R (metres).

    Zones are vertical cylinders of ``zone_radius`` metres around ray origins,
    chosen far from each other; the test centres are up to ``test_probes`` ray
    origins inside them with at least ``min_rays`` rays within R. Training rays
    lie farther than 2R from each test centre, so that no probe of radius R on
    the training side comes within R of a test centre. A few zones purge far
    less than scattered centres would. ``min_train``: training rays that are left at least (``min_rays``). The same seed
    gives the same split.

    Raises `NergError` when the rays hold no such zone or too little is left.
    """
    if zones < 1 or not radius > 0 or not zone_radius > 0:
        raise NergError(f"zones {zones}, radius {radius}, zone_radius {zone_radius}: all must be positive")
    rng = np.random.default_rng(seed)
    index = RayIndex(rays)

    # Farthest-point choice among random origins, which follow where people are;
    # candidates with too few rays around are no use as a test.
    candidates = rays.origin[rng.permutation(len(rays))[:256]]
    candidates = candidates[_enough(index, candidates, radius, min_rays)]
    if len(candidates) < zones:
        raise NergError(
            f"only {len(candidates)} of 256 positions have {min_rays} rays within {radius} m; "
            "enlarge the radius or lower min_rays"
        )
    chosen = [0]
    while len(chosen) < zones:
        apart = np.linalg.norm(candidates[:, None, :2] - candidates[chosen][None, :, :2], axis=2).min(axis=1)
        # Among the far half at random: always the farthest would be the corners.
        order = np.argsort(-apart)
        chosen.append(int(rng.choice(order[: max(1, len(order) // 4)])))
    zone_centres = candidates[chosen]

    centres, zone = [], []
    for z, centre in enumerate(zone_centres):
        found = rng.permutation(np.flatnonzero(((rays.origin[:, :2] - centre[:2]) ** 2).sum(axis=1) <= zone_radius**2))
        # A few times as many as are wanted will do; of millions of rays not each can be asked.
        found = found[: 16 * test_probes]
        enough = found[_enough(index, rays.origin[found], radius, min_rays)]
        share = test_probes // zones + (z < test_probes % zones)
        centres.append(rays.origin[enough[:share]])
        zone.append(np.full(len(centres[-1]), z))
    test_centres, zone = np.concatenate(centres), np.concatenate(zone)

    near = _distance_to(test_centres, rays.origin)
    train = near > 2.0 * radius
    if train.sum() < (min_rays if min_train is None else min_train):
        raise NergError(f"{train.sum()} rays are left to train on; choose fewer or smaller zones, or a smaller radius")
    return PositionSplit(train, near <= radius, test_centres, zone_centres, zone)


def purge(rays: Rays, centres: np.ndarray, distance: float) -> np.ndarray:
    """Rays whose origins are farther than ``distance`` metres from every one of
    ``centres`` (T, 3): the mask (N,) of what may be trained on."""
    return _distance_to(np.asarray(centres, dtype=np.float64).reshape(-1, 3), rays.origin) > distance


def split_by_person(
    rays: Rays, *, test_share: float = 0.5, test_persons: Sequence[str] | None = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out people: masks (N,) of training and test rays.

    ``test_persons`` by name, or a random ``test_share`` of those who have rays,
    at least one on each side. Raises `NergError` for an unknown name or when
    a side is empty.
    """
    present = np.unique(rays.person)
    if test_persons is not None:
        unknown = [p for p in test_persons if p not in rays.persons]
        if unknown:
            raise NergError(
                f"no person is called {', '.join(map(repr, unknown))}; the persons are {', '.join(rays.persons)}"
            )
        held = np.array([rays.persons.index(p) for p in test_persons])
    else:
        count = int(np.clip(round(test_share * len(present)), 1, max(1, len(present) - 1)))
        held = np.random.default_rng(seed).permutation(present)[:count]
    test = np.isin(rays.person, held)
    if test.all() or not test.any():
        raise NergError(f"{len(present)} persons cannot be split into training and test; give rays of at least two")
    return ~test, test


def split_by_time(
    rays: Rays, *, test_share: float = 0.2, gap: float = 5.0, of: str = "all"
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out the end: masks (N,) of training and test rays.

    Test is the last ``test_share`` of the time from the first ray to the last one, training what lies more than ``gap``
    seconds before it; rays between are on neither side, since gaze repeats itself for seconds. ``of``: ``all``, one cut
    for all (a day of a shop), or ``person``, each person's own time (recordings with clocks of their own). Raises
    `NergError` when a side is empty.
    """
    if of not in ("all", "person") or not 0 < test_share < 1 or not gap >= 0:
        raise NergError(
            'a split by time needs the clock "all" or "person", a share between 0 and 1 and a gap of 0 s or more, '
            f'got "{of}", {test_share} and {gap}'
        )
    group = np.zeros(len(rays), np.int64) if of == "all" else rays.person
    first, last = np.full(group.max(initial=0) + 1, np.inf), np.full(group.max(initial=0) + 1, -np.inf)
    np.minimum.at(first, group, rays.t)
    np.maximum.at(last, group, rays.t)
    cut = (last - test_share * (last - first))[group]
    train, test = rays.t < cut - gap, rays.t >= cut
    if not train.any() or not test.any():
        raise NergError(
            f"{train.sum()} rays are left to train on and {test.sum()} to test; choose a smaller gap or another share"
        )
    return train, test


def combine(*sides: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Masks (N,) of training and test rays of several splits at once.

    Training rays are those of every training side, test rays those of every test side (unseen people at unseen places,
    say). What is on the training side of one and the test side of another is used on neither.

    Raises `NergError` when a side is empty.
    """
    if not sides:
        raise ValueError("say how to split: by position, person or time")
    train, test = (np.logical_and.reduce(side) for side in zip(*sides))
    if not train.any() or not test.any():
        raise NergError(
            f"together the splits leave {train.sum()} rays to train on and {test.sum()} to test; "
            "hold out more of one of them"
        )
    return train, test


def position_of_split(rays: Rays) -> dict[str, Any]:
    """How ``rays``, one side of a split by position, were parted: ``test_centres`` (lists of 3), ``radius`` and so on,
    as their metadata tell; empty where they do not."""
    for step in rays.metadata.get("steps", []):
        if step["step"] == "split" and isinstance(step.get("by"), dict):
            return step["by"].get("position", {})
    return {}


def _enough(index: RayIndex, places: np.ndarray, radius: float, least: int) -> np.ndarray:
    """Which places have at least ``least`` rays within ``radius``: no need to count the others."""
    return np.diff(index.nearest(places, least, radius).offsets) >= least


def _distance_to(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import KDTree

    return KDTree(centres).query(points)[0]
