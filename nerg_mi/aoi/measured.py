"""Hits of gaze samples on AOIs, summed block by block over participants and cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.values import to_name
from nerg_mi.formats.areas import Region
from nerg_mi.measures.shares import VisibilityCache
from nerg_mi.measures.visits import (
    ALL,
    Aoi,
    Cell,
    HitAssignment,
    VisitRules,
    Visits,
    VisitSums,
    assign_hits,
    concatenate_hits,
    find_visits,
    make_timeline,
    merge_directions,
    merge_members,
    sample_cone,
    sum_visits,
)
from nerg_mi.rays.dataset import RayDataset, is_dataset
from nerg_mi.rays.filters import argsort_by_person_time
from nerg_mi.rays.rays import Rays, merge_rays

from .scene import GazeScene

# ---- Sums of samples ----

BLOCK_SIZE = 1 << 17  # approximate number of samples of a block
_HIT_BATCH = 1 << 15


@dataclass(frozen=True)
class TimeWindow:
    """A time window from ``start`` (inclusive) to ``end`` (exclusive), in seconds on the clock of the samples."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class AoiContext:
    """How gaze samples are assigned to areas and cells.

    Parameters
    ----------
    gaze_scene
        Scene that the samples are traced in.
    aois
        Elementary AOIs.
    names
        Names of the areas.
    members
        Indices into ``aois`` of each area.
    transition_areas
        Indices of the areas between which transitions are counted.
    rules
        Definition of sessions and visits.
    margin
        Surface tolerance in scene units.
    tolerance
        Angular tolerance in degrees.
    use_hit_points
        Whether samples end at their recorded hit points, if surfaces are unknown.
    fov
        Angle of the field of view in degrees.
    visibility_cache
        Visibility of the AOIs; None if visibility is not analysed.
    windows, zones
        Time windows, and zones of the floor.
    cohorts
        Cohort of each participant; empty to use the cohorts of the samples.
    cohort_names
        Names of the cohorts.
    """

    gaze_scene: GazeScene
    aois: Sequence[Aoi]
    names: tuple[str, ...]
    members: Sequence[tuple[int, ...]]
    transition_areas: Sequence[int]
    rules: VisitRules
    margin: float
    tolerance: float = 0.0
    use_hit_points: bool = False
    fov: float = 360.0
    visibility_cache: VisibilityCache | None = None
    windows: Sequence[TimeWindow] = ()
    zones: Sequence[Region] = ()
    cohorts: dict[str, str] = field(default_factory=dict)
    cohort_names: tuple[str, ...] = ()

    def cell_masks(self, rays: Rays, positions: np.ndarray) -> list[tuple[Cell, np.ndarray | None]]:
        """Return the cells with the masks (N,) of their samples; ``positions`` (N, 3) are the origins in the scene."""
        masks: list[tuple[Cell, np.ndarray | None]] = [(ALL, None)]
        for name in self.cohort_names:
            masks.append((Cell("cohort", name), self._cohort_mask(rays, name)))
        for window in self.windows:
            masks.append((Cell("window", window.name), (rays.t >= window.start) & (rays.t < window.end)))
        for zone in self.zones:
            on_floor = np.column_stack([positions[:, :2], np.full(len(positions), zone.center[2])])
            masks.append((Cell("zone", zone.name), zone.contains(on_floor)))
        return masks

    def _cohort_mask(self, rays: Rays, name: str) -> np.ndarray:
        if self.cohorts:
            is_member = np.array([self.cohorts.get(to_name(person)) == name for person in rays.persons], bool)
            return is_member[rays.person]
        if rays.cohort is None or name not in rays.cohorts:
            return np.zeros(len(rays), bool)
        return rays.cohort == rays.cohorts.index(name)

    def assign_hits(self, rays: Rays) -> HitAssignment:
        """Assign samples to the areas that they hit; distances are in metres."""
        parts = [self._assign_batch(rays, slice(a, a + _HIT_BATCH)) for a in range(0, max(len(rays), 1), _HIT_BATCH)]
        hits = merge_members(concatenate_hits(parts), self.members)
        return HitAssignment(hits.count, hits.rows, tuple(d / self.gaze_scene.scale for d in hits.distance))

    def _assign_batch(self, rays: Rays, rows: slice) -> HitAssignment:
        scene = self.gaze_scene
        o, d = scene.transform_points(rays.origin[rows]), scene.transform_directions(rays.direction[rows])
        hit_depth: np.ndarray | None = None
        if self.use_hit_points and rays.hit is not None:
            distance = np.linalg.norm(rays.hit[rows] - rays.origin[rows], axis=1) * scene.scale
            hit_depth = np.where(np.isfinite(distance), distance, np.inf)
        hits = []
        for direction in sample_cone(d, self.tolerance) if self.tolerance > 0 else [d]:
            depth = hit_depth if scene.geometry is None else scene.trace_depth(o, direction)
            hits.append(assign_hits(self.aois, o, direction, depth, self.margin))
        return hits[0] if len(hits) == 1 else merge_directions(hits)

    def visibility(self, rays: Rays) -> np.ndarray | None:
        """Return whether each area is visible to the participant of each sample, (N, A); None if visibility is not
        analysed."""
        if self.visibility_cache is None:
            return None
        out = np.zeros((len(rays), len(self.names)), bool)
        for a in range(0, len(rays), _HIT_BATCH):
            part = slice(a, a + _HIT_BATCH)
            observers = self.gaze_scene.transform_points(rays.origin[part])
            point_visibility, cell = self.visibility_cache.get_visibility(observers)
            visible = self.visibility_cache.visible_in_fov(
                point_visibility[cell],
                observers,
                self.gaze_scene.transform_directions(facing_directions(rays)[part]),
                self.fov,
            )
            for k, indices in enumerate(self.members):
                out[part, k] = visible[:, list(indices)].any(axis=1)
        return out


def facing_directions(rays: Rays) -> np.ndarray:
    """Return the facing directions (N, 3): head directions, or gaze directions if head directions are unknown."""
    if rays.head is None:
        return rays.direction
    is_known = np.isfinite(rays.head).all(axis=1, keepdims=True)
    return np.where(is_known, rays.head, rays.direction)


def count_block(rays: Rays, context: AoiContext) -> VisitSums:
    """Sum the visits of a block of samples that contains whole sessions.

    The result depends on the arguments only. `nerg_mi.measures.visits.merge_sums` adds the results of the blocks in
    order.
    """
    hits = context.assign_hits(rays)
    cells = context.cell_masks(rays, context.gaze_scene.transform_points(rays.origin))
    return sum_visits(
        rays, hits, context.names, cells, context.rules, context.visibility(rays), context.transition_areas
    )


def find_area_visits(rays: Rays, context: AoiContext) -> dict[str, Visits]:
    """Return the visits of each area by its name; ``first`` are indices of ``rays``."""
    order = argsort_by_person_time(rays)
    sorted_rays = rays if order is None else rays.select(order)
    timeline = make_timeline(sorted_rays.person, sorted_rays.t, context.rules)
    hits = context.assign_hits(sorted_rays)
    visits = [find_visits(np.sort(rows), timeline, context.rules) for rows in hits.rows]
    return {name: v if order is None else replace(v, first=order[v.first]) for name, v in zip(context.names, visits)}


def iter_blocks(
    source: Rays | RayDataset | str | Path, rules: VisitRules, max_samples: int = BLOCK_SIZE
) -> Iterator[Rays]:
    """Yield the samples of a file or dataset in blocks of about ``max_samples`` that contain whole sessions.

    Participants are sorted by name and their samples by time. The partition is deterministic. Raises `NergError` for
    samples that cannot be read.
    """
    if isinstance(source, (str, Path)) and is_dataset(source):
        source = RayDataset.open(source)
    if isinstance(source, RayDataset):
        data = source.require_single_place()
        parts = (
            ((source.id, part.day, part.bucket), rays)
            for source, part in data.parts
            for rays in replace(data, parts=((source, part),)).scan(whole_parts=True)
        )
        yield from _split_at_sessions(parts, rules, max_samples)
        return
    rays = source if isinstance(source, Rays) else Rays.load(source)
    if not len(rays):
        raise NergError("there are no gaze samples; import some, or relax the selection")
    yield from _split_at_sessions(iter([((), rays)]), rules, max_samples)


def list_cohorts(source: Rays | str | Path, first: Rays) -> tuple[str, ...]:
    """Return the names of the cohorts of the samples; ``first`` is one block of them."""
    if not isinstance(source, Rays) and is_dataset(source):
        return tuple(sorted(RayDataset.open(source).cohorts))
    return tuple(sorted(first.cohorts))


def count_rays(source: Rays | str | Path) -> int:
    """Return the number of samples."""
    if isinstance(source, Rays):
        return len(source)
    return len(RayDataset.open(source)) if is_dataset(source) else len(Rays.load(source))


def _split_at_sessions(parts: Iterator[tuple[tuple, Rays]], rules: VisitRules, max_samples: int) -> Iterator[Rays]:
    """Split parts at session boundaries.

    Only parts with the same key may continue each other's sessions. The last session of a part is held back until the
    next part shows whether it continues.
    """
    pending: Rays | None = None
    pending_key: tuple = ()
    for key, part in parts:
        if pending is not None:
            if key == pending_key and pending.persons[pending.person[-1]] in part.persons:
                part = merge_rays([pending, part])
            else:
                yield pending
        pending_key = key
        part = _sort_rays(part)
        boundaries = _session_boundaries(part, rules)
        start = 0
        for a, b in zip(boundaries[:-1], boundaries[1:]):
            if b - start > max_samples and a > start:
                yield part.select(np.arange(start, a))
                start = int(a)
        last = int(boundaries[-2])
        if last > start:
            yield part.select(np.arange(start, last))
        pending = part.select(np.arange(last, len(part)))
    if pending is not None and len(pending):
        yield pending


def _sort_rays(rays: Rays) -> Rays:
    """Sort samples by participant and time. The names need not be sorted again."""
    order = argsort_by_person_time(rays)
    return rays if order is None else rays.select(order)


def _session_boundaries(rays: Rays, rules: VisitRules) -> np.ndarray:
    """Return the start rows of the sessions, followed by the number of samples."""
    step = np.diff(rays.t)
    is_start = (np.diff(rays.person) != 0) | (step > rules.session_pause * (1 + 1e-9))
    return np.r_[0, np.flatnonzero(is_start) + 1, len(rays)]


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """E viewpoints in the scene: ``positions`` and ``facing`` directions (E, 3), names of their participants, and
    the cells that each belongs to."""

    positions: np.ndarray
    facing: np.ndarray
    participants: tuple[str, ...]
    cells: tuple[frozenset[Cell], ...]


class ViewpointSampler:
    """Selects every n-th sample of a stream as a viewpoint, and at least one per block for each participant."""

    def __init__(self, stride: int):
        self._stride, self._num_passed = max(1, stride), 0
        self._poses: list[np.ndarray] = [np.zeros((0, 6))]
        self._participants: list[str] = []
        self._cells: list[frozenset[Cell]] = []
        self._interned: dict[frozenset[Cell], frozenset[Cell]] = {}

    def add(self, rays: Rays, context: AoiContext) -> None:
        """Select viewpoints from a block."""
        number = self._num_passed + np.arange(len(rays))
        is_chosen = number % self._stride == self._stride // 2
        order = np.argsort(rays.person, kind="stable")
        _, start, count = np.unique(rays.person[order], return_index=True, return_counts=True)
        has_none = ~np.logical_or.reduceat(is_chosen[order], start)
        is_chosen[order[(start + count // 2)[has_none]]] = True
        self._num_passed += len(rays)
        rows = np.flatnonzero(is_chosen)
        subset = rays.select(rows)
        positions, facing = (
            context.gaze_scene.transform_points(subset.origin),
            context.gaze_scene.transform_directions(facing_directions(subset)),
        )
        self._poses.append(np.hstack([positions, facing]))
        self._participants += [subset.persons[k] for k in subset.person.tolist()]
        cells = context.cell_masks(subset, positions)
        for k in range(len(rows)):
            row_cells = frozenset(cell for cell, mask in cells if mask is None or mask[k])
            self._cells.append(self._interned.setdefault(row_cells, row_cells))

    def viewpoints(self) -> Viewpoints:
        """Return all selected viewpoints."""
        poses = np.concatenate(self._poses)
        return Viewpoints(poses[:, :3], poses[:, 3:], tuple(self._participants), tuple(self._cells))
