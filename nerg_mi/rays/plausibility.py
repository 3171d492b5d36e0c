"""What is implausible about a set of rays, and the mistake that is likely behind it.

Units and axes show in the heights and the extent. A mirrored or reversed direction shows where it disagrees with the
hit point, or with where people walk: people look ahead. A frame mirrored as a whole, positions with directions,
contradicts nothing and cannot be seen without the place itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .filters import time_order
from .rays import Rays

# The bounds are wide: they catch a wrong unit or axis, not an unusual shop.
_OFF = 5.0  # degrees between direction and hit point
_NEAR = 0.2  # metres: directions to nearer hit points say little
_FEW = 20  # hit points from which on they are asked
_STEEP = 50.0  # degrees up or down
_AHEAD = 0.2  # correlation of gaze and walking along an axis
_MOST = 200_000  # rays looked at
_WALKED = 1 << 19, 1 << 11  # rays looked at in runs of so many, where it matters which comes after which
_USUAL = 5.0, 2100.0  # rays a second of devices that there are


@dataclass(frozen=True, eq=False)
class Figures:
    """What a summary has found of rays already, in the frame of rays."""

    height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    extent: np.ndarray  # (3,) of the origins' box, metres
    speed: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    step: float | None  # median of a person's positive times between rays, seconds; NaN: none is; None: no times
    order: np.ndarray | None  # (N,) by person and time, as `filters.time_order` gives it


def find_warnings(rays: Rays, figures: Figures) -> list[str]:
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy: those of all
    `CHECKS`."""
    return [warning for check in CHECKS for warning in check(rays, figures)]


def _to_source(rays: Rays) -> np.ndarray:
    """Rotation, or mirror, from the frame of rays back to the file's, (3, 3): file = R ours."""
    matrix = np.asarray(rays.metadata.get("transform", np.eye(4)), dtype=np.float64)[:3, :3]
    return np.linalg.inv(matrix / np.cbrt(abs(np.linalg.det(matrix))))


def check_files(rays: Rays, figures: Figures) -> list[str]:
    """What the reader of the files found wrong with them."""
    return list(rays.metadata.get("complaints", []))


def check_lengths(rays: Rays, figures: Figures) -> list[str]:
    """Units of length and the up axis, by the heights and the extent of the origins."""
    extent, median, out = figures.extent, figures.height[1], []
    if 100 <= median <= 230:
        out.append(f"the median height is {median:.0f} m: is the unit centimetres? (--units cm)")
    elif extent.max() > 1000 or 1000 <= median <= 2300:
        out.append(
            f"the origins span {extent.max():.0f} m, at a median height of {median:.0f} m: "
            "is the unit millimetres? (--units mm)"
        )
    elif extent.max() < 0.05:
        out.append(f"the origins span {extent.max():.3f} m: is the unit larger than declared?")
    elif (extent[2] > 2.0 and extent[2] > min(extent[0], extent[1])) or not 0.4 <= median <= 2.3:
        what = (
            "the origins vary more in height than sideways"
            if 0.4 <= median <= 2.3
            else f"the median eye height is {median:.2f} m"
        )
        axis = _standing_axis(rays)
        remedy = (
            f"{axis} of the file looks like the height: is it the up axis? (--up {axis})"
            if axis
            else "check the up axis and the unit, or the floor is not at height 0"
        )
        out.append(f"{what}; {remedy}")
    return out


def _standing_axis(rays: Rays) -> str | None:
    """The axis of the file along which origins stay where heads are, if there is one besides the declared."""
    part = rays.origin[:: max(1, len(rays) // _MOST)] @ _to_source(rays).T
    low, mid, high = np.percentile(part, [5, 50, 95], axis=0)
    like_heads = (np.abs(mid) > 0.9) & (np.abs(mid) < 2.2) & (high - low < 1.0)
    like_heads[np.argmax(np.abs(_to_source(rays)[:, 2]))] = False
    (found,) = np.nonzero(like_heads)
    return None if len(found) != 1 else ("-" if mid[found[0]] < 0 else "") + "xyz"[found[0]]


def check_times(rays: Rays, figures: Figures) -> list[str]:
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
        tick = rays.metadata.get("tick", 1.0)
        fits = [f for f in (1e-3, 1e-6, 1e-7, 1e-9, 1e3, 60.0) if _USUAL[0] <= 1 / (step * f) <= _USUAL[1]]
        remedy = "check the unit of time (--tick)"
        if fits:
            unit, rate = tick * fits[0], 1 / (step * fits[0])
            remedy = f"were a unit of the file's time {unit:g} s, it would be {rate:.3g} a second (--tick {unit:g})"
        out.append(f"a ray comes every {step:.3g} s; {remedy}")
    return out


def check_directions(rays: Rays, figures: Figures) -> list[str]:
    """The frame of the directions: by the hit points or, where these tell nothing, by steep gaze and by walking."""
    return _check_hits(rays) or [*_check_elevation(rays), *_check_walking(rays, figures.order)]


def _check_hits(rays: Rays) -> list[str]:
    if rays.hit is None:
        return []
    R = _to_source(rays)
    some = np.flatnonzero(np.isfinite(rays.hit).all(axis=1))
    some = some[:: max(1, len(some) // _MOST)]
    to_hit = (rays.hit[some] - rays.origin[some]) @ R.T
    length = np.linalg.norm(to_hit, axis=1)
    far = length > _NEAR
    if far.sum() < _FEW:
        return []
    to_hit, d = to_hit[far] / length[far, None], rays.direction[some][far] @ R.T
    angle = lambda v: float(np.median(np.degrees(np.arccos(np.clip(np.sum(v * to_hit, axis=1), -1, 1)))))
    now = angle(d)
    if not now > _OFF:
        return []
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=3)))[1:]
    tried = {" and ".join("xyz"[i] for i in np.flatnonzero(s < 0)): angle(d * s) for s in signs}
    best = min(tried, key=tried.__getitem__)
    remedy = "check that they are of one frame and one unit"
    if tried[best] < min(_OFF, 0.5 * now):
        remedy = f"with {best} of the directions negated they would, to {tried[best]:.2g}: check their frame"
    return [f"the directions miss the hit points by {now:.0f} degrees (median); {remedy}"]


def _check_elevation(rays: Rays) -> list[str]:
    elevation = np.degrees(np.arcsin(np.clip(rays.direction[:: max(1, len(rays) // _MOST), 2], -1, 1)))
    median = np.median(elevation)
    if abs(median) <= _STEEP:
        return []
    return [
        f"half of the rays look more than {abs(median):.0f} degrees {'up' if median > 0 else 'down'}: "
        "check the axes of the directions, or which way is forward"
    ]


def _check_walking(rays: Rays, order: np.ndarray | None) -> list[str]:
    agree = walking_agreement(rays, order)
    if agree is None:
        return []
    against = [i for i in range(3) if agree[i] < -_AHEAD]
    along = [i for i in range(3) if agree[i] > _AHEAD]
    if against and not along:
        return [
            "people look back to where they came from: are the directions reversed? "
            "(--forward, or the sign of the direction)"
        ]
    if against:
        return [
            f"along {' and '.join('xyz'[i] for i in against)} of the file people look away from where they walk: "
            "are positions and directions mirrored against each other? (--hand)"
        ]
    return []


CHECKS: tuple[Callable[[Rays, Figures], list[str]], ...] = (check_files, check_lengths, check_times, check_directions)
"""What is looked for, in the order of the card; each check gives no sentence where nothing is wrong."""


def walking_agreement(rays: Rays, order: np.ndarray | None = None) -> np.ndarray | None:
    """Correlation of gaze with walking along each axis of the file, (3,), 0 along the up axis; ``None`` where nobody
    walks.

    Steps of half a second, at 0.3 to 3 m/s. People look ahead: far above zero along each axis on which they walk.
    ``order``: `filters.time_order` of the rays, if it is known. Of millions of rays, runs of some thousands are looked
    at.
    """
    order = time_order(rays) if order is None else order
    n, (most, run) = len(rays), _WALKED
    if n <= most:
        rows = np.arange(n)
    else:
        first = np.linspace(0, n - run, most // run).astype(np.int64)
        rows = (first[:, None] + np.arange(run)).ravel()
    order = rows if order is None else order[rows]
    t, person = rays.t[order], rays.person[order]
    starts = np.r_[np.flatnonzero(np.r_[True, np.diff(person) != 0]), len(t)]
    later = np.minimum(np.arange(len(t)) + _lag(t, starts), len(t) - 1)
    dt = t[later] - t
    same = (person[later] == person) & (dt > 0) & (dt < 2.0)
    moved = (rays.origin[order[later]] - rays.origin[order])[same]
    moved[:, 2] = 0
    speed = np.linalg.norm(moved, axis=1) / dt[same]
    walks = (speed > 0.3) & (speed < 3.0)
    if walks.sum() < 200:
        return None
    R = _to_source(rays)
    d = rays.direction[order[same]][walks] * (1, 1, 0)
    v, d = moved[walks] / np.linalg.norm(moved[walks], axis=1, keepdims=True) @ R.T, d @ R.T
    norm = np.sqrt((v**2).mean(axis=0) * (d**2).mean(axis=0))
    # An axis on which hardly anybody walks says nothing.
    share = (v**2).mean(axis=0)
    return np.where(share > 0.05, (v * d).mean(axis=0) / np.maximum(norm, 1e-12), 0.0)


def _lag(t: np.ndarray, starts: np.ndarray) -> int:
    """Rays in half a second."""
    step = np.diff(t)
    step[starts[1:-1] - 1] = np.inf
    step = step[(step > 0) & (step <= 1.0)]
    return max(1, round(0.5 / np.median(step))) if step.size else 1
