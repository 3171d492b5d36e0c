"""Clocks that jump, change their pace, or are those of several recordings under one name."""

from __future__ import annotations

import numpy as np

from .figures import Figures, group_medians, name_some
from .protocol import check

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
    count, names = sum(map(len, found.values())), name_some([rays.persons[p] for p in found])
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
    names = name_some([rays.persons[p] for p in np.unique(person[1:][overlap])])
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
    names = lambda mask: name_some([rays.persons[p] for p in np.unique(rays.person[a][mask])])
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
        names = name_some([rays.persons[q] for q in np.flatnonzero(other(of_person / usual))])
        out.append(
            f"a ray of {names} comes every {of_person[p]:.3g} s, and of others every {usual:.3g} s: does their clock "
            "count in another unit? Import them apart (--tick)"
        )
    odd = other(pace / of_person[person])
    changes = np.bincount(person[odd], minlength=count) > np.maximum(1, _FEW * np.bincount(person, minlength=count))
    if changes.any():
        share = 100 * odd[changes[person]].mean()
        out.append(
            f"the clock of {name_some([rays.persons[p] for p in np.flatnonzero(changes)])} changes its pace by more "
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
    names = name_some([rays.persons[p] for p in fewer])
    return [
        f"the clock of {names} counts from another moment than that of others: split by time for each person by itself "
        "(--clock person)"
    ]
