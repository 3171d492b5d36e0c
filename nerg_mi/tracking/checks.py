"""Plausibility checks of recordings: the interface of a check, and the checks of participants, lengths, eyes, times
and clocks.

To add a check, write ``@check("what it detects") def check_NAME(stats)`` here or in
:mod:`nerg_mi.tracking.direction_checks`, and add it to the list at the end of that file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.errors import parameter

from .filters import Sessions, find_frozen_gaze, find_sessions
from .rays import Rays
from .readers.base import UNITS

# ---- The input of checks, and functions that several checks use ----

MAX_CHECKED_RAYS = 200_000  # Larger sets are subsampled where a sample gives the same answer
MIN_RAYS = 50  # Minimum number of rays for statements about most of them: one second of a recording
_MAX_NAMES = 3  # participants listed in a message


@dataclass(frozen=True, eq=False)
class RayStatistics:
    """Rays in the common frame, with the figures that the summary has already computed."""

    rays: Rays
    height_percentiles: np.ndarray  # (3,) 5th, 50th and 95th percentile of the origins' heights, metres
    extent: np.ndarray  # (3,) size of the bounding box of the origins, metres
    speed_p95: float  # 95th percentile of the origins' speeds, m/s; NaN if unknown
    # Median of the positive intervals between rays of a participant, seconds. NaN: no interval is positive.
    # None: no participant has two rays.
    median_interval: float | None
    order: np.ndarray | None  # (N,) order by participant and time, from `filters.argsort_by_person_time`

    @cached_property
    def sessions(self) -> Sessions:
        """Recordings, in storage order of the rays."""
        return find_sessions(self.rays)

    @cached_property
    def is_frozen(self) -> np.ndarray:
        """Mask (N,) bool of rays with frozen gaze: the gaze does not move although the head does."""
        return find_frozen_gaze(self.rays, self.sessions)

    @property
    def is_floor_at_zero(self) -> bool:
        """Whether height 0 is the floor, as far as the reader of the files knows."""
        return self.rays.metadata.get("floor") != "unknown"

    @property
    def is_subsampled(self) -> bool:
        """Whether rays were thinned since the import, so that intervals between them are not sampling intervals."""
        return any(step.get("step") in ("thin", "fixations") for step in self.rays.metadata.get("steps", []))


def to_source(rays: Rays) -> np.ndarray:
    """Rotation or reflection R (3, 3) from the common frame back to the frame of the file: v_file = R v_rays."""
    matrix = np.asarray(rays.metadata.get("transform", np.eye(4)), dtype=np.float64)[:3, :3]
    return np.linalg.inv(matrix / np.cbrt(abs(np.linalg.det(matrix))))


def group_medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Medians (count,) of the ``values`` (n,) per ``group`` (n,) of numbers below ``count``; NaN for empty groups."""
    order = np.lexsort((values, group))
    ends = np.searchsorted(group[order], np.arange(count + 1))
    n, values = np.diff(ends), values[order]
    if not values.size:
        return np.full(count, np.nan)
    low, high = (np.clip(ends[:-1] + k, 0, len(values) - 1) for k in ((n - 1) // 2, n // 2))
    return np.where(n > 0, 0.5 * (values[low] + values[high]), np.nan)


def list_names(names: Sequence[str]) -> str:
    """Join names, shortened: ``ann, bo, cy and 4 more``."""
    num_others = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {num_others} more" if num_others > 0 else "")


def list_persons(rays: Rays, persons: Iterable[int]) -> str:
    """Join the names of participants given by their codes; see `list_names`."""
    return list_names([rays.persons[person] for person in persons])


# ---- Interface of a check ----


@dataclass(frozen=True)
class Check:
    """A check of rays for one kind of mistake."""

    name: str
    """Name of the check: that of its function without ``check_``."""

    description: str
    """What the check detects, as a phrase in Markdown."""

    run: Callable[[RayStatistics], list[str]]
    """Returns sentences about implausible data, each with the likely mistake and its remedy. The list is empty if
    nothing is wrong or if the rays do not permit a conclusion. Takes a fraction of a second for millions of rays."""


def check(description: str) -> Callable[[Callable[[RayStatistics], list[str]]], Check]:
    """Make a check called NAME from a function ``check_NAME(stats)``."""
    return lambda find: Check(find.__name__.removeprefix("check_"), description, find)


# ---- Clocks that jump or change their rate, and clocks of several recordings under one name ----

_MIN_GAP = 5.0  # seconds; after a longer gap the motion of the head across the gap is examined
_MIN_CLOCK_RESET = 1.0  # seconds; a smaller step back is a misplaced row
_NEIGHBOUR_RAYS = 10  # rays before and after a gap from which the head's motion is measured
_MIN_SPEED, _MIN_TURN_RATE = 0.2, 10.0  # m/s and degrees per second of a moving head
_MAX_STEP_RATIO = 3.0  # maximum step across a gap, in typical steps, if only the clock has jumped
_GAP_LIMITS = 0.01, 500  # maximum fraction of rays that are gaps, and maximum number of gaps examined
_MIN_DUPLICATE_FRACTION = 0.05  # of a participant's rays that share their time with another ray
_MIN_DISTANCE = 0.3  # metres; rays at the same time that are farther apart belong to two participants
_WINDOW_RAYS, _MAX_WINDOWS = 64, 4096  # rays per window, and maximum number of windows examined
_INTERVAL_RATIO = 20.0  # maximum ratio between sampling intervals of one device
_MIN_WINDOW_FRACTION = 0.02  # of a participant's windows
_MIN_EPOCH_DIFFERENCE = 1e8  # seconds (three years) between times on one clock


@check(
    "times that go back or jump although the head continues its motion; recordings under one name that overlap or are "
    "duplicated; clocks of some participants with another unit or epoch (`--tick`, `--person-from`, `--clock`)"
)
def check_clocks(stats: RayStatistics) -> list[str]:
    if stats.median_interval is None or np.isnan(stats.median_interval):
        return []  # check_times reports this
    return [
        *(_check_jumps(stats) or _check_duplicates(stats) or _check_overlaps(stats)),
        *(_check_clock_rates(stats) or _check_epochs(stats)),
    ]


def _check_jumps(stats: RayStatistics) -> list[str]:
    """Detect gaps or backward steps of the clock across which the head continues its motion."""
    if stats.is_subsampled:
        return []
    rays, sessions = stats.rays, stats.sessions
    person, t = (v if sessions.order is None else v[sessions.order] for v in (rays.person, rays.t))
    dt = np.diff(t)
    (gaps,) = np.nonzero((person[1:] == person[:-1]) & ((dt < -_MIN_CLOCK_RESET) | (dt >= _MIN_GAP)))
    jumps: dict[int, list[float]] = {}
    if len(gaps) > max(10, _GAP_LIMITS[0] * len(rays)):
        return []
    for k in gaps[:: max(1, len(gaps) // _GAP_LIMITS[1])].tolist():
        a, b = max(0, k + 1 - _NEIGHBOUR_RAYS), min(len(t), k + 1 + _NEIGHBOUR_RAYS)
        rows = sessions.rows(slice(a, b))
        if (rays.person[rows] == person[k]).all() and b - a > _NEIGHBOUR_RAYS and _moves_as_before(stats, rows, k - a):
            jumps.setdefault(int(person[k]), []).append(float(dt[k]))
    if not jumps:
        return []
    longest = max((s for steps in jumps.values() for s in steps), key=abs)
    count, names = sum(map(len, jumps.values())), list_persons(rays, jumps)
    return [
        f"the clock of {names} jumps {'once' if count == 1 else f'{count} times'}, by at most {longest:+,.0f} s, while "
        "the head moves as if there were no gap: correct the times in the file"
    ]


def _moves_as_before(stats: RayStatistics, rows: slice | np.ndarray, gap_index: int) -> bool:
    """Whether the head moves across the gap after row ``gap_index`` as it does before and after the gap."""
    rays = stats.rays
    dt = np.delete(np.diff(rays.t[rows]), gap_index)
    dt = float(np.median(dt[dt > 0])) if (dt > 0).any() else 0.0
    for values, min_speed in ((rays.origin, _MIN_SPEED), (rays.head, np.radians(_MIN_TURN_RATE))):
        if values is not None and dt > 0:
            step = np.linalg.norm(np.diff(values[rows], axis=0), axis=1)
            typical_step = float(np.median(np.delete(step, gap_index)))
            if typical_step > min_speed * dt:
                # A head that only turns must also stay at its position.
                gap_distance = np.linalg.norm(np.diff(rays.origin[rows], axis=0), axis=1)[gap_index]
                return bool(
                    step[gap_index] <= _MAX_STEP_RATIO * typical_step
                    and gap_distance <= max(0.02, _MAX_STEP_RATIO * typical_step)
                )
    return False


def _check_overlaps(stats: RayStatistics) -> list[str]:
    """Detect recordings of one participant that overlap in time."""
    rays, sessions = stats.rays, stats.sessions
    has_resets = np.isin(sessions.person, sessions.person[sessions.is_clock_reset])
    if not has_resets.any():
        return []
    times_at = lambda places: rays.t[places if sessions.order is None else sessions.order[places]]
    person, first, last = (
        sessions.person[has_resets],
        times_at(sessions.starts[:-1][has_resets]),
        times_at(sessions.starts[1:][has_resets] - 1),
    )
    order = np.lexsort((first, person))
    person, first, last = person[order], first[order], last[order]
    overlap = (person[1:] == person[:-1]) & (first[1:] < last[:-1])
    if not overlap.any():
        return []
    names = list_persons(rays, np.unique(person[1:][overlap]))
    return [
        f"recordings of {names} overlap in time: do several participants or several clocks share a name? "
        f"({parameter('person_from', 'filename')}, or {parameter('columns', 'person=...')})"
    ]


def _check_duplicates(stats: RayStatistics) -> list[str]:
    """Detect rays of one participant at equal times: a file that was imported twice, or two participants."""
    rays, order = stats.rays, stats.order
    person, t = (v if order is None else v[order] for v in (rays.person, rays.t))
    is_same_time = (np.diff(person) == 0) & (np.diff(t) == 0)
    if not is_same_time.any():
        return []
    count = np.bincount(person[1:][is_same_time], minlength=len(rays.persons))
    is_affected = count > _MIN_DUPLICATE_FRACTION * np.bincount(person, minlength=len(rays.persons))
    (pairs,) = np.nonzero(is_same_time & is_affected[person[1:]])
    pairs = pairs[:: max(1, len(pairs) // 10_000)]
    if not pairs.size:
        return []
    a, b = (pairs + k if order is None else order[pairs + k] for k in (0, 1))
    distance = np.linalg.norm(rays.origin[a] - rays.origin[b], axis=1)
    rotation = np.linalg.norm(rays.direction[a] - rays.direction[b], axis=1)
    names = lambda mask: list_persons(rays, np.unique(rays.person[a][mask]))
    out = []
    if np.mean(is_copy := (distance < 1e-3) & (rotation < 1e-3)) > 0.5:
        out.append(f"rays of {names(is_copy)} are duplicated: was a file imported twice?")
    if np.mean(is_elsewhere := distance > _MIN_DISTANCE) > 0.5:
        out.append(
            f"{names(is_elsewhere)} is at two positions at the same time: do several participants share a name? "
            f"({parameter('person_from', 'filename')}, or {parameter('columns', 'person=...')})"
        )
    return out


def _check_clock_rates(stats: RayStatistics) -> list[str]:
    """Detect times in different units, between participants or within one participant's rays."""
    rays, sessions = stats.rays, stats.sessions
    if stats.is_subsampled:
        return []
    length = np.diff(sessions.starts)
    first, session = [], np.flatnonzero(length > _WINDOW_RAYS)
    num_windows = [
        max(1, min(int(length[s]) // _WINDOW_RAYS, _MAX_WINDOWS * int(length[s]) // len(rays))) for s in session
    ]
    for s, n in zip(session.tolist(), num_windows):
        first.append(np.linspace(sessions.starts[s], sessions.starts[s + 1] - _WINDOW_RAYS - 1, n).astype(np.int64))
    if not first:
        return []
    positions = np.concatenate(first)[:, None] + np.arange(_WINDOW_RAYS + 1)
    t = rays.t[positions if sessions.order is None else sessions.order[positions]]
    interval, person = np.median(np.diff(t, axis=1), axis=1), np.repeat(sessions.person[session], num_windows)
    interval, person = interval[interval > 0], person[interval > 0]
    count = len(rays.persons)
    person_interval = group_medians(interval, person, count)
    out, typical = [], np.nanmedian(person_interval)
    differs = lambda ratio: (ratio > _INTERVAL_RATIO) | (ratio < 1 / _INTERVAL_RATIO)
    for p in np.flatnonzero(differs(person_interval / typical))[:1]:
        names = list_persons(rays, np.flatnonzero(differs(person_interval / typical)))
        out.append(
            f"the sampling interval of {names} is {person_interval[p]:.3g} s, that of other participants "
            f"{typical:.3g} s: does their clock use another unit? Import them separately ({parameter('tick')})"
        )
    is_odd = differs(interval / person_interval[person])
    has_changes = np.bincount(person[is_odd], minlength=count) > np.maximum(
        1, _MIN_WINDOW_FRACTION * np.bincount(person, minlength=count)
    )
    if has_changes.any():
        percent = 100 * is_odd[has_changes[person]].mean()
        out.append(
            f"the sampling interval of {list_persons(rays, np.flatnonzero(has_changes))} changes by a factor of more "
            f"than {_INTERVAL_RATIO:.0f} in {percent:.0f} % of the rays: does the clock use two units? Correct the "
            "times in the file"
        )
    return out


def _check_epochs(stats: RayStatistics) -> list[str]:
    """Detect participants whose clocks start from epochs that are years apart."""
    rays, sessions = stats.rays, stats.sessions
    first = sessions.starts[:-1] if sessions.order is None else sessions.order[sessions.starts[:-1]]
    order = np.argsort(rays.t[first], kind="stable")
    start_time, person = rays.t[first][order], sessions.person[order]
    cut = int(np.argmax(np.diff(start_time))) + 1 if len(start_time) > 1 else 0
    if not cut or start_time[cut] - start_time[cut - 1] < _MIN_EPOCH_DIFFERENCE:
        return []
    minority = np.unique(min(person[cut:], person[:cut], key=len))
    names = list_persons(rays, minority)
    return [
        f"the clock of {names} starts from another epoch than that of the other participants: split each "
        f"participant by time separately ({parameter('clock', 'person')})"
    ]


# ---- Unit of length, from the distance between the eyes ----

MEAN_EYE_DISTANCE = (
    0.063  # Mean distance between the eyes of adults, metres; 95 % are between 0.055 and 0.071 (Dodgson 2004)
)
_EYE_DISTANCE_BOUNDS = (0.050, 0.078), (0.055, 0.072)  # metres; of one participant, and of the median of several
_MIN_PERSONS = 5
_UNIT_TOLERANCE = 1.25  # maximum ratio between an estimated unit and a named one


@check(
    "distances between the eyes that are not anatomical, if both eyes are recorded (`--units`, or the scale of the "
    "recorder's scene)"
)
def check_eyes(stats: RayStatistics) -> list[str]:
    rays = stats.rays
    present = {rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))}
    distances = {name: d for name, d in rays.metadata.get("eye_distance", {}).items() if name in present}
    implausible = {
        name: d for name, d in distances.items() if not _EYE_DISTANCE_BOUNDS[0][0] <= d <= _EYE_DISTANCE_BOUNDS[0][1]
    }
    if (
        not implausible
        and len(distances) >= _MIN_PERSONS
        and not _EYE_DISTANCE_BOUNDS[1][0] <= np.median([*distances.values()]) <= _EYE_DISTANCE_BOUNDS[1][1]
    ):
        implausible = distances
    if not implausible:
        return []
    distance = float(np.median([*implausible.values()]))
    suffix = "" if len(implausible) == len(distances) else f" of {list_names(list(implausible))}"
    declared = rays.metadata.get("source_frame", {}).get("units", "m")
    size = UNITS.get(declared, 1.0) * MEAN_EYE_DISTANCE / max(distance, 1e-12)
    matching_units = [
        u
        for u, metres in UNITS.items()
        if u != declared and metres / _UNIT_TOLERANCE <= size <= metres * _UNIT_TOLERANCE
    ]
    if matching_units:
        remedy = f"is the unit {matching_units[0]}? ({parameter('units', matching_units[0])})"
    else:
        remedy = f"the unit of length of the file is about {size:.2g} m: scale its positions by this factor"
    return [
        f"the eyes{suffix} are {1e3 * distance:.3g} mm apart; {1e3 * MEAN_EYE_DISTANCE:.0f} mm is typical; {remedy}"
    ]


# ---- Warnings of the readers of tracking files ----


@check("problems that the reader found in the files")
def check_files(stats: RayStatistics) -> list[str]:
    return list(stats.rays.metadata.get("complaints", []))


# ---- Frozen gaze ----

_MIN_FROZEN_FRACTION, _MIN_FROZEN_SECONDS = 0.01, 10.0  # of a participant's rays; less is a brief loss of tracking


@check(
    "gaze that does not move for a second or more, in the world or relative to the head, while the head moves "
    "(`nerg rays filter`)"
)
def check_frozen(stats: RayStatistics) -> list[str]:
    rays = stats.rays
    frozen = stats.is_frozen
    if not frozen.any() or not stats.median_interval:
        return []
    num_frozen, num_rays = (np.bincount(p, minlength=len(rays.persons)) for p in (rays.person[frozen], rays.person))
    persons = np.flatnonzero(
        (num_frozen >= _MIN_FROZEN_FRACTION * num_rays) & (num_frozen * stats.median_interval >= _MIN_FROZEN_SECONDS)
    )
    if not persons.size:
        return []
    persons = persons[np.argsort(-num_frozen[persons] / num_rays[persons], kind="stable")]
    names = [f"{rays.persons[p]} ({100 * num_frozen[p] / num_rays[p]:.0f} % of the rays)" for p in persons]
    always_frozen = [p for p in persons if num_frozen[p] > 0.9 * num_rays[p]]
    remedy = "exclude these times (nerg rays filter --start, --end)"
    if len(always_frozen) == len(persons):
        remedy = "exclude these participants (nerg rays filter --without-person)"
    return [
        f"the gaze of {list_names(names)} does not move for seconds while the head moves: the tracker has probably "
        f"lost the eyes, or recorded the direction of the head as gaze; {remedy}"
    ]


# ---- Unit of length and up axis, from the heights of heads ----
#
# The bounds are wide: they detect a wrong unit or axis, not an unusual environment.

_HEAD_HEIGHTS = 0.4, 2.3  # metres above the floor; range of the median height of all heads


@check(
    "implausible heights and extents of head positions, origins that never move, and the axis of the file with "
    "plausible heights (`--units`, `--up`)"
)
def check_lengths(stats: RayStatistics) -> list[str]:
    """Check the unit of length and the up axis by the heights and the extent of the origins."""
    extent, median, out = stats.extent, stats.height_percentiles[1], []
    if stats.rays.metadata.get("has_fixed_origins"):
        return []  # check_files reports these
    if not extent.any() and len(stats.rays) > 1:
        position = ", ".join(f"{v:.3g}" for v in stats.rays.origin[0] + 0.0)
        return [
            f"all origins are {position} m: the head's position was not recorded, or the gaze is in the head's "
            f"frame; map the position (origin) and the rotation of the head ({parameter('columns')}), if the files "
            "contain them"
        ]
    if 100 <= median <= 230:
        out.append(f"the median height is {median:.0f} m: is the unit centimetres? ({parameter('units', 'cm')})")
    elif extent.max() > 1000 or 1000 <= median <= 2300:
        out.append(
            f"the origins span {extent.max():.0f} m, at a median height of {median:.0f} m: is the unit "
            f"millimetres? ({parameter('units', 'mm')})"
        )
    elif extent.max() < 0.05 and len(stats.rays) >= MIN_RAYS:
        out.append(f"the origins span only {extent.max():.3f} m: is the unit larger than declared?")
    elif (extent[2] > 2.0 and extent[2] > min(extent[0], extent[1])) or (
        stats.is_floor_at_zero and not _HEAD_HEIGHTS[0] <= median <= _HEAD_HEIGHTS[1]
    ):
        finding = (
            "the origins vary more in height than horizontally"
            if not stats.is_floor_at_zero or _HEAD_HEIGHTS[0] <= median <= _HEAD_HEIGHTS[1]
            else f"the median eye height is {median:.2f} m"
        )
        axis = _find_height_axis(stats.rays)
        remedy = (
            f"{axis} of the file has the values of a head's height: is it the up axis? ({parameter('up', axis)})"
            if axis
            else "check the up axis and the unit; otherwise the floor is not at height 0"
        )
        out.append(f"{finding}; {remedy}")
    return out


def _find_height_axis(rays: Rays) -> str | None:
    """Find the axis of the file, other than the declared up axis, along which origins stay at head height; None if
    there is no such axis or more than one."""
    positions = rays.origin[:: max(1, len(rays) // MAX_CHECKED_RAYS)] @ to_source(rays).T
    low, mid, high = np.percentile(positions, [5, 50, 95], axis=0)
    is_head_height = (np.abs(mid) > 0.9) & (np.abs(mid) < 2.2) & (high - low < 1.0)
    is_head_height[np.argmax(np.abs(to_source(rays)[:, 2]))] = False
    (axes,) = np.nonzero(is_head_height)
    return None if len(axes) != 1 else ("-" if mid[axes[0]] < 0 else "") + "xyz"[axes[0]]


# ---- Participant columns that count rows or samples ----

_MAX_RAYS_OF_COUNTER = 2  # median number of rays per participant


# A long number as spreadsheets display it, and save it as text.
_ROUNDED_NUMBER = re.compile(r"\d([.,]\d+)?E\+\d\d+")


@check(
    "participants with one or two rays each: a row counter mapped as the participant (`person` in `--map`); names that "
    "are numbers rounded by a spreadsheet"
)
def check_participants(stats: RayStatistics) -> list[str]:
    rays = np.bincount(stats.rays.person)
    rays = rays[rays > 0]
    rounded = [name for name in stats.rays.participants if _ROUNDED_NUMBER.fullmatch(name)]
    if rounded:
        return [
            f"{list_names(rounded)} {'is a number' if len(rounded) == 1 else 'are numbers'} that a spreadsheet has "
            "rounded, so that different participants may have become one: export the column as text"
        ]
    if stats.is_subsampled or len(rays) < MIN_RAYS or np.median(rays) > _MAX_RAYS_OF_COUNTER:
        return []
    return [
        f"{len(rays):,} participants have only {len(stats.rays):,} rays in total: does their column count rows? "
        f"(leave person out of {parameter('columns')}, so that each file is one participant)"
    ]


# ---- Unit and column of time ----

_DEVICE_RATES = 5.0, 2100.0  # sampling rates of existing devices, Hz
_COMMON_RATE = 60.0


@check("speeds above walking pace, implausible sampling rates, constant times (`--tick`, `--map t=`)")
def check_times(stats: RayStatistics) -> list[str]:
    """Check the unit and the column of time by the speeds of the origins and the sampling rate."""
    speed, step, out = stats.speed_p95, stats.median_interval, []
    if speed > 5:
        out.append(
            f"5 % of the steps are faster than {speed:.1f} m/s, which is above walking pace: check the unit of "
            f"time ({parameter('tick')}) or of length"
        )
    if step is None or np.isnan(step):
        if step is not None:
            out.append(
                "all rays of a participant have the same time: is the column of time correct? "
                f"({parameter('columns', 't=...')})"
            )
        return out
    # With most intervals above one second, hardly any time counts as recorded.
    if not 1e-4 <= step <= 1.0:
        tick = stats.rays.metadata.get("tick", 1.0)
        rates = {1 / (step * f): f for f in (1e-3, 1e-6, 1e-7, 1e-9, 1e3, 60.0)}
        factors = {rate: f for rate, f in rates.items() if _DEVICE_RATES[0] <= rate <= _DEVICE_RATES[1]}
        remedy = f"check the unit of time ({parameter('tick')})"
        if factors:
            # Microseconds of 60 Hz are also 600 Hz in the ticks of .NET, and these are also 6 Hz in microseconds.
            rate = min(factors, key=lambda rate: abs(math.log(rate / _COMMON_RATE)))
            unit = tick * factors[rate]
            remedy = (
                f"with a unit of time of {unit:g} s the sampling rate would be {rate:.3g} Hz "
                f"({parameter('tick', f'{unit:g}')})"
            )
        out.append(f"the median sampling interval is {step:.3g} s; {remedy}")
    return out


# ---- The checks of recordings, in the order of the quality report ----

RECORDING_CHECKS: tuple[Check, ...] = (
    check_files,
    check_participants,
    check_lengths,
    check_eyes,
    check_times,
    check_clocks,
    check_frozen,
)
