"""What the rows of a table tell of its frame: the up axis and the unit by where heads are, the clock by its steps, the
way heads look by where they walk, and whether gaze is the head's or the world's by how far it is from the head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.rays.readers.frames import UNITS
from nerg_mi.rays.readers.parsing import poses

_LOW, _HIGH = 0.7, 2.3  # metres: so high are eyes, of people who sit or stand
_STAYS = 1.2  # metres: they hardly vary more in height
_RATES = 5.0, 2100.0  # rows a second of devices that there are
_TICKS = (1.0, 1e-3, 1e-6, 1e-9, 1e-7)
_STEP = 0.5  # seconds of walking that are looked at
_WALK = 0.3, 3.0  # metres a second
_AHEAD = 0.3  # mean cosine of a way to look and walking, from which on it is ahead
_FEWEST = 50  # steps of walking


@dataclass(frozen=True)
class Standing:
    """The axis that is up and the unit of length, by ``height``, the median along it in metres."""

    up: str
    units: str
    height: float


def find_standing(places: np.ndarray) -> Standing | None:
    """Of places of heads (n, 3), the one axis along which they stay where eyes are, in metres, centimetres or
    millimetres; None where no axis does, or two do."""
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return None
    low, middle, high = np.percentile(places, [5, 50, 95], axis=0)
    moves = np.ptp(places, axis=0).max() > 0
    found = []
    for units, metre in UNITS.items():
        for axis in range(3):
            height, varies = abs(middle[axis]) * metre, (high - low)[axis] * metre
            # An axis along which nothing moves may be a constant of another kind, but for a head that is not tracked.
            if _LOW <= height <= _HIGH and varies < _STAYS and moves:
                found.append((Standing(("-" if middle[axis] < 0 else "") + "xyz"[axis], units, height), varies))
    metres = [f for f in found if f[0].units == "m"] or found
    if len(metres) > 1:
        # Somebody who stays in a room may be at 1.6 m along each axis: up is where all of the time is spent.
        metres.sort(key=lambda f: f[1])
        if metres[0][1] > 0.5 * metres[1][1]:
            return None
    return metres[0][0] if metres else None


def find_tick(times: np.ndarray) -> float | None:
    """Seconds in a unit of ``times`` (n,), under which rows come as often as a device's; None where none fits."""
    step = np.diff(times[np.isfinite(times)])
    step = step[step > 0]
    if not step.size:
        return None
    middle = float(np.median(step))
    return next((t for t in _TICKS if _RATES[0] <= 1 / (middle * t) <= _RATES[1]), None)


def is_unit(vectors: np.ndarray, tolerance: float = 0.02) -> bool:
    """Whether nearly all of (n, C) that are finite have the length one; zeros count as missing."""
    length = np.linalg.norm(vectors, axis=1)
    length = length[np.isfinite(length) & (length > 1e-9)]
    return bool(length.size and np.mean(np.abs(length - 1) < tolerance) > 0.95)


def find_forward(turns: np.ndarray, places: np.ndarray, seconds: np.ndarray, up: str, metre: float) -> str | None:
    """The axis of the head's frame that points where people walk; None where they do not walk, or no axis does.

    ``turns`` (n, 3, 3) head to table, ``places`` (n, 3), ``seconds`` (n,); ``metre``: of a unit of length.
    """
    way = _walking(places, seconds, up, metre)
    good = np.isfinite(way).all(axis=1) & np.isfinite(turns).all(axis=(1, 2))
    if good.sum() < _FEWEST:
        return None
    level = _level(up)
    agree = {
        name: float(np.mean(np.sum((turns[good] @ axis) * level * way[good], axis=1)))
        for name, axis in poses.AXES.items()
        if name[-1] != up[-1]
    }
    best = max(agree, key=agree.__getitem__)
    return best if agree[best] > _AHEAD else None


def find_local(gaze: np.ndarray, turns: np.ndarray, forward: str) -> bool | None:
    """Whether ``gaze`` (n, 3) is in the head's frame rather than the table's: as which it is nearer to where the head
    points. None where both are alike, as of a head that does not turn."""
    ahead = poses.AXES[forward]
    length = np.linalg.norm(gaze, axis=1)
    good = np.isfinite(turns).all(axis=(1, 2)) & (length > 1e-9)
    d, heads = gaze[good] / length[good, None], turns[good] @ ahead
    if not len(d):
        return None
    angle = lambda cosine: float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    local, world = angle(d @ ahead), angle(np.sum(d * heads, axis=1))
    return None if abs(local - world) < 5.0 else local < world


def _walking(places: np.ndarray, seconds: np.ndarray, up: str, metre: float) -> np.ndarray:
    """Unit directions (n, 3) of the level way of the next half second; NaN where nobody walks."""
    out = np.full(places.shape, np.nan)
    step = np.median(np.diff(seconds)) if len(seconds) > 1 else np.nan
    if not step > 0:
        return out
    lag = max(1, min(round(_STEP / step), len(places) - 1))
    moved = (places[lag:] - places[:-lag]) * _level(up)
    taken = seconds[lag:] - seconds[:-lag]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = metre * length / taken
        walks = (speed > _WALK[0]) & (speed < _WALK[1]) & (taken < 4 * _STEP)
    out[:-lag][walks] = moved[walks] / length[walks, None]
    return out


def _level(up: str) -> np.ndarray:
    """One for each axis but the up one."""
    return (np.arange(3) != "xyz".index(up[-1])).astype(np.float64)
