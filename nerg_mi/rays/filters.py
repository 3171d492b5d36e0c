"""Filters and splits of rays: by time, person and confidence, fixations, frozen gaze, recordings, and held-out
parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf

from .rays import RayIndex, Rays

# ---- Choosing among rays: by time, person, cohort, place and confidence; and fewer of those who stand still ----


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
    """Rays (N,) bool that meet every condition given.

    ``time``: from (inclusive) and to (exclusive), seconds, either may be ``None``. ``persons``, ``without_persons``,
    ``cohorts``: names. ``box``: x0, x1, y0, y1, z0, z1 in metres that hold the origin. ``min_confidence``: at least
    this. ``with_hit``: a hit point is known. Raises `NergError` for an unknown name or a box that is none.
    """
    keep = np.ones(len(rays), bool)
    if time is not None:
        start, end = time
        keep &= (rays.t >= (-np.inf if start is None else start)) & (rays.t < (np.inf if end is None else end))
    if persons is not None:
        keep &= np.isin(rays.person, _codes(persons, rays.persons, "person"))
    if without_persons is not None:
        keep &= ~np.isin(rays.person, _codes(without_persons, rays.persons, "person"))
    if cohorts is not None:
        if rays.cohort is None:
            raise NergError("these rays have no cohorts; import them with a cohort column (--map cohort=...)")
        keep &= np.isin(rays.cohort, _codes(cohorts, rays.cohorts, "cohort"))
    if box is not None:
        sides = np.asarray(box, dtype=np.float64)
        if sides.shape != (6,) or not (sides[0::2] < sides[1::2]).all():
            raise NergError(
                f"a box is x0, x1, y0, y1, z0, z1 in metres with each first below its second, got {sides.tolist()}"
            )
        keep &= ((rays.origin >= sides[0::2]) & (rays.origin <= sides[1::2])).all(axis=1)
    if min_confidence is not None:
        keep &= rays.confidence >= min_confidence
    if with_hit:
        keep &= False if rays.hit is None else np.isfinite(rays.hit).all(axis=1)
    return keep


def _codes(names: Sequence[str], known: tuple[str, ...], what: str) -> list[int]:
    unknown = [n for n in names if n not in known]
    if unknown:
        raise NergError(f"no {what} is called {', '.join(map(repr, unknown))}; there are {', '.join(known)}")
    return [known.index(n) for n in names]


def argsort_by_person_time(rays: Rays) -> np.ndarray | None:
    """The rays' order by person and time (N,); None where they are in that order already."""
    earlier = (rays.person[1:] < rays.person[:-1]) | (
        (rays.person[1:] == rays.person[:-1]) & (rays.t[1:] < rays.t[:-1])
    )
    return np.lexsort((rays.t, rays.person)) if earlier.any() else None


def group_by_person(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """The rays' order by person and time (N,), and where in it each person's run starts, with N at the end."""
    order = np.lexsort((rays.t, rays.person))
    starts = np.flatnonzero(np.r_[True, np.diff(rays.person[order]) != 0])
    return order, np.r_[starts, len(rays)]


def label_stays(rays: Rays, distance: float = 0.1, gap: float = 1.0) -> np.ndarray:
    """Which stay each ray belongs to, (N,) int64: the rays of a person from a first one on, as long as the origins lie
    within ``distance`` metres of its origin and no pause is longer than ``gap`` seconds. Numbered from 0."""
    order, starts = group_by_person(rays)
    origin, t = rays.origin[order], rays.t[order]
    # A pause or another person ends a stay in any case.
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
    """Rays (N,) bool that are left where people stand still: of a stay (:func:`label_stays`) longer than ``seconds``,
    as many as ``seconds`` hold at its own rate, evenly over all of it.

    Somebody who waits at a counter for ten minutes then counts as much as somebody who stops there for ``seconds``, and
    what they looked at keeps its shares. Walking is left as it is.
    """
    if not (seconds > 0 and distance > 0):
        raise NergError(f"seconds {seconds} and distance {distance} must be positive")
    label = label_stays(rays, distance, gap)
    order = np.lexsort((rays.t, label))
    counts = np.bincount(label)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    t = rays.t[order]
    lasted = t[first + counts - 1] - t[first]
    share = np.minimum(1.0, seconds / np.maximum(lasted, 1e-9))
    # Within a stay, rank r is kept where r * share passes a whole number.
    rank = np.arange(len(t)) - np.repeat(first, counts)
    s = np.repeat(share, counts)
    kept = np.floor(rank * s) != np.floor((rank - 1) * s)
    out = np.empty(len(t), bool)
    out[order] = kept
    return out


# ---- Fixations: when gaze rests ----
#
# I-VT and I-DT of Salvucci and Goldberg (2000), on directions in the world.
#
# Angles are in degrees, times in seconds. A pause of a person longer than ``gap`` ends a fixation. Both return for each
# ray the number of its fixation, or -1; numbers run person after person in time.

_GAP = 0.1


def detect_fixations_ivt(rays: Rays, velocity: float = 100.0, min_duration: float = 0.06, gap: float = _GAP) -> np.ndarray:
    """By velocity (I-VT): runs of rays that turn no faster than ``velocity`` degrees a second, of ``least`` seconds or
    more.

    The velocity of a ray is that from the one before it (of the first of a run, to the one after). 100 degrees a second
    is for gaze in the world of people who walk and turn, 30 is usual where the head rests. Returns (N,) int64.
    """
    _positive(velocity=velocity, least=min_duration, gap=gap)
    order, starts = group_by_person(rays)
    t, d = rays.t[order], rays.direction[order]
    step = np.diff(t)
    joined = (step > 0) & (step <= gap)
    joined[starts[1:-1] - 1] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        slow = joined & (_angles(d[1:], d[:-1]) <= velocity * step)
    # Rays joined by slow steps are one run; a ray after a fast step begins one.
    run = np.cumsum(np.r_[True, ~slow]) - 1
    return _numbered(run, t, order, min_duration)


def detect_fixations_idt(rays: Rays, dispersion: float = 3.0, min_duration: float = 0.1, gap: float = _GAP) -> np.ndarray:
    """By dispersion (I-DT): a window of ``least`` seconds whose directions lie within ``dispersion`` degrees grows as
    long as they do; otherwise it starts one ray later.

    Dispersion is the spread of the angle sideways plus the spread upwards, max - min each, in the plane that touches
    the sphere at the window's first direction (azimuthal equidistant, its axes level and upright). Returns (N,) int64.
    """
    _positive(dispersion=dispersion, least=min_duration, gap=gap)
    order, starts = group_by_person(rays)
    t, d = rays.t[order], rays.direction[order]
    bounds = np.flatnonzero(np.r_[True, np.diff(t) > gap])
    bounds = np.union1d(bounds, starts)
    label = np.full(len(t), -1, np.int64)
    number = 0
    for a, b in zip(bounds[:-1], bounds[1:]):
        # The last ray of the shortest window that starts at each; b where the time does not suffice.
        full = np.searchsorted(t[a:b], t[a:b] + min_duration - 1e-9) + a
        start, possible = a, _may_start(d[a:b], full - a, b - a, dispersion)
        for s in np.flatnonzero(possible) + a:
            if s < start:
                continue
            start = _grow(d, s, full[s - a] + 1, b, dispersion)
            label[s:start] = number
            number += 1
    out = np.empty_like(label)
    out[order] = label
    return out


def average_fixations(rays: Rays, label: np.ndarray) -> tuple[Rays, np.ndarray]:
    """One ray a fixation, and how long each lasted (F,), seconds.

    Time of the middle, mean origin, mean direction, mean confidence, mean hit point and mean head (of those known) of
    the rays with the same number in ``label`` (N,), -1 left out. Raises `NergError` when there is no fixation.
    """
    kept = np.flatnonzero(label >= 0)
    if not kept.size:
        raise NergError(
            "there is no fixation among these rays; raise the velocity or the dispersion, or lower the duration"
        )
    _, index, number = np.unique(label[kept], return_index=True, return_inverse=True)
    n = np.bincount(number).astype(np.float64)
    mean = lambda v: np.stack([np.bincount(number, weights=c) for c in v[kept].T], axis=1) / n[:, None]
    direction = mean(rays.direction)
    first, last = np.full(len(n), np.inf), np.full(len(n), -np.inf)
    np.minimum.at(first, number, rays.t[kept])
    np.maximum.at(last, number, rays.t[kept])
    hit = None if rays.hit is None else _mean_of_known(rays.hit[kept], number)
    head = None if rays.head is None else _mean_of_known(rays.head[kept], number)
    if head is not None:
        head /= np.linalg.norm(head, axis=1, keepdims=True)
    one = replace(
        rays.select(kept[index]),
        t=0.5 * (first + last),
        origin=mean(rays.origin),
        hit=hit,
        head=head,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        confidence=np.clip(np.bincount(number, weights=rays.confidence[kept]) / n, 0.0, 1.0),
    )
    return one, last - first


def _mean_of_known(values: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Means (F, C) of the rows of ``values`` (N, C) with the same ``number`` (N,); NaN where all hold a NaN."""
    known = np.isfinite(values).all(axis=1)
    weight = np.bincount(number, weights=known.astype(float))
    sums = np.stack([np.bincount(number, weights=np.where(known, c, 0.0)) for c in values.T], axis=1)
    with np.errstate(invalid="ignore"):
        return sums / weight[:, None]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors."""
    return np.degrees(2.0 * np.arcsin(np.minimum(1.0, np.sqrt(0.5 * vmf.one_minus_cosine(a, b)))))


def _numbered(run: np.ndarray, t: np.ndarray, order: np.ndarray, least: float) -> np.ndarray:
    counts = np.bincount(run)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    long = t[first + counts - 1] - t[first] >= least - 1e-9
    number = np.where(long, np.cumsum(long) - 1, -1)
    out = np.empty(len(t), np.int64)
    out[order] = number[run]
    return out


def _plane(d: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Degrees sideways and upwards (..., 2) of directions (..., 3), seen from ``first`` (..., 3): azimuthal
    equidistant."""
    level = np.hypot(first[..., 0], first[..., 1])
    steep = level < 1e-9  # who looks straight up has no level of their own
    side = np.stack(
        [np.where(steep, 1.0, first[..., 1]), np.where(steep, 0.0, -first[..., 0]), np.zeros_like(level)], axis=-1
    )
    side = side / np.where(steep, 1.0, level)[..., None]
    upright = np.cross(side, first)
    dot = lambda u: np.sum(d * u, axis=-1)
    x, y, z = dot(side), dot(upright), dot(first)
    r = np.hypot(x, y)
    scale = np.where(r > 1e-12, np.degrees(np.arctan2(r, z)) / np.maximum(r, 1e-12), np.degrees(1.0))
    return np.stack([x * scale, y * scale], axis=-1)


def _may_start(d: np.ndarray, full: np.ndarray, n: int, dispersion: float) -> np.ndarray:
    """Where a window of the least duration holds together, (n,) bool: all starts at once, since most of them fail."""
    out = full < n
    starts = np.flatnonzero(out)
    if not starts.size:
        return out
    width = int((full[starts] - starts).max()) + 1
    for block in np.array_split(starts, max(1, starts.size * width >> 20)):
        at = np.minimum(block[:, None] + np.arange(width), full[block][:, None])
        plane = _plane(d[at], d[block][:, None, :])
        out[block] = np.ptp(plane, axis=1).sum(axis=1) <= dispersion
    return out


def _grow(d: np.ndarray, start: int, end: int, limit: int, dispersion: float) -> int:
    """Where the window from ``start`` ends that holds together and is at least up to ``end``."""
    step = 32
    while True:
        upto = min(end + step, limit)
        plane = _plane(d[start:upto], d[start])
        spread = (np.maximum.accumulate(plane) - np.minimum.accumulate(plane)).sum(axis=1)
        apart = np.flatnonzero(spread > dispersion)
        if apart.size:
            return start + int(apart[0])
        if upto == limit:
            return limit
        end, step = upto, 4 * step


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise NergError(f"{name} must be positive, got {value}")


# ---- Recordings of people among rays: what one person did in one go, as it was stored ----

PAUSE = 60.0  # Seconds: a longer pause ends a recording
_BACK = 1.0  # seconds by which time goes back where another recording begins; less is a row in the wrong place
_MIXED = 10, 0.01  # rows, and share of them, at which time goes back in an order in which nobody recorded


@dataclass(frozen=True, eq=False)
class Sessions:
    """Rays in the order of recordings, those of a person together; S recordings."""

    order: np.ndarray | None  # (N,) of the rays; None: they are in it already
    starts: np.ndarray  # (S + 1,) where each begins in that order, with N at the end
    person: np.ndarray  # (S,) of each
    back: np.ndarray  # (S,) bool: it begins since time went back

    def rows(self, part: slice) -> slice | np.ndarray:
        """Which rays a part of the order is."""
        return part if self.order is None else self.order[part]

    def label_rays(self) -> np.ndarray:
        """Number of the recording of each place of the order, (N,)."""
        return np.repeat(np.arange(len(self.person)), np.diff(self.starts))


def find_sessions(rays: Rays) -> Sessions:
    """Recordings: of a person, from one time at which their clock goes back by more than a second, or makes a pause of
    more than `PAUSE`, to the next.

    Rays are stored as they were imported. Where they were mixed since, so that time goes back again and again, they are
    taken in the order of time.
    """
    person = rays.person
    order = np.argsort(person, kind="stable") if (person[1:] < person[:-1]).any() else None
    sorted_ = lambda values: values if order is None else values[order]
    other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    if np.count_nonzero(~other & (step < -_BACK)) > max(_MIXED[0], _MIXED[1] * len(rays)):
        order = argsort_by_person_time(rays)
        other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    back = ~other & (step < -_BACK)
    new = np.flatnonzero(other | back | (step > PAUSE)) + 1
    starts = np.r_[0, new, len(rays)]
    return Sessions(order, starts, sorted_(person)[starts[:-1]], np.r_[False, back[new - 1]])


# ---- Gaze that stands still while the head does not: what trackers write that have lost the eyes ----

_STILL = 2e-4  # radians between one ray and the next; trackers that see the eyes make more noise
_LASTS = 1.0  # seconds; such trackers reach 0.4 at most in 58 recordings
_PAUSE = 0.5  # seconds without a ray after which gaze is new
_MOVED, _TURNED = 0.02, 0.05  # metres and radians of a head that moves meanwhile
_BLOCK = 1 << 18


def find_frozen(rays: Rays, sessions: Sessions) -> np.ndarray:
    """Rays (N,) bool of a second or more in which the gaze does not turn though the head moves or turns: the gaze in
    the world or, where heads are known, its angle to the head."""
    out = np.zeros(len(rays), bool)
    for still in _still_steps(rays, sessions):
        edges = np.flatnonzero(np.diff(np.r_[False, still, False]))
        first, last = edges[::2], edges[1::2]
        at = lambda k: k if sessions.order is None else sessions.order[k]
        long = rays.t[at(last)] - rays.t[at(first)] >= _LASTS
        for a, b in zip(first[long].tolist(), last[long].tolist()):
            rows = sessions.rows(slice(a, b + 1))
            moved = np.ptp(rays.origin[rows], axis=0).max() > _MOVED
            turned = rays.head is not None and np.ptp(rays.head[rows], axis=0).max() > _TURNED
            if moved or turned:
                out[rows] = True
    return out


def _still_steps(rays: Rays, sessions: Sessions) -> list[np.ndarray]:
    """Whether gaze stands still from each place of the order to the next, (N - 1,) bool: in the world and, where heads
    are known, against them."""
    n = len(rays)
    world = np.zeros(n - 1, bool)
    head = None if rays.head is None else np.zeros(n - 1, bool)
    for a in range(0, n - 1, _BLOCK):
        rows = sessions.rows(slice(a, a + _BLOCK + 1))
        d, here = rays.direction[rows], slice(a, min(a + _BLOCK, n - 1))
        dt = np.diff(rays.t[rows])
        near = (dt >= 0) & (dt <= _PAUSE)
        way = np.diff(d, axis=0)
        world[here] = near & (np.einsum("ij,ij->i", way, way) < _STILL**2)
        if rays.head is not None and head is not None:
            off = rays.head[rows] - d
            head[here] = near & (np.abs(np.diff(np.sqrt(np.einsum("ij,ij->i", off, off)))) < _STILL)
    found = [world] if head is None else [world, head]
    for still in found:
        still[sessions.starts[1:-1] - 1] = False
    return found


# ---- Splits of rays into training and test that share no ray ----
#
# Neighbouring probes hold the same rays: a random choice of test probes is tested on what it was trained on. So
# positions are held out in zones, with every ray within reach of a test probe purged, and people are held out whole.


@dataclass(frozen=True, eq=False)
class PositionSplit:
    """Rays split by position; those on neither side were purged."""

    train: np.ndarray  # (N,) bool: farther than 2R from every test centre
    test: np.ndarray  # (N,) bool: within R of one
    test_centres: np.ndarray  # (T, 3) metres
    zone_centres: np.ndarray  # (Z, 3) metres
    zone: np.ndarray  # (T,) the zone of each test centre

    @property
    def masks(self) -> tuple[np.ndarray, np.ndarray]:
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

    Zones are vertical cylinders of ``zone_radius`` metres around ray origins, chosen far from each other; the test
    centres are up to ``test_probes`` ray origins inside them with at least ``min_rays`` rays within R. Training rays
    lie farther than 2R from each test centre, so that no probe of radius R on the training side comes within R of a
    test centre. A few zones purge far less than scattered centres would. ``min_train``: training rays that are left at
    least (``min_rays``). The same seed gives the same split.

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
    rays: Rays, *, test_fraction: float = 0.5, test_persons: Sequence[str] | None = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out people: masks (N,) of training and test rays.

    ``test_persons`` by name, or a random ``test_share`` of those who have rays, at least one on each side. Raises
    `NergError` for an unknown name or when a side is empty.
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
        count = int(np.clip(round(test_fraction * len(present)), 1, max(1, len(present) - 1)))
        held = np.random.default_rng(seed).permutation(present)[:count]
    test = np.isin(rays.person, held)
    if test.all() or not test.any():
        raise NergError(f"{len(present)} persons cannot be split into training and test; give rays of at least two")
    return ~test, test


def split_by_time(
    rays: Rays, *, test_fraction: float = 0.2, gap: float = 5.0, clock: str = "all"
) -> tuple[np.ndarray, np.ndarray]:
    """Hold out the end: masks (N,) of training and test rays.

    Test is the last ``test_share`` of the time from the first ray to the last one, training what lies more than ``gap``
    seconds before it; rays between are on neither side, since gaze repeats itself for seconds. ``of``: ``all``, one cut
    for all (a day of a shop), or ``person``, each person's own time (recordings with clocks of their own). Raises
    `NergError` when a side is empty.
    """
    if clock not in ("all", "person") or not 0 < test_fraction < 1 or not gap >= 0:
        raise NergError(
            'a split by time needs the clock "all" or "person", a share between 0 and 1 and a gap of 0 s or more, '
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
            f"{train.sum()} rays are left to train on and {test.sum()} to test; choose a smaller gap or another share"
        )
    return train, test


def combine_splits(*sides: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
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


def read_position_split(rays: Rays) -> dict[str, Any]:
    """How ``rays``, one side of a split by position, were parted: ``test_centres`` (lists of 3), ``radius`` and so on,
    as their metadata tell; empty where they do not."""
    for step in rays.metadata.get("steps", []):
        if step["step"] == "split" and isinstance(step.get("by"), dict):
            return step["by"].get("position", {})
    return {}


def _enough(index: RayIndex, places: np.ndarray, radius: float, least: int) -> np.ndarray:
    """Which places have at least ``least`` rays within ``radius``: no need to count the others."""
    return np.diff(index.query(places, least, radius).offsets) >= least


def _distance_to(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import KDTree

    return KDTree(centres).query(points)[0]
