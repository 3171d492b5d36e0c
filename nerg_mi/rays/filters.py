"""Choosing among rays: by time, person, cohort, place and confidence; and fewer of those who stand still."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerg_mi.errors import NergError

from .rays import Rays


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
    this.
    ``with_hit``: a hit point is known. Raises `NergError` for an unknown name or a box that is none.
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


def time_order(rays: Rays) -> np.ndarray | None:
    """The rays' order by person and time (N,); None where they are in that order already."""
    earlier = (rays.person[1:] < rays.person[:-1]) | (
        (rays.person[1:] == rays.person[:-1]) & (rays.t[1:] < rays.t[:-1])
    )
    return np.lexsort((rays.t, rays.person)) if earlier.any() else None


def person_order(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """The rays' order by person and time (N,), and where in it each person's run starts, with N at the end."""
    order = np.lexsort((rays.t, rays.person))
    starts = np.flatnonzero(np.r_[True, np.diff(rays.person[order]) != 0])
    return order, np.r_[starts, len(rays)]


def label_stays(rays: Rays, distance: float = 0.1, gap: float = 1.0) -> np.ndarray:
    """Which stay each ray belongs to, (N,) int64: the rays of a person from a first one on, as long as the origins lie
    within ``distance`` metres of its origin and no pause is longer than ``gap`` seconds. Numbered from 0."""
    order, starts = person_order(rays)
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
