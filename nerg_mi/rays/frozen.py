"""Gaze that stands still while the head does not: what trackers write that have lost the eyes."""

from __future__ import annotations

import numpy as np

from .rays import Rays
from .sessions import Sessions

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
