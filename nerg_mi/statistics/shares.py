"""Shares of observers' gaze on things, and what they could see.

A share is, of the integral over all directions, the part that ends on each.

A direction counts for a thing by the rule of `landing`: the first surface that the observer meets lies in the box, or
is the mesh or the shape. Sums are over directions of equal area on a golden spiral, and every thing is summed over as
many as its error asks for: of a finer spiral only those are looked along that cross the thing, so that small things
take no more than large ones, and things that ask for the same spiral share its directions. What a sum is a share of is
summed in the same way over the whole sphere, with what escapes and meets no surface.

Errors are those of the integral over an observer's sphere (`nerg_mi.transport.observer_gaze`): told from the
scatter of sums over every eighth direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.sphere import fibonacci_directions, indices_in_cone
from nerg_mi.ranges import LENGTHS, check_number
from nerg_mi.transport.observer_gaze import ERROR_PARTS, ERROR_EXPONENT

from .visits import Aoi, assign_hits, regroup

INITIAL_DIRECTIONS = 1 << 13  # directions over the sphere that are looked along first
MAX_DIRECTIONS = 1 << 20  # a spiral has so many directions over the sphere at most, a fifth of a degree apart
WHOLE = 1 << 17  # and if all of them are looked along
LEAST = 64  # so many directions cross a thing at least, where a spiral has them
MAX_AOI_DIRECTIONS = 1 << 14  # a thing that so many directions cross is summed over no more
_RAYS = 1 << 17
_SPHERE = 4 * math.pi

DirectionQuery = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | None]]
"""Of unit directions (N, 3): the gaze (M, N) of an observer in 1/sr, or in proportion to it, by each member of an
ensemble or by one field; and the distance (N,) of the surface that is met, infinite where there is none, or None where
no surfaces are known."""


@dataclass(frozen=True, eq=False)
class Shares:
    """Of E eyes and A areas: ``share`` (E, A) of the gaze, and the ``error`` (E, A) that it is likely to have at most;
    ``seen`` (E, A): whether any direction ends on the area;
    ``distance`` (E, A): the mean distance to the area, times the share; ``escaped`` (E,): the share that meets no
    surface, NaN where none are known; ``whole`` (E,): the integral of the gaze, of which these are shares; ``members``
    (M, E, A): the share by each member of an ensemble, by one field the same again."""

    share: np.ndarray
    error: np.ndarray
    is_hit: np.ndarray
    distance: np.ndarray
    escaped: np.ndarray
    integral: np.ndarray
    members: np.ndarray


@dataclass(frozen=True, kw_only=True)
class QuadratureRule:
    """How finely is summed: to an error of ``tolerance``, a share of what is summed, or of ``least``, a share of the
    gaze, over ``first`` directions around an eye or more."""

    rtol: float = 1e-2
    atol: float = 1e-5
    initial_directions: int = INITIAL_DIRECTIONS


COARSE = QuadratureRule(rtol=0.02, atol=5e-5)  # for many areas at once, or many eyes over which is averaged


def gaze_shares(
    make_gaze_evaluator: Callable[[np.ndarray], DirectionQuery],
    observers: np.ndarray,
    aois: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
    rule: QuadratureRule | None = None,
    on_eyes: Callable[[int], None] | None = None,
) -> Shares:
    """The shares of gaze that ``eyes`` (E, 3) give to areas, which consist of ``things`` by their numbers, ``members``.

    ``make_gaze_evaluator`` makes the look of an eye (3,); ``margin``: as of `visits.land`. ``on_eyes`` is told how many eyes are
    done, after some of them each time. Raises `NergError` where the gaze is not finite.
    """
    rule = rule or QuadratureRule()
    observers = np.asarray(observers, float)
    found: list[Shares] = []
    each = max(1, _RAYS // rule.initial_directions)
    for a in range(0, len(observers), each):
        some = observers[a : a + each]
        found.append(_Sums(make_gaze_evaluator, some, aois, members, margin, rule).shares())
        if on_eyes is not None:
            on_eyes(a + len(some))
    if not found:
        none = np.zeros((0, len(members)))
        return Shares(none, none, none.astype(bool), none, np.zeros(0), np.zeros(0), none[None])
    names = ("share", "error", "seen", "distance", "escaped", "whole")
    joined = {name: np.concatenate([getattr(f, name) for f in found]) for name in names}
    return Shares(**joined, members=np.concatenate([f.members for f in found], axis=1))


class _Sums:
    """Sums of some eyes. Column A of what is kept of A areas is the whole sphere."""

    def __init__(
        self,
        make_gaze_evaluator: Callable[[np.ndarray], DirectionQuery],
        eyes: np.ndarray,
        things: Sequence[Aoi],
        members: Sequence[tuple[int, ...]],
        margin: float,
        rule: QuadratureRule,
    ):
        self.make_gaze_evaluator, self.eyes, self.things, self.members = make_gaze_evaluator, eyes, things, members
        self.looks: dict[int, DirectionQuery] = {}
        self.margin, self.rule = margin, rule
        E, A = len(eyes), len(members)
        # Integrals over the parts of a spiral: of the mean density, and of members apart.
        self.parts: np.ndarray = np.zeros((1, E, A + 1, ERROR_PARTS))
        self.distance, self.escaped = np.zeros((E, A)), np.zeros(E)
        self.seen = np.zeros((E, A), bool)
        self.count = np.full((E, A + 1), rule.initial_directions)
        # Of an area the directions of the spiral that was last asked for.
        self._crossing: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
        for e in range(E):
            for a in range(A):
                self.count[e, a] = self._first_count(e, a)
        open_ = np.ones((E, A + 1), bool)
        while open_.any():
            for count in np.unique(self.count[open_]).tolist():
                self._sum(int(count), open_ & (self.count == count))
            open_ = self._refine(open_)

    def shares(self) -> Shares:
        value, error = self._integrals()
        whole = value[:, :, -1]
        if not np.isfinite(value).all():
            eye = self.eyes[np.flatnonzero(~np.isfinite(value).all(axis=(0, 2)))[0]]
            raise NergError(f"the gaze of the observer at {eye.tolist()} is not finite; place them within the scene")
        some = np.where(whole > 0, whole, 1)
        share = value[:, :, :-1] / some[:, :, None]
        relative = error / some[0, :, None]
        error = np.hypot(relative[:, :-1], share[0] * relative[:, -1:])
        members = share[1:] if len(share) > 1 else share
        distance, escaped = self.distance / some[0, :, None], self.escaped / some[0]
        return Shares(share[0], error, self.seen, distance, escaped, whole[0], members)

    def _integrals(self) -> tuple[np.ndarray, np.ndarray]:
        """``(value (M, E, A + 1), error (E, A + 1))``, the error of the mean density."""
        scatter = self.parts[0].std(axis=-1, ddof=1)
        return self.parts.mean(axis=-1), scatter * ERROR_PARTS**-ERROR_EXPONENT

    def _refine(self, open_: np.ndarray) -> np.ndarray:
        """Give more directions to those sums of ``open_`` (E, A + 1) that err by more than the tolerance, and say
        which these are."""
        value, error = self._integrals()
        enough = self.rule.rtol * np.abs(value[0]) + self.rule.atol * value[0, :, -1:]
        most = np.full(self.count.shape, MAX_DIRECTIONS)
        most[:, -1] = WHOLE
        more = open_ & (error > enough) & (self.count < most)
        for e, a in np.argwhere(more).tolist():
            # What is told falls nearly as their number grows.
            times = 1 << max(1, math.ceil(math.log2(error[e, a] / enough[e, a])))
            if a < len(self.members):
                crossing = max(1, len(self._numbers(int(self.count[e, a]), e, a)))
                times = min(times, MAX_AOI_DIRECTIONS // crossing)
            count = min(int(self.count[e, a]) * times, int(most[e, a]))
            more[e, a] = count > self.count[e, a]
            self.count[e, a] = count
        return more

    def _first_count(self, e: int, a: int) -> int:
        """Directions around an eye of which enough cross an area, or as many as may be."""
        count = self.rule.initial_directions
        while count < MAX_DIRECTIONS and (crossing := len(self._numbers(count, e, a))) < LEAST:
            count = min(MAX_DIRECTIONS, count << max(1, math.ceil(math.log2(LEAST / max(crossing, 0.5)))))
        return count

    def _numbers(self, count: int, e: int, a: int) -> np.ndarray:
        """Numbers of those of ``count`` directions around an eye that may be on an area."""
        if self._crossing.get((e, a), (0, None))[0] == count:
            return self._crossing[e, a][1]
        found = []
        for k in self.members[a]:
            center, radius = self.things[k].ball
            away = center - self.eyes[e]
            apart = float(np.linalg.norm(away))
            axis = away / apart if apart > 0 else np.array([0.0, 0.0, 1.0])
            numbers = indices_in_cone(count, axis, math.asin(min(radius / apart, 1.0)) if apart > radius else math.pi)
            d = fibonacci_directions(count, numbers)
            found.append(numbers[self.things[k].may_meet(np.broadcast_to(self.eyes[e], d.shape), d)])
        numbers = found[0] if len(found) == 1 else np.unique(np.concatenate(found))
        self._crossing[e, a] = count, numbers
        return numbers

    def _sum(self, count: int, wanted: np.ndarray) -> None:
        """Sum those of ``wanted`` (E, A + 1) over ``count`` directions around the eyes."""
        batch: list[_Looked] = []
        for e in np.flatnonzero(wanted.any(axis=1)).tolist():
            areas = np.flatnonzero(wanted[e, :-1]).tolist()
            among = {a: self._numbers(count, e, a) for a in areas}
            if wanted[e, -1]:
                numbers = np.arange(count)
            else:
                numbers = np.unique(np.concatenate(list(among.values())))
            d = fibonacci_directions(count, numbers)
            if not len(d):
                continue
            if e not in self.looks:
                self.looks[e] = self.make_gaze_evaluator(self.eyes[e])
            gaze, depth = self.looks[e](d)
            gaze = np.maximum(gaze, 0)
            gaze = np.concatenate([gaze.mean(axis=0)[None], gaze]) if len(gaze) > 1 else gaze
            rows = {a: np.searchsorted(numbers, n) for a, n in among.items()}
            batch.append(_Looked(e, numbers, d, gaze, depth, rows))
            if sum(len(b.numbers) for b in batch) >= _RAYS:
                self._add(count, batch, wanted)
                batch = []
        if batch:
            self._add(count, batch, wanted)

    def _add(self, count: int, batch: Sequence[_Looked], wanted: np.ndarray) -> None:
        E, A = len(self.eyes), len(self.members)
        gaze = np.concatenate([b.gaze for b in batch], axis=1)
        if len(gaze) != len(self.parts):
            self.parts = np.repeat(self.parts, len(gaze), axis=0)
        starts = np.cumsum([0, *(len(b.numbers) for b in batch)])
        eye = np.repeat([b.eye for b in batch], np.diff(starts))
        place = eye * ERROR_PARTS + np.concatenate([b.numbers for b in batch]) % ERROR_PARTS
        # Directions in each part of the spiral.
        size = (count - np.arange(ERROR_PARTS) + ERROR_PARTS - 1) // ERROR_PARTS
        part = lambda rows, w: (
            np.bincount(place[rows], w, E * ERROR_PARTS).reshape(E, ERROR_PARTS) * (_SPHERE / np.maximum(size, 1))
        )
        d = np.concatenate([b.directions for b in batch])
        known = batch[0].depth is not None
        depth = np.concatenate([b.depth for b in batch if b.depth is not None]) if known else None
        among: list[list[np.ndarray]] = [[] for _ in self.things]
        for b, start in zip(batch, starts):
            for a, rows in b.rows.items():
                for k in self.members[a]:
                    among[k].append(rows + start)
        which = [np.unique(np.concatenate(r)) if r else np.zeros(0, np.int64) for r in among]
        landed = regroup(assign_hits(self.things, self.eyes[eye], d, depth, self.margin, which), self.members)
        wanted = wanted & np.isin(np.arange(E), [b.eye for b in batch])[:, None]
        for a in np.flatnonzero(wanted[:, :A].any(axis=0)).tolist():
            mine, rows = wanted[:, a], landed.rows[a]
            for m, g in enumerate(gaze):
                self.parts[m, mine, a] = part(rows, g[rows])[mine]
            self.seen[eye[rows], a] = True
            self.distance[mine, a] = part(rows, gaze[0, rows] * landed.distance[a]).mean(axis=1)[mine]
        mine = wanted[:, A]
        if mine.any():
            every = np.arange(len(eye))
            for m, g in enumerate(gaze):
                self.parts[m, mine, A] = part(every, g)[mine]
            out = every[:0] if depth is None else np.flatnonzero(~np.isfinite(depth))
            self.escaped[mine] = np.nan if depth is None else part(out, gaze[0, out]).mean(axis=1)[mine]


@dataclass(frozen=True, eq=False)
class _Looked:
    """What the ``eye`` meets in ``directions`` with these ``numbers``; of areas the ``rows`` that may be on them."""

    eye: int
    numbers: np.ndarray
    directions: np.ndarray
    gaze: np.ndarray
    depth: np.ndarray | None
    rows: dict[int, np.ndarray]


# ---- What could be seen: things of which a point is in view, and in nobody's way; isovists without tracking ----
#
# A thing could be seen by somebody at p who is turned to f if one of its sample points s faces p (n · (p - s) > 0,
# where it has an outside), lies within the view, (s - p) · f >= |s - p| cos(v / 2) for a view of v degrees, and no
# surface stands before it. An isovist is the region that is seen from a point (Benedikt 1979); here its horizontal
# slice at eye height, whose area is ½ Σ r² Δθ over directions.

DepthQuery = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of origins and unit directions (N, 3): distance to the first surface (N,), infinite where there is none."""

POINTS_PER_AOI = 48  # points of a thing that are looked for
_SIGHTS = 1 << 20


@dataclass(frozen=True)
class SamplePoints:
    """Sample points of K things: ``points``, ``normals`` (S, 3), and whose they are, ``thing`` (S,)."""

    points: np.ndarray
    normals: np.ndarray
    aoi_index: np.ndarray
    num_aois: int

    @classmethod
    def sample(cls, aois: Sequence[Aoi], num_points: int = POINTS_PER_AOI) -> SamplePoints:
        found = [thing.sample_points(num_points) for thing in aois]
        who = np.repeat(np.arange(len(aois)), [len(points) for points, _ in found])
        nothing = np.zeros((0, 3))
        points, normals = (np.concatenate([nothing, *(f[k] for f in found)]) for k in range(2))
        return cls(points, normals, who, len(aois))


def unhidden(targets: SamplePoints, observers: np.ndarray, depth: DepthQuery, margin: float) -> np.ndarray:
    """Which of the S points are seen from each of E ``eyes`` (E, 3), turned to wherever they like: (E, S). A surface
    may stand up to ``margin`` before a point and yet be its own."""
    out = np.zeros((len(observers), len(targets.points)), bool)
    each = max(1, _SIGHTS // max(len(targets.points), 1))
    for a in range(0, len(observers), each):
        eye = observers[a : a + each]
        away = targets.points[None] - eye[:, None]
        distance = np.linalg.norm(away, axis=2)
        inside = np.einsum("esk,sk->es", away, targets.normals)
        flat = ~np.any(targets.normals != 0, axis=1)
        e, s = np.nonzero(((inside < 0) | flat) & (distance > 0))
        if len(e):
            met = depth(eye[e], away[e, s] / distance[e, s][:, None])
            out[a + e, s] = met >= distance[e, s] - margin
    return out


def visible_in_fov(targets: SamplePoints, observers: np.ndarray, ahead: np.ndarray, is_visible: np.ndarray, fov: float) -> np.ndarray:
    """Whether any of the points of each of K things that are ``seen`` (N, S) lies within a ``view`` of so many degrees
    about the unit directions ``ahead`` (N, 3) of ``eyes`` (N, 3): (N, K)."""
    out = np.zeros((len(observers), targets.num_aois), bool)
    least = np.cos(np.radians(min(fov, 360.0) / 2))
    starts = np.flatnonzero(np.r_[True, np.diff(targets.aoi_index) != 0]) if len(targets.aoi_index) else np.zeros(0, int)
    each = max(1, _SIGHTS // max(len(targets.points), 1))
    for a in range(0, len(observers), each):
        part = slice(a, a + each)
        eye, f = observers[part], ahead[part]
        # |s - p|² and (s - p) · f by products of matrices.
        along = f @ targets.points.T - np.einsum("nk,nk->n", f, eye)[:, None]
        square = (targets.points**2).sum(axis=1) - 2 * eye @ targets.points.T + (eye**2).sum(axis=1)[:, None]
        within = is_visible[part] & (along >= least * np.sqrt(np.maximum(square, 0)))
        if len(starts):
            out[part, targets.aoi_index[starts]] = np.logical_or.reduceat(within, starts, axis=1)
    return out


class VisibilityCache:
    """What can be seen from where people stood, at the middles of cells of edge ``cell``, each traced once.

    Of very many cells those that are not asked for again are forgotten: what is said stays the same.
    """

    MOST = 1 << 28
    """Bytes of what is known of cells."""

    def __init__(self, targets: SamplePoints, depth: DepthQuery, cell: float, margin: float):
        check_number(cell, LENGTHS, "--cell")
        self._targets, self._depth, self._cell, self._margin = targets, depth, cell, margin
        self._known: dict[tuple[int, int, int], np.ndarray] = {}
        self.traced = 0

    def in_view(self, is_visible: np.ndarray, observers: np.ndarray, ahead: np.ndarray, fov: float) -> np.ndarray:
        """`in_view` of its things."""
        return visible_in_fov(self._targets, observers, ahead, is_visible, fov)

    def get_visibility(self, observers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(points (C, S), cell (N,))``: which points are seen from the cells of N ``eyes``, and which is whose."""
        index = np.floor(observers / self._cell).astype(np.int64)
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
    visible_share: np.ndarray


def find_standing_positions(
    lower: np.ndarray, upper: np.ndarray, step: float, height: float, depth: DepthQuery, floor: float
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


def compute_isovists(
    points: np.ndarray, depth: DepthQuery, targets: SamplePoints, margin: float, max_distance: float, directions: int = 360
) -> Isovists:
    """Those of ``points`` (G, 3) by so many ``directions`` around; nothing is farther than ``reach``."""
    angle = 2 * np.pi * (np.arange(directions) + 0.5) / directions
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(directions)])
    r = np.empty((len(points), directions))
    each = max(1, _SIGHTS // directions)
    for a in range(0, len(points), each):
        part = points[a : a + each]
        met = depth(np.repeat(part, directions, axis=0), np.tile(around, (len(part), 1)))
        r[a : a + each] = np.minimum(met, max_distance).reshape(-1, directions)
    ends = r[:, :, None] * around[None, :, :2]
    perimeter = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).sum(axis=1)
    seen = unhidden(targets, points, depth, margin)
    count = np.bincount(targets.aoi_index, minlength=targets.num_aois)
    share = (
        np.stack([seen[:, targets.aoi_index == k].sum(axis=1) / max(count[k], 1) for k in range(targets.num_aois)], axis=1)
        if targets.num_aois
        else np.zeros((len(points), 0))
    )
    area = 0.5 * (r**2).sum(axis=1) * (2 * np.pi / directions)
    return Isovists(points, area, perimeter, r.min(axis=1), r.max(axis=1), r.mean(axis=1), share)
