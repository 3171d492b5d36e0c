"""Generated recordings of people, and the mistakes that are planted in them, for `benchmarks/tracking_checks.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from nerg_mi.rays.checks.head import head_frames
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.rays.readers.frames import UNITY

import numpy as np

ROOM = np.array([9.0, 6.0, 3.0])  # metres
RATE = 50.0  # rays a second


def make_recording(people: int = 6, seconds: float = 150.0, seed: int = 0, unit: float = 1.0) -> Rays:
    """People who walk about in a room, from place to place, and look at points of its walls: their eyes jump every few
    tenths of a second, mostly to where they walk, and their heads follow. With hit points, heads and eye distances.

    ``unit``: of lengths, in metres, if it is taken for a metre.
    """
    rng = np.random.default_rng(seed)
    parts = [_make_person(rng, round(seconds * RATE)) for _ in range(people)]
    t, origin, d, hit, head = (np.concatenate([p[i] for p in parts]) for i in range(5))
    person = np.repeat(np.arange(people), [len(p[0]) for p in parts])
    names = tuple(f"p{i + 1}" for i in range(people))
    metadata = {
        "frame": dict(FRAME),
        "source_frame": UNITY.to_dict(),
        "transform": UNITY.to_rays().tolist(),
        "eye_distance": {name: float(rng.normal(0.063, 0.003)) / unit for name in names},
    }
    origin, hit = origin / unit, hit / unit
    return Rays(t, person, names, origin, d, np.ones(len(t)), hit, metadata=metadata, head=head)


def _make_person(rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    dt = 1.0 / RATE
    floor, at = np.empty((n, 2)), rng.uniform([1, 1], ROOM[:2] - 1)
    goal, wait, speed = at, 0, 0.0
    for i in range(n):
        if wait > 0:
            wait -= 1
        elif np.linalg.norm(goal - at) < 0.2:
            wait = int(rng.exponential(1.5) * RATE)
            goal, speed = rng.uniform([1, 1], ROOM[:2] - 1), rng.uniform(0.5, 1.1)
        else:
            at = at + speed * dt * (goal - at) / np.linalg.norm(goal - at)
        floor[i] = at
    sway = np.cumsum(rng.normal(0, 0.002, (n, 3)), axis=0)
    sway -= np.linspace(0, 1, n)[:, None] * sway[-1]
    height = rng.uniform(1.45, 1.75)
    origin = np.column_stack([_smooth(floor, 15), np.full(n, height)]) + 0.3 * sway
    ahead = np.gradient(_smooth(floor, 75), axis=0)
    # What is looked at: a point of the walls, for some tenths of a second.
    hit, i = np.empty((n, 3)), 0
    yaw = rng.uniform(-np.pi, np.pi)
    while i < n:
        lasts = max(8, int(rng.exponential(0.35) * RATE))
        if np.linalg.norm(ahead[i]) > 0.3 * dt:
            yaw = np.arctan2(ahead[i, 1], ahead[i, 0]) + rng.normal(0, 0.5)
        else:
            yaw += rng.normal(0, 0.5)
        pitch = rng.normal(-0.15, 0.15)
        hit[i : i + lasts] = _on_wall(
            origin[i], np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        )
        i += lasts
    d = hit - origin
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    head = _smooth(d, 25) + rng.normal(0, 0.001, (n, 3)) + (0, 0, 0.05)
    head /= np.linalg.norm(head, axis=1, keepdims=True)
    noisy = d + rng.normal(0, 0.003, (n, 3))
    return np.arange(n) * dt, origin, noisy / np.linalg.norm(noisy, axis=1, keepdims=True), hit, head


def _smooth(v: np.ndarray, rows: int) -> np.ndarray:
    padded = np.pad(v, ((rows, rows), (0, 0)), mode="edge")
    kernel = np.hanning(2 * rows + 1) / np.hanning(2 * rows + 1).sum()
    return np.stack([np.convolve(c, kernel, mode="valid") for c in padded.T], axis=1)


def _on_wall(origin: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Where a direction from within the room meets its walls, floor or ceiling."""
    with np.errstate(divide="ignore"):
        far = np.where(d > 0, (ROOM - origin) / d, -origin / d)
    return origin + d * far[np.abs(d) > 1e-9].min()


@dataclass(frozen=True)
class Mistake:
    """A mistake as people make it."""

    name: str
    check: str  # that names it
    plant: Callable[[Rays, np.ndarray], Rays]  # into the rays of a mask (N,) bool
    of: str = "rays people all"  # whether it befalls the last of everybody's rays, some of the people, or all
    head: bool = False  # whether it leaves no trace without heads


def last_rows(rays: Rays, share: float) -> np.ndarray:
    """The last ``share`` of each person's rays, (N,) bool."""
    out = np.zeros(len(rays), bool)
    for p in np.unique(rays.person):
        (mine,) = np.nonzero(rays.person == p)
        out[mine[round(len(mine) * (1 - share)) :]] = True
    return out


def last_people(rays: Rays, share: float) -> np.ndarray:
    """The rays of the last ``share`` of the people, of one at least, (N,) bool."""
    there = np.unique(rays.person)
    return np.isin(rays.person, there[-max(1, round(share * len(there))) :])


def _put(rays: Rays, mask: np.ndarray, **columns: np.ndarray) -> Rays:
    """``rays`` with other values in the rows of the mask."""
    new = {name: np.where(mask[:, None] if v.ndim > 1 else mask, v, getattr(rays, name)) for name, v in columns.items()}
    return replace(rays, **new)


def _own(rays: Rays) -> np.ndarray:
    """Directions in the head's frame: ahead, right and up."""
    return np.einsum("nij,nj->ni", head_frames(rays.head.astype(float)), rays.direction)


def _from_own(rays: Rays, own: np.ndarray) -> np.ndarray:
    return np.einsum("nij,ni->nj", head_frames(rays.head.astype(float)), own)


def _in_unity(rays: Rays) -> np.ndarray:
    """The head's frame as Unity has it, with right, up and ahead along the axes of the world, as rays have them."""
    ahead, right, up = _own(rays).T
    return np.column_stack([right, ahead, up])


def _held(rays: Rays, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """``values`` (N, 3) that stay what they are in the first row of the mask of each person."""
    out = values.copy()
    for p in np.unique(rays.person[mask]):
        mine = np.flatnonzero(mask & (rays.person == p))
        out[mine] = values[mine[0]]
    return out


def _scaled(factor: float) -> Callable[[Rays, np.ndarray], Rays]:
    def plant(rays: Rays, mask: np.ndarray) -> Rays:
        eyes = {
            name: d * (factor if mask[rays.person == p].all() else 1.0)
            for p, name in enumerate(rays.persons)
            if (d := rays.metadata.get("eye_distance", {}).get(name)) is not None
        }
        moved = {"hit": factor * rays.hit} if rays.hit is not None else {}
        changed = _put(rays, mask, origin=factor * rays.origin, **moved)
        return replace(changed, metadata={**rays.metadata, "eye_distance": eyes} if eyes else rays.metadata)

    return plant


def _moved(matrix: np.ndarray, shift: tuple[float, float, float] = (0, 0, 0)) -> Callable[[Rays, np.ndarray], Rays]:
    """All of it in another frame."""

    def plant(rays: Rays, mask: np.ndarray) -> Rays:
        columns = {"origin": rays.origin @ matrix.T + shift, "direction": rays.direction @ matrix.T}
        if rays.hit is not None:
            columns["hit"] = rays.hit @ matrix.T + shift
        if rays.head is not None:
            columns["head"] = rays.head @ matrix.T
        return _put(rays, mask, **columns)

    return plant


def _at_times(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[Rays, np.ndarray], Rays]:
    """Times by ``change`` of them and of where in its recording the mistake begins."""

    def plant(rays: Rays, mask: np.ndarray) -> Rays:
        start = np.zeros(len(rays.persons))
        for p in np.unique(rays.person[mask]):
            start[p] = rays.t[mask & (rays.person == p)].min()
        return _put(rays, mask, t=change(rays.t, start[rays.person]))

    return plant


def _twice(rays: Rays, mask: np.ndarray) -> Rays:
    return rays.select(np.r_[np.arange(len(rays)), np.flatnonzero(mask)])


def _one_name(rays: Rays, mask: np.ndarray) -> Rays:
    return replace(rays, person=np.where(mask, rays.person[0], rays.person))


def _sessions(rays: Rays, mask: np.ndarray) -> Rays:
    """A second recording of each, whose clock begins at the same time, and who walk elsewhere in it."""
    other = rays.select(mask)
    again = replace(other, origin=other.origin * (1, 1, 1) + (0.7, 0.4, 0), hit=None)
    columns = {
        name: np.concatenate([column, getattr(again, name)])
        for name, column in replace(rays, hit=None).columns().items()
    }
    return replace(rays, hit=None, **{k: v for k, v in columns.items() if k != "hit"})


_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])

_NEGATED = {axis: np.where(np.arange(3) == i, -1.0, 1.0) for i, axis in enumerate("xyz")}

MISTAKES = (
    Mistake("lengths in cm taken for m", "lengths", _scaled(100.0), "people all"),
    Mistake("lengths in mm taken for m", "lengths", _scaled(1000.0), "people all"),
    Mistake("units of 0.5 m taken for m", "eyes", _scaled(2.0), "people all"),
    Mistake("y up taken for z up", "lengths", _moved(_Y_UP), "people all"),
    Mistake("heights counted from a head", "lengths", _moved(np.eye(3), (0, 0, -1.6)), "people all"),
    Mistake("a frame turned by 90 degrees", "frames", _moved(_TURN), "people"),
    Mistake("a frame mirrored as a whole", "frames", _moved(np.diag([-1.0, 1, 1])), "people all"),
    Mistake("a frame 60 m away", "frames", _moved(np.eye(3), (60, 0, 0)), "people"),
    *(
        Mistake(
            f"{axis} of the directions negated",
            "directions",
            partial(lambda signs, r, m: _put(r, m, direction=r.direction * signs), signs),
        )
        for axis, signs in _NEGATED.items()
    ),
    Mistake("directions reversed", "directions", lambda r, m: _put(r, m, direction=-r.direction)),
    Mistake(
        "left and right of the eyes exchanged",
        "holding",
        lambda r, m: _put(r, m, direction=_from_own(r, _own(r) * (1, -1, 1))),
        head=True,
    ),
    Mistake(
        "up and down of the eyes exchanged",
        "holding",
        lambda r, m: _put(r, m, direction=_from_own(r, _own(r) * (1, 1, -1))),
        head=True,
    ),
    Mistake(
        "another axis of the head ahead", "head", lambda r, m: _put(r, m, direction=_from_own(r, _own(r)[:, [1, 0, 2]]))
    ),
    Mistake("gaze in the head taken for the world's", "head", lambda r, m: _put(r, m, direction=_in_unity(r))),
    Mistake("gaze in the world taken for the head's", "head", lambda r, m: _put(r, m, direction=_twice_turned(r))),
    Mistake("gaze frozen in the world", "frozen", lambda r, m: _put(r, m, direction=_held(r, r.direction, m))),
    Mistake(
        "gaze frozen in the head",
        "frozen",
        lambda r, m: _put(r, m, direction=_from_own(r, _held(r, _own(r), m))),
        head=True,
    ),
    Mistake(
        "the head's direction in place of gaze",
        "frozen",
        lambda r, m: _put(r, m, direction=r.head.astype(float)),
        head=True,
    ),
    Mistake(
        "the head's direction 0.06 s ago in place of gaze",
        "locked",
        lambda r, m: _put(r, m, direction=np.roll(r.head, round(0.06 * RATE), axis=0).astype(float)),
        "people all",
        head=True,
    ),
    Mistake("a clock set back by 20 s", "clocks", _at_times(lambda t, start: t - 20.0), "rays"),
    Mistake("a clock set ahead by an hour", "clocks", _at_times(lambda t, start: t + 3600.0), "rays"),
    Mistake("ms taken for s", "clocks", _at_times(lambda t, start: start + 1000.0 * (t - start))),
    Mistake("clocks that count from 1970", "clocks", _at_times(lambda t, start: t + 1.7e9), "people"),
    Mistake("files imported twice", "clocks", _twice, "people all"),
    Mistake("several people under one name", "clocks", _one_name, "people all"),
    Mistake("recordings that all begin at 0, under one name", "clocks", _sessions),
)


def _twice_turned(rays: Rays) -> np.ndarray:
    """Directions of the world, turned by the head as if they were in its frame, in Unity's way."""
    right, ahead, up = rays.direction.T
    return _from_own(rays, np.column_stack([ahead, right, up]))
