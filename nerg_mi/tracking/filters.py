"""Filters and splits of rays: selection by conditions, thinning, frozen gaze, recordings, and splits into training and
test rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.values import find_names, to_numbers

from .rays import RayIndex, Rays

# ---- Selection by time, participant, cohort, position and confidence, and thinning of stationary rays ----


def select_mask(
    rays: Rays,
    *,
    time: tuple[float | None, float | None] | None = None,
    persons: Sequence[str] | None = None,
    without_persons: Sequence[str] | None = None,
    cohorts: Sequence[str] | None = None,
    box: Sequence[float] | None = None,
    min_confidence: float | None = None,
    with_hit: bool = False,
) -> np.ndarray:
    """Mask (N,) bool of the rays that meet every given condition.

    Parameters
    ----------
    time
        Start (inclusive) and end (exclusive) in seconds; None for no limit.
    persons, without_persons, cohorts
        Names of participants to select or to exclude, and of cohorts to select.
    box
        x0, x1, y0, y1, z0, z1 in metres; the origin must be inside.
    min_confidence
        Minimum confidence.
    with_hit
        Whether a ray must have a hit point.

    Raises
    ------
    NergError
        For an unknown name or an invalid box.
    """
    keep = np.ones(len(rays), bool)
    if time is not None:
        start, end = time
        keep &= (rays.t >= (-np.inf if start is None else start)) & (rays.t < (np.inf if end is None else end))
    if persons is not None:
        keep &= np.isin(rays.person, find_names(persons, rays.persons, "person"))
    if without_persons is not None:
        keep &= ~np.isin(rays.person, find_names(without_persons, rays.persons, "person"))
    if cohorts is not None:
        if rays.cohort is None:
            raise NergError(
                f"these rays have no cohorts; import them with a cohort column ({parameter('columns', 'cohort=...')})"
            )
        keep &= np.isin(rays.cohort, find_names(cohorts, rays.cohorts, "cohort"))
    if box is not None:
        sides = to_numbers(box, "a box")
        if sides.shape != (6,) or not (sides[0::2] < sides[1::2]).all():
            raise NergError(
                f"a box needs x0, x1, y0, y1, z0, z1 in metres with x0 < x1, y0 < y1, z0 < z1, got {sides.tolist()}"
            )
        keep &= ((rays.origin >= sides[0::2]) & (rays.origin <= sides[1::2])).all(axis=1)
    if min_confidence is not None:
        keep &= rays.confidence >= min_confidence
    if with_hit:
        keep &= False if rays.hit is None else np.isfinite(rays.hit).all(axis=1)
    return keep


def argsort_by_person_time(rays: Rays) -> np.ndarray | None:
    """Order (N,) of the rays by participant and time; None if they are already in that order."""
    earlier = (rays.person[1:] < rays.person[:-1]) | (
        (rays.person[1:] == rays.person[:-1]) & (rays.t[1:] < rays.t[:-1])
    )
    return np.lexsort((rays.t, rays.person)) if earlier.any() else None


def group_by_person(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Order (N,) of the rays by participant and time, and the start of each participant in it, with N at the end."""
    order = np.lexsort((rays.t, rays.person))
    starts = np.flatnonzero(np.r_[True, np.diff(rays.person[order]) != 0])
    return order, np.r_[starts, len(rays)]


def label_stays(rays: Rays, distance: float = 0.1, gap: float = 1.0) -> np.ndarray:
    """Label each ray with the number of its stay, from 0, (N,) int64.

    A stay is a run of rays of one participant whose origins are within ``distance`` metres of the origin of its first
    ray, without a pause longer than ``gap`` seconds.
    """
    order, starts = group_by_person(rays)
    origin, t = rays.origin[order], rays.t[order]
    # A pause or another participant always ends a stay.
    new = np.r_[True, np.diff(t) > gap]
    new[starts[:-1]] = True
    bounds = np.r_[np.flatnonzero(new), len(t)]
    label = np.empty(len(t), np.int64)
    number = -1
    for a, b in zip(bounds[:-1], bounds[1:]):
        while a < b:
            number += 1
            end, step = a + 1, 64
            while end < b:
                away = np.flatnonzero(
                    ((origin[end : end + step] - origin[a]) ** 2).sum(axis=1)[: b - end] > distance**2
                )
                end = min(end + (int(away[0]) if away.size else step), b)
                if away.size:
                    break
                step *= 4
            label[a:end] = number
            a = end
    out = np.empty_like(label)
    out[order] = label
    return out


def thin_mask(rays: Rays, seconds: float = 2.0, distance: float = 0.1, gap: float = 1.0) -> np.ndarray:
    """Mask (N,) bool that thins stationary rays: keep at most ``seconds`` of each stay, evenly spread over it.

    Ten minutes of waiting at a counter then count as much as a stop of ``seconds`` there, and the distribution of gaze
    within the stay is preserved. Those of walking participants are unchanged. See `label_stays` for ``distance``
    (metres) and ``gap`` (seconds).
    """
    if not (seconds > 0 and distance > 0):
        raise NergError(f"seconds {seconds} and distance {distance} must be positive")
    label = label_stays(rays, distance, gap)
    order = np.lexsort((rays.t, label))
    counts = np.bincount(label)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    t = rays.t[order]
    duration = t[first + counts - 1] - t[first]
    fraction = np.minimum(1.0, seconds / np.maximum(duration, 1e-9))
    # Within a stay, keep rank r if r * fraction passes an integer.
    rank = np.arange(len(t)) - np.repeat(first, counts)
    ray_fraction = np.repeat(fraction, counts)
    is_kept = np.floor(rank * ray_fraction) != np.floor((rank - 1) * ray_fraction)
    out = np.empty(len(t), bool)
    out[order] = is_kept
    return out


# ---- Recordings: continuous runs of one participant, in storage order ----

MAX_PAUSE = 60.0  # seconds; a longer pause ends a recording
_MIN_CLOCK_RESET = 1.0  # seconds; a step back by more starts a recording, a smaller one is a misplaced row
_MIXED_LIMITS = 10, 0.01  # number and fraction of backward steps above which rays are not in recorded order


@dataclass(frozen=True, eq=False)
class Sessions:
    """S recordings, and an order of the rays in which each recording is contiguous."""

    order: np.ndarray | None  # (N,) indices of rays; None: the rays are in that order
    starts: np.ndarray  # (S + 1,) start of each recording in that order, with N at the end
    person: np.ndarray  # (S,) code of the participant
    is_clock_reset: np.ndarray  # (S,) bool: the recording starts because time went back

    def rows(self, part: slice) -> slice | np.ndarray:
        """Indices of the rays in a slice of the order."""
        return part if self.order is None else self.order[part]

    def label_rays(self) -> np.ndarray:
        """Number of the recording at each position of the order, (N,)."""
        return np.repeat(np.arange(len(self.person)), np.diff(self.starts))


def find_sessions(rays: Rays) -> Sessions:
    """Find the recordings of each participant: a new one starts when the clock goes back by more than a second, or
    after a pause longer than `MAX_PAUSE`.

    Rays are expected in the order of the import. If their order was changed since, so that time goes back repeatedly,
    they are sorted by time first.
    """
    person = rays.person
    order = np.argsort(person, kind="stable") if (person[1:] < person[:-1]).any() else None
    sorted_ = lambda values: values if order is None else values[order]
    other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    if np.count_nonzero(~other & (step < -_MIN_CLOCK_RESET)) > max(_MIXED_LIMITS[0], _MIXED_LIMITS[1] * len(rays)):
        order = argsort_by_person_time(rays)
        other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    back = ~other & (step < -_MIN_CLOCK_RESET)
    new = np.flatnonzero(other | back | (step > MAX_PAUSE)) + 1
    starts = np.r_[0, new, len(rays)]
    return Sessions(order, starts, sorted_(person)[starts[:-1]], np.r_[False, back[new - 1]])


_MAX_JITTER = 1.5  # intervals longer than this multiple of their median are gaps


def estimate_interval(steps: np.ndarray) -> float:
    """Estimate the sampling interval from the intervals (N,) between successive samples; NaN without positive ones.

    The mean of the positive intervals without gaps: their median is biased by the resolution of the clock, as 17 ms at
    60 Hz in whole milliseconds.
    """
    steps = steps[steps > 0]
    if not steps.size:
        return float("nan")
    median = np.partition(steps, len(steps) // 2)[len(steps) // 2]
    return float(steps[steps <= _MAX_JITTER * median * (1 + 1e-6)].mean())


# ---- Frozen gaze: gaze that does not move while the head does, as trackers write when they lose the eyes ----

_MAX_STILL_STEP = 2e-4  # radians between successive rays; tracked eyes have more noise
_MIN_FROZEN_SECONDS = 1.0  # seconds; tracked eyes reach at most 0.4 in 58 recordings
_MAX_INTERVAL = 0.5  # seconds; a longer interval ends a frozen run
_MIN_HEAD_MOVEMENT, _MIN_HEAD_ROTATION = 0.02, 0.05  # metres and radians of the head's motion during the run
_BLOCK = 1 << 18


def find_frozen_gaze(rays: Rays, sessions: Sessions) -> np.ndarray:
    """Mask (N,) bool of frozen gaze: runs of a second or more in which the gaze in the world, or its angle to the head,
    is constant although the head moves or turns."""
    out = np.zeros(len(rays), bool)
    for still in _find_still_steps(rays, sessions):
        edges = np.flatnonzero(np.diff(np.r_[False, still, False]))
        first, last = edges[::2], edges[1::2]
        at = lambda k: k if sessions.order is None else sessions.order[k]
        long = rays.t[at(last)] - rays.t[at(first)] >= _MIN_FROZEN_SECONDS
        for a, b in zip(first[long].tolist(), last[long].tolist()):
            rows = sessions.rows(slice(a, b + 1))
            has_moved = np.ptp(rays.origin[rows], axis=0).max() > _MIN_HEAD_MOVEMENT
            has_turned = rays.head is not None and np.ptp(rays.head[rows], axis=0).max() > _MIN_HEAD_ROTATION
            if has_moved or has_turned:
                out[rows] = True
    return out


def _find_still_steps(rays: Rays, sessions: Sessions) -> list[np.ndarray]:
    """Masks (N - 1,) bool of steps in that order without motion of the gaze: in the world and, if heads are recorded,
    relative to the head."""
    n = len(rays)
    world = np.zeros(n - 1, bool)
    head = None if rays.head is None else np.zeros(n - 1, bool)
    for a in range(0, n - 1, _BLOCK):
        rows = sessions.rows(slice(a, a + _BLOCK + 1))
        d, block = rays.direction[rows], slice(a, min(a + _BLOCK, n - 1))
        dt = np.diff(rays.t[rows])
        near = (dt >= 0) & (dt <= _MAX_INTERVAL)
        step = np.diff(d, axis=0)
        world[block] = near & (np.einsum("ij,ij->i", step, step) < _MAX_STILL_STEP**2)
        if rays.head is not None and head is not None:
            distance = rays.head[rows] - d
            head[block] = near & (np.abs(np.diff(np.sqrt(np.einsum("ij,ij->i", distance, distance)))) < _MAX_STILL_STEP)
    masks = [world] if head is None else [world, head]
    for still in masks:
        still[sessions.starts[1:-1] - 1] = False
    return masks


# ---- Splits into training and test rays without shared rays ----
#
# Neighbouring probes contain the same rays, so that a random choice of test probes would test on training data.
# Therefore positions are held out in zones, with all rays near a test probe purged, and participants as a whole.


@dataclass(frozen=True, eq=False)
class PositionSplit:
    """Rays split by position; rays on neither side are purged."""

    train: np.ndarray  # (N,) bool: farther than 2R from every test centre
    test: np.ndarray  # (N,) bool: within R of a test centre
    test_centres: np.ndarray  # (T, 3) metres
    zone_centres: np.ndarray  # (Z, 3) metres
    zone: np.ndarray  # (T,) zone of each test centre

    @property
    def masks(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks (N,) of training and test rays."""
        return self.train, self.test


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

    Zones are vertical cylinders around ray origins, far from each other. Training rays are farther than 2R from each
    test centre, so that no training probe of radius R shares a ray with a test probe. A few zones purge far fewer rays
    than scattered centres would. Equal seeds give equal splits.

    Parameters
    ----------
    zones, zone_radius
        Number of zones, and their radius in metres.
    test_probes
        Maximum number of test centres: ray origins within the zones.
    min_rays
        Minimum number of rays within R of a test centre.
    min_train
        Minimum number of training rays. Default: ``min_rays``.

    Raises
    ------
    NergError
        If there is no such zone, or too few training rays are left.
    """
    if zones < 1 or not radius > 0 or not zone_radius > 0:
        raise NergError(f"zones {zones}, radius {radius}, zone_radius {zone_radius}: all must be positive")
    rng = np.random.default_rng(seed)
    index = RayIndex(rays)

    # Farthest-point sampling of random origins, whose density follows that of the participants;
    # candidates with too few rays around them cannot be tested.
    candidates = rays.origin[rng.permutation(len(rays))[:256]]
    candidates = candidates[_has_enough_rays(index, candidates, radius, min_rays)]
    if len(candidates) < zones:
        raise NergError(
            f"only {len(candidates)} of 256 positions have {min_rays} rays within {radius} m; "
            "enlarge the radius or lower min_rays"
        )
    selected = [0]
    while len(selected) < zones:
        distances = np.linalg.norm(candidates[:, None, :2] - candidates[selected][None, :, :2], axis=2).min(axis=1)
        # A random one of the farthest quarter: the farthest would always be a corner.
        order = np.argsort(-distances)
        selected.append(int(rng.choice(order[: max(1, len(order) // 4)])))
    zone_centres = candidates[selected]

    centres, zone = [], []
    for z, centre in enumerate(zone_centres):
        rows = rng.permutation(np.flatnonzero(((rays.origin[:, :2] - centre[:2]) ** 2).sum(axis=1) <= zone_radius**2))
        # A multiple of the number required suffices; testing all of millions of rays would take too long.
        rows = rows[: 16 * test_probes]
        enough = rows[_has_enough_rays(index, rays.origin[rows], radius, min_rays)]
        count = test_probes // zones + (z < test_probes % zones)
        centres.append(rays.origin[enough[:count]])
        zone.append(np.full(len(centres[-1]), z))
    test_centres, zone = np.concatenate(centres), np.concatenate(zone)

    near = _distance_to_nearest(test_centres, rays.origin)
    train = near > 2.0 * radius
    if train.sum() < (min_rays if min_train is None else min_train):
        raise NergError(f"only {train.sum()} training rays are left; use fewer or smaller zones, or a smaller radius")
    return PositionSplit(train, near <= radius, test_centres, zone_centres, zone)


def purge(rays: Rays, centres: np.ndarray, distance: float) -> np.ndarray:
    """Mask (N,) of rays that may be used for training: origins farther than ``distance`` metres from all ``centres``
    (T, 3)."""
    return _distance_to_nearest(np.asarray(centres, dtype=np.float64).reshape(-1, 3), rays.origin) > distance


def split_by_person(
    rays: Rays, *, test_fraction: float = 0.5, test_persons: Sequence[str] | None = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out participants: masks (N,) of training and test rays.

    Test participants are ``test_persons`` by name, or a random ``test_fraction`` of those with rays, at least one on
    each side. Raises `NergError` for an unknown name, or if a side is empty.
    """
    present = np.unique(rays.person)
    if test_persons is not None:
        test_codes = np.array(find_names(test_persons, rays.persons, "person"))
    else:
        count = int(np.clip(round(test_fraction * len(present)), 1, max(1, len(present) - 1)))
        test_codes = np.random.default_rng(seed).permutation(present)[:count]
    test = np.isin(rays.person, test_codes)
    if test.all() or not test.any():
        raise NergError(
            f"{len(present)} participants cannot be split into training and test; provide rays of at least two"
        )
    return ~test, test


def split_by_time(
    rays: Rays, *, test_fraction: float = 0.2, gap: float = 5.0, clock: str = "all"
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out the end of the recorded time: masks (N,) of training and test rays.

    Rays between the two sides are used on neither, since gaze is correlated over seconds.

    Parameters
    ----------
    test_fraction
        Fraction of the time from the first to the last ray that is the test side.
    gap
        Seconds between the training and the test side.
    clock
        ``all``: one cut for all rays (such as a day in a shop); ``person``: one cut per participant (recordings with
        separate clocks).

    Raises
    ------
    NergError
        If a side is empty.
    """
    if clock not in ("all", "person") or not 0 < test_fraction < 1 or not gap >= 0:
        raise NergError(
            'a split by time needs the clock "all" or "person", a fraction between 0 and 1 and a gap of 0 s or more, '
            f'got "{clock}", {test_fraction} and {gap}'
        )
    group = np.zeros(len(rays), np.int64) if clock == "all" else rays.person
    first, last = np.full(group.max(initial=0) + 1, np.inf), np.full(group.max(initial=0) + 1, -np.inf)
    np.minimum.at(first, group, rays.t)
    np.maximum.at(last, group, rays.t)
    cut = (last - test_fraction * (last - first))[group]
    train, test = rays.t < cut - gap, rays.t >= cut
    if not train.any() or not test.any():
        raise NergError(
            f"only {train.sum()} training rays and {test.sum()} test rays are left; use a smaller gap or another "
            "fraction"
        )
    return train, test


def combine_splits(*sides: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Combine several splits: masks (N,) of training and test rays.

    Training rays are on the training side of each split, test rays on the test side of each (such as unseen
    participants at unseen positions). All other rays are used on neither side. Raises `NergError` if a side is empty.
    """
    if not sides:
        raise ValueError("no split was given; split by position, person or time")
    train, test = (np.logical_and.reduce(side) for side in zip(*sides))
    if not train.any() or not test.any():
        raise NergError(
            f"the splits together leave only {train.sum()} training rays and {test.sum()} test rays; "
            "hold out more in one of them"
        )
    return train, test


def read_position_split(rays: Rays) -> dict[str, Any]:
    """Read from the metadata how ``rays`` were split by position: ``test_centres`` (lists of 3), ``radius`` and so on;
    empty if they were not."""
    for step in rays.metadata.get("steps", []):
        if step["step"] == "split" and isinstance(step.get("by"), dict):
            return step["by"].get("position", {})
    return {}


def _has_enough_rays(index: RayIndex, positions: np.ndarray, radius: float, min_rays: int) -> np.ndarray:
    """Mask of positions with at least ``min_rays`` rays within ``radius``, without counting all of them."""
    return np.diff(index.query(positions, min_rays, radius).offsets) >= min_rays


def _distance_to_nearest(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import KDTree

    return KDTree(centres).query(points)[0]
