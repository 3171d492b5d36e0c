"""Rays, block by block, as sums: what each lands on, what could be seen, and which cells it is of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.rays.dataset import RayDataset, is_dataset
from nerg_mi.rays.filters import argsort_by_person_time
from nerg_mi.rays.rays import Rays, merge_rays
from nerg_mi.statistics.shares import VisibilityCache
from nerg_mi.statistics.visits import (
    ALL,
    Aoi,
    Cell,
    HitAssignment,
    VisitRules,
    VisitSums,
    concatenate_hits,
    sample_cone,
    assign_hits,
    partial_sums,
    regroup,
    unite,
)

from .scene import GazeScene

# ---- Rays as sums ----

BLOCK = 1 << 17  # about so many rays are looked at at once
_LAND = 1 << 15


@dataclass(frozen=True)
class TimeWindow:
    """A time from ``start`` (inclusive) to ``end``, on the rays' clock, in seconds."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class AoiContext:
    """How rays are counted. ``names`` of the areas, and of which ``things`` each consists, ``members``; ``movable``:
    areas between which looks move; ``margin`` in units of the place; ``hits``: whether rays end at their hit points;
    ``view`` in degrees; ``cells_in_view``: None where it is not asked what could be seen."""

    gaze_scene: GazeScene
    aois: Sequence[Aoi]
    names: tuple[str, ...]
    members: Sequence[tuple[int, ...]]
    movable: Sequence[int]
    rules: VisitRules
    margin: float
    tolerance: float = 0.0
    hits: bool = False
    fov: float = 360.0
    visibility_cache: VisibilityCache | None = None
    windows: Sequence[TimeWindow] = ()
    zones: Sequence[Region] = ()
    cohorts: dict[str, str] = field(default_factory=dict)
    cohort_names: tuple[str, ...] = ()

    def cell_masks(self, rays: Rays, positions: np.ndarray) -> list[tuple[Cell, np.ndarray | None]]:
        """The cells with the rays that are of each; ``places`` (N, 3): where they start, in the place."""
        found: list[tuple[Cell, np.ndarray | None]] = [(ALL, None)]
        for name in self.cohort_names:
            found.append((Cell("cohort", name), self._of_cohort(rays, name)))
        for w in self.windows:
            found.append((Cell("window", w.name), (rays.t >= w.start) & (rays.t < w.end)))
        for zone in self.zones:
            on_floor = np.column_stack([positions[:, :2], np.full(len(positions), zone.center[2])])
            found.append((Cell("zone", zone.name), zone.contains(on_floor)))
        return found

    def _of_cohort(self, rays: Rays, name: str) -> np.ndarray:
        if self.cohorts:
            mine = np.array([self.cohorts.get(person) == name for person in rays.persons], bool)
            return mine[rays.person]
        if rays.cohort is None or name not in rays.cohorts:
            return np.zeros(len(rays), bool)
        return rays.cohort == rays.cohorts.index(name)

    def assign_hits(self, rays: Rays) -> HitAssignment:
        """What the rays are on, area by area; distances in metres."""
        parts = [self._land(rays, slice(a, a + _LAND)) for a in range(0, max(len(rays), 1), _LAND)]
        found = regroup(concatenate_hits(parts), self.members)
        return HitAssignment(found.count, found.rows, tuple(d / self.gaze_scene.scale for d in found.distance))

    def _land(self, rays: Rays, part: slice) -> HitAssignment:
        around = self.gaze_scene
        o, d = around.transform_points(rays.origin[part]), around.transform_directions(rays.direction[part])
        known: np.ndarray | None = None
        if self.hits and rays.hit is not None:
            away = np.linalg.norm(rays.hit[part] - rays.origin[part], axis=1) * around.scale
            known = np.where(np.isfinite(away), away, np.inf)
        ways = []
        for direction in sample_cone(d, self.tolerance) if self.tolerance > 0 else [d]:
            depth = known if around.geometry is None else around.trace_depth(o, direction)
            ways.append(assign_hits(self.aois, o, direction, depth, self.margin))
        return ways[0] if len(ways) == 1 else unite(ways)

    def visibility(self, rays: Rays) -> np.ndarray | None:
        """Which areas each ray's person could see then (N, A); None where that is not asked."""
        if self.visibility_cache is None:
            return None
        out = np.zeros((len(rays), len(self.names)), bool)
        for a in range(0, len(rays), _LAND):
            part = slice(a, a + _LAND)
            eyes = self.gaze_scene.transform_points(rays.origin[part])
            points, cell = self.visibility_cache.get_visibility(eyes)
            seen = self.visibility_cache.in_view(points[cell], eyes, self.gaze_scene.transform_directions(facing_directions(rays)[part]), self.fov)
            for k, of in enumerate(self.members):
                out[part, k] = seen[:, list(of)].any(axis=1)
        return out


def facing_directions(rays: Rays) -> np.ndarray:
    """Where people are turned (N, 3): their heads, or, where these are not known, their rays."""
    if rays.head is None:
        return rays.direction
    known = np.isfinite(rays.head).all(axis=1, keepdims=True)
    return np.where(known, rays.head, rays.direction)


def count_block(rays: Rays, context: AoiContext) -> VisitSums:
    """The partial sums of a block of rays that holds sittings as a whole: a pure function of its arguments, whose
    results `nerg_mi.statistics.visits.merge` adds up in the order of the blocks."""
    landed = context.assign_hits(rays)
    cells = context.cell_masks(rays, context.gaze_scene.transform_points(rays.origin))
    return partial_sums(rays, landed, context.names, cells, context.rules, context.visibility(rays), context.movable)


def iter_blocks(source: Rays | RayDataset | str | Path, rules: VisitRules, most: int = BLOCK) -> Iterator[Rays]:
    """The rays of a file, or of a dataset, in blocks of about ``most`` that hold sittings as a whole; persons sorted by
    name, and each one's rays by time. The same blocks every time. Raises `NergError` for rays that cannot be read."""
    if isinstance(source, (str, Path)) and is_dataset(source):
        source = RayDataset.open(source)
    if isinstance(source, RayDataset):
        data = source.require_single_place()
        parts = (
            ((source.id, part.day, part.bucket), rays)
            for source, part in data.parts
            for rays in replace(data, parts=((source, part),)).scan(whole_parts=True)
        )
        yield from _whole(parts, rules, most)
        return
    rays = source if isinstance(source, Rays) else Rays.load(source)
    if not len(rays):
        raise NergError("there are no rays to count; import some, or widen the conditions by which they were chosen")
    yield from _whole(iter([((), rays)]), rules, most)


def list_cohorts(source: Rays | str | Path, first: Rays) -> tuple[str, ...]:
    """The cohorts that rays have, of which ``first`` is a block."""
    if not isinstance(source, Rays) and is_dataset(source):
        return tuple(sorted(RayDataset.open(source).cohorts))
    return tuple(sorted(first.cohorts))


def count_rays(source: Rays | str | Path) -> int:
    """How many rays there are."""
    if isinstance(source, Rays):
        return len(source)
    return len(RayDataset.open(source)) if is_dataset(source) else len(Rays.load(source))


def _whole(parts: Iterator[tuple[tuple, Rays]], rules: VisitRules, most: int) -> Iterator[Rays]:
    """Parts, each with a key that those have in common which may go on with each other, cut where sittings end; what a
    part ends with is kept until it is known that the next does not go on with it."""
    held: Rays | None = None
    before: tuple = ()
    for key, part in parts:
        if held is not None:
            if key == before and held.persons[held.person[-1]] in part.persons:
                part = merge_rays([held, part])
            else:
                yield held
        before = key
        part = _sorted(part)
        ends = _ends(part, rules)
        start = 0
        for a, b in zip(ends[:-1], ends[1:]):
            if b - start > most and a > start:
                yield part.select(np.arange(start, a))
                start = int(a)
        last = int(ends[-2])
        if last > start:
            yield part.select(np.arange(start, last))
        held = part.select(np.arange(last, len(part)))
    if held is not None and len(held):
        yield held


def _sorted(rays: Rays) -> Rays:
    """In the order of persons and times; names are in their order already, or do not matter."""
    order = argsort_by_person_time(rays)
    return rays if order is None else rays.select(order)


def _ends(rays: Rays, rules: VisitRules) -> np.ndarray:
    """Where sittings begin, with 0 first and the number of rays last."""
    step = np.diff(rays.t)
    new = (np.diff(rays.person) != 0) | (step > rules.session_pause * (1 + 1e-9))
    return np.r_[0, np.flatnonzero(new) + 1, len(rays)]


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Where people stood, in the place: ``positions``, ``ahead`` (E, 3), whose they are, ``person`` (E,) names, and of
    which ``cells`` each is."""

    positions: np.ndarray
    ahead: np.ndarray
    participants: tuple[str, ...]
    cells: tuple[frozenset[Cell], ...]


class ViewpointSampler:
    """Takes every so manieth ray of a stream, and one of each block whose people would have none: of each a position, a
    direction, and whose and of which cells it is, which is less than what is counted of its person."""

    def __init__(self, stride: int):
        self._every, self._passed = max(1, stride), 0
        self._points: list[np.ndarray] = [np.zeros((0, 6))]
        self._person: list[str] = []
        self._cells: list[frozenset[Cell]] = []
        self._same: dict[frozenset[Cell], frozenset[Cell]] = {}

    def add(self, rays: Rays, context: AoiContext) -> None:
        """The chosen of a block."""
        number = self._passed + np.arange(len(rays))
        chosen = number % self._every == self._every // 2
        order = np.argsort(rays.person, kind="stable")
        _, start, count = np.unique(rays.person[order], return_index=True, return_counts=True)
        none = ~np.logical_or.reduceat(chosen[order], start)
        chosen[order[(start + count // 2)[none]]] = True
        self._passed += len(rays)
        rows = np.flatnonzero(chosen)
        some = rays.select(rows)
        at, turned = context.gaze_scene.transform_points(some.origin), context.gaze_scene.transform_directions(facing_directions(some))
        self._points.append(np.hstack([at, turned]))
        self._person += [some.persons[k] for k in some.person.tolist()]
        cells = context.cell_masks(some, at)
        for k in range(len(rows)):
            mine = frozenset(cell for cell, mask in cells if mask is None or mask[k])
            self._cells.append(self._same.setdefault(mine, mine))

    def viewpoints(self) -> Viewpoints:
        """All that were taken."""
        found = np.concatenate(self._points)
        return Viewpoints(found[:, :3], found[:, 3:], tuple(self._person), tuple(self._cells))
