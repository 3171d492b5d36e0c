"""Checks of rays for implausible recordings: what a check is and is given, and those of participants, lengths,
eyes, times and clocks.

To add one, write ``@check("what it looks for") def check_NAME(figures)`` here or in
:mod:`nerg_mi.rays.direction_checks`, and add it to the list at the end of that file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .filters import Sessions, find_frozen, find_sessions
from .rays import Rays
from .readers.base import UNITS

# ---- What checks of rays are given, and what several of them need ----

MOST = 200_000  # Rays looked at, where a part of them says as much as all
ENOUGH = 50  # Rays from which on something can be said of what most of them do: a second of a recording
_NAMED = 3  # people


@dataclass(frozen=True, eq=False)
class Figures:
    """Rays, and what a summary has found of them already, in the frame of rays."""

    rays: Rays
    height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    extent: np.ndarray  # (3,) of the origins' box, metres
    speed: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    step: float | None  # median of a person's positive times between rays, seconds; NaN: none is; None: no times
    order: np.ndarray | None  # (N,) by person and time, as `filters.time_order` gives it

    @cached_property
    def sessions(self) -> Sessions:
        """Recordings, in the order in which rays are stored."""
        return find_sessions(self.rays)

    @cached_property
    def frozen(self) -> np.ndarray:
        """Rays (N,) bool whose gaze stands still while the head moves."""
        return find_frozen(self.rays, self.sessions)

    @property
    def floor_known(self) -> bool:
        """Whether the height 0 is the floor, as far as the reader of the files knows."""
        return self.rays.metadata.get("floor") != "unknown"

    @property
    def selected(self) -> bool:
        """Whether rays between others were left out since the import, so that the times between them say little."""
        return any(step.get("step") in ("thin", "fixations") for step in self.rays.metadata.get("steps", []))


def to_source(rays: Rays) -> np.ndarray:
    """Rotation, or mirror, from the frame of rays back to the file's, (3, 3): file = R ours."""
    matrix = np.asarray(rays.metadata.get("transform", np.eye(4)), dtype=np.float64)[:3, :3]
    return np.linalg.inv(matrix / np.cbrt(abs(np.linalg.det(matrix))))


def group_medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Medians (count,) of the ``values`` (n,) with the same number ``group`` (n,); NaN where there are none."""
    order = np.lexsort((values, group))
    ends = np.searchsorted(group[order], np.arange(count + 1))
    n, values = np.diff(ends), values[order]
    if not values.size:
        return np.full(count, np.nan)
    low, high = (np.clip(ends[:-1] + k, 0, len(values) - 1) for k in ((n - 1) // 2, n // 2))
    return np.where(n > 0, 0.5 * (values[low] + values[high]), np.nan)


def name_some(names: Sequence[str]) -> str:
    """``ann, bo, cy and 4 more``."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def name_persons(rays: Rays, persons: Iterable[int]) -> str:
    """As `name_some`, of numbers of persons."""
    return name_some([rays.persons[person] for person in persons])


# ---- What a check of rays is ----


@dataclass(frozen=True)
class Check:
    """A look at rays for one kind of mistake."""

    name: str
    """A word, that of its function."""

    looks_for: str
    """What gives the mistake away, in a phrase of Markdown."""

    find: Callable[[Figures], list[str]]
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy; none where nothing
    is wrong, or where the rays do not tell. Of millions of rays it takes a fraction of a second."""


def check(looks_for: str) -> Callable[[Callable[[Figures], list[str]]], Check]:
    """Make a check, which is called NAME, of a function ``check_NAME(figures)``."""
    return lambda find: Check(find.__name__.removeprefix("check_"), looks_for, find)


# ---- Clocks that jump, change their pace, or are those of several recordings under one name ----

_GAP = 5.0  # seconds without a ray after which it is asked whether the head went on meanwhile
_BACK = 1.0  # seconds; less is a row in the wrong place
_BESIDE = 10  # rays before and after a gap by which a movement is known
_MOVES, _TURNS = 0.2, 10.0  # metres and degrees a second of a head that moves
_AS_BEFORE = 3.0  # steps of the movement that a head does over what is a gap of the clock alone
_GAPS = 0.01, 500  # share of the rays up to which they are gaps, and how many are looked at
_SAME = 0.05  # share of a person's rays at the time of another of theirs
_APART = 0.3  # metres: two people
_WINDOW, _WINDOWS = 64, 4096  # rays, and how many such windows are looked at
_PACE = 20.0  # factor between the paces of one device
_FEW = 0.02  # share of a person's windows
_EPOCH = 1e8  # seconds, three years, between times on one clock


@check(
    "times that go back or leap while the head goes on as before, recordings under one name that overlap or are there "
    "twice, people whose clock counts in another unit or from another moment (`--tick`, `--person-from`, `--clock`)"
)
def check_clocks(figures: Figures) -> list[str]:
    if figures.step is None or np.isnan(figures.step):
        return []  # no two times, which another check tells
    return [
        *(_check_jumps(figures) or _check_duplicates(figures) or _check_overlaps(figures)),
        *(_check_pace(figures) or _check_epochs(figures)),
    ]


def _check_jumps(figures: Figures) -> list[str]:
    """Gaps, or steps back, of the clock over which the head goes on as before."""
    if figures.selected:
        return []
    rays, sessions = figures.rays, figures.sessions
    person, t = (v if sessions.order is None else v[sessions.order] for v in (rays.person, rays.t))
    dt = np.diff(t)
    (gaps,) = np.nonzero((person[1:] == person[:-1]) & ((dt < -_BACK) | (dt >= _GAP)))
    found: dict[int, list[float]] = {}
    if len(gaps) > max(10, _GAPS[0] * len(rays)):
        return []
    for k in gaps[:: max(1, len(gaps) // _GAPS[1])].tolist():
        a, b = max(0, k + 1 - _BESIDE), min(len(t), k + 1 + _BESIDE)
        rows = sessions.rows(slice(a, b))
        if (rays.person[rows] == person[k]).all() and b - a > _BESIDE and _goes_on(figures, rows, k - a):
            found.setdefault(int(person[k]), []).append(float(dt[k]))
    if not found:
        return []
    longest = max((s for steps in found.values() for s in steps), key=abs)
    count, names = sum(map(len, found.values())), name_persons(rays, found)
    return [
        f"the clock of {names} jumps {'once' if count == 1 else f'{count} times'}, by {longest:+,.0f} s at most, while "
        "the head goes on as if there were no gap: mend the times of the file"
    ]


def _goes_on(figures: Figures, rows: slice | np.ndarray, k: int) -> bool:
    """Whether the head moves from place ``k`` of the rows to the next as it does before and after."""
    rays = figures.rays
    dt = np.delete(np.diff(rays.t[rows]), k)
    dt = float(np.median(dt[dt > 0])) if (dt > 0).any() else 0.0
    for values, least in ((rays.origin, _MOVES), (rays.head, np.radians(_TURNS))):
        if values is not None and dt > 0:
            step = np.linalg.norm(np.diff(values[rows], axis=0), axis=1)
            usual = float(np.median(np.delete(step, k)))
            if usual > least * dt:
                # Whoever turns their head stands where they stood, besides.
                moved = np.linalg.norm(np.diff(rays.origin[rows], axis=0), axis=1)[k]
                return bool(step[k] <= _AS_BEFORE * usual and moved <= max(0.02, _AS_BEFORE * usual))
    return False


def _check_overlaps(figures: Figures) -> list[str]:
    """Recordings of one person that go on at the same times."""
    rays, sessions = figures.rays, figures.sessions
    some = np.isin(sessions.person, sessions.person[sessions.back])
    if not some.any():
        return []
    at = lambda places: rays.t[places if sessions.order is None else sessions.order[places]]
    person, first, last = sessions.person[some], at(sessions.starts[:-1][some]), at(sessions.starts[1:][some] - 1)
    order = np.lexsort((first, person))
    person, first, last = person[order], first[order], last[order]
    overlap = (person[1:] == person[:-1]) & (first[1:] < last[:-1])
    if not overlap.any():
        return []
    names = name_persons(rays, np.unique(person[1:][overlap]))
    return [
        f"recordings of {names} overlap in time: do several people, or several clocks, share a name? "
        "(--person-from filename, or --map person=...)"
    ]


def _check_duplicates(figures: Figures) -> list[str]:
    """Rays of one person at the same times: a file twice, or two people."""
    rays, order = figures.rays, figures.order
    person, t = (v if order is None else v[order] for v in (rays.person, rays.t))
    same = (np.diff(person) == 0) & (np.diff(t) == 0)
    if not same.any():
        return []
    count = np.bincount(person[1:][same], minlength=len(rays.persons))
    who = count > _SAME * np.bincount(person, minlength=len(rays.persons))
    (pairs,) = np.nonzero(same & who[person[1:]])
    pairs = pairs[:: max(1, len(pairs) // 10_000)]
    if not pairs.size:
        return []
    a, b = (pairs + k if order is None else order[pairs + k] for k in (0, 1))
    apart = np.linalg.norm(rays.origin[a] - rays.origin[b], axis=1)
    turned = np.linalg.norm(rays.direction[a] - rays.direction[b], axis=1)
    names = lambda mask: name_persons(rays, np.unique(rays.person[a][mask]))
    out = []
    if np.mean(twice := (apart < 1e-3) & (turned < 1e-3)) > 0.5:
        out.append(f"rays of {names(twice)} are there twice: was a file imported two times?")
    if np.mean(two := apart > _APART) > 0.5:
        out.append(
            f"{names(two)} is at two places at the same times: do several people share a name? "
            "(--person-from filename, or --map person=...)"
        )
    return out


def _check_pace(figures: Figures) -> list[str]:
    """Times that count in other units for some of the people, or some of the time."""
    rays, sessions = figures.rays, figures.sessions
    if figures.selected:
        return []
    length = np.diff(sessions.starts)
    first, session = [], np.flatnonzero(length > _WINDOW)
    per = [max(1, min(int(length[s]) // _WINDOW, _WINDOWS * int(length[s]) // len(rays))) for s in session]
    for s, n in zip(session.tolist(), per):
        first.append(np.linspace(sessions.starts[s], sessions.starts[s + 1] - _WINDOW - 1, n).astype(np.int64))
    if not first:
        return []
    places = np.concatenate(first)[:, None] + np.arange(_WINDOW + 1)
    t = rays.t[places if sessions.order is None else sessions.order[places]]
    pace, person = np.median(np.diff(t, axis=1), axis=1), np.repeat(sessions.person[session], per)
    pace, person = pace[pace > 0], person[pace > 0]
    count = len(rays.persons)
    of_person = group_medians(pace, person, count)
    out, usual = [], np.nanmedian(of_person)
    other = lambda ratio: (ratio > _PACE) | (ratio < 1 / _PACE)
    for p in np.flatnonzero(other(of_person / usual))[:1]:
        names = name_persons(rays, np.flatnonzero(other(of_person / usual)))
        out.append(
            f"a ray of {names} comes every {of_person[p]:.3g} s, and of others every {usual:.3g} s: does their clock "
            "count in another unit? Import them apart (--tick)"
        )
    odd = other(pace / of_person[person])
    changes = np.bincount(person[odd], minlength=count) > np.maximum(1, _FEW * np.bincount(person, minlength=count))
    if changes.any():
        share = 100 * odd[changes[person]].mean()
        out.append(
            f"the clock of {name_persons(rays, np.flatnonzero(changes))} changes its pace by more "
            f"than {_PACE:.0f} times for {share:.0f} % of the rays: does it count in two units? Mend the file's times"
        )
    return out


def _check_epochs(figures: Figures) -> list[str]:
    """People whose clocks count from moments that lie years apart."""
    rays, sessions = figures.rays, figures.sessions
    first = sessions.starts[:-1] if sessions.order is None else sessions.order[sessions.starts[:-1]]
    order = np.argsort(rays.t[first], kind="stable")
    when, person = rays.t[first][order], sessions.person[order]
    cut = int(np.argmax(np.diff(when))) + 1 if len(when) > 1 else 0
    if not cut or when[cut] - when[cut - 1] < _EPOCH:
        return []
    fewer = np.unique(min(person[cut:], person[:cut], key=len))
    names = name_persons(rays, fewer)
    return [
        f"the clock of {names} counts from another moment than that of others: split by time for each person by itself "
        "(--clock person)"
    ]


# ---- The unit of length, by how far the eyes are apart ----

USUAL = 0.063  # Metres between the eyes of adults, on average; 95 % of them lie between 0.055 and 0.071 (Dodgson 2004)
_BOUNDS = (0.050, 0.078), (0.055, 0.072)  # metres, of one, and of the median of several
_SEVERAL = 5
_LIKE = 1.25  # factor up to which a unit fits


@check(
    "eyes nearer to each other or farther apart than people's, where both are recorded (`--units`, or the scale of the "
    "recorder's scene)"
)
def check_eyes(figures: Figures) -> list[str]:
    rays = figures.rays
    there = {rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))}
    found = {name: d for name, d in rays.metadata.get("eye_distance", {}).items() if name in there}
    odd = {name: d for name, d in found.items() if not _BOUNDS[0][0] <= d <= _BOUNDS[0][1]}
    if not odd and len(found) >= _SEVERAL and not _BOUNDS[1][0] <= np.median([*found.values()]) <= _BOUNDS[1][1]:
        odd = found
    if not odd:
        return []
    distance = float(np.median([*odd.values()]))
    whose = "" if len(odd) == len(found) else f" of {name_some(list(odd))}"
    declared = rays.metadata.get("source_frame", {}).get("units", "m")
    size = UNITS.get(declared, 1.0) * USUAL / max(distance, 1e-12)
    fits = [u for u, metres in UNITS.items() if u != declared and metres / _LIKE <= size <= metres * _LIKE]
    if fits:
        remedy = f"is the unit {fits[0]}? (--units {fits[0]})"
    else:
        remedy = f"a unit of the file's lengths is about {size:.2g} m: scale its positions by that"
    return [f"the eyes{whose} are {1e3 * distance:.3g} mm apart, where people have {1e3 * USUAL:.0f}; {remedy}"]


# ---- What the readers of tracking files found wrong with them ----


@check("what the reader of the files found wrong with them, as it read them")
def check_files(figures: Figures) -> list[str]:
    return list(figures.rays.metadata.get("complaints", []))


# ---- Gaze that does not move ----

_SHARE, _SECONDS = 0.01, 10.0  # of a person's rays: less is a moment without the eyes


@check(
    "gaze that does not turn for a second or more, in the world or against the head, while the head moves "
    "(`nerg rays filter`)"
)
def check_frozen(figures: Figures) -> list[str]:
    rays = figures.rays
    frozen = figures.frozen
    if not frozen.any() or not figures.step:
        return []
    lost, all_ = (np.bincount(p, minlength=len(rays.persons)) for p in (rays.person[frozen], rays.person))
    who = np.flatnonzero((lost >= _SHARE * all_) & (lost * figures.step >= _SECONDS))
    if not who.size:
        return []
    who = who[np.argsort(-lost[who] / all_[who], kind="stable")]
    names = [f"{rays.persons[p]} ({100 * lost[p] / all_[p]:.0f} % of the rays)" for p in who]
    whole = [p for p in who if lost[p] > 0.9 * all_[p]]
    remedy = "leave these times out (nerg rays filter --from, --to)"
    if len(whole) == len(who):
        remedy = "leave them out (nerg rays filter --without-person)"
    return [
        f"the gaze of {name_some(names)} stands still for seconds while the head moves, as if the tracker had lost the "
        f"eyes or wrote the head's direction in their place; {remedy}"
    ]


# ---- The unit of length and the up axis, by where heads are ----
#
# The bounds are wide: they catch a wrong unit or axis, not an unusual shop.

_HEADS = 0.4, 2.3  # metres over the floor between which the median of all heads is


@check(
    "heights and extents that heads do not have, and the axis of the file along which they have them (`--units`, "
    "`--up`)"
)
def check_lengths(figures: Figures) -> list[str]:
    """Units of length and the up axis, by the heights and the extent of the origins."""
    extent, median, out = figures.extent, figures.height[1], []
    if 100 <= median <= 230:
        out.append(f"the median height is {median:.0f} m: is the unit centimetres? (--units cm)")
    elif extent.max() > 1000 or 1000 <= median <= 2300:
        out.append(
            f"the origins span {extent.max():.0f} m, at a median height of {median:.0f} m: "
            "is the unit millimetres? (--units mm)"
        )
    elif extent.max() < 0.05 and len(figures.rays) >= ENOUGH:
        out.append(f"the origins span {extent.max():.3f} m: is the unit larger than declared?")
    elif (extent[2] > 2.0 and extent[2] > min(extent[0], extent[1])) or (
        figures.floor_known and not _HEADS[0] <= median <= _HEADS[1]
    ):
        what = (
            "the origins vary more in height than sideways"
            if not figures.floor_known or _HEADS[0] <= median <= _HEADS[1]
            else f"the median eye height is {median:.2f} m"
        )
        axis = _standing_axis(figures.rays)
        remedy = (
            f"{axis} of the file looks like the height: is it the up axis? (--up {axis})"
            if axis
            else "check the up axis and the unit, or the floor is not at height 0"
        )
        out.append(f"{what}; {remedy}")
    return out


def _standing_axis(rays: Rays) -> str | None:
    """The axis of the file along which origins stay where heads are, if there is one besides the declared."""
    part = rays.origin[:: max(1, len(rays) // MOST)] @ to_source(rays).T
    low, mid, high = np.percentile(part, [5, 50, 95], axis=0)
    like_heads = (np.abs(mid) > 0.9) & (np.abs(mid) < 2.2) & (high - low < 1.0)
    like_heads[np.argmax(np.abs(to_source(rays)[:, 2]))] = False
    (found,) = np.nonzero(like_heads)
    return None if len(found) != 1 else ("-" if mid[found[0]] < 0 else "") + "xyz"[found[0]]


# ---- Participants who are rows of a table: its column of them counts rows, or names each sample ----

_PARTICIPANTS_FEW = 2  # rays of a participant, by the median


@check("participants of one or two rays each: a column that counts rows, taken for participants (`person` in `--map`)")
def check_participants(figures: Figures) -> list[str]:
    rays = np.bincount(figures.rays.person)
    rays = rays[rays > 0]
    if figures.selected or len(rays) < ENOUGH or np.median(rays) > _PARTICIPANTS_FEW:
        return []
    return [
        f"{len(rays):,} participants have {len(figures.rays):,} rays together: does their column count rows? (leave "
        "person out of --map, so that each file is a participant)"
    ]


# ---- The unit and the column of time ----

_USUAL = 5.0, 2100.0  # rays a second of devices that there are


@check("speeds that nobody walks, rates of rays that no device has, times that never change (`--tick`, `--map t=`)")
def check_times(figures: Figures) -> list[str]:
    """The unit and the column of time, by the speeds of the origins and the rate of rays."""
    speed, step, out = figures.speed, figures.step, []
    if speed > 5:
        out.append(
            f"5 % of the steps are faster than {speed:.1f} m/s, no walking pace: "
            "check the unit of time (--tick) or length"
        )
    if step is None or np.isnan(step):
        if step is not None:
            out.append(
                "all rays of a person have the same time: is it the column of times that was named? (--map t=...)"
            )
        return out
    # Where most rays come more than a second apart hardly anything counts as recorded time.
    if not 1e-4 <= step <= 1.0:
        tick = figures.rays.metadata.get("tick", 1.0)
        fits = [f for f in (1e-3, 1e-6, 1e-7, 1e-9, 1e3, 60.0) if _USUAL[0] <= 1 / (step * f) <= _USUAL[1]]
        remedy = "check the unit of time (--tick)"
        if fits:
            unit, rate = tick * fits[0], 1 / (step * fits[0])
            remedy = f"were a unit of the file's time {unit:g} s, it would be {rate:.3g} a second (--tick {unit:g})"
        out.append(f"a ray comes every {step:.3g} s; {remedy}")
    return out


# ---- The checks of recordings, in the order of the card: who, how large, and when ----

RECORDING_CHECKS: tuple[Check, ...] = (
    check_files,
    check_participants,
    check_lengths,
    check_eyes,
    check_times,
    check_clocks,
    check_frozen,
)
