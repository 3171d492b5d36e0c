"""The frame of the directions, by walking: people look ahead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.rays.filters import time_order
from nerg_mi.rays.rays import Rays

from .figures import Figures, name_some, to_source

_AHEAD = 0.2  # correlation of gaze and walking along an axis
_WALKED = 1 << 19, 1 << 11  # rays looked at in runs of so many, where it matters which comes after which
_ALONE = 0.3, 500  # the same of one person, of whom more is needed
_STEPS = 200  # of half a second, from which on walking says something
_ONE_WAY, _ANY_WAY = 0.85, 0.5  # lengths of mean directions: of gaze that stays about one, of ways that do not


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of half a second of people who walk: W of them, along the axes of the file, without their heights."""

    way: np.ndarray  # (W, 3) unit
    gaze: np.ndarray  # (W, 3) of lengths up to one
    person: np.ndarray  # (W,)


def find_against_walking(figures: Figures) -> list[str]:
    """Directions that disagree with where people walk: of all of them or of some; reversed, mirrored, or staying
    where they are whichever way people walk."""
    rays = figures.rays
    steps = _find_steps(rays, figures.order, figures.frozen)
    if len(steps.way) < _STEPS:
        return []
    if rays.head is None and _stays(steps):
        return [
            "the directions stay about one direction of the file, whichever way people walk: are they in the head's "
            "frame? (--preset unity_local, or the head's pose in --map)"
        ]
    if found := _name_disagreement(_correlate(steps), "people", _AHEAD):
        return [found]
    by_person, stay = {}, []
    for p in np.flatnonzero(np.bincount(steps.person) >= _ALONE[1]):
        mine = steps.person == p
        own = _Steps(steps.way[mine], steps.gaze[mine], steps.person[mine])
        if rays.head is None and _stays(own):
            stay.append(rays.persons[p])
        elif found := _name_disagreement(_correlate(own), "{}", _ALONE[0]):
            by_person.setdefault(found, []).append(rays.persons[p])
    out = [text.replace("{}", name_some(names)) for text, names in by_person.items()]
    if stay:
        out.append(
            f"the directions of {name_some(stay)} stay about one direction of the file, whichever way they walk, and "
            "those of others do not: are they in the head's frame? (--preset unity_local, or the head's pose in --map)"
        )
    return out


def _name_disagreement(agree: np.ndarray, who: str, least: float) -> str:
    against = [i for i in range(3) if agree[i] < -least]
    along = [i for i in range(3) if agree[i] > _AHEAD]
    if against and not along:
        verb = "look back to where they came from"
        return f"{who} {verb}: are the directions reversed? (--forward, or the sign of the direction)"
    if against:
        return (
            f"along {' and '.join('xyz'[i] for i in against)} of the file {who} look away from where they walk: "
            "are positions and directions mirrored against each other? (--hand)"
        )
    return ""


def _stays(steps: _Steps) -> bool:
    """Whether gaze stays about one direction while people walk in many, and turns neither with them nor against."""
    length = np.maximum(np.linalg.norm(steps.gaze, axis=1, keepdims=True), 1e-12)
    gaze, way = steps.gaze / length, steps.way
    mean_gaze, mean_way = gaze.mean(axis=0), way.mean(axis=0)
    turns = _correlate(_Steps(way - mean_way, gaze - mean_gaze, steps.person))
    lengths = np.linalg.norm(mean_gaze), np.linalg.norm(mean_way)
    return bool(lengths[0] > _ONE_WAY and lengths[1] < _ANY_WAY and (np.abs(turns) < _AHEAD).all())


def walking_agreement(rays: Rays, order: np.ndarray | None = None) -> np.ndarray | None:
    """Correlation of gaze with walking along each axis of the file, (3,), 0 along the up axis; ``None`` where nobody
    walks.

    Steps of half a second, at 0.3 to 3 m/s. People look ahead: far above zero along each axis on which they walk.
    ``order``: `filters.time_order` of the rays, if it is known. Of millions of rays, runs of some thousands are looked
    at.
    """
    steps = _find_steps(rays, time_order(rays) if order is None else order)
    return None if len(steps.way) < _STEPS else _correlate(steps)


def _correlate(steps: _Steps) -> np.ndarray:
    v, d = steps.way, steps.gaze
    norm = np.sqrt((v**2).mean(axis=0) * (d**2).mean(axis=0))
    # An axis on which hardly anybody walks says nothing.
    share = (v**2).mean(axis=0)
    return np.where(share > 0.05, (v * d).mean(axis=0) / np.maximum(norm, 1e-12), 0.0)


def _find_steps(rays: Rays, order: np.ndarray | None, without: np.ndarray | None = None) -> _Steps:
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
    if without is not None:
        walks &= ~without[order[same]]
    R = to_source(rays)
    d = rays.direction[order[same]][walks] * (1, 1, 0)
    v = moved[walks] / np.linalg.norm(moved[walks], axis=1, keepdims=True)
    return _Steps(v @ R.T, d @ R.T, person[same][walks])


def _lag(t: np.ndarray, starts: np.ndarray) -> int:
    """Rays in half a second."""
    step = np.diff(t)
    step[starts[1:-1] - 1] = np.inf
    step = step[(step > 0) & (step <= 1.0)]
    # Times may lie so close together that the quotient is no index.
    return max(1, round(min(0.5 / np.median(step), len(t)))) if step.size else 1
