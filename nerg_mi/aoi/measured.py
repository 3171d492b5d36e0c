"""Hits of gaze samples on AOIs, summed block by block over participants and cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.tables import unescape_formula
from nerg_mi.files.values import to_name
from nerg_mi.formats.boxes import Region
from nerg_mi.tracking.dataset import RayDataset
from nerg_mi.tracking.filters import argsort_by_person_time
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.tracking.rays import Rays, merge_rays
from nerg_mi.tracking.readers.columns import open_named_table

from .areas import AreaGroup
from .moving import MovingAreas, place_objects
from .placed import (
    HitAssignment,
    PlacedAreas,
    assign_hits,
    concatenate_hits,
    merge_directions,
    merge_members,
    sample_cone,
)
from .settings import TrackerError, VisitRules
from .shares import SamplePoints, VisibilityCache
from .tracker_error import Disturbance
from .validations import read_validation
from .visits import ALL, Cell, Visits, VisitSums, find_visits, join_cells, make_timeline, sum_visits

# ---- Cohorts ----

MAX_PARTICIPANTS = 10_000_000  # maximum number of participants in a table of cohorts


def read_cohorts(path: Path) -> dict[str, str]:
    """Read the cohort of each participant from a CSV file with columns ``person`` (or ``participant``) and ``cohort``.

    Rows without a name or a cohort, as at the end of many tables, are ignored. Raises `NergError` for missing columns,
    and for a participant in two cohorts.
    """
    cohorts: dict[str, str] = {}
    for block in open_named_table(path, (), ("person", "cohort"))[1]:
        for participant, cohort in (map(to_name, map(unescape_formula, row)) for row in block.texts.tolist()):
            if participant and cohort and cohorts.setdefault(participant, cohort) != cohort:
                raise NergError(f'"{path}" has "{sanitize(participant, 40)}" in two cohorts; remove one of them')
        if len(cohorts) > MAX_PARTICIPANTS:
            raise NergError(f'"{path}" names more than {MAX_PARTICIPANTS:,} participants; remove some')
    if not cohorts:
        raise NergError(
            f'"{path}" contains no participants; write the header person,cohort and one row per participant'
        )
    return cohorts


# ---- Sums of samples ----

BLOCK_SIZE = 1 << 17  # approximate number of samples of a block
_HIT_BATCH = 1 << 15


@dataclass(frozen=True)
class TimeWindow:
    """A time window from ``start`` (inclusive) to ``end`` (exclusive), in seconds on the clock of the samples."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class Counting:
    """Which visits are counted, and in which cells.

    Parameters
    ----------
    rules
        Definition of sessions and visits.
    windows, zones
        Time windows, and zones of the floor.
    cohorts
        File with the cohort of each participant (`read_cohorts`). None: the cohorts of the samples.
    aoi_visibility
        Whether the visibility of AOIs is analysed.
    fov
        Angle of the field of view in degrees.
    error
        Error of the eye tracker.
    validation
        File with the error of each participant (`read_validation`), which replaces ``error``.
    objects
        Poses of areas and shapes that move.
    """

    rules: VisitRules = VisitRules()
    windows: tuple[TimeWindow, ...] = ()
    zones: tuple[Region, ...] = ()
    cohorts: Path | None = None
    aoi_visibility: bool = False
    fov: float = 120.0
    error: TrackerError = TrackerError()
    validation: Path | None = None
    objects: ObjectPoses | None = None

    @property
    def has_error(self) -> bool:
        """Whether measures are corrected for the error of the tracker."""
        return self.validation is not None or self.error.accuracy > 0 or self.error.precision > 0

    @cached_property
    def disturbance(self) -> Disturbance:
        """The error of the tracker, by participant."""
        return Disturbance(self.error, {} if self.validation is None else read_validation(self.validation))


@dataclass(frozen=True, eq=False)
class AoiContext:
    """How gaze samples are assigned to areas and cells.

    Parameters
    ----------
    placed
        Areas in the environment that the samples are traced in.
    counting
        What is counted.
    use_hit_points
        Whether samples end at their recorded hit points, if surfaces are unknown.
    cohort_names
        Names of the cohorts of the samples, which a table of ``counting`` replaces.
    """

    placed: PlacedAreas
    counting: Counting
    use_hit_points: bool = False
    cohort_names: tuple[str, ...] = ()

    @cached_property
    def cohorts(self) -> dict[str, str]:
        """Cohort of each participant in the table; empty without one."""
        return {} if self.counting.cohorts is None else read_cohorts(self.counting.cohorts)

    @cached_property
    def visibility_cache(self) -> VisibilityCache | None:
        """Visibility of the AOIs; None if visibility is not analysed."""
        if not self.counting.aoi_visibility:
            return None
        placed, sampling = self.placed, self.placed.sampling
        targets = SamplePoints.sample(placed.aois, sampling.aoi_samples)
        return VisibilityCache(targets, placed.trace_depth, sampling.cell_size * placed.scale, placed.margin)

    @cached_property
    def moving(self) -> MovingAreas | None:
        """The areas as they move; None if nothing moves."""
        poses = self.counting.objects
        return None if poses is None else place_objects(self.placed, poses)

    @property
    def transition_areas(self) -> list[int]:
        """Indices of the areas between which transitions are counted."""
        return [k for k, area in enumerate(self.placed.areas.areas) if not isinstance(area, AreaGroup)]

    def cell_masks(self, rays: Rays, positions: np.ndarray) -> list[tuple[Cell, np.ndarray | None]]:
        """Return the cells with the masks (N,) of their samples; ``positions`` (N, 3) are the origins in the scene."""
        masks: list[tuple[Cell, np.ndarray | None]] = [(ALL, None)]
        for name in sorted(set(self.cohorts.values())) or self.cohort_names:
            masks.append((Cell("cohort", name), self._cohort_mask(rays, name)))
        for window in self.counting.windows:
            masks.append((Cell("window", window.name), (rays.t >= window.start) & (rays.t < window.end)))
        for zone in self.counting.zones:
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
        hits = merge_members(concatenate_hits(parts), self.placed.members)
        return HitAssignment(hits.count, hits.rows, tuple(d / self.placed.scale for d in hits.distance))

    def _assign_batch(self, rays: Rays, rows: slice) -> HitAssignment:
        placed, environment = self.placed, self.placed.environment
        o, d = environment.points_to_field(rays.origin[rows]), environment.directions_to_field(rays.direction[rows])
        hit_depth: np.ndarray | None = None
        if self.use_hit_points and rays.hit is not None:
            distance = np.linalg.norm(rays.hit[rows] - rays.origin[rows], axis=1) * placed.scale
            hit_depth = np.where(np.isfinite(distance), distance, np.inf)
        hits = []
        tolerance = placed.sampling.tolerance
        scene = None if self.moving is None else self.moving.at(rays.select(np.arange(len(rays))[rows]))
        for direction in sample_cone(d, tolerance) if tolerance > 0 else [d]:
            if scene is not None:
                hits.append(scene.assign_hits(o, direction, hit_depth))
                continue
            depth = environment.trace_depth(o, direction) if environment.has_surfaces else hit_depth
            hits.append(assign_hits(placed.aois, o, direction, depth, placed.margin))
        return hits[0] if len(hits) == 1 else merge_directions(hits)

    def visibility(self, rays: Rays) -> np.ndarray | None:
        """Return whether each area is visible to the participant of each sample, (N, A); None if visibility is not
        analysed."""
        if self.visibility_cache is None:
            return None
        environment, directions = self.placed.environment, facing_directions(rays)
        out = np.zeros((len(rays), len(self.placed.areas.names)), bool)
        for a in range(0, len(rays), _HIT_BATCH):
            part = slice(a, a + _HIT_BATCH)
            observers = environment.points_to_field(rays.origin[part])
            facing, fov = environment.directions_to_field(directions[part]), self.counting.fov
            if self.moving is None:
                visible = self.visibility_cache.visible_in_fov(observers, facing, fov)
            else:
                scene = self.moving.at(rays.select(np.arange(len(rays))[part]))
                visible = scene.find_visible(observers, facing, fov)
            for k, indices in enumerate(self.placed.members):
                out[part, k] = visible[:, list(indices)].any(axis=1)
        return out


def facing_directions(rays: Rays) -> np.ndarray:
    """Return the facing directions (N, 3): head directions, or gaze directions if head directions are unknown."""
    if rays.head is None:
        return rays.direction
    is_known = np.isfinite(rays.head).all(axis=1, keepdims=True)
    return np.where(is_known, rays.head, rays.direction)


def count_block(rays: Rays, context: AoiContext) -> VisitSums:
    """Sum the visits of a block of samples that contains whole sessions, sorted by participant and time.

    The result depends on the arguments only. `nerg_mi.aoi.visits.merge_sums` adds the results of the blocks in
    order.
    """
    hits = context.assign_hits(rays)
    cells = context.cell_masks(rays, context.placed.environment.points_to_field(rays.origin))
    names, rules = context.placed.areas.names, context.counting.rules
    recorded = sum_visits(rays, hits, names, cells, rules, context.visibility(rays), context.transition_areas)
    if not context.counting.has_error:
        return recorded
    parts = [recorded]
    for draw, disturbed in enumerate(context.counting.disturbance.draw(rays, rules), 1):
        of_draw = [(replace(cell, draw=draw), mask) for cell, mask in cells]
        parts.append(sum_visits(disturbed, context.assign_hits(disturbed), names, of_draw, rules, None, ()))
    return join_cells(parts)


def find_area_visits(rays: Rays, context: AoiContext) -> dict[str, Visits]:
    """Return the visits of each area by its name; ``first`` are indices of ``rays``."""
    order = argsort_by_person_time(rays)
    sorted_rays = rays if order is None else rays.select(order)
    names, rules = context.placed.areas.names, context.counting.rules
    timeline = make_timeline(sorted_rays.person, sorted_rays.t, rules)
    hits = context.assign_hits(sorted_rays)
    visits = [find_visits(np.sort(rows), timeline, rules) for rows in hits.rows]
    return {name: v if order is None else replace(v, first=order[v.first]) for name, v in zip(names, visits)}


def iter_blocks(source: Rays | RayDataset, rules: VisitRules, max_samples: int = BLOCK_SIZE) -> Iterator[Rays]:
    """Yield samples in blocks of about ``max_samples`` that contain whole sessions.

    Participants are sorted by name and their samples by time. The partition is deterministic. Raises `NergError` for
    samples that cannot be read.
    """
    if isinstance(source, RayDataset):
        data = source.require_single_place()
        parts = (
            ((source.id, part.day, part.bucket), rays)
            for source, part in data.parts
            for rays in replace(data, parts=((source, part),)).scan(whole_parts=True)
        )
        yield from _split_at_sessions(parts, rules, max_samples)
        return
    if not len(source):
        raise NergError("there are no gaze samples; import some, or relax the selection")
    yield from _split_at_sessions(iter([((), source)]), rules, max_samples)


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
        order = argsort_by_person_time(part)
        part = part if order is None else part.select(order)
        step = np.diff(part.t)
        is_start = (np.diff(part.person) != 0) | (step > rules.session_gap * (1 + 1e-9))
        boundaries = np.r_[0, np.flatnonzero(is_start) + 1, len(part)]
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
