"""What could be seen: things of which a point is in view, and in nobody's way; isovists for places without tracking.

A thing could be seen by somebody at p who is turned to f if one of its sample points s faces p (n · (p - s) > 0, where
it has an outside), lies within the view, (s - p) · f >= |s - p| cos(v / 2) for a view of v degrees, and no surface
stands before it. An isovist is the region that is seen from a point (Benedikt 1979); here its horizontal slice at eye
height, whose area is ½ Σ r² Δθ over directions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import LENGTHS, check_number

from .visits import Thing

Depth = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of origins and unit directions (N, 3): distance to the first surface (N,), infinite where there is none."""

SAMPLES = 48
"""Points of a thing that are looked for."""

_RAYS = 1 << 20


@dataclass(frozen=True)
class Targets:
    """Sample points of K things: ``points``, ``normals`` (S, 3), and whose they are, ``thing`` (S,)."""

    points: np.ndarray
    normals: np.ndarray
    thing: np.ndarray
    count: int

    @classmethod
    def of(cls, things: Sequence[Thing], samples: int = SAMPLES) -> Targets:
        found = [thing.samples(samples) for thing in things]
        who = np.repeat(np.arange(len(things)), [len(points) for points, _ in found])
        nothing = np.zeros((0, 3))
        points, normals = (np.concatenate([nothing, *(f[k] for f in found)]) for k in range(2))
        return cls(points, normals, who, len(things))


def unhidden(targets: Targets, eyes: np.ndarray, depth: Depth, margin: float) -> np.ndarray:
    """Which of the S points are seen from each of E ``eyes`` (E, 3), turned to wherever they like: (E, S). A surface
    may stand up to ``margin`` before a point and yet be its own."""
    out = np.zeros((len(eyes), len(targets.points)), bool)
    each = max(1, _RAYS // max(len(targets.points), 1))
    for a in range(0, len(eyes), each):
        eye = eyes[a : a + each]
        away = targets.points[None] - eye[:, None]
        distance = np.linalg.norm(away, axis=2)
        inside = np.einsum("esk,sk->es", away, targets.normals)
        flat = ~np.any(targets.normals != 0, axis=1)
        e, s = np.nonzero(((inside < 0) | flat) & (distance > 0))
        if len(e):
            met = depth(eye[e], away[e, s] / distance[e, s][:, None])
            out[a + e, s] = met >= distance[e, s] - margin
    return out


def in_view(targets: Targets, eyes: np.ndarray, ahead: np.ndarray, seen: np.ndarray, view: float) -> np.ndarray:
    """Whether any of the points of each of K things that are ``seen`` (N, S) lies within a ``view`` of so many degrees
    about the unit directions ``ahead`` (N, 3) of ``eyes`` (N, 3): (N, K)."""
    out = np.zeros((len(eyes), targets.count), bool)
    least = np.cos(np.radians(min(view, 360.0) / 2))
    starts = np.flatnonzero(np.r_[True, np.diff(targets.thing) != 0]) if len(targets.thing) else np.zeros(0, int)
    each = max(1, _RAYS // max(len(targets.points), 1))
    for a in range(0, len(eyes), each):
        part = slice(a, a + each)
        eye, f = eyes[part], ahead[part]
        # |s - p|² and (s - p) · f by products of matrices.
        along = f @ targets.points.T - np.einsum("nk,nk->n", f, eye)[:, None]
        square = (targets.points**2).sum(axis=1) - 2 * eye @ targets.points.T + (eye**2).sum(axis=1)[:, None]
        within = seen[part] & (along >= least * np.sqrt(np.maximum(square, 0)))
        if len(starts):
            out[part, targets.thing[starts]] = np.logical_or.reduceat(within, starts, axis=1)
    return out


class CellsInView:
    """What can be seen from where people stood, at the middles of cells of edge ``cell``, each traced once.

    Of very many cells those that are not asked for again are forgotten: what is said stays the same.
    """

    MOST = 1 << 28
    """Bytes of what is known of cells."""

    def __init__(self, targets: Targets, depth: Depth, cell: float, margin: float):
        check_number(cell, LENGTHS, "--cell")
        self._targets, self._depth, self._cell, self._margin = targets, depth, cell, margin
        self._known: dict[tuple[int, int, int], np.ndarray] = {}
        self.traced = 0

    def in_view(self, seen: np.ndarray, eyes: np.ndarray, ahead: np.ndarray, view: float) -> np.ndarray:
        """`in_view` of its things."""
        return in_view(self._targets, eyes, ahead, seen, view)

    def seen(self, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(points (C, S), cell (N,))``: which points are seen from the cells of N ``eyes``, and which is whose."""
        index = np.floor(eyes / self._cell).astype(np.int64)
        cells, of = np.unique(index, axis=0, return_inverse=True)
        keys = [tuple(key) for key in cells.tolist()]
        new = [k for k, key in enumerate(keys) if key not in self._known]
        if len(self._known) * len(self._targets.points) / 8 > self.MOST:
            self._known = {key: self._known[key] for key in keys if key in self._known}
        if new:
            found = unhidden(self._targets, (cells[new] + 0.5) * self._cell, self._depth, self._margin)
            self.traced += len(new)
            for k, row in zip(new, found):
                self._known[keys[k]] = np.packbits(row)
        bits = np.stack([self._known[key] for key in keys])
        return np.unpackbits(bits, axis=1, count=len(self._targets.points)).astype(bool), of.ravel()


@dataclass(frozen=True)
class Isovists:
    """At G places of the floor, ``points`` (G, 3) at eye height: ``area`` (G,) in square metres of the horizontal
    slice, its ``perimeter``, ``nearest``, ``farthest`` and mean (``radius``) reach, in metres; ``seen`` (G, K): share
    of the points of each thing that are seen, by somebody who turns round."""

    points: np.ndarray
    area: np.ndarray
    perimeter: np.ndarray
    nearest: np.ndarray
    farthest: np.ndarray
    radius: np.ndarray
    seen: np.ndarray


def standing(
    lower: np.ndarray, upper: np.ndarray, step: float, height: float, depth: Depth, floor: float
) -> np.ndarray:
    """Places (G, 3) on a grid at eye ``height`` above the ``floor`` where somebody can stand: what is below is the
    floor, and one is inside of nothing, which would end above at the height at which it begins from above."""
    sides = [np.arange(a + step / 2, b, step) for a, b in zip(lower[:2], upper[:2])]
    if not 0 < len(sides[0]) * len(sides[1]) <= 4_000_000:
        raise NergError(
            f"a grid of {step:g} m has {len(sides[0])} x {len(sides[1])} places here; choose another --step"
        )
    xy = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    eyes = np.column_stack([xy, np.full(len(xy), floor + height)])
    down, up = (np.tile(np.array([0.0, 0.0, s]), (len(eyes), 1)) for s in (-1.0, 1.0))
    below = depth(eyes, down)
    free = np.abs(below - height) < max(0.1, 0.05 * height)
    above = depth(eyes, up)
    top = np.column_stack([xy, np.full(len(xy), float(upper[2]) - 1e-3)])
    fall = depth(top, down)
    ends, begins = eyes[:, 2] + above, top[:, 2] - fall
    within = np.isfinite(above) & (ends < upper[2] - 0.05) & (np.abs(ends - begins) < 0.02)
    return eyes[free & ~within]


def isovists(
    points: np.ndarray, depth: Depth, targets: Targets, margin: float, reach: float, directions: int = 360
) -> Isovists:
    """Those of ``points`` (G, 3) by so many ``directions`` around; nothing is farther than ``reach``."""
    angle = 2 * np.pi * (np.arange(directions) + 0.5) / directions
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(directions)])
    r = np.empty((len(points), directions))
    each = max(1, _RAYS // directions)
    for a in range(0, len(points), each):
        part = points[a : a + each]
        met = depth(np.repeat(part, directions, axis=0), np.tile(around, (len(part), 1)))
        r[a : a + each] = np.minimum(met, reach).reshape(-1, directions)
    ends = r[:, :, None] * around[None, :, :2]
    perimeter = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).sum(axis=1)
    seen = unhidden(targets, points, depth, margin)
    count = np.bincount(targets.thing, minlength=targets.count)
    share = (
        np.stack([seen[:, targets.thing == k].sum(axis=1) / max(count[k], 1) for k in range(targets.count)], axis=1)
        if targets.count
        else np.zeros((len(points), 0))
    )
    area = 0.5 * (r**2).sum(axis=1) * (2 * np.pi / directions)
    return Isovists(points, area, perimeter, r.min(axis=1), r.max(axis=1), r.mean(axis=1), share)
